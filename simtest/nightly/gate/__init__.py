"""The gate: a run against the baseline, by tests whose error rates are measured (docs/gallery/gate_measured.md).

`compare.compare` is the way in: it pairs the rows of the cells that differ, tests them (`contrasts`) for the
`quantities` against their margins, corrects the p-values, and adds single results, which need no test. `findings` says
in sentences what was found.
"""
