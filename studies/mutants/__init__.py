"""Planted faults and the tests that catch them: `python -m studies.mutants --tests` (docs/measured/gate.md)."""
