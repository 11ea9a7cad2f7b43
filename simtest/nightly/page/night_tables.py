"""The night's smaller tables: canaries, failures and coverage, costs, provenance."""

from typing import Any

import polars as pl
from scipy.stats import chi2

from simtest.nightly.gate.records import Night, Verdict
from simtest.nightly.page.phrases import bounds, interval, measure
from simtest.pages.style import estimator_order
from simtest.report.run_folder import flattened

COVERED = float(chi2.ppf(0.95, 2))


def canaries(night: Night) -> list[dict[str, Any]]:
    """Give the canaries, those out of bounds first."""
    rows = night.figures.filter(pl.col("kind") == "canary")
    rows = rows.with_columns(pl.col("passed").fill_null(False)).sort("passed", maintain_order=True)
    return [
        {
            "name": row["experiment"] or "–", "quantity": row["quantity"] or "–", "about": row["about"] or "",
            "value": measure(row["value"], row["unit"]), "passed": row["passed"], "sort": row["value"],
            "allowed": bounds(row["low"], row["high"], row["unit"]), "where": row["setting"] or row["label"] or "",
        }
        for row in rows.iter_rows(named=True)
    ]  # fmt: skip


def answers(night: Night, by: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Count answers, failures, missed and false ones, and how often the 95 % region held the truth.

    Parameters
    ----------
    night : Night
        Whose rows are counted.
    by : tuple of str
        Columns to count apart, beside the estimator.

    Returns
    -------
    list of dict
        A row for each estimator, in the report's order within each group.
    """
    rows = night.rows
    if rows.is_empty():
        return []
    true, ok = pl.col("true_id").is_not_null(), pl.col("status") == "ok"
    held = pl.col("mahalanobis2").filter(ok & true).drop_nulls()
    table = rows.group_by(*by, "estimator", maintain_order=True).agg(
        true=true.sum(), ok=(ok & true).sum(), missed=(pl.col("status") == "missed").sum(), false=(~true).sum(),
        with_region=held.len(), covered=(held <= COVERED).sum(),
        failed=(true & ~ok & (pl.col("status") != "missed")).sum(),
    )  # fmt: skip
    order = estimator_order(table["estimator"].drop_nulls().to_list())
    made = [_answers(row, by) for row in table.iter_rows(named=True)]
    groups = list(dict.fromkeys(tuple(row[name] for name in by) for row in made))
    place = {group: i for i, group in enumerate(groups)}
    return sorted(made, key=lambda row: (place[tuple(row[name] for name in by)], order.index(row["estimator"])))


def _answers(row: dict[str, Any], by: tuple[str, ...]) -> dict[str, Any]:
    share = None if not row["with_region"] else 100 * row["covered"] / row["with_region"]
    return {
        **{name: row[name] for name in (*by, "estimator", "true", "ok", "failed", "missed", "false")},
        "answered": f"{100 * row['ok'] / row['true']:.1f}" if row["true"] else "–",
        "covered": "–" if share is None else f"{share:.1f}",
        "with_region": row["with_region"],
    }


def reasons(night: Night) -> tuple[list[str], list[dict[str, Any]]]:
    """Give the failures' reasons, the commonest first, and their counts by estimator."""
    rows = night.rows
    failed = rows.filter(pl.col("true_id").is_not_null() & ~pl.col("status").is_in(["ok", "missed"]))
    if failed.is_empty():
        return [], []
    counts = failed.group_by("status", "estimator").len()
    totals = counts.group_by("status").agg(pl.col("len").sum()).sort("len", "status", descending=[True, False])
    names = totals["status"].to_list()
    found = {(row["estimator"], row["status"]): row["len"] for row in counts.iter_rows(named=True)}
    estimators = estimator_order(counts["estimator"].to_list())
    return names, [{"estimator": e, "counts": [found.get((e, name), 0) for name in names]} for e in estimators]


def costs(night: Night, verdict: Verdict) -> list[dict[str, Any]]:
    """Give run time and memory, beside the baseline's where the gate compared them."""
    rows = night.figures.filter(pl.col("kind") == "cost")
    key = ("experiment", "setting", "estimator", "quantity")
    compared = {tuple(row[name] for name in key): row for row in verdict.comparisons.iter_rows(named=True)}
    made = []
    for row in rows.iter_rows(named=True):
        before = compared.get(tuple(row[name] for name in key), {})
        names = [row[name] for name in ("experiment", "setting", "estimator") if row[name]]
        made.append(
            {"name": ", ".join(dict.fromkeys(names)) or "–", "quantity": row["quantity"] or "–",
             "value": measure(row["value"], row["unit"]), "sort": row["value"],
             "interval": interval(row["low"], row["high"], row["unit"]), "about": row["about"] or "",
             "baseline": measure(before.get("baseline"), row["unit"])}
        )  # fmt: skip
    return made


def provenance(night: Night, verdict: Verdict) -> list[tuple[str, str, str | None]]:
    """Give what made the two nights' numbers: (name, tonight, baseline), the latter None without a baseline."""
    tonight, base = flattened(night.run), None if verdict.baseline is None else flattened(verdict.baseline)
    names = list(dict.fromkeys([*tonight, *(base or {})]))
    return [(name, tonight.get(name, "–"), None if base is None else base.get(name, "–")) for name in names]
