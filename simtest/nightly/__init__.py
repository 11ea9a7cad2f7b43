"""The nightly: a profile's experiments are measured, judged and drawn, night after night.

`run` calls the three stages, each of which hands one record of `records` to the next:

    run = measure_run(...)      # measure: experiments -> NightlyRun
    judged = judge(run, ...)    # judge: gate/ against the baseline, history -> JudgedRun
    draw(judged, ...)           # draw: reports, page/, outputs/ (JSON, Markdown)

`storage` writes a run, `baseline` accepts one, `history` keeps the figures of all, `layout` names the folders.
"""
