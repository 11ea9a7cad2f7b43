"""The verdict without the page: JSON, and Markdown that fits a comment on a pull request (docs/howto/nightly.md)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from simtest.nightly.records import OUTCOMES, JudgedRun, Verdict
from simtest.nightly.words import cell_name, headline, plain, short_commit
from simtest.pages.markdown import escaped
from simtest.runtime.files import write_atomically, write_json

SCHEMA_VERSION = 3

FILES = VERDICT, SUMMARY = "verdict.json", "summary.md"
"""Names of the files, which lie beside the page."""


def write_outputs(folder: Path, judged: JudgedRun) -> None:
    """Write the `FILES` into a folder; the same run gives the same bytes."""
    write_json(folder / VERDICT, _verdict_json(judged))
    text = summary(judged)
    write_atomically(folder / SUMMARY, lambda part: part.write_text(text, encoding="utf-8"))


def _verdict_json(judged: JudgedRun) -> dict[str, Any]:
    run, verdict = judged.run, judged.verdict
    return {
        "schema": SCHEMA_VERSION,
        "profile": run.record.profile,
        "state": verdict.state,
        "exit_code": verdict.exit_code,
        "headline": headline(verdict),
        "bit_equal": verdict.bit_equal,
        "causes": list(verdict.causes),
        "notes": list(verdict.notes),
        "run": run.record.to_json(),
        "baseline": None if verdict.baseline is None else verdict.baseline.to_json(),
        "counts": verdict.counts,
        "reports": list(judged.reports),
        "comparisons": _rows_json(verdict.comparisons.filter(pl.col("outcome") != "same")),
    }


def _rows_json(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Return a table's rows as JSON can hold them: nulls are left out, numbers that are not finite are text."""
    return [
        {key: str(value) if isinstance(value, float) and not math.isfinite(value) else value
         for key, value in row.items() if value is not None}
        for row in table.iter_rows(named=True)
    ]  # fmt: skip


MAX_CHARACTERS = 60_000
"""A comment on GitHub may have 65,536."""

MAX_ROWS, MAX_NOTES = 20, 20


def summary(judged: JudgedRun) -> str:
    """Return the summary as Markdown text of at most `MAX_CHARACTERS`."""
    record, verdict = judged.run.record, judged.verdict
    notes = [f"- {escaped(note)}" for note in verdict.notes[:MAX_NOTES]]
    if len(verdict.notes) > MAX_NOTES:
        notes.append(f"- ... and {len(verdict.notes) - MAX_NOTES} more notes")
    causes = [f"- {escaped(cause)}" for cause in verdict.causes]
    took = "" if record.duration_s is None else f"{record.duration_s:.0f} s "
    counts = OUTCOMES if verdict.baseline is not None else ()
    columns = ("experiment", "rows", "answered", "missed", "false", *counts)
    parts = [
        f"## Nightly {escaped(record.profile)}: {escaped(headline(verdict))}",
        *(["\n".join(causes)] if causes else []),
        _compared(verdict),
        *(["\n".join(notes)] if notes else []),
        *_changes("Worse", verdict, "worse"),
        *_changes("Changed, to be explained", verdict, "changed"),
        *_changes("Better", verdict, "better"),
        "### By experiment",
        _table(columns, judged.by_experiment().select(columns).rows()),
        f"{escaped(record.started)}, commit {short_commit(record.commit)}, {took}on "
        f"{escaped(record.processor)}; run `{escaped(record.id)}`",
    ]
    text = "\n\n".join(parts) + "\n"
    # A cut table is still readable, a comment that GitHub refuses is not.
    if len(text) > MAX_CHARACTERS:
        end = "\n\n(cut; the page has the rest)\n"
        text = text[: MAX_CHARACTERS - len(end)] + end
    return text


def _compared(verdict: Verdict) -> str:
    baseline = verdict.baseline
    if baseline is None:
        return "There is no baseline to compare with."
    equal = {True: "Bit-equal to", False: "Not bit-equal to", None: "Compared with"}[verdict.bit_equal]
    reason = f': "{escaped(baseline.reason)}"' if baseline.reason else ""
    return f"{equal} the baseline of {escaped(baseline.started)}, commit {short_commit(baseline.commit)}{reason}."


def _changes(title: str, verdict: Verdict, outcome: str) -> list[str]:
    # The surest first
    changes = verdict.comparisons.filter(pl.col("outcome") == outcome).sort(
        "p_holm", "experiment", "label", "setting", "estimator", "quantity", nulls_last=True, maintain_order=True
    )
    if not changes.height:
        return []
    rows = []
    for row in changes.head(MAX_ROWS).iter_rows(named=True):
        interval = "" if row["low"] is None else f" [{plain(row['low'])}, {plain(row['high'])}]"
        rows.append(
            (row["experiment"], cell_name(row), row["quantity"], plain(row["baseline"], row["unit"]),
             plain(row["tonight"], row["unit"]), plain(row["difference"]) + interval, plain(row["p_holm"]))
        )  # fmt: skip
    head = ("experiment", "cell", "figure", "baseline", "tonight", "difference [95 %]", "p (Holm)")
    more = [f"... and {changes.height - MAX_ROWS} more; the page has them."] if changes.height > MAX_ROWS else []
    return [f"### {title}: {changes.height}", _table(head, rows), *more]


def _table(head: Sequence[str], rows: Sequence[Sequence[str | int | None]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join("" if cell is None else escaped(cell) for cell in line) + " |" for line in lines)
