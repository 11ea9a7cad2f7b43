"""The nightly: a profile's experiments are measured, judged and drawn, night after night.

`run` calls the three stages, each of which hands one record of `records` to the next:

    run = measure_run(...)      # experiments -> NightlyRun
    judged = judge(run, ...)    # `compare` against the baseline, history -> JudgedRun
    draw(judged, ...)           # reports, `page`, `outputs` (JSON, Markdown)

`compare` pairs the rows of the cells that differ, tests them (`contrasts`) for the `quantities` against their margins,
and corrects the p-values; the tests' error rates are measured (docs/measured/gate.md). `words` says in
sentences what was found. `store` names the folders, writes a run, keeps the history and accepts a baseline.
"""
