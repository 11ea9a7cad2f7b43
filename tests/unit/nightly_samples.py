"""A small run, made without rendering, for the tests of the nightly."""

from datetime import UTC, datetime
from itertools import product

import polars as pl

from simtest.nightly.quantities import setting_figures
from simtest.nightly.records import CELL, COMPARISONS, JudgedRun, NightlyRun, RunRecord, Verdict
from simtest.validation.columns import SCHEMA

STARTED = datetime(2026, 3, 1, 2, 30, tzinfo=UTC)

RUN = {
    "id": "20260301T023000Z-7-0123abcd", "profile": "quick", "started": STARTED.isoformat(timespec="seconds"),
    "duration_s": 12.3, "command": "simtest nightly", "commit": "0123456789abcdef0123+", "version": "0.1.0",
    "versions": {"simtest": "0.1.0", "numpy": "2.4.6"}, "python": "3.11.9", "processor": "A processor",
    "system": "Linux", "source_hash": "ab" * 32, "variant": "llvm_ad_mono", "llvm": None,
}  # fmt: skip


SETTINGS = ("plane, tilt_deg=0", "plane, tilt_deg=5")


def make_rows(count=4, error_deg=1.0):
    made = [
        {
            "experiment": experiment, "label": "plane", "surface": "plane", "setting": setting, "realisation": number,
            "specularity": 0, "true_id": 0, "seed": 1000 * block + number, "estimator": estimator, "status": "ok",
            "error_deg": error_deg + 0.1 * number,
        }
        for block, (experiment, setting) in enumerate(product(("first", "second"), SETTINGS))
        for estimator in ("cone_axis", "circle_pose")
        for number in range(count)
    ]  # fmt: skip
    made[0] |= {"status": "missed", "error_deg": None, "specularity": None}
    made.append(made[-1] | {"true_id": None, "specularity": 1})
    return pl.DataFrame(made, schema=SCHEMA)


def make_run(record=None, rows=None):
    rows = make_rows() if rows is None else rows
    return NightlyRun(RunRecord(**{**RUN, **(record or {})}), rows, setting_figures(rows))


def compared(run, outcomes, **more):
    """Return comparisons of a run's cells, with outcomes in turn."""
    cells = run.figures.select(CELL).unique(maintain_order=True).rows()
    made = [
        dict(zip(CELL, cell, strict=True))
        | {"quantity": "mean_deg", "unit": "deg", "method": "paired", "n": 4, "baseline": 1.0, "tonight": 1.1,
           "difference": 0.1, "low": 0.05, "high": 0.15, "margin": 0.02, "p": 1e-6, "p_holm": 1e-4}
        | {"outcome": outcomes[i % len(outcomes)], **more}
        for i, cell in enumerate(cells)
    ]  # fmt: skip
    return pl.DataFrame(made, schema=COMPARISONS)


def regression(run, outcomes=("worse", "same", "better", "equivalent"), notes=(), **more):
    baseline = RunRecord(**RUN, reason="first")
    return Verdict("regression", False, compared(run, outcomes, **more), tuple(notes), baseline)


def no_baseline():
    return Verdict("no baseline", None, pl.DataFrame(schema=COMPARISONS), ("No baseline.",), None)


def judged(run, verdict):
    return JudgedRun(run, verdict, pl.DataFrame())
