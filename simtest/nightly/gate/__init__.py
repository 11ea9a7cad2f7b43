"""The gate: a run against the baseline, by tests whose error rates are measured (docs/gallery/gate_measured.md).

`compare.compare` is the way in. It hashes cells (`figures`), pairs the rows of differing ones (`pairing`), tests them
(`contrasts`) for the `quantities` against their margins, and corrects the p-values. `single_results` adds what needs no
test, `findings` says in sentences what was found.
"""
