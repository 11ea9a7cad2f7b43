"""The scripts behind the manual's tables and figures, each run by one command: `python -m studies.NAME`."""
