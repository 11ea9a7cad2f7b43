"""Planted faults, and who names them: canaries in seconds, then the quick profile's night by the gate.

`python -m studies.mutants` plants each fault of `catalogue.MUTANTS` alone, in a process of its own, and prints the
table of docs/gate.md.
"""
