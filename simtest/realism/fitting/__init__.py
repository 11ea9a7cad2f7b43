"""Fits the ranges of a dataset recipe to real frames: `bank` renders over them, `inference` finds what frames have."""
