"""Nights made from the rows of real runs: what the nightly page is timed and tested with.

Errors are real; later nights are the same figures with noise, as if each night's seeds were fresh. The verdicts are
made up to show all outcomes, so no figure of them means anything.
"""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from simtest.nightly.gate.records import COMPARISONS, FIGURES, PLACE, Night, Verdict
from simtest.runtime import provenance
from simtest.validation.statistics import figures

FIRST = datetime(2024, 2, 1, 2, 30, tzinfo=UTC)
UNITS = {"mean_deg": "deg", "median_deg": "deg", "p95_deg": "deg", "mean_penalised_deg": "deg", "coverage95": "share",
         "failed_rate": "share", "missed_rate": "share"}  # fmt: skip
MARGIN_DEG, MARGIN_SHARE = 0.002, 0.02


def night_of(rows: pl.DataFrame, started: datetime = FIRST, profile: str = "full") -> Night:
    """Give a night of some experiments' rows.

    Parameters
    ----------
    rows : polars.DataFrame
        results.parquet of one or more runs.
    started : datetime
        When.
    profile : str
        Its profile.

    Returns
    -------
    Night
    """
    table = [entry for place, own in rows.group_by(PLACE, maintain_order=True) for entry in _of_place(place, own)]
    made = pl.DataFrame([*table, *_canaries(), *_costs(rows)], schema=FIGURES)
    run = {"id": "made", "profile": profile, "started": started.isoformat(timespec="seconds"), "duration_s": 1234.5,
           "command": f"simtest nightly --profile {profile}", **provenance.environment()}  # fmt: skip
    return Night(run, rows, made)


def _of_place(place: tuple[Any, ...], rows: pl.DataFrame) -> list[dict[str, Any]]:
    found = figures(rows)
    n = found.n or 1
    failed = sum(found.n_failed_by_reason.values())
    values = vars(found) | {"failed_rate": failed / n, "missed_rate": found.n_missed / n}
    low, high = found.ci95_deg
    common = {**dict(zip(PLACE, place, strict=True)), "kind": "setting", "n": found.n}
    return [
        common | {"quantity": name, "unit": unit, "value": values[name], "low": low if name == "mean_deg" else None,
                  "high": high if name == "mean_deg" else None}
        for name, unit in UNITS.items()
        if values[name] is not None
    ]  # fmt: skip


def _canaries() -> list[dict[str, Any]]:
    made = (
        ("axis of a plane", "error_deg", "deg", 0.0031, 0.0, 0.01, "cone_axis on a noise-free plane"),
        ("noise hashes", "distinct hashes", "", 20.0, 20.0, 20.0, "20 realisations, 20 different noises"),
        ("far ellipse", "radius", "px", 3.21, 2.99, 3.01, "a circle of r = 3 px at (5000, 5000)"),
    )
    return [
        {"kind": "canary", "experiment": name, "quantity": quantity, "unit": unit, "value": value, "low": low,
         "high": high, "passed": low <= value <= high, "about": about}
        for name, quantity, unit, value, low, high, about in made
    ]  # fmt: skip


def _costs(rows: pl.DataFrame) -> list[dict[str, Any]]:
    names = rows["experiment"].unique(maintain_order=True).to_list()
    times = [
        {"kind": "cost", "experiment": name, "quantity": "run time", "unit": "×",
         "value": 10.0 * (i + 1), "low": 9.5 * (i + 1), "high": 10.5 * (i + 1)}
        for i, name in enumerate(names)
    ]  # fmt: skip
    return [*times, {"kind": "cost", "experiment": "all", "quantity": "peak memory", "unit": "MB", "value": 812.0}]


def history_of(night: Night, nights: int, seed: int = 0, noise: float = 0.05) -> pl.DataFrame:
    """Give a history that ends before a night: its figures, each night with noise of its own.

    Parameters
    ----------
    night : Night
        The last one, which is not part of what is given.
    nights : int
        How many.
    seed : int
        Of the noise.
    noise : float
        Standard deviation of a night's figure, share of it; places also drift slowly.

    Returns
    -------
    polars.DataFrame
        As the history's files hold it.
    """
    rng = np.random.default_rng(seed)
    held = night.figures.filter(pl.col("value").is_not_null())
    values = held["value"].to_numpy()
    last = datetime.fromisoformat(night.run["started"])
    drift = np.cumsum(rng.normal(0, 0.004, (nights, len(values))), axis=0)[::-1]
    parts = []
    for i in range(nights):
        started = last - timedelta(days=nights - i)
        factor = np.exp(drift[i] + rng.normal(0, noise, len(values)))
        commit = f"{rng.integers(2**48):012x}" if i % 3 == 0 or not parts else parts[-1]["commit"][0]
        run = {"run_id": f"night-{i:05d}", "commit": commit, "profile": night.run["profile"],
               "state": "regression" if rng.random() < 0.02 else "fine", "bit_equal": i % 3 != 0,
               "processor": "made up", "versions": "made up", "duration_s": 1200.0,
               "source_hash": "made up"}  # fmt: skip
        constants = [pl.lit(value).alias(name) for name, value in run.items()]
        own = held.with_columns(pl.Series("value", np.where(values == 0, 0.0, values * factor)))
        parts.append(own.with_columns(pl.lit(started).alias("started"), *constants))
    return pl.concat(parts) if parts else pl.DataFrame(schema=FIGURES)


def verdict_of(night: Night, seed: int = 0, state: str = "regression") -> Verdict:
    """Give a made-up verdict with every outcome; of state "fine", one where all is the same bytes."""
    rng = np.random.default_rng(seed)
    held = night.figures.filter((pl.col("kind") == "setting") & pl.col("value").is_not_null())
    rows = [
        _compared(row, rng if state == "regression" else None, i) for i, row in enumerate(held.iter_rows(named=True))
    ]
    comparisons = pl.DataFrame(rows, schema=COMPARISONS)
    notes = ("numpy: 2.4.5 at the baseline, 2.4.6 tonight: unpaired tests", "overview: 3 contours changed topology")
    started = datetime.fromisoformat(night.run["started"]) - timedelta(days=30)
    baseline = night.run | {"id": "base", "started": started.isoformat(), "reason": "first figures"}
    if state == "no baseline":
        return Verdict(state, None, comparisons.clear(), (), None)
    return Verdict(state, state == "fine", comparisons, notes if state == "regression" else (), baseline)


def _compared(row: dict[str, Any], rng: np.random.Generator | None, i: int) -> dict[str, Any]:
    value = row["value"]
    made = {name: row[name] for name in (*PLACE, "quantity", "unit", "n")} | {"baseline": value, "tonight": value}
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


def with_started(night: Night, started: datetime) -> Night:
    """Give the same night at another time."""
    return replace(night, run=night.run | {"started": started.isoformat(timespec="seconds")})
