"""The nightly's page over a history of 1,000 nights, generated from a real run with noise; some 2 minutes.

`python -m benchmarks.history DIR [PROFILE]` writes such reports to look at.
"""

import sys
import tempfile
import time
from datetime import timedelta
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.measuring import Figure
from simtest.nightly.baseline import accept
from simtest.nightly.history import TREND_COLUMNS, TRENDS, append, history_rows, read_history
from simtest.nightly.layout import Reports
from simtest.nightly.measure import RunOptions
from simtest.nightly.page import write_nightly_page
from simtest.nightly.records import COMPARISONS, JudgedRun, NightlyRun, Verdict
from simtest.nightly.run import run_nightly
from simtest.nightly.verdict import verdict_on
from simtest.spec import Profile, load_profile

NIGHTS = 1000
LIMIT_S = 20.0

NOISE = 0.03
"""Relative standard deviation of a figure from run to run."""

STEP, STEPS = 0.05, 6
"""Relative standard deviation of lasting changes of one estimator's figures, and about how many there are."""


def figures() -> list[Figure]:
    """Generate, and time reading the history and writing the page."""
    with tempfile.TemporaryDirectory() as scratch:
        reports = Reports(Path(scratch))
        run = _with_history(reports, load_profile("quick"))
        start = time.perf_counter()
        history, _ = read_history(reports.history, "quick", TREND_COLUMNS, TRENDS)
        read_s = time.perf_counter() - start
        judged = JudgedRun(run, verdict_on(run, run), history)
        start = time.perf_counter()
        page = write_nightly_page(reports.work / "page", judged)
        page_s = time.perf_counter() - start
        size = page.stat().st_size / 1e6
    about = f"{history.height} figures of {history['run_id'].n_unique()} nights"
    return [
        Figure(f"reading a history of {NIGHTS} nights", read_s, unit="s", about=about),
        Figure("reading it and writing the page", read_s + page_s, LIMIT_S, unit="s", about=f"page {page_s:.1f} s"),
        Figure("size of the page", size, 8.0, unit="MB"),
    ]


def _with_history(reports: Reports, profile: Profile) -> NightlyRun:
    """Make a run, accept it, and put a history before it."""
    run = run_nightly(profile, reports, RunOptions(workers=2)).judged.run
    accept(reports, profile.name, "first night")
    generate(reports, run)
    return run


def generate(reports: Reports, run: NightlyRun, nights: int = NIGHTS, seed: int = 0) -> None:
    """Write a history before a real run, a run a night, its figures disturbed.

    Parameters
    ----------
    reports : Reports
        Folders of the reports.
    run : NightlyRun
        The real run.
    nights : int
        How many.
    seed : int
        Of the noise.
    """
    rng = np.random.default_rng(seed)
    estimators = run.figures["estimator"].unique().drop_nulls().sort().to_list()
    level = dict.fromkeys(estimators, 1.0)
    commit = f"{rng.integers(2**48):012x}"
    for number in range(nights):
        changed = rng.random() < 0.3
        if changed:
            commit = f"{rng.integers(2**48):012x}"
        worse = changed and rng.random() < STEPS / (0.3 * nights)
        if worse:
            level[str(rng.choice(estimators))] *= float(np.exp(rng.normal(0, STEP)))
        started = run.record.start - timedelta(days=nights - number, minutes=float(rng.uniform(0, 30)))
        values = {
            "id": f"{started:%Y%m%dT%H%M%SZ}-{number}-{rng.integers(2**32):08x}",
            "started": started.isoformat(timespec="seconds"),
            "commit": commit,
            "duration_s": float((run.record.duration_s or 0.0) * rng.lognormal(0, 0.1)),
        }
        factors = rng.lognormal(0, NOISE, run.figures.height)
        noisy = run.figures.with_columns(
            pl.col("value", "low", "high") * pl.Series(factors) * pl.col("estimator").replace_strict(level, default=1.0)
        )
        verdict = Verdict("regression" if worse else "fine", not changed, pl.DataFrame(schema=COMPARISONS), (), None)
        disturbed = NightlyRun(run.record.model_copy(update=values), run.rows, noisy)
        append(reports.history, history_rows(disturbed, verdict))


def _main(folder: str, profile: str = "quick") -> None:
    """Make a run with a history in a folder, then its page again."""
    reports, described = Reports(Path(folder)), load_profile(profile)
    run = _with_history(reports, described)
    history, _ = read_history(reports.history, described.name, TREND_COLUMNS, TRENDS)
    print(write_nightly_page(reports.latest(described.name), JudgedRun(run, verdict_on(run, run), history)))


if __name__ == "__main__":
    _main(*sys.argv[1:])
