"""The nightly: a profile's experiments are measured, judged and drawn, night after night.

`run` calls the three stages, each of which hands one record of `records` to the next:

    run = measure_run(...)      # experiments -> NightlyRun
    judged = judge(run, ...)    # gate/ against the baseline, history -> JudgedRun
    draw(judged, ...)           # reports, page/, `outputs` (JSON, Markdown)

`store` names the folders, writes a run and accepts a baseline, `history` keeps the figures of all.
"""
