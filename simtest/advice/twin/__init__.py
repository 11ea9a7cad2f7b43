"""Twins of real highlights: rendered ones that look alike, whose normals are known, through the same reconstruction.

`patches` is the tissue that twins are made of, `scenes` draws what nobody told from its priors, `bank` renders frames
and scores each highlight in them, `matching` weighs the bank's highlights by their likeness to a real one, and `run` is
the whole for one picture. `writing` and `page` are what is written of it.
"""
