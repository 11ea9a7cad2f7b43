"""Experiments: what is simulated, how estimates are measured against the truth, and what the laws predict.

`cases` expands an experiment into scenes, `runner` runs them in parts (`case_work`), and `realisation` makes one of
them: frame, detections and rows (`scoring`, `glints`, `columns`). `statistics` counts and sums up rows, `run_summary`
writes and reads what a run's summary.json says; `guide` names the best methods (`comparison`). `kept_frames` keeps some
frames for the page. `laws` are the closed-form errors, and `predicted` applies them to an estimate.
`paper/` is the published protocol; `references` and `depth_maps` compare with a given surface.
"""
