"""What a verdict's findings come from, in sentences that a user can act on: the cause first."""

from collections.abc import Mapping

import polars as pl

from simtest.errors import FAULTS
from simtest.nightly.gate.quantities import ANSWERED, IS_TRUE
from simtest.nightly.gate.single_results import SINGLE
from simtest.nightly.records import CELL, POOLED, NightlyRun, to_explain
from simtest.validation.columns import BUDGET_COLUMNS
from simtest.validation.faults import fault_sentences, faults_of

MOST = 8
"""Sentences at most; what else was found is counted in one more."""

WORDS = {
    "mean_deg": "the mean error",
    "mean_penalised_deg": "the mean error, 90 deg for each unanswered highlight,",
    "oracle_deg": "the mean error of the better candidate",
    "base_deg": "the mean error against the base's normal",
    "look_deg": "the mean error where the estimate looks",
    "law_deg": "the error that the law predicts",
    "axis_ratio": "the axis ratio's deviation from its law",
    "axis_ratio_level": "the mean axis ratio",
    "gain_error": "the error of the gains 1 + d k",
    "gain_oracle_error": "the error of the better gains 1 + d k",
    "direction_deg": "the error of the curvature's direction",
    "eps_over_d": "the light's distance over the surface's",
    "peak_snr": "the highlights' peak over the noise",
    "region_deg": "the size of the reported regions",
    "noise_part_deg": "the noise's part of the reported uncertainty",
    "truth_in_region": "the truth's place in the reported regions (0.5 where they are right, 1 where too wide)",
    "unanswered": "the share of unanswered highlights",
    "missed": "the share of missed highlights",
    "false": "the number of false detections a frame",
    "coverage95": "the share of true normals inside the 95 % region",
    "no_region": "the share of answers without a region",
    "no_axis_ratio": "the share of answers without an axis ratio to judge",
    "no_law": "the share of answers without a law",
    "flagged": "the share of answers with a flag",
    "wrong_sign": "the share of wrong signs among those that motion told",
    "n": "the number of true highlights",
    "single answers": "the number of answers",
    "single flags": "the number of answers with a flag",
    "single false": "the number of false detections",
}
"""Quantities in words; others bear their own names."""

_GROUP = ("kind", "experiment", "estimator", "quantity")
_LINKED = ("mean_deg", "single error", "region_deg", "single region", "coverage95", "truth_in_region", "noise_part_deg")
"""Quantities with whose change the budget's parts are told."""


def causes(
    comparisons: pl.DataFrame, tonight: NightlyRun, baseline: NightlyRun | None, most: int = MOST
) -> tuple[str, ...]:
    """Return what the findings among a verdict's comparisons are, a sentence each, those of the surest cause first.

    First errors inside estimators, with their text, then what is missing, what tests show to be worse, single results,
    and what is better or else and must be explained. Of each estimator, experiment and quantity the setting that moved
    farthest is named, and how many others there are.
    """
    made = [f"{fault}." for fault in _faults(tonight, baseline)]
    made += [_sentence(group, tonight, baseline) for group in _groups(comparisons)]
    left = len(made) - most
    return tuple(made[:most] + ([f"And {left} more findings of this kind; the table has all."] if left > 0 else []))


def _faults(tonight: NightlyRun, baseline: NightlyRun | None) -> list[str]:
    """Return the errors inside the estimators that have more of them than in the baseline."""
    found = pl.col("status").is_in(list(map(str, FAULTS)))
    now, was = (
        {} if run is None else dict(run.rows.filter(found)["estimator"].value_counts().iter_rows())
        for run in (tonight, baseline)
    )
    more = [name for name, count in now.items() if count > was.get(name, 0)]
    return fault_sentences(faults_of(tonight.rows.filter(pl.col("estimator").is_in(more))))


def _groups(comparisons: pl.DataFrame) -> list[dict[str, object]]:
    """Return the findings by kind, experiment, estimator and quantity, each as the setting that moved farthest."""
    found = comparisons.filter((pl.col("outcome") == "worse") | to_explain())
    worse = pl.col("outcome") == "worse"
    # First what is missing, then what tests show, then single results
    kind = pl.when(pl.col("quantity") == "n").then(1).when(pl.col("method") == SINGLE).then(3).otherwise(2)
    scale = pl.max_horizontal(pl.col("margin").abs(), pl.col("baseline").abs(), pl.lit(1e-9))
    found = found.with_columns(
        kind=kind + pl.when(worse).then(0).otherwise(10), size=(pl.col("difference").abs() / scale).fill_null(0.0),
        # A row over many settings names none.
        own=pl.col("setting") != POOLED,
    )  # fmt: skip
    groups = found.sort("own", "size", descending=True, maintain_order=True).group_by(_GROUP, maintain_order=True)
    firsts = groups.agg(pl.all().first(), settings=pl.col("own").sum())
    return firsts.sort("kind", "settings", descending=[False, True], maintain_order=True).to_dicts()


