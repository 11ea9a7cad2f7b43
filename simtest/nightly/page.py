"""The page of a judged run: the verdict first, then what changed, trends, results and provenance."""

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from simtest.nightly import words
from simtest.nightly.quantities import COVERED
from simtest.nightly.records import JudgedRun, NightlyRun, RunRecord, Verdict
from simtest.nightly.store import TRENDS
from simtest.nightly.words import MEANINGS, interval, measure, short_commit, signed
from simtest.pages import style
from simtest.pages.charts import Axis, Chart, Mark, Panel, embedded
from simtest.pages.html import environment
from simtest.pages.style import NEUTRAL, estimator_order, number
from simtest.report.run_folder import flattened
from simtest.runtime.files import write_atomically
from simtest.validation.statistics import counts, row_kind

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


TITLES = dict(zip(TRENDS, ("mean error (deg)", "unanswered", "in the 95 % region"), strict=True))
"""What the panels show, by quantity."""

_TICKS = 4
"""As many dates stand side by side on a phone."""

_DAY_S = 86_400.0
_POINT, _CROSS = "●", "✖"


def trends(history: pl.DataFrame, baseline: RunRecord | None, colours: Mapping[str, str]) -> list[Chart]:
    """Describe a chart for each experiment, with a panel a quantity, of a history (`read_history`)."""
    if history.is_empty():
        return []
    first = history["started"].min()
    assert isinstance(first, datetime)
    key = ("experiment", "estimator", "quantity", "run_id", "started", "commit", "state")
    medians = history.group_by(key).agg(pl.col("value").median()).sort(*key[:3], "started", "run_id")
    medians = medians.with_columns(day=(pl.col("started") - first).dt.total_seconds() / _DAY_S)
    accepted = None if baseline is None else (baseline.start - first).total_seconds() / _DAY_S
    # A run alone has no span.
    low, high = -0.5, float(medians["day"].to_numpy().max()) + 0.5
    days = np.unique(np.linspace(0, np.floor(high), _TICKS).round())
    x = Axis("", limits=(low, high), named=tuple((day, f"{first + timedelta(days=day):%Y-%m-%d}") for day in days))
    return [
        Chart(f"trend{i}", str(name), tuple(_panels(own, x, accepted, colours)), height=640)
        for i, ((name,), own) in enumerate(medians.group_by("experiment", maintain_order=True))
    ]


def _panels(medians: pl.DataFrame, x: Axis, accepted: float | None, colours: Mapping[str, str]) -> Iterator[Panel]:
    for quantity, title in TITLES.items():
        shown = medians.filter(pl.col("quantity") == quantity)
        if shown.is_empty():
            continue
        least, most = float(shown["value"].to_numpy().min()), float(shown["value"].to_numpy().max())
        marks = [mark for (name,), own in shown.group_by("estimator", maintain_order=True)
                 for mark in _curve(str(name), own, colours.get(str(name), NEUTRAL))]  # fmt: skip
        if accepted is not None:
            marks.append(Mark([accepted] * 2, [least, most], NEUTRAL, "baseline", line="dot"))
        yield Panel(x, Axis(title, "log" if 0 < 20 * least < most else "linear"), tuple(marks))


def _curve(name: str, runs: pl.DataFrame, colour: str) -> Iterator[Mark]:
    """Yield the curve of an estimator, and crosses at the runs that were a regression or changed."""
    told = [
        f"{name}: {number(row['value'])}\n{row['started']:%Y-%m-%d %H:%M} UTC\n"
        f"commit {short_commit(row['commit'])}, {row['state']}"
        for row in runs.iter_rows(named=True)
    ]
    day, value = runs["day"].to_numpy(), runs["value"].to_numpy()
    yield Mark(day, value, colour, name, line="solid", width=1.3, symbol=_POINT, size=4, hover=told)
    found = runs["state"].is_in(["regression", "changed"]).fill_null(False).to_numpy()
    if found.any():
        why = [text for text, is_found in zip(told, found, strict=True) if is_found]
        yield Mark(day[found], value[found], colour, name, listed=False, symbol=_CROSS, size=10, hover=why)


REPORTS = "reports"
"""Folder beside the page with the run folders of experiments that have findings."""


def write_nightly_page(folder: Path, judged: JudgedRun, files: Sequence[str] = ()) -> Path:
    """Write the page of a run into a folder, which is made if need be.

    Parameters
    ----------
    folder : pathlib.Path
        Gets index.html.
    judged : JudgedRun
        The run.
    files : sequence of str
        Names of the files that lie beside the page, to link.

    Returns
    -------
    pathlib.Path
        The page.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    html = _render(judged, files)
    page = folder / "index.html"
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _render(judged: JudgedRun, files: Sequence[str]) -> str:
    run, verdict, record = judged.run, judged.verdict, judged.run.record
    names = [name for name in run.rows["estimator"].drop_nulls().unique(maintain_order=True) if name]
    past = [] if judged.history.is_empty() else judged.history["estimator"].drop_nulls().unique().sort().to_list()
    colours = style.colours(dict.fromkeys([*names, *past]))
    charts = trends(judged.history, verdict.baseline, colours)
    return environment().get_template("nightly.html.j2").render(
        title=f"Nightly accuracy, {record.profile} profile",
        started=words.when(record.started),
        commit=words.short_commit(record.commit),
        duration_s=record.duration_s,
        state=verdict.state,
        mark=words.MARKS[verdict.state],
        headline=words.headline_sentence(verdict),
        lines=words.verdict_lines(verdict),
        causes=verdict.causes,
        notes=verdict.notes,
        reports={name: f"{REPORTS}/{name}/index.html" for name in judged.reports},
        counts=words.counts(verdict),
        compared=comparisons(verdict),
        trends=charts,
        results=results(run),
        results_apart=results(run, apart=True),
        provenance=provenance(judged),
        files=files,
        colours={name: colours[name] for name in style.estimator_order(names)},
        **embedded(charts),
    )  # fmt: skip
