"""The page's tables: comparisons, results, provenance."""

from typing import NamedTuple

import polars as pl

from simtest.nightly.gate.quantities import COVERED
from simtest.nightly.phrases import MEANINGS, interval, measure, signed
from simtest.nightly.records import JudgedRun, NightlyRun, Verdict
from simtest.pages.style import estimator_order, number
from simtest.report.run_folder import flattened
from simtest.validation.row_kinds import counts, row_kind

MOST_ROWS = 800
"""Rows of the table; equal and equivalent ones are left out first. verdict.json holds all."""


class Entry(NamedTuple):
    """An entry of a table."""

    text: str | int
    css: str = ""  # "text": aligned left; "wrap": may be broken; "estimator": with its colour
    value: float | None = None  # sorts the entry in the place of its text
    head: bool = False  # whether it names its row
    sign: str = ""  # outcome whose sign and colour the text has


class Table(NamedTuple):
    """A table: accessible name, headings (those of columns of text begin with "="), and rows."""

    label: str
    heads: tuple[str, ...]
    rows: list[list[Entry]]


class Comparisons(NamedTuple):
    """The table of comparisons, the worst first; how many it does not hold, by outcome; values by column to filter."""

    table: Table
    left_out: dict[str, int]
    choices: dict[str, list[str]]


def comparisons(verdict: Verdict, most: int = MOST_ROWS) -> Comparisons:
    """Return the table of a verdict's comparisons, of so many rows at most."""
    # By outcome, then by size in margins
    rank = pl.col("outcome").replace_strict({name: i for i, name in enumerate(MEANINGS)}, default=-1)
    size = (pl.col("difference").abs() / pl.col("margin")).fill_nan(None)
    names = pl.col("experiment", "setting", "estimator", "quantity", "method").replace("", None).fill_null("–")
    found = verdict.comparisons.with_columns(names, rank=rank, size=size)
    found = found.sort("rank", "size", descending=[False, True], nulls_last=True, maintain_order=True)
    shown = found.head(most)
    rows = []
    for row in shown.iter_rows(named=True):
        unit, difference = row["unit"], row["difference"]
        rows.append(
            [Entry(row["outcome"], "text", sign=row["outcome"]), Entry(row["experiment"], "text"),
             Entry(row["setting"], "text wrap"), Entry(row["estimator"], "text"), Entry(row["quantity"], "text"),
             _number(signed(difference, unit), difference), Entry(interval(row["low"], row["high"])),
             _share(difference, row["baseline"]), _number(measure(row["baseline"], unit), row["baseline"]),
             _number(measure(row["tonight"], unit), row["tonight"]), _number(number(row["margin"]), row["margin"]),
             _number(number(row["p_holm"], 2), row["p_holm"]), Entry("–" if row["n"] is None else row["n"]),
             Entry(row["method"], "text")]
        )  # fmt: skip
    heads = (
        "=outcome", "=experiment", "=setting", "=estimator", "=quantity", "difference", "95\u00a0% interval", "share",
        "baseline", "tonight", "margin", "p (Holm)", "n", "=test",
    )  # fmt: skip
    choices = {name: shown[name].unique().sort().to_list() for name in ("experiment", "estimator", "quantity")}
    choices["outcome"] = shown["outcome"].unique(maintain_order=True).to_list()
    left = dict(found.slice(most)["outcome"].value_counts(sort=True).iter_rows())
    return Comparisons(Table("Figures against the baseline", heads, rows), left, choices)


def _number(text: str, value: float | None) -> Entry:
    return Entry(text, value=value)


def _share(difference: float | None, baseline: float | None) -> Entry:
    """Return a difference as a share of the baseline, %."""
    if difference is None or not baseline:
        return Entry("–")
    share = 100 * difference / abs(baseline)
    if abs(share) >= 1000:
        return _number(f"{'+' if share > 0 else '−'}×{number(abs(difference / baseline) + 1, 2)}", share)
    return _number(f"{signed(float(f'{share:.2g}'))}\u00a0%", share)


def results(run: NightlyRun, apart: bool = False) -> Table:
    """Count results, failures, missed and false ones, and how often the 95 % region held the truth, by estimator.

    Experiments are counted together, or `apart`.
    """
    # Enumerations sort in the order of their names.
    by = [pl.col("estimator").cast(pl.Enum(estimator_order(run.rows["estimator"])))]
    if apart:
        by.insert(0, pl.col("experiment").cast(pl.Enum(run.rows["experiment"].unique(maintain_order=True))))
    # Squared Mahalanobis distances of stated regions
    held = pl.col("mahalanobis2").filter(row_kind(run.rows) == "ok").drop_nulls()
    table = run.rows.group_by(by).agg(**counts(run.rows), with_region=held.len(), covered=(held <= COVERED).sum())
    names = ("experiment", "estimator")[-len(by) :]
    entries = []
    for row in table.sort(names).iter_rows(named=True):
        numbers = (
            row["true"], row["ok"], _percent(row["ok"], row["true"]), row["failed"], row["missed"], row["false"],
            row["with_region"], _percent(row["covered"], row["with_region"]),
        )  # fmt: skip
        texts = [Entry(row[name], f"text {name}", head=name == names[0]) for name in names]
        entries.append(texts + [Entry(value) for value in numbers])
    heads = ("true highlights", "answered", "answered\u00a0%", "failed", "missed", "false", "with a region",
             "held the truth\u00a0%")  # fmt: skip
    label = f"Failures and coverage by {names[0]}"
    return Table(label, (*(f"={name}" for name in names), *heads), entries)


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f}" if whole else "–"


def provenance(judged: JudgedRun) -> Table:
    """Return what made the numbers of tonight, and of the baseline where there is one."""
    records = {"=tonight": judged.run.record, "=baseline": judged.verdict.baseline}
    texts = {head: flattened(record.to_json()) for head, record in records.items() if record is not None}
    entries = []
    # In the order of tonight's record, then of what the baseline's has beside it
    for name in dict.fromkeys(name for own in texts.values() for name in own):
        values = [own.get(name, "–") for own in texts.values()]
        mark = "≠ " if len(set(values)) > 1 else ""
        codes = [Entry(value, "text wrap-short code") for value in values]
        entries.append([Entry(mark + name, "text", head=True), *codes])
    return Table("Provenance", ("=of", *texts), entries)