def _sentence(row: Mapping[str, object], tonight: NightlyRun, baseline: NightlyRun | None) -> str:
    quantity, unit = str(row["quantity"]), f" {row['unit']}" if row["unit"] else ""
    where = _where(row)
    was, now = (_number(row[key]) + unit for key in ("baseline", "tonight"))
    if quantity == "n" and row["method"] == "none":
        return f"{where}: the cell is missing tonight (it had {was} true highlights)."
    outcome = {"worse": "worse", "better": "better: explain", "changed": "changed: explain"}[str(row["outcome"])]
    pooled = row["unit"] == "x" and row["setting"] == POOLED
    told = f"is {now} of the baseline's" if pooled else f"is {now}, was {was}"
    words = WORDS.get(quantity) or quantity
    if row["method"] == SINGLE:
        told, words = _of_single(row, was, now, words)
    text = f"{where}: {words} {told} ({outcome})."
    return text + _reasons(row, tonight, baseline) + _budget(row, tonight, baseline)


def _of_single(row: Mapping[str, object], was: str, now: str, words: str) -> tuple[str, str]:
    count = row["n"]
    results = "result of the same seed" if count == 1 else "results of the same seeds"
    if words in WORDS.values():
        return f"is {now}, was {was}; {count} {results} moved", words
    name = words.removeprefix("single ")
    farthest = "one result of the same seed" if count == 1 else f"the one of {count} results that moved farthest"
    return f"is {now}, was {was}", f"the {name} of {farthest}"


def _where(row: Mapping[str, object]) -> str:
    """Return estimator, experiment and setting of a finding, and in how many more settings it is found."""
    estimator, experiment = row["estimator"] or "all estimators", row["experiment"]
    setting = row["setting"] or row["label"]
    if setting == POOLED:
        # Cells that are bit-equal are not pooled.
        place = "all cells that differ" if experiment == POOLED else f"{experiment}, all cells that differ"
    else:
        place = f"{experiment}, {setting}" if setting else str(experiment)
    more = int(str(row["settings"])) - 1
    others = f" and {more} more setting{'s' * (more > 1)}" if more > 0 else ""
    return f"{estimator} in {place}{others}"


def _own(run: NightlyRun | None, row: Mapping[str, object]) -> pl.DataFrame | None:
    """Return the rows of a run that a finding is about."""
    if run is None:
        return None
    names = [name for name in CELL if row[name] not in (None, POOLED)]
    return run.rows.filter(*(pl.col(name) == row[name] for name in names))


def _reasons(row: Mapping[str, object], tonight: NightlyRun, baseline: NightlyRun | None) -> str:
    """Return why answers are missing: the reasons that grew in number, with the text of the first of them."""
    before, after = _own(baseline, row), _own(tonight, row)
    if row["quantity"] not in ("single answers", "unanswered", "mean_penalised_deg") or before is None or after is None:
        return ""
    was, now = (
        dict(table.filter(IS_TRUE, pl.col("status") != "ok")["status"].value_counts().iter_rows())
        for table in (before, after)
    )
    grown = sorted(((now[reason] - was.get(reason, 0), reason) for reason in now), reverse=True)
    if not grown or grown[0][0] <= 0:
        return ""
    count, reason = grown[0]
    texts = after.filter(pl.col("status") == reason)["flags"] if "flags" in after.columns else pl.Series([""])
    text = next((f" ({text})" for text in texts.drop_nulls() if text), "")
    return f" {count} more than before: {reason}{text}."


def _budget(row: Mapping[str, object], tonight: NightlyRun, baseline: NightlyRun | None) -> str:
    """Return which part of the reported uncertainty moved most."""
    before, after = _own(baseline, row), _own(tonight, row)
    if row["quantity"] not in _LINKED or before is None or after is None:
        return ""
    held = [name for name in BUDGET_COLUMNS if name in before.columns and name in after.columns]
    if not held:
        return ""
    was, now = (table.filter(ANSWERED).select(pl.col(held).mean().fill_null(0.0)).row(0) for table in (before, after))
    apart, name, first, second = max(
        (abs(b - a), name, a, b) for name, a, b in zip(held, was, now, strict=True)
    )  # fmt: skip
    if apart <= 0.02 * max(first, second):
        return ""
    part = name.removeprefix("budget_").removesuffix("_deg")
    return f" Of the reported uncertainty the part {part} is {second:.3g} deg, was {first:.3g} deg."


def _number(value: object) -> str:
    """Return a number with three digits, a whole one with all."""
    if isinstance(value, float):
        return f"{value:.0f}" if value.is_integer() else f"{value:.3g}"
    return "nothing" if value is None else str(value)
