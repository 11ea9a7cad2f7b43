"""A trial of bands of glitter: the organ's normal where glints of any size lie densest.

`cells` counts the pixels that glint and those that could; `fit` adds gaussian bands to a flat background, by maximum
quasi-likelihood; `judge` says which bands carry a normal, how wide its region is, and why others are refused.
"""
