"""Figures that are judged without a test: canaries, whose value is known, and costs."""

from typing import Any

import polars as pl

from simtest.nightly.gate.limits import Limits
from simtest.nightly.gate.records import PLACE

_KEY = (*PLACE, "quantity")


def canaries(tonight: pl.DataFrame, baseline: pl.DataFrame | None) -> list[dict[str, Any]]:
    """Give the comparisons of canaries: worse where one is outside of what it may be, or missing tonight.

    Parameters
    ----------
    tonight, baseline : polars.DataFrame
        Figures of two nights; no baseline where there is none.

    Returns
    -------
    list of dict
        Rows of `COMPARISONS`; `low`, `high` are what the canary may be.
    """
    made = []
    for row in _both(tonight, baseline, "canary"):
        if row["value"] is None and row["passed"] is None:
            made.append({**_named(row), "baseline": row["value_before"], "outcome": "worse"})
            continue
        same = row["value_before"] is not None and row["value"] == row["value_before"]
        fine = "same" if same else "equivalent" if row["value_before"] is not None else "new"
        made.append(
            {
                **_named(row), "n": row["n"], "baseline": row["value_before"], "tonight": row["value"],
                "difference": _difference(row), "low": row["low"], "high": row["high"],
                "outcome": fine if row["passed"] else "worse",
            }
        )  # fmt: skip
    return made


def costs(
    tonight: pl.DataFrame, baseline: pl.DataFrame | None, limits: Limits, same_machine: bool = True
) -> list[dict[str, Any]]:
    """Give the comparisons of costs: worse where tonight's whole interval lies beyond the baseline's and the margin.

    Parameters
    ----------
    tonight, baseline : polars.DataFrame
        Figures of two nights; no baseline where there is none. A figure without an interval stands for itself.
    limits : Limits
        `memory` is the margin of quantities whose name holds "memory", `run_time` that of all others.
    same_machine : bool
        Whether both nights ran on the same processor; costs of different ones are shown and not judged.

    Returns
    -------
    list of dict
        Rows of `COMPARISONS`.
    """
    made = []
    for row in _both(tonight, baseline, "cost"):
        share = limits.memory if "memory" in row["quantity"] else limits.run_time
        before, after = row["value_before"], row["value"]
        own = {**_named(row), "baseline": before, "tonight": after, "difference": _difference(row), "n": row["n"]}
        if before is None or after is None:
            made.append({**own, "outcome": "new" if before is None else "gone"})
            continue
        first = (_or(row["low_before"], before), _or(row["high_before"], before))
        second = (_or(row["low"], after), _or(row["high"], after))
        if not same_machine:
            outcome = "undecided"
        elif before == after:
            outcome = "same"
        elif second[0] > first[1] * (1 + share):
            outcome = "worse"
        elif second[1] < first[0] * (1 - share):
            outcome = "better"
        else:
            outcome = "equivalent" if abs(after - before) <= share * before else "undecided"
        made.append({**own, "margin": share * before, "outcome": outcome})
    return made


def _both(tonight: pl.DataFrame, baseline: pl.DataFrame | None, kind: str) -> list[dict[str, Any]]:
    """Give the figures of a kind with the baseline's beside them; values that are no number count as unknown."""
    after = tonight.filter(pl.col("kind") == kind).with_columns(pl.col("value", "low", "high").fill_nan(None))
    if baseline is None:
        none = pl.lit(None, pl.Float64)
        return after.with_columns(value_before=none, low_before=none, high_before=none).to_dicts()
    before = baseline.filter(pl.col("kind") == kind).select(
        *_KEY, pl.col("value", "low", "high").fill_nan(None).name.suffix("_before")
    )
    return after.join(before, on=_KEY, how="full", coalesce=True, maintain_order="left_right").to_dicts()


def _named(row: dict[str, Any]) -> dict[str, Any]:
    return {**{name: row[name] for name in _KEY}, "unit": row["unit"] or "", "method": "none"}


def _difference(row: dict[str, Any]) -> float | None:
    before, after = row["value_before"], row["value"]
    return None if before is None or after is None else after - before


def _or(value: float | None, other: float) -> float:
    return other if value is None else value
