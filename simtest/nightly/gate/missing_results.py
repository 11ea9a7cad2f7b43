"""What one of two nights lacks: a place, or highlights of one. What vanishes is a regression until it is accepted."""

from typing import Any

import polars as pl

from simtest.nightly.gate.records import PLACE


def digests(figures: pl.DataFrame) -> pl.DataFrame:
    """Give each place's hash, in the order of the places' names, and its number of true highlights, `n`."""
    own = figures.filter(pl.col("kind") == "setting")
    counted = own.filter(pl.col("quantity") == "n").select(*PLACE, highlights="value").unique(PLACE)
    return own.select(*PLACE, "digest").unique(PLACE).join(counted, on=PLACE, how="left").sort(PLACE)


def places(first: pl.DataFrame, second: pl.DataFrame) -> list[dict[str, Any]]:
    """Give the comparisons of places that one of the nights lacks, on `n`: worse where it is tonight that lacks them.

    Parameters
    ----------
    first, second : polars.DataFrame
        See `digests`: of the baseline and of tonight.

    Returns
    -------
    list of dict
        Rows of `COMPARISONS`.
    """
    made: list[dict[str, Any]] = []
    for here, there, outcome in ((first, second, "worse"), (second, first, "new")):
        for row in here.join(there, on=PLACE, how="anti", maintain_order="left").to_dicts():
            own: dict[str, Any] = {"quantity": "n", "unit": "", "method": "none", "outcome": outcome}
            had = row["highlights"]
            if outcome == "worse":
                own |= {"baseline": had, "tonight": 0.0, "difference": None if had is None else -had, "margin": 0.0}
            else:
                own["tonight"] = had
            made.append({**{name: row[name] for name in PLACE}, **own})
    return made


def highlights(lost: pl.DataFrame, named: list[dict[str, Any]], comparable: frozenset[int]) -> list[dict[str, Any]]:
    """Give the comparisons of places that have lost highlights of the baseline, on `n`.

    Parameters
    ----------
    lost : polars.DataFrame
        See `simtest.nightly.gate.pairing.Pairing`.
    named : list of dict
        Names of the places by their number.
    comparable : frozenset of int
        Places whose seeds mean the same in both nights; of others a loss is told, and not judged.

    Returns
    -------
    list of dict
        Rows of `COMPARISONS`.
    """
    return [
        {
            **named[row["place"]], "quantity": "n", "unit": "", "method": "paired", "baseline": float(row["before"]),
            "tonight": float(row["kept"]), "difference": float(row["kept"] - row["before"]), "margin": 0.0,
            "settled": "worse" if row["place"] in comparable else "undecided",
        }
        for row in lost.sort("place").to_dicts()
    ]  # fmt: skip
