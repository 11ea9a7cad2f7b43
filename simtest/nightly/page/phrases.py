"""Sentences of the page: the verdict, and numbers with their units."""

from datetime import UTC, datetime
from typing import Any

import polars as pl

from simtest.nightly.gate.records import OUTCOMES, Night, Verdict
from simtest.pages.style import degrees, labelled, number

STATES = {
    "fine": "Fine: nothing is worse than the baseline.",
    "no baseline": "No baseline: there is nothing to compare with.",
}
MARKS = {"fine": "✓", "regression": "✗", "no baseline": "○"}

MEANINGS = {
    "worse": "beyond the margin, at the corrected level: a regression",
    "better": "beyond the margin the other way",
    "gone": "the baseline has it, tonight has not",
    "new": "tonight has it, the baseline has not",
    "undecided": "neither a change nor its absence is shown",
    "equivalent": "the interval lies within the margin",
    "same": "the same bytes",
}
"""What the outcomes mean, those first that a reader looks for first."""

SHARE = "share"
"""Unit of what is shown in per cent."""

_ACCEPT = "simtest nightly accept --reason TEXT"


def short_commit(commit: str | None) -> str:
    """Give a commit's first 12 digits, with "+" where the checkout was changed; "unknown" where there is none."""
    if not commit:
        return "unknown"
    return commit[:12] + ("+" if commit.endswith("+") and len(commit) > 12 else "")


def when(started: Any) -> str:
    """Write a time as date and minute, UTC; what is no time, as it is."""
    try:
        time = started if isinstance(started, datetime) else datetime.fromisoformat(str(started))
    except ValueError:
        return str(started)
    return f"{time.astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def scaled(value: float | None, unit: str | None) -> float | None:
    """Give a number as it is shown: shares in per cent."""
    return value if value is None or unit != SHARE else 100 * value


def measure(value: float | None, unit: str | None) -> str:
    """Write a number with its unit."""
    if unit in ("deg", "°"):
        return degrees(value)
    text = number(scaled(value, unit))
    shown = "%" if unit == SHARE else unit
    return text if text == "–" or not shown else f"{text}\u00a0{shown}"


def signed(value: float | None, unit: str | None = "") -> str:
    """Write a difference with its sign."""
    text = measure(value, unit).replace("-", "−")
    return "+" + text if value is not None and value > 0 and text != "–" else text


def interval(low: float | None, high: float | None, unit: str | None = "") -> str:
    """Write an interval in the unit that `measure` shows; a dash where there is none."""
    if low is None and high is None:
        return "–"
    return f"{number(scaled(low, unit))} to {number(scaled(high, unit))}".replace("-", "−")


def bounds(low: float | None, high: float | None, unit: str | None = "") -> str:
    """Write what a value may be."""
    if low is not None and low == high:
        return f"exactly {number(scaled(low, unit))}"
    if number(high) == "–":
        return "–" if number(low) == "–" else f"at least {number(scaled(low, unit))}"
    return f"at most {number(scaled(high, unit))}" if number(low) == "–" else interval(low, high, unit)


def headline(night: Night, verdict: Verdict) -> str:
    """Say in one sentence what the gate says of the night."""
    if verdict.state != "regression":
        return STATES.get(verdict.state, f"{verdict.state}.")
    worse, out = verdict.regressions, out_of_bounds(night)
    if worse.is_empty():
        verb = "canary is" if len(out) == 1 else "canaries are"
        why = f"{len(out)} {verb} out of bounds: {labelled(out)}" if out else "the gate says so"
        return f"Regression: no figure is worse than the baseline, but {why}."
    named = worse["estimator"].replace("", None).drop_nulls()
    counted = named.value_counts().sort("count", "estimator", descending=[True, False])
    names = [f"{name} ({count})" for name, count in counted.iter_rows()]
    which = f": {labelled(names)}" if names else ""
    verb = "is" if worse.height == 1 else "are"
    return f"Regression: {worse.height} of {verdict.comparisons.height} figures {verb} worse than the baseline{which}."


def out_of_bounds(night: Night) -> list[str]:
    """Name the canaries that did not pass."""
    failed = night.figures.filter((pl.col("kind") == "canary") & ~pl.col("passed").fill_null(False))
    return list(dict.fromkeys(str(name) for name in failed["experiment"]))


def lines(night: Night, verdict: Verdict) -> list[tuple[str, str]]:
    """Give the verdict's further lines as (name, text)."""
    made = [("Bit-equal", _bit_equal(verdict))]
    base = verdict.baseline
    if base:
        text = f"{when(base.get('started'))}, commit {short_commit(base.get('commit'))}"
        made.append(("Baseline", f"{text}: {base['reason']}" if base.get("reason") else text))
    else:
        made.append(("Baseline", f"none; `{_ACCEPT}` makes this night the baseline"))
    count = night.figures.filter(pl.col("kind") == "canary").height
    if count:
        out = out_of_bounds(night)
        made.append(("Canaries", f"out of bounds: {labelled(out)}" if out else f"all {count} figures within bounds"))
    return made


def _bit_equal(verdict: Verdict) -> str:
    if verdict.bit_equal is None:
        return "not known without a baseline"
    if verdict.bit_equal:
        return "yes: all rows are the same bytes as the baseline's"
    return "no: some rows differ from the baseline's"


def counts(verdict: Verdict) -> list[tuple[str, int, str]]:
    """Count the outcomes that occur: (outcome, count, meaning), those first that a reader looks for first."""
    found = dict(verdict.comparisons["outcome"].value_counts().iter_rows())
    order = [*MEANINGS, *(name for name in OUTCOMES if name not in MEANINGS)]
    return [(name, found[name], MEANINGS.get(name, "")) for name in order if found.get(name)]
