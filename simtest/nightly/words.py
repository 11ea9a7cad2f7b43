"""A verdict in words: numbers, names and sentences, its causes first, and in what else two runs differ.

The page writes numbers with three digits and typographic signs (`measure`, `signed`, `interval`), the files
with four digits in plain characters (`plain`).
"""

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import polars as pl

from simtest.errors import FAULTS, Reason
from simtest.nightly.quantities import ANSWERED, IS_TRUE, KEY, QUANTITIES
from simtest.nightly.records import CELL, POOLED, SINGLE, NightlyRun, RunRecord, Verdict, to_explain
from simtest.pages.style import degrees, labelled, number
from simtest.validation.columns import BUDGET_COLUMNS
from simtest.validation.run_summary import faults_of

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
    """Return the verdict in a few words, with the estimators to blame and the experiments that show it."""
    worse, other = verdict.regressions.height, verdict.unexplained.height
    if verdict.state == "regression":
        return f"regression: {worse} figure{'s' * (worse != 1)} worse{_blamed(verdict.regressions)}"
    if verdict.state == "changed":
        return f"changed: {other} figure{'s' * (other != 1)} to explain{_blamed(verdict.unexplained)}"
    return "fine, bit-equal" if verdict.state == "fine" and verdict.bit_equal else verdict.state


def headline_sentence(verdict: Verdict) -> str:
    """Return the verdict in a sentence, with the estimators to blame and the experiments that show it."""
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
    """Return the estimators and experiments of findings with their numbers, after a colon; nothing where none is."""
    # Rows over several of them name none.
    parts = [_counted(found[key].replace(["", POOLED], None)) for key in ("estimator", "experiment")]
    text = " in ".join(filter(None, parts))
    return f": {text}" if text else ""


def _counted(names: pl.Series) -> str:
    counts = names.drop_nulls().value_counts().sort("count", names.name, descending=[True, False])
    return labelled([f"{name} ({count})" for name, count in counts.iter_rows()])


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


MOST = 8
"""Causes at most; what else was found is counted in one more."""

MEDIANS_DEG = 1e-3
"""Medians of errors that differ by no more are equal, on another processor too."""

_WORDS = {name: quantity.words for name, quantity in QUANTITIES.items()} | {
    "n": "the number of true highlights",
    "single answers": "the number of answers",
    "single flags": "the number of answers with a flag",
    "single false": "the number of false detections",
}
"""Quantities in words; single results bear their own names."""

_LINKED = ("mean_deg", "single error", "region_deg", "single region", "coverage95", "truth_in_region", "noise_part_deg")
"""Quantities with whose change the budget's parts are told."""

_FAR, _FAR_DEG = 10, 1.0
"""A rise by so many margins and so many degrees is reported even where nothing can be decided."""


def causes(comparisons: pl.DataFrame, tonight: NightlyRun, baseline: NightlyRun | None) -> tuple[str, ...]:
    """Return what the findings among a verdict's comparisons are, a sentence each, those of the surest cause first.

    First errors inside estimators, with their text, then what is missing, what tests show to be worse, single results,
    and what is better or else and must be explained. Of each estimator, experiment and quantity the setting that moved
    farthest is named, and how many others there are.
    """
    made = [f"{fault}." for fault in _faults(tonight, baseline)]
    if baseline is not None:
        made += [_sentence(group, baseline.rows, tonight.rows) for group in _groups(comparisons)]
    left = len(made) - MOST
    return tuple(made[:MOST] + ([f"And {left} more findings of this kind; the table has all."] if left > 0 else []))


def _faults(tonight: NightlyRun, baseline: NightlyRun | None) -> list[str]:
    """Return the errors inside the estimators that have more of them than in the baseline."""
    found = pl.col("status").is_in(list(map(str, FAULTS)))
    now, was = (
        {} if run is None else dict(run.rows.filter(found)["estimator"].value_counts().iter_rows())
        for run in (tonight, baseline)
    )
    more = [name for name, count in now.items() if count > was.get(name, 0)]
    return [str(fault) for fault in faults_of(tonight.rows.filter(pl.col("estimator").is_in(more)))]


def _groups(comparisons: pl.DataFrame) -> list[dict[str, Any]]:
    """Return the findings by kind, experiment, estimator and quantity, each as the setting that moved farthest."""
    worse = pl.col("outcome") == "worse"
    # First what is missing, then what tests show, then single results
    kind = pl.when(pl.col("quantity") == "n").then(1).when(pl.col("method") == SINGLE).then(3).otherwise(2)
    scale = pl.max_horizontal(pl.col("margin").abs(), pl.col("baseline").abs(), pl.lit(1e-9))
    found = comparisons.filter(worse | to_explain()).with_columns(
        kind=kind + pl.when(worse).then(0).otherwise(10),
        # Rounding does not decide which of those that moved alike is named.
        size=(pl.col("difference").abs() / scale).fill_null(0.0).round_sig_figs(9),
        # A row over many settings names none.
        own=pl.col("setting") != POOLED,
    )  # fmt: skip
    found = found.sort("own", "size", descending=True, maintain_order=True)
    groups = found.group_by("kind", "experiment", "estimator", "quantity", maintain_order=True)
    firsts = groups.agg(pl.all().first(), settings=pl.col("own").sum())
    return firsts.sort("kind", "settings", descending=[False, True], maintain_order=True).to_dicts()


