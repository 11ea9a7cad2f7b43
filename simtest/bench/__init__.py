"""The frozen benchmark: cases, seeds, run, certificate and table."""
