"""What a verdict comes to, in a few rows: for the command line, the Markdown summary and the badge."""

from typing import Any

import polars as pl

from simtest.nightly.gate.records import OUTCOMES, PLACE, Night, Verdict

MISSED = "missed"


def headline(verdict: Verdict) -> str:
    """Give the verdict in a line."""
    worse = verdict.regressions.height
    if verdict.state == "regression":
        return f"regression: {worse} figure{'s' * (worse != 1)} worse" if worse else "regression"
    if verdict.state == "no baseline":
        return "no baseline"
    return "fine, bit-equal" if verdict.bit_equal else "fine"


def by_experiment(night: Night, verdict: Verdict) -> list[dict[str, Any]]:
    """Count by experiment: true highlights, those answered, missed, false detections, and the gate's outcomes.

    Returns
    -------
    list of dict
        Keys `experiment`, `rows`, `answered`, `missed`, `false` (of all estimators together) and `OUTCOMES`.
    """
    true = pl.col("true_id").is_not_null()
    counted = night.rows.group_by("experiment", maintain_order=True).agg(
        true.sum().alias("rows"),
        (true & (pl.col("status") == "ok")).sum().alias("answered"),
        (true & (pl.col("status") == MISSED)).sum().alias("missed"),
        (~true).sum().alias("false"),
    )
    table = {str(row["experiment"]): row for row in counted.iter_rows(named=True)}
    compared = without_canaries(night, verdict).group_by("experiment", "outcome").len().sort("experiment")
    # Without a baseline there are no outcomes to count.
    for name, outcome, number in compared.rows() if verdict.baseline is not None else ():
        empty = {"experiment": name, "rows": None, "answered": None, "missed": None, "false": None}
        table.setdefault(str(name), empty)[outcome] = number
    return [{**dict.fromkeys(OUTCOMES, 0), **row} for row in table.values()]


def failed_canaries(night: Night) -> pl.DataFrame:
    """Give the figures of the canaries that are not what they may be."""
    return night.figures.filter(pl.col("kind") == "canary", ~pl.col("passed").fill_null(False))


def without_canaries(night: Night, verdict: Verdict) -> pl.DataFrame:
    """Give the comparisons but those of canaries, which are told by what they may be."""
    # A canary may watch an experiment, and have its name.
    key = (*PLACE, "quantity")
    canaries = night.figures.filter(pl.col("kind") == "canary").select(key)
    return verdict.comparisons.join(canaries, on=key, how="anti", nulls_equal=True, maintain_order="left")


def ordered(comparisons: pl.DataFrame, outcome: str) -> pl.DataFrame:
    """Give the comparisons of an outcome, the surest first."""
    return comparisons.filter(pl.col("outcome") == outcome).sort(
        "p_holm", "experiment", "label", "setting", "estimator", "quantity", nulls_last=True, maintain_order=True
    )


def place_name(row: dict[str, Any]) -> str:
    """Give a place in words: setting and estimator; the setting begins with its label."""
    words = [row["setting"] or row["label"] or row["surface"], row["estimator"]]
    return ", ".join(str(word) for word in words if word)


def number(value: float | None, unit: str | None = None) -> str:
    """Write a figure with four digits; an empty one as a dash."""
    if value is None:
        return "-"
    return f"{value:.4g}" + (f" {unit}" if unit else "")
