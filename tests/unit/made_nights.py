"""Runs made from the rows of real experiments: what the nightly page is timed and tested with.

Errors are real; later runs are the same figures with noise, as if each night's seeds were fresh. The verdicts are
made up to show all outcomes, so no figure of them means anything.
"""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from simtest.nightly.quantities import setting_figures
from simtest.nightly.records import CELL, COMPARISONS, NightlyRun, RunRecord, Verdict
from simtest.nightly.store import HISTORY, TREND_COLUMNS, trend_rows
from simtest.runtime import provenance

FIRST = datetime(2024, 2, 1, 2, 30, tzinfo=UTC)
MARGIN_DEG, MARGIN_SHARE = 0.002, 0.02


def run_of(rows: pl.DataFrame, started: datetime = FIRST, profile: str = "full") -> NightlyRun:
    """Make a run of some experiments' rows.

    Parameters
    ----------
    rows : polars.DataFrame
        results.parquet of one or more experiments.
    started : datetime
        When.
    profile : str
        Its profile.

    Returns
    -------
    NightlyRun
    """
    record = RunRecord(
        id="made", profile=profile, started=started.isoformat(timespec="seconds"), duration_s=1234.5,
        command=f"simtest nightly --profile {profile}", **provenance.environment(),
    )  # fmt: skip
    return NightlyRun(record, rows, setting_figures(rows))


def history_of(run: NightlyRun, runs: int, seed: int = 0, noise: float = 0.05) -> pl.DataFrame:
    """Make a history that ends before a run: its figures, each earlier run with noise of its own.

    Parameters
    ----------
    run : NightlyRun
        The last one, which is not part of the history.
    runs : int
        How many.
    seed : int
        Of the noise.
    noise : float
        Standard deviation of a run's figure, share of it; cells also drift slowly.

    Returns
    -------
    polars.DataFrame
        As `read_history` returns it.
    """
    rng = np.random.default_rng(seed)
    held = run.figures
    values = held["value"].to_numpy()
    drift = np.cumsum(rng.normal(0, 0.004, (runs, len(values))), axis=0)[::-1]
    parts: list[pl.DataFrame] = []
    for i in range(runs):
        started = run.record.start - timedelta(days=runs - i)
        factor = np.exp(drift[i] + rng.normal(0, noise, len(values)))
        commit = f"{rng.integers(2**48):012x}" if i % 3 == 0 or not parts else parts[-1]["commit"][0]
        constants = {"run_id": f"night-{i:05d}", "commit": commit, "started": started,
                     "state": "regression" if rng.random() < 0.02 else "fine"}  # fmt: skip
        own = held.with_columns(pl.Series("value", np.where(values == 0, 0.0, values * factor)))
        parts.append(trend_rows(own.with_columns(pl.lit(value).alias(name) for name, value in constants.items())))
    return pl.concat(parts) if parts else pl.DataFrame(schema=HISTORY).select(TREND_COLUMNS)


def verdict_of(run: NightlyRun, seed: int = 0, state: str = "regression") -> Verdict:
    """Make up a verdict with every outcome; of state "fine", one where all is the same bytes."""
    rng = np.random.default_rng(seed)
    held = run.figures
    rows = [
        _compared(row, rng if state == "regression" else None, i) for i, row in enumerate(held.iter_rows(named=True))
    ]
    comparisons = pl.DataFrame(rows, schema=COMPARISONS)
    notes = ("numpy: 2.4.5 at the baseline, 2.4.6 tonight: unpaired tests", "overview: 3 contours changed topology")
    started = (run.record.start - timedelta(days=30)).isoformat()
    baseline = run.record.model_copy(update={"id": "base", "started": started, "reason": "first figures"})
    if state == "no baseline":
        return Verdict(state, None, comparisons.clear(), (), None)
    return Verdict(state, state == "fine", comparisons, notes if state == "regression" else (), baseline)


def _compared(row: dict[str, Any], rng: np.random.Generator | None, i: int) -> dict[str, Any]:
    value = row["value"]
    made = {name: row[name] for name in (*CELL, "quantity", "unit", "n")} | {"baseline": value, "tonight": value}
    if rng is None:
        return made | {"method": "equal", "difference": 0.0, "outcome": "same"}
    margin = max(MARGIN_DEG, MARGIN_SHARE * abs(value))
    planted = {7: ("worse", 4.0), 19: ("worse", 2.5), 23: ("better", -3.0), 31: ("undecided", 1.1)}.get(i % 97)
    if i % 97 in (40, 41):
        gone = i % 97 == 40
        return made | {"method": "none", "outcome": "gone" if gone else "new", "tonight" if gone else "baseline": None}
    outcome, size = planted or ("equivalent", float(rng.uniform(-0.5, 0.5)))
    difference = size * margin
    half = margin * 0.4
    p = 1e-7 if outcome == "worse" else 0.8
    return made | {
        "method": "paired", "baseline": value - difference, "difference": difference, "low": difference - half,
        "high": difference + half, "margin": margin, "p": p, "p_holm": min(1.0, p * 500), "outcome": outcome,
    }  # fmt: skip
