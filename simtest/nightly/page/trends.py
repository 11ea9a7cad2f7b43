"""The figures of many nights, packed so that a page can hold them.

A curve is one quantity of one estimator in one setting. Where there are more nights than a curve may have points, the
newest are all kept; the older ones are cut into stretches, and of each the lowest and the highest are kept, so that no
peak is lost. Values are stored as 16 bits between the curve's own least and largest, and all are packed by zlib.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.nightly.phrases import short_commit
from simtest.nightly.records import CELL, NightlyRun
from simtest.runtime.arrays import Array, Mask

NIGHT_COLUMNS = ("run_id", "started", "commit", "state")
HISTORY_COLUMNS = ("kind", *CELL, "quantity", "unit", "value", *NIGHT_COLUMNS, "profile")
"""All that the page reads of the history; a history of other columns may leave the rest out."""

BUDGET_BYTES = 2_800_000  # most that the curves may take in the page
MOST_POINTS = 500  # most points of a curve: more cannot be told apart on a screen
NEWEST = 30  # nights that are all kept

LEAST_POINTS = NEWEST + 20
"""Points that every curve has; where there is no room for them, the oldest nights are left out."""

COSTS, MEDIAN = "run time and memory", "median over all settings"
_KEY = ("kind", *CELL, "quantity", "unit")
_KINDS = ("setting", "cost", "ladder")
LEFT_OUT = 65535  # code of a night that a curve has no point at
_NAMES_BYTES, _NIGHT_BYTES = 45, 50  # what a curve's names and ends, and a night's, take


@dataclass(frozen=True)
class Trends:
    """The curves of a page."""

    data: dict[str, Any]  # JSON that the page's script unpacks
    nights: int  # that are shown
    left_out: int  # older ones that there was no room for
    points: int  # most points of a curve; fewer than `nights` where the curves are thinned


def trends(history: pl.DataFrame, night: NightlyRun, budget: int = BUDGET_BYTES) -> Trends | None:
    """Pack the history of a night's profile, the night included, into a number of bytes.

    The history holds rows of the history's files, `HISTORY_COLUMNS` at least; it may be empty, and may hold the night
    already. Returns None where no night has a figure.
    """
    rows = _held(history, night)
    if rows.is_empty():
        return None
    rows, nights = _numbered(rows)
    keys, values = _matrix(rows, nights.height)
    keys, values = _with_medians(_named(keys), values)
    shown = _room(values, budget)
    left_out = nights.height - shown
    values, nights = values[:, left_out:], nights.slice(left_out)
    seen = np.asarray(np.isfinite(values).any(axis=1))
    keys, values = keys.filter(seen), values[seen]
    points = _points(values, budget)
    return Trends(_packed(keys, values, _thinned(values, points), nights), shown, left_out, points)


def _held(history: pl.DataFrame, night: NightlyRun) -> pl.DataFrame:
    """Return the numbers of all nights of the profile, `HISTORY_COLUMNS`, a night's rows together."""
    run = night.record
    parts = []
    if not history.is_empty():
        past = history.select(HISTORY_COLUMNS).filter(pl.col("profile") == run.profile)
        parts.append(past.with_columns(pl.col("started").cast(_TIME)))
    if not parts or not (parts[0]["run_id"] == run.id).any():
        own = {"run_id": run.id, "commit": run.commit, "state": None, "profile": run.profile}
        started = run.start
        constants = [pl.lit(value, pl.String).alias(name) for name, value in own.items()]
        tonight = night.figures.with_columns(pl.lit(started).cast(_TIME).alias("started"), *constants)
        parts.append(tonight.select(HISTORY_COLUMNS))
    return pl.concat(parts).filter(pl.col("kind").is_in(_KINDS) & pl.col("value").is_finite())


_TIME = pl.Datetime("us", "UTC")


