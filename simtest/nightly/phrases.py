"""Numbers, names and sentences of a judged run, for terminal, files and page alike.

The page writes numbers with three digits and typographic signs (`measure`, `signed`, `interval`), the files
with four digits in plain characters (`plain`).
"""

import re
from collections.abc import Mapping
from datetime import UTC, datetime

import polars as pl

from simtest.nightly.records import Verdict
from simtest.pages.style import degrees, labelled, number

STATES = {
    "fine": "Fine: nothing is worse than the baseline, and nothing else needs a reason.",
    "no baseline": "No baseline: there is nothing to compare with.",
}
MARKS = {"fine": "✓", "changed": "≠", "regression": "✗", "no baseline": "○"}

MEANINGS = {
    "worse": "beyond the margin, at the corrected level, or missing: a regression",
    "better": "beyond the margin the other way: to be explained",
    "changed": "a level or a single result moved: to be explained",
    "gone": "in the baseline, but not tonight",
    "new": "tonight, but not in the baseline",
    "undecided": "neither a change nor equivalence is shown",
    "equivalent": "the interval lies within the margin",
    "same": "identical bytes",
}
"""Meanings of the outcomes, those first that a reader looks for first."""

_ACCEPT = "simtest nightly accept --reason TEXT"


def cell_name(row: Mapping[str, str | None]) -> str:
    """Return the name of a cell: setting and estimator; the setting begins with its label."""
    return ", ".join(filter(None, (row["setting"] or row["label"] or row["surface"], row["estimator"])))


def short_commit(commit: str | None) -> str:
    """Return a commit's first 12 digits, with "+" where the checkout was changed; "unknown" where there is none."""
    found = re.fullmatch(r"([0-9a-f]{12})[0-9a-f]*(\+?)", commit or "")
    return "".join(found.groups()) if found else "unknown"


def when(started: str) -> str:
    """Return a time as date and minute, UTC."""
    return f"{datetime.fromisoformat(started).astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def plain(value: float | None, unit: str | None = None) -> str:
    """Write a number for a text file, with four digits; an empty one as a dash."""
    if value is None:
        return "-"
    return f"{value:.4g}" + (f" {unit}" if unit else "")


def measure(value: float | None, unit: str | None) -> str:
    """Write a number with its unit."""
    if unit == "deg":
        return degrees(value)
    text = number(value)
    return text if text == "–" or not unit else f"{text}\u00a0{unit}"


def signed(value: float | None, unit: str | None = "") -> str:
    """Write a difference with its sign."""
    text = measure(value, unit).replace("-", "−")
    return "+" + text if value is not None and value > 0 and text != "–" else text


def interval(low: float | None, high: float | None) -> str:
    """Write an interval; a dash where there is none."""
    return "–" if low is None and high is None else f"{number(low)} to {number(high)}".replace("-", "−")


def headline(verdict: Verdict) -> str:
    """Return the verdict in a few words."""
    worse, other = verdict.regressions.height, verdict.unexplained.height
    if verdict.state == "regression":
        return f"regression: {worse} figure{'s' * (worse != 1)} worse"
    if verdict.state == "changed":
        return f"changed: {other} figure{'s' * (other != 1)} to explain"
    return "fine, bit-equal" if verdict.state == "fine" and verdict.bit_equal else verdict.state


def headline_sentence(verdict: Verdict) -> str:
    """Return the verdict in a sentence, with the estimators to blame."""
    if verdict.state == "changed":
        found = verdict.unexplained
        verb = "has" if found.height == 1 else "have"
        return (
            f"Changed: nothing is worse, but {found.height} of {verdict.comparisons.height} figures {verb} changed"
            f"{_blamed(found)}. Explain it, then accept the run: {_ACCEPT}."
        )
    if verdict.state != "regression":
        return STATES[verdict.state]
    worse = verdict.regressions
    verb = "is" if worse.height == 1 else "are"
    return (
        f"Regression: {worse.height} of {verdict.comparisons.height} figures {verb} worse than the baseline"
        f"{_blamed(worse)}."
    )


def _blamed(found: pl.DataFrame) -> str:
    """Return the estimators of findings with their numbers, after a colon; nothing where none is named."""
    named = found["estimator"].replace("", None).drop_nulls()
    counted = named.value_counts().sort("count", "estimator", descending=[True, False])
    names = [f"{name} ({count})" for name, count in counted.iter_rows()]
    return f": {labelled(names)}" if names else ""


def verdict_lines(verdict: Verdict) -> list[tuple[str, str]]:
    """Return the verdict's further lines as (name, text)."""
    equal = {
        None: "not known without a baseline",
        True: "yes: all rows are identical to the baseline's, byte by byte",
        False: "no: some rows differ from the baseline's",
    }[verdict.bit_equal]
    text, record = f"none; `{_ACCEPT}` makes this run the baseline", verdict.baseline
    if record is not None:
        text = f"{when(record.started)}, commit {short_commit(record.commit)}"
        text += f": {record.reason}" if record.reason else ""
    return [("Bit-equal", equal), ("Baseline", text)]


def counts(verdict: Verdict) -> list[tuple[str, int, str]]:
    """Return the outcomes that occur as (outcome, count, meaning), those first that a reader looks for first."""
    found = verdict.counts
    return [(name, found[name], meaning) for name, meaning in MEANINGS.items() if found[name]]
