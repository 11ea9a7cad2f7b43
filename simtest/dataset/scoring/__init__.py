"""Scores answers that were made elsewhere: the truth of exported frames is rendered again from its seeds.

`record` keeps what was exported, `views` renders a run's or dataset's frames again, `frames` yields them by name,
`table_file` and `table` read a table of normals and check it, `answers` looks them up as an estimator does, `run` makes
a run's results of them. `dense` scores maps of normals or depths.
"""
