"""Factors of ripples and bends (docs/concepts/uncertainty.md), fitted to random fields of glints. See `__main__`."""
