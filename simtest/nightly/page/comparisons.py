"""The table of what got better or worse."""

from dataclasses import dataclass
from typing import Any

import polars as pl

from simtest.nightly.gate.records import Verdict
from simtest.nightly.page.phrases import MEANINGS, interval, measure, scaled, signed
from simtest.pages.style import number

MOST_ROWS = 800
"""Rows of the table; what is equal or equivalent is left out first. verdict.json holds all."""


@dataclass(frozen=True)
class Comparisons:
    """The rows of the table and what may be chosen of them.

    Parameters
    ----------
    rows : list of dict
        Texts and sort keys, the worst first.
    left_out : dict
        How many of each outcome the table does not hold.
    choices : dict
        The values that occur, by column to filter by.
    """

    rows: list[dict[str, Any]]
    left_out: dict[str, int]
    choices: dict[str, list[str]]


def comparisons(verdict: Verdict, most: int = MOST_ROWS) -> Comparisons:
    """Give the table of a verdict's comparisons.

    Parameters
    ----------
    verdict : Verdict
        The gate's.
    most : int
        Rows at most.

    Returns
    -------
    Comparisons
    """
    rank = pl.col("outcome").replace_strict({name: i for i, name in enumerate(MEANINGS)}, default=-1)
    size = (pl.col("difference").abs() / pl.col("margin")).fill_nan(None)
    table = verdict.comparisons.with_columns(rank.alias("rank"), size.alias("size"))
    table = table.sort("rank", "size", descending=[False, True], nulls_last=True, maintain_order=True)
    shown, rest = table.head(most), table.slice(most)
    rows = [_row(row) for row in shown.iter_rows(named=True)]
    choices = {name: sorted({row[name] for row in rows}) for name in ("experiment", "estimator", "quantity")}
    present = {row["outcome"] for row in rows}
    choices["outcome"] = [name for name in MEANINGS if name in present]
    left = {name: count for name, count in rest["outcome"].value_counts(sort=True).iter_rows()}
    return Comparisons(rows, left, choices)


def _row(row: dict[str, Any]) -> dict[str, Any]:
    unit = row["unit"] or ""
    names = {name: row[name] or "–" for name in ("experiment", "setting", "estimator", "quantity", "method")}
    return names | {
        "outcome": row["outcome"],
        "baseline": (measure(row["baseline"], unit), row["baseline"]),
        "tonight": (measure(row["tonight"], unit), row["tonight"]),
        "difference": (signed(row["difference"], unit), row["difference"]),
        "share": _share(row["difference"], row["baseline"]),
        "interval": interval(row["low"], row["high"], unit),
        "margin": (number(scaled(row["margin"], unit)), row["margin"]),
        "p": (number(row["p_holm"], 2), row["p_holm"]),
        "n": row["n"] if row["n"] is not None else "–",
    }


def _share(difference: float | None, baseline: float | None) -> tuple[str, float | None]:
    """Give a difference as a share of the baseline, %."""
    if difference is None or not baseline:
        return "–", None
    share = 100 * difference / abs(baseline)
    if abs(share) >= 1000:
        return f"{'+' if share > 0 else '−'}×{number(abs(difference / baseline) + 1, 2)}", share
    return f"{signed(float(f'{share:.2g}'))}\u00a0%", share
