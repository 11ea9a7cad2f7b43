"""The verdict as Markdown that fits a comment on a pull request."""

from collections.abc import Sequence
from typing import Any

import polars as pl

from simtest.nightly.gate.records import OUTCOMES, Night, Verdict
from simtest.nightly.history import short_commit
from simtest.nightly.overview import (
    by_experiment,
    failed_canaries,
    headline,
    number,
    ordered,
    place_name,
    without_canaries,
)

MAX_CHARACTERS = 60_000
"""A comment on GitHub may have 65,536."""

MAX_ROWS, MAX_NOTES, MAX_TEXT = 20, 20, 300


def summary(night: Night, verdict: Verdict) -> str:
    """Give the summary as Markdown text of at most `MAX_CHARACTERS`."""
    run, compared = night.run, without_canaries(night, verdict)
    parts = [f"## Nightly {_cell(run['profile'])}: {headline(verdict)}", _compared(verdict)]
    parts += [f"- {_cell(note)}" for note in verdict.notes[:MAX_NOTES]]
    if len(verdict.notes) > MAX_NOTES:
        parts.append(f"- ... and {len(verdict.notes) - MAX_NOTES} more notes")
    parts += _changes("Worse", ordered(compared, "worse"))
    parts += _canaries(failed_canaries(night))
    parts += _changes("Better", ordered(compared, "better"))
    parts += ["### By experiment", _table_by_experiment(night, verdict)]
    parts.append(
        f"{_cell(run['started'])}, commit {short_commit(run.get('commit'))}, {run['duration_s']:.0f} s on "
        f"{_cell(run['processor'])}; run `{_cell(run['id'])}`"
    )
    text = "\n\n".join(_joined(parts)) + "\n"
    if len(text) > MAX_CHARACTERS:
        end = "\n\n(cut; the page has the rest)\n"
        text = text[: MAX_CHARACTERS - len(end)] + end
    return text


def _joined(parts: Sequence[str]) -> list[str]:
    """Put the items of a list below each other without empty lines."""
    joined: list[str] = []
    for part in filter(None, parts):
        if joined and part.startswith("- ") and joined[-1].startswith("- "):
            joined[-1] += f"\n{part}"
        else:
            joined.append(part)
    return joined


def _compared(verdict: Verdict) -> str:
    if verdict.baseline is None:
        return "There is no baseline to compare with."
    baseline = verdict.baseline
    equal = {True: "Bit-equal to", False: "Not bit-equal to", None: "Compared with"}[verdict.bit_equal]
    reason = f': "{_cell(baseline["reason"])}"' if baseline.get("reason") else ""
    return (
        f"{equal} the baseline of {_cell(baseline['started'])}, commit {short_commit(baseline.get('commit'))}{reason}."
    )


def _changes(title: str, changes: pl.DataFrame) -> list[str]:
    if not changes.height:
        return []
    rows = [
        (
            row["experiment"], place_name(row), row["quantity"], number(row["baseline"], row["unit"]),
            number(row["tonight"], row["unit"]), _difference(row), number(row["p_holm"]),
        )
        for row in changes.head(MAX_ROWS).iter_rows(named=True)
    ]  # fmt: skip
    head = ("experiment", "place", "figure", "baseline", "tonight", "difference [95 %]", "p (Holm)")
    more = [f"... and {changes.height - MAX_ROWS} more; the page has them."] if changes.height > MAX_ROWS else []
    return [f"### {title}: {changes.height}", _table(head, rows), *more]


def _difference(row: dict[str, Any]) -> str:
    interval = "" if row["low"] is None else f" [{number(row['low'])}, {number(row['high'])}]"
    return number(row["difference"]) + interval


def _canaries(failed: pl.DataFrame) -> list[str]:
    if not failed.height:
        return []
    rows = [
        (row["experiment"], row["setting"], row["quantity"], number(row["value"], row["unit"]),
         f"{number(row['low'])} to {number(row['high'])}")
        for row in failed.head(MAX_ROWS).iter_rows(named=True)
    ]  # fmt: skip
    return [f"### Canaries failed: {failed.height}", _table(("canary", "setting", "figure", "value", "allowed"), rows)]


def _table_by_experiment(night: Night, verdict: Verdict) -> str:
    counts = OUTCOMES if verdict.baseline is not None else ()
    keys = ("experiment", "rows", "answered", "missed", "false", *counts)
    rows = [[row[key] for key in keys] for row in by_experiment(night, verdict)]
    return _table(keys, rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join("" if cell is None else _cell(cell) for cell in line) + " |" for line in lines)


def _cell(value: Any) -> str:
    """Give a text as it stands in a table: on one line, without what Markdown or HTML would take for its own."""
    text = " ".join(str(value).split())
    text = text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 3] + "..."
    for sign, safe in (("\\", "\\\\"), ("|", "\\|"), ("`", "'"), ("&", "&amp;"), ("<", "&lt;"), ("@", "&#64;")):
        text = text.replace(sign, safe)
    return text