def _sentence(row: Mapping[str, Any], before: pl.DataFrame, after: pl.DataFrame) -> str:
    quantity, unit, where = row["quantity"], f" {row['unit']}" if row["unit"] else "", _where(row)
    was, now = (_number(row[key]) + unit for key in ("baseline", "tonight"))
    if quantity == "n" and row["method"] == "none":
        return f"{where}: the cell is missing tonight (it had {was} true highlights)."
    words, told = _WORDS.get(quantity, quantity), f"is {now}, was {was}"
    if row["unit"] == "x" and row["setting"] == POOLED:
        told = f"is {now} of the baseline's"
    if row["method"] == SINGLE:
        count = row["n"]
        if quantity in _WORDS:
            told += f"; {count} {'result of the same seed' if count == 1 else 'results of the same seeds'} moved"
        else:
            one = "one result of the same seed" if count == 1 else f"the one of {count} results that moved farthest"
            words = f"the {quantity.removeprefix('single ')} of {one}"
    outcome = {"worse": "worse", "better": "better: explain", "changed": "changed: explain"}[row["outcome"]]
    names = [name for name in CELL if row[name] not in (None, POOLED)]
    own = [rows.filter(*(pl.col(name) == row[name] for name in names)) for rows in (before, after)]
    reasons = _reasons(*own) if quantity in ("single answers", "unanswered", "mean_penalised_deg") else ""
    return f"{where}: {words} {told} ({outcome}).{reasons}{_budget(*own) if quantity in _LINKED else ''}"


def _where(row: Mapping[str, Any]) -> str:
    """Return estimator, experiment and setting of a finding, and in how many more settings it is found."""
    estimator, experiment = row["estimator"] or "all estimators", row["experiment"]
    setting = row["setting"] or row["label"]
    if setting == POOLED:
        # Cells that are bit-equal are not pooled.
        place = "all cells that differ" if experiment == POOLED else f"{experiment}, all cells that differ"
    else:
        place = f"{experiment}, {setting}" if setting else experiment
    more = row["settings"] - 1
    others = f" and {more} more setting{'s' * (more > 1)}" if more > 0 else ""
    return f"{estimator} in {place}{others}"


def _reasons(before: pl.DataFrame, after: pl.DataFrame) -> str:
    """Return why answers are missing: the reason that grew most in number, with the first text of it."""
    was, now = (
        dict(table.filter(IS_TRUE, pl.col("status") != "ok")["status"].value_counts().iter_rows())
        for table in (before, after)
    )
    count, reason = max(((now[reason] - was.get(reason, 0), reason) for reason in now), default=(0, ""))
    if count <= 0:
        return ""
    texts = after.filter(pl.col("status") == reason)["flags"] if "flags" in after.columns else pl.Series([""])
    text = next((f" ({text})" for text in texts.drop_nulls() if text), "")
    return f" {count} more than before: {reason}{text}."


def _budget(before: pl.DataFrame, after: pl.DataFrame) -> str:
    """Return which part of the reported uncertainty moved most."""
    held = [name for name in BUDGET_COLUMNS if name in before.columns and name in after.columns]
    if not held:
        return ""
    was, now = (table.filter(ANSWERED).select(pl.col(held).mean().fill_null(0.0)).row(0) for table in (before, after))
    apart, name, first, second = max((abs(b - a), name, a, b) for name, a, b in zip(held, was, now, strict=True))
    if apart <= 0.02 * max(first, second):
        return ""
    part = name.removeprefix("budget_").removesuffix("_deg")
    return f" Of the reported uncertainty the part {part} is {second:.3g} deg, was {first:.3g} deg."


def _number(value: object) -> str:
    """Return a number with three digits, a whole one with all."""
    if isinstance(value, float):
        return f"{value:.0f}" if value.is_integer() else f"{value:.3g}"
    return "nothing" if value is None else str(value)


def redefined(baseline: RunRecord, tonight: RunRecord) -> list[str]:
    """Return the experiments whose definition is known in both records, and differs."""
    first, second = baseline.definitions, tonight.definitions
    return sorted(name for name in first.keys() & second.keys() if first[name] != second[name])


def large_and_undecided(comparisons: pl.DataFrame) -> tuple[str, ...]:
    """Report rises of single realisations that a reader must look at, though one number decides nothing."""
    errors = pl.col("quantity").is_in(["mean_deg", "mean_penalised_deg"]) & (pl.col("setting") != POOLED)
    far = (pl.col("difference") > _FAR * pl.col("margin")) & (pl.col("difference") > _FAR_DEG)
    found = comparisons.filter(errors & far, pl.col("n") == 1, pl.col("outcome") == "undecided")
    if found.is_empty():
        return ()
    return (
        f"In {found.select(CELL).n_unique()} cells of one realisation the error rose by more than {_FAR} margins and "
        f"{_FAR_DEG:g} deg, by {float(found['difference'].to_numpy().max()):.2g} deg at most: too few to decide, look "
        "at them.",
    )


