"""The gate: a run against the baseline, by tests whose error rates are measured (docs/gallery/gate_measured.md).

`compare.compare` is the way in. It hashes cells (`figures`), pairs the rows of differing ones (`pairing`,
`pairing_units`), tests them (`contrasts`, `pooling`) for the quantities of `quantities` against the margins of
`limits`, and corrects the p-values (`holm`). `missing_results`, `single_results`, `causes` and `notes` add what needs
no test.
"""
