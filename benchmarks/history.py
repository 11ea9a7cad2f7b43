"""The nightly's page over a history of 1,000 nights, generated from a real night with noise; some 2 minutes.

`python -m benchmarks.history DIR [PROFILE]` writes such reports to look at.
"""

import shutil
import sys
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.measuring import Figure
from simtest.nightly.baseline import accept
from simtest.nightly.gate.records import PLACE, Night, Verdict
from simtest.nightly.history import TREND_COLUMNS, TRENDS, append, history_rows, read_history
from simtest.nightly.layout import Reports
from simtest.nightly.run import judge, publish, run_nightly
from simtest.spec import load_profile

NIGHTS = 1000
LIMIT_S = 20.0

NOISE = 0.03
"""Relative standard deviation of a figure from night to night."""

STEP, STEPS = 0.05, 6
"""Relative standard deviation of lasting changes of one estimator's figures, and about how many there are."""


def figures() -> list[Figure]:
    """Generate, and time reading the history and writing the page."""
    with tempfile.TemporaryDirectory() as scratch:
        reports = Reports(Path(scratch))
        outcome = run_nightly(load_profile("quick"), reports, workers=2)
        accept(reports, "quick", "first night")
        generate(reports, outcome.night, NIGHTS)
        start = time.perf_counter()
        history, _ = read_history(reports.history, "quick", TREND_COLUMNS, TRENDS)
        read_s = time.perf_counter() - start
        verdict = judge(outcome.night, outcome.night)
        folder = reports.work / "page"
        folder.mkdir()
        start = time.perf_counter()
        target = publish(reports, folder, outcome.night, verdict, history)
        page_s = time.perf_counter() - start
        size = (target / "index.html").stat().st_size / 1e6
    about = f"{history.height} figures of {history['run_id'].n_unique()} nights"
    return [
        Figure(f"reading a history of {NIGHTS} nights", read_s, unit="s", about=about),
        Figure("reading it and writing the page", read_s + page_s, LIMIT_S, unit="s", about=f"page {page_s:.1f} s"),
        Figure("size of the page", size, 8.0, unit="MB"),
    ]


def generate(reports: Reports, night: Night, nights: int = NIGHTS, seed: int = 0) -> None:
    """Write a history of nights before a real one, a night a day, its figures disturbed.

    Parameters
    ----------
    reports : Reports
        Where the history lies.
    night : Night
        The real night.
    nights : int
        How many.
    seed : int
        Of the noise.
    """
    rng = np.random.default_rng(seed)
    last = datetime.fromisoformat(night.run["started"]).astimezone(UTC)
    estimators = night.figures["estimator"].unique().drop_nulls().sort().to_list()
    level = dict.fromkeys(estimators, 1.0)
    commit = f"{rng.integers(2**48):012x}"
    for number in range(nights):
        changed = rng.random() < 0.3
        if changed:
            commit = f"{rng.integers(2**48):012x}"
        worse = changed and rng.random() < STEPS / (0.3 * nights)
        if worse:
            level[str(rng.choice(estimators))] *= float(np.exp(rng.normal(0, STEP)))
        started = last - timedelta(days=nights - number, minutes=float(rng.uniform(0, 30)))
        run = night.run | {
            "id": f"{started:%Y%m%dT%H%M%SZ}-{number}-{rng.integers(2**32):08x}",
            "started": started.isoformat(timespec="seconds"),
            "commit": commit,
            "duration_s": float(night.run["duration_s"] * rng.lognormal(0, 0.1)),
        }
        factors = rng.lognormal(0, NOISE, night.figures.height)
        noisy = night.figures.with_columns(
            pl.col("value", "low", "high") * pl.Series(factors) * pl.col("estimator").replace_strict(level, default=1.0)
        )
        empty = pl.DataFrame(schema=dict.fromkeys(PLACE, pl.String()))
        verdict = Verdict("regression" if worse else "fine", not changed, empty, (), None)
        append(reports.history, history_rows(Night(run, night.rows, noisy), verdict))


def _main(folder: str, profile: str = "quick") -> None:
    """Run a night in a folder and put a history before it, then the page again."""
    reports, described = Reports(Path(folder)), load_profile(profile)
    outcome = run_nightly(described, reports, workers=2)
    accept(reports, described.name, "first night")
    generate(reports, outcome.night)
    history, _ = read_history(reports.history, described.name, TREND_COLUMNS, TRENDS)
    scratch = reports.work / "page"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    verdict = judge(outcome.night, outcome.night)
    print(publish(reports, scratch, outcome.night, verdict, history) / "index.html")


if __name__ == "__main__":
    _main(*sys.argv[1:])
