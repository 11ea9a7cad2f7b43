"""Corpus `hard`: what the stated uncertainties are worth where pictures are as pictures are. See `__main__`."""
