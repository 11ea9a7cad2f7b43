"""The factors of ripples and bends (docs/uncertainty.md), fitted to random fields of glints. See `__main__`."""
