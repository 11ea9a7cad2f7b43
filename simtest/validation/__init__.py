"""Experiments: what is simulated, how estimates are measured against the truth, and what the laws predict.

`cases` expands an experiment into scenes, `runner` runs them in parts (`execution`), and `realisation` makes one of
them: frame, detections (`matching`) and rows (`metrics`, `columns`). `statistics` summarises rows, which
`row_kinds` counts; `guide` names the best methods (`comparison`). Some frames are kept for the page (`gallery_items`).
`laws` are the closed-form errors, and `predicted` applies them to an estimate.
`paper/` is the published protocol; `reference_surface` and `depth_maps` compare with a given surface.
"""
