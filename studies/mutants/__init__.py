"""Planted faults, and who names them: canaries in seconds, then the quick profile's night by the gate.

`python -m studies.mutants` plants each fault of `catalogue.MUTANTS` alone, outside of the calling process, and prints
the table of docs/gallery/gate_measured.md.
"""
