"""Twins of real highlights: rendered ones that look alike, whose normals are known, through the same reconstruction.

`scenes` draws what nobody told from its priors, `bank` renders frames, `scoring` scores each highlight in them and
weighs them by their likeness to a real one, and `run` is the whole for one picture.
"""
