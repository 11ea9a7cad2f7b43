"""Planted faults and the tests that catch them: `python -m studies.mutants --tests` (docs/gallery/gate_measured.md)."""