def _numbered(rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Add the number of the night, by time, to the rows; returns them and the nights."""
    # Runs of equal names are found at a fraction of what a join on millions of names takes.
    stretch = rows["run_id"].rle_id()
    starts = np.flatnonzero(np.diff(stretch.to_numpy(), prepend=-1))
    firsts = rows.select(NIGHT_COLUMNS)[starts.tolist()]
    nights = firsts.unique("run_id").sort("started", "run_id").with_row_index("night")
    place = firsts.join(nights.select("run_id", "night"), on="run_id", how="left", maintain_order="left")["night"]
    return rows.with_columns(pl.Series("night", place.to_numpy()[stretch.to_numpy()])), nights


def _matrix(rows: pl.DataFrame, nights: int) -> tuple[pl.DataFrame, Array]:
    """Return the curves' keys and their values, shape (curves, nights); NaN where a night has none."""
    groups = rows.group_by(_KEY, maintain_order=True).agg("night", "value")
    values = np.full((groups.height, nights), np.nan)
    index = np.repeat(np.arange(groups.height), groups["night"].list.len().to_numpy())
    values[index, groups["night"].explode().to_numpy()] = groups["value"].explode().to_numpy()
    return groups.select(_KEY), values


def _named(keys: pl.DataFrame) -> pl.DataFrame:
    """Name the curves: costs stand together, each experiment a curve."""
    cost = pl.col("kind") == "cost"
    # A name that does not apply is null or empty.
    keys = keys.with_columns(pl.col(pl.String).replace("", None))
    named = keys.with_columns(
        estimator=pl.coalesce("estimator", pl.when(cost).then("experiment"), pl.lit("all")),
        experiment=pl.when(cost).then(pl.lit(COSTS)).otherwise(pl.coalesce("experiment", pl.lit("all"))),
        setting=pl.coalesce("setting", "label", pl.lit("all")),
        unit=pl.col("unit").fill_null(""),
        quantity=pl.col("quantity").fill_null(""),
    )
    # The surface tells settings apart that share a name.
    several = pl.col("surface").n_unique().over("experiment", "setting") > 1
    setting = pl.when(several).then(pl.format("{}, {}", "setting", "surface"))
    return named.with_columns(setting=pl.coalesce(setting, "setting"))


def _with_medians(keys: pl.DataFrame, values: Array) -> tuple[pl.DataFrame, Array]:
    """Put before the curves those of the median over an experiment's settings, where it has several."""
    names = ["experiment", "estimator", "quantity", "unit"]
    groups = keys.with_row_index("row").group_by(names, maintain_order=True).agg("row", "kind")
    groups = groups.filter(pl.col("row").list.len() > 1)
    if groups.is_empty():
        return keys.select(*names, "setting"), values
    medians = np.array([_median(values[rows]) for rows in groups["row"].to_list()])
    made = groups.select(*names, pl.lit(MEDIAN).alias("setting"))
    return pl.concat([made, keys.select(*names, "setting")]), np.concatenate([medians, values])


def _median(values: Array) -> Array:
    """Return the median over rows of each column that has a value."""
    made = np.full(values.shape[1], np.nan)
    held = np.isfinite(values).any(axis=0)
    made[held] = np.nanmedian(values[:, held], axis=0)
    return made


def _changing(values: Array) -> Mask:
    """Return which curves are no level lines: the others need no values."""
    return np.asarray(np.nanmax(values, axis=1) > np.nanmin(values, axis=1))


def _room(values: Array, budget: int) -> int:
    """Return for how many nights there is room where each curve has the least number of points."""
    curves, nights = values.shape
    changing = int(np.count_nonzero(_changing(values)))
    left = budget - curves * _NAMES_BYTES - changing * LEAST_POINTS * 8 / 3
    return int(min(nights, max(left / (changing / 6 + _NIGHT_BYTES), LEAST_POINTS)))


def _points(values: Array, budget: int) -> int:
    """Return how many points a curve may have: 2 bytes each, and a bit a night; 4 characters hold 3 bytes."""
    curves, nights = values.shape
    changing = max(int(np.count_nonzero(_changing(values))), 1)
    left = budget - curves * _NAMES_BYTES - changing * nights / 6 - nights * _NIGHT_BYTES
    return int(np.clip(left / (changing * 8 / 3), LEAST_POINTS, MOST_POINTS))


def _thinned(values: Array, points: int) -> Mask:
    """Choose the points of each curve, shape (curves, nights)."""
    held = np.isfinite(values)
    curves, nights = values.shape
    if nights <= points:
        return np.asarray(held)
    kept = np.zeros_like(held)
    kept[:, nights - NEWEST :] = held[:, nights - NEWEST :]
    old = nights - NEWEST
    count = max((points - NEWEST) // 2, 1)
    width = -(-old // count)
    padded = np.full((curves, width * -(-old // width)), np.nan)
    padded[:, :old] = values[:, :old]
    stretches = padded.reshape(curves, -1, width)
    first = np.arange(stretches.shape[1]) * width
    # A stretch without a value gives its first night, which is not held.
    for lowest in (np.where(np.isnan(stretches), np.inf, stretches), np.where(np.isnan(stretches), np.inf, -stretches)):
        np.put_along_axis(kept, np.minimum(lowest.argmin(axis=2) + first, old - 1), True, axis=1)
    return np.asarray(np.where(_changing(values)[:, None], kept, True) & held)


def _packed(keys: pl.DataFrame, values: Array, kept: Mask, nights: pl.DataFrame) -> dict[str, Any]:
    names = {name: keys[name].unique(maintain_order=True).to_list() for name in keys.columns}
    low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
    span = np.where(high > low, high - low, 1.0)[:, None]
    with np.errstate(invalid="ignore"):
        codes = np.where(kept, np.rint((values - low[:, None]) / span * (LEFT_OUT - 1)), LEFT_OUT).astype("<u2")
    return {
        "nights": {
            "started": nights["started"].dt.strftime("%Y-%m-%dT%H:%M:%SZ").to_list(),
            "commit": [short_commit(commit) for commit in nights["commit"]],
            "state": [state or "" for state in nights["state"]],
        },
        "names": names,
        "series": {name: _numbers(keys[name], names[name]) for name in keys.columns},
        "low": [float(f"{v:.7g}") for v in low],
        "high": [float(f"{v:.7g}") for v in high],
        # A curve after the other, a code a night; what is left out, and level lines, compress to nothing.
        "values": base64.b64encode(codes.tobytes()).decode("ascii"),
    }


def _numbers(column: pl.Series, names: Sequence[str]) -> list[int]:
    number = {name: i for i, name in enumerate(names)}
    return [number[name] for name in column]
