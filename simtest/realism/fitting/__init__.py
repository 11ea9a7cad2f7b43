"""Fits the distributions of a dataset recipe to real frames.

`parameters` says which ranges of a recipe can be fitted, `frames` renders frames of a recipe without their labels, and
`summaries` turns a frame's measured statistics into numbers that are near normal. `bank` holds such frames over the
whole ranges; `emulator` says from them what a frame of given parameters shows, and `inference` finds the parameters
that real frames have. `fit` is the whole, and `outcome` what is written of it.
"""
