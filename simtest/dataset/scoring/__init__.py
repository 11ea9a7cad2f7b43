"""Scores answers that were made elsewhere: the truth of exported frames is rendered again from its seeds.

`frames` renders a run's or dataset's frames again, and keeps what was exported of them; `answers` reads a table of
normals, checks it, and gives them as an estimator's; `score` makes a run's results of them. `dense` scores maps of
normals or depths.
"""