def notes_on(
    baseline: NightlyRun, tonight: NightlyRun, bit_equal: bool, unmatched: int, short: int, absent: Sequence[str]
) -> tuple[str, ...]:
    """Report in what two runs differ beside their numbers, in plain sentences.

    `unmatched` counts the cells whose results differ and whose rows are no exact pairs, `short` those that have lost
    highlights of the baseline, `absent` names columns that the baseline lacks.
    """
    before, after = baseline.record, tonight.record
    first, second = before.versions, after.versions
    names = [name for name in sorted(first.keys() | second.keys()) if first.get(name) != second.get(name)]
    was, now = (", ".join(f"{name} {own.get(name, 'missing')}" for name in names) for own in (first, second))
    # simtest's own version is what the gate judges: its change alone leaves the pairs.
    unpaired = "" if set(names) <= {"simtest"} else "All cells were compared unpaired."
    made = [_changed("Versions", was, now, unpaired)]
    for key in ("processor", "profile", "variant", "llvm", "python"):
        # A record that lacks a key says nothing of it.
        if getattr(before, key) and getattr(after, key):
            made.append(_changed(f"The {key}", getattr(before, key), getattr(after, key)))
    for name in sorted(before.variants.keys() & after.variants.keys()):
        pair = before.variants[name], after.variants[name]
        # A change of the run's own variant is told once.
        if pair != (before.variant, after.variant):
            made.append(_changed(f"The variant of {name}", *pair))
    if names := redefined(before, after):
        made.append(f"The definition of {', '.join(names)} changed: their cells were compared unpaired.")
    if unmatched:
        made.append(f"Seeds or rows of {unmatched} cells differ from the baseline's: these were compared unpaired.")
    if short:
        made.append(f"In {short} cells highlights of the baseline are missing tonight, in frames of the same seeds.")
    if absent:
        made.append(
            f"The baseline, of an older version, lacks {len(absent)} columns of results (such as {absent[0]}): what is "
            "made of them is judged from the next accepted baseline on."
        )
    if not bit_equal:
        made += _numbers(baseline.rows, tonight.rows)
    return tuple(note for note in made if note)


def _changed(what: str, before: str | None, after: str | None, consequence: str = "") -> str:
    if before == after:
        return ""
    return f"{what} changed from {before or 'unknown'} to {after or 'unknown'}. {consequence}".strip()


def _numbers(*tables: pl.DataFrame) -> list[str]:
    """Report how near the medians of two runs are, and how many results changed in kind."""
    made = []
    # Medians by cell
    first, second = (rows.filter(ANSWERED).group_by(CELL).agg(pl.col("error_deg").median()) for rows in tables)
    both = first.join(second, on=CELL, suffix="_2")
    apart = (both["error_deg"] - both["error_deg_2"]).abs()
    if both.height:
        made.append(
            f"Medians agree to {MEDIANS_DEG:g} deg in {int((apart <= MEDIANS_DEG).sum())} of {both.height} cells; they "
            f"differ by {float(apart.to_numpy().max()):.2g} deg at most."
        )
    # Status by highlight: of the same seeds and definition, what changed is the code's.
    first, second = (
        rows.filter(IS_TRUE).select(*KEY, "status", answered=ANSWERED).unique(KEY, keep="first") for rows in tables
    )
    both = first.join(second, on=KEY, suffix="_2")
    before, after = pl.col("answered"), pl.col("answered_2")
    other = pl.col("status").ne_missing(pl.col("status_2"))
    # Only isophotes that open change a contour's topology; other reasons are named for what they are.
    is_open = pl.any_horizontal(pl.col("status", "status_2") == str(Reason.NO_CLOSED_ISOPHOTE))
    status, lost, gained, opened, missed = both.select(
        status=other, lost=before & ~after, gained=after & ~before, opened=other & (before | after) & is_open,
        missed=pl.any_horizontal(pl.col("status", "status_2") == "missed") & other,
    ).sum().row(0)  # fmt: skip
    # Detections by frame
    frame = ("experiment", "setting", "realisation", "seed")
    first, second = (rows.group_by(frame).agg(found=pl.col("specularity").drop_nulls().n_unique()) for rows in tables)
    frames = first.join(second, on=frame, suffix="_2")
    detections = frames.filter(pl.col("found") != pl.col("found_2")).height
    if both.height:
        why = f" In {opened} of them an isophote opened or closed." if opened else ""
        why += f" In {missed} of them the highlight was detected in one run alone." if missed else ""
        made.append(
            f"Of {both.height} pairs of results {status} differ in status, {lost} of them answered in the baseline "
            f"alone and {gained} tonight alone; of {frames.height} frames {detections} have another number of "
            f"detections.{why}"
        )
    return made
