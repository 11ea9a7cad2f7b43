"""The gate: tonight against the baseline."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl

from simtest.nightly.contrasts import UNIT, Outcomes, holm, paired, pooled, unit_sums, unpaired
from simtest.nightly.quantities import (
    ANSWERED,
    IS_TRUE,
    MIXED,
    OPTIONAL_COLUMNS,
    PENALISED,
    QUANTITIES,
    REGION_DEG,
    RESULT_COLUMNS,
    SAME_AS,
    Quantity,
    harms,
    told_twice,
)
from simtest.nightly.records import CELL, COMPARISONS, POOLED, SINGLE, Cell, NightlyRun, RunRecord, Verdict, to_explain
from simtest.nightly.words import causes, large_and_undecided, notes_on, redefined
from simtest.validation.columns import SCHEMA
from simtest.validation.statistics import is_false

ALPHA = 0.01
"""Family-wise level: chance that a run without a change is called one, at most."""

POOLED_WEIGHT = 0.5
"""Share of `ALPHA`, in [0, 1), of all comparisons over many settings together."""

_WORK = {**COMPARISONS, "better": pl.Float64(), "within": pl.Boolean()}
"""Columns of comparisons before `_judged`: `p` is that of a rise, `better` that of a fall, `within` as in `Outcomes`;
an outcome that is set already stands."""


def compare(tonight: NightlyRun, baseline: NightlyRun | None) -> Verdict:
    """Compare a run with the baseline; without one there is nothing to compare, and the causes are faults alone.

    Cells whose results are the same bytes are the same; the others are tested, pair by pair where seeds and versions
    are the same, with all tests as one family (docs/concepts/gate.md). What tonight lacks, a cell or true highlights of
    a cell whose seeds are the same, is worse.
    """
    if baseline is None:
        none = pl.DataFrame(schema=COMPARISONS)
        return Verdict("no baseline", None, none, (), None, causes(none, tonight, None))
    same_machine = _machine(baseline.record) == _machine(tonight.record)
    first, second = digests(baseline.figures), digests(tonight.figures)
    bit_equal = first.select(*CELL, "digest").equals(second.select(*CELL, "digest"))
    shared = first.join(second, on=CELL, suffix="_2", maintain_order="left")
    equal = pl.col("digest") == pl.col("digest_2")
    aligned, absent = _aligned(baseline, tonight)
    tested, unmatched, short = _tested(*aligned, shared.filter(~equal).select(CELL), same_machine)
    made = [missing_cells(first, second), _same(shared.filter(equal).select(CELL), tonight.figures), *tested]
    held = [table for table in made if table.height]
    comparisons = _judged(pl.concat([pl.DataFrame(schema=_WORK), *held], how="diagonal_relaxed"))
    notes = notes_on(baseline, tonight, bit_equal, unmatched, short, absent)
    notes += large_and_undecided(comparisons)
    found = causes(comparisons, tonight, baseline)
    state = "changed" if comparisons.filter(to_explain()).height else "fine"
    state = "regression" if (comparisons["outcome"] == "worse").any() else state
    return Verdict(state, bit_equal, comparisons, notes, baseline.record, found)


def _machine(record: RunRecord) -> tuple[str | None, ...]:
    """Return what else than the code decides the last digits of a result."""
    return record.processor, record.variant, record.llvm, record.python


def _aligned(baseline: NightlyRun, tonight: NightlyRun) -> tuple[tuple[NightlyRun, NightlyRun], list[str]]:
    """Return both runs with the columns that the gate reads, and the names of those that the baseline lacks.

    What the baseline lacks is null in both: it is judged from the next accepted baseline on.
    """
    held = baseline.rows.columns
    absent = [name for name in RESULT_COLUMNS if name not in held]
    lacking = [pl.lit(None, SCHEMA[name]).alias(name) for name in absent]
    lacking += [pl.lit(None, dtype).alias(name) for name, dtype in OPTIONAL_COLUMNS.items() if name not in held]
    both = [run.rows.with_columns(lacking) for run in (baseline, tonight)]
    return (replace(baseline, rows=both[0]), replace(tonight, rows=both[1])), absent


def _same(equal: pl.DataFrame, figures: pl.DataFrame) -> pl.DataFrame:
    """Return the figures of cells whose results are the same bytes as comparisons: the same rows give the same ones."""
    value = pl.col("value")
    return figures.join(equal, on=CELL, how="semi", nulls_equal=True).select(
        *CELL, "quantity", "unit", "n", method=pl.lit("equal"), baseline=value, tonight=value, difference=pl.lit(0.0),
        outcome=pl.lit("same"),
    )  # fmt: skip


def _tested(
    baseline: NightlyRun, tonight: NightlyRun, differing: pl.DataFrame, same_machine: bool
) -> tuple[list[pl.DataFrame], int, int]:
    """Compare cells whose results differ; return also how many are no pairs, and how many lost highlights."""
    if differing.is_empty():
        return [], 0, 0
    # Pair the rows
    cells = differing.with_row_index("cell").with_columns(pl.col("cell").cast(pl.Int64))
    before, after = (harms(run.rows, cells) for run in (baseline, tonight))
    matched = pairing(before, after)
    comparable = _comparable(baseline.record, tonight.record, cells)
    of_same_seeds = matched.cells & comparable
    made = [lost_highlights(matched.lost, cells, comparable)]
    if same_machine:
        own = cells.filter(pl.col("cell").is_in(list(of_same_seeds)))
        made.append(moved(*(run.rows.join(own, on=CELL, how="semi") for run in (baseline, tonight))))
    # Choose the quantities and add up
    in_pairs = pl.col("cell").is_in(list(of_same_seeds))
    without = _not_tested(pl.concat([before, after]), *(told_twice(run.rows, cells) for run in (baseline, tonight)))
    chosen = [run.join(without, on=("cell", "quantity"), how="anti", maintain_order="left") for run in (before, after)]
    taken = frames_taken(baseline.figures, tonight.figures, cells)
    of_pairs = unit_sums(with_all_frames(pairs(*(run.filter(in_pairs) for run in chosen)), taken, before, after))
    of_each = [unit_sums(with_all_frames(run.filter(~in_pairs), taken, run)) for run in chosen]
    # Test
    for name, quantity in QUANTITIES.items():
        own, first, second = (table.filter(pl.col("quantity") == name) for table in (of_pairs, *of_each))
        first, second = (
            one.join(other, on="cell", how="semi", maintain_order="left")
            for one, other in ((first, second), (second, first))
        )
        for units, outcomes, method in (
            (own, paired(own, quantity), "paired"), (first, unpaired(first, second, quantity), "unpaired")
        ):  # fmt: skip
            names = cells.join(units, on="cell", how="semi").sort("cell").select(CELL)
            made.append(_compared(names, name, quantity, outcomes, method, quantity.unit))
            made += _pooled(names, name, quantity, outcomes, method)
        if name not in SAME_AS and name not in MIXED:
            rest = cells.join(own, on="cell", how="anti").join(first, on="cell", how="anti").sort("cell")
            made.append(_untested(rest, name, quantity, before, after))
    return made, cells.height - len(matched.cells), matched.lost.height


def _comparable(baseline: RunRecord, tonight: RunRecord, cells: pl.DataFrame) -> frozenset[int]:
    """Return the cells whose seeds mean the same in both runs: of the same definition, made by the same versions."""
    # simtest's own version does not count: the gate is there to judge it.
    if {**baseline.versions, "simtest": ""} != {**tonight.versions, "simtest": ""}:
        return frozenset()
    moved_on = redefined(baseline, tonight)
    return frozenset(cells.filter(~pl.col("experiment").is_in(moved_on))["cell"].to_list())


def _not_tested(harms: pl.DataFrame, *twice: pl.DataFrame) -> pl.DataFrame:
    """Return the cells and quantities of two runs' harms that are not tested.

    A quantity that is another one in both runs would be tested twice (`twice`, of each run); an indicator of
    `MIXED` is tested in the cells where it takes both values across the two runs.
    """
    found = harms.group_by("cell", "quantity").agg(kinds=pl.col("value").n_unique())
    alike = found.filter(pl.col("quantity").is_in(MIXED), pl.col("kinds") == 1)
    first, second = twice
    both = first.join(second, on=("cell", "quantity"), how="semi")
    return pl.concat([both, alike.select("cell", "quantity")])


def _compared(
    cells: pl.DataFrame, name: str, quantity: Quantity, found: Outcomes, method: str, unit: str
) -> pl.DataFrame:
    """Return outcomes as comparisons, still without corrected p-values; numbers that are not finite become null."""
    # From harms to the figures that are shown
    sign, start = (-1.0, 1.0) if quantity.falls else (1.0, 0.0)
    low, high = (found.high, found.low) if quantity.falls else (found.low, found.high)
    table = pl.DataFrame(
        {"n": found.n, "baseline": start + sign * found.baseline, "tonight": start + sign * found.tonight,
         "difference": sign * found.difference, "low": sign * low, "high": sign * high, "margin": found.margin,
         "p": found.worse, "better": found.better, "within": found.within}
    )  # fmt: skip
    floats = pl.col(pl.Float64)
    table = table.with_columns(pl.when(floats.is_finite()).then(floats))
    constants = {"quantity": name, "unit": unit, "method": method}
    return cells.hstack(table).with_columns(pl.lit(value).alias(key) for key, value in constants.items())


def _pooled(
    cells: pl.DataFrame, name: str, quantity: Quantity, found: Outcomes, method: str
) -> Iterator[pl.DataFrame]:  # fmt: skip
    """Yield the tests over all cells of an estimator, in each experiment and in all together."""
    groups: dict[Cell, list[int]] = {}
    experiments: dict[Cell, set[str]] = {}
    for i, (experiment, estimator) in enumerate(cells.select("experiment", "estimator").rows()):
        for over in (experiment, POOLED):
            group = Cell(over, POOLED, POOLED, POOLED, estimator)
            groups.setdefault(group, []).append(i)
            experiments.setdefault(group, set()).add(experiment)
    for group, members in groups.items():
        # All experiments together are another test only where they are several.
        if len(members) > 1 and (group.experiment != POOLED or len(experiments[group]) > 1):
            over = pl.DataFrame([group], schema=list(CELL), orient="row")
            unit = "x" if quantity.relative else quantity.unit
            yield _compared(over, name, quantity, pooled(found[members], quantity), method, unit)


def _untested(
    cells: pl.DataFrame, name: str, quantity: Quantity, before: pl.DataFrame, after: pl.DataFrame
) -> pl.DataFrame:  # fmt: skip
    """Compare the cells where one run alone knows a quantity, or both but for no pair: without a test."""
    means = [
        run.filter(pl.col("quantity") == name).group_by("cell").agg(pl.col("value").mean().alias(name))
        for run in (before, after)
    ]
    both = means[0].join(means[1], on="cell", how="full", coalesce=True, suffix="_2")
    first, second = pl.col(name), pl.col(f"{name}_2")
    shown = (1 - first, 1 - second) if quantity.falls else (first, second)
    one_sided = pl.when(first.is_null()).then(pl.lit("new")).when(second.is_null()).then(pl.lit("gone"))
    return cells.join(both, on="cell", how="inner", maintain_order="left").select(
        *CELL, quantity=pl.lit(name), unit=pl.lit(quantity.unit), method=pl.lit("none"), baseline=shown[0],
        tonight=shown[1], outcome=one_sided.otherwise(pl.lit("undecided")),
    )  # fmt: skip


def _judged(made: pl.DataFrame) -> pl.DataFrame:
    """Correct the p-values, of one family of both sides, and settle the outcomes."""
    # Correct both sides together: a fall is a finding as a rise is.
    family = made["p"].is_not_null().to_numpy()
    is_pooled = (made["setting"] == POOLED).fill_null(False).to_numpy()[family]
    weights = np.ones(len(is_pooled))
    # The pooled tests share a part of the family, where there are both.
    if is_pooled.any() and not is_pooled.all():
        weights = np.where(is_pooled, POOLED_WEIGHT / is_pooled.sum(), (1 - POOLED_WEIGHT) / (~is_pooled).sum())
    p = np.stack([made[name].to_numpy()[family] for name in ("p", "better")])
    corrected = np.full((2, made.height), np.nan)
    corrected[:, family] = holm(p.ravel(), np.tile(weights, 2)).reshape(p.shape)
    made = made.with_columns(rises=corrected[0], falls=corrected[1]).with_columns(
        pl.col("rises", "falls").fill_nan(None)
    )
    # Settle
    margin = pl.col("margin")
    inside = (pl.col("low") >= -margin) & (pl.col("high") <= margin)
    level = pl.col("quantity").is_in([name for name, own in QUANTITIES.items() if own.level])
    changed = pl.min_horizontal("rises", "falls") <= ALPHA
    outcome = (
        pl.when(pl.col("outcome").is_not_null()).then("outcome")
        .when(level & changed).then(pl.lit("changed"))
        .when(pl.col("rises") <= ALPHA).then(pl.lit("worse"))
        .when(pl.col("falls") <= ALPHA).then(pl.lit("better"))
        .when(inside.fill_null(False) | pl.col("within").fill_null(False)).then(pl.lit("equivalent"))
        .otherwise(pl.lit("undecided"))
    )  # fmt: skip
    # Of both sides the surer one is shown.
    fell = (pl.col("falls") < pl.col("rises")).fill_null(False)
    shown = {"p": pl.when(fell).then("better").otherwise("p"), "p_holm": pl.when(fell).then("falls").otherwise("rises")}
    return made.with_columns(outcome=outcome, **shown).select(*COMPARISONS)


_FALSE = pl.col("quantity") == "false"


class Pairing(NamedTuple):
    """Cells whose frames have the same seeds in two runs."""

    cells: frozenset[int]  # all true highlights tonight are in the baseline, once: rows are compared pair by pair
    lost: pl.DataFrame  # `cell`, `before` (true highlights of the baseline), `kept`: where tonight lacks some of them


def pairing(before: pl.DataFrame, after: pl.DataFrame) -> Pairing:
    """Find the cells that are pairs, and those that have lost highlights, in the `harms` of two runs."""
    # Count each true highlight in both runs; each has one row of this quantity.
    key = ("cell", "realisation", "true_id", "seed")
    counted = [
        run.filter(pl.col("quantity") == PENALISED).group_by(key).agg(pl.len().alias(name))
        for run, name in ((before, "first"), (after, "second"))
    ]
    first, second = pl.col("first"), pl.col("second")
    counts = (
        counted[0]
        .join(counted[1], on=key, how="full", coalesce=True, nulls_equal=True)
        .with_columns(first.fill_null(0), second.fill_null(0))
        .group_by("cell")
        .agg(
            before=(first > 0).sum(), kept=((first > 0) & (second > 0)).sum(), gained=(first == 0).sum(),
            repeated=((first > 1) | (second > 1)).any(),
        )
    )  # fmt: skip
    # Compare the frames' seeds. A frame without a highlight has rows only where something was found in it.
    frames = [run.filter(_FALSE).select("cell", "realisation", "seed") for run in (before, after)]
    both = frames[0].join(frames[1], on=("cell", "realisation"), suffix="_2")
    moved = set(both.filter(pl.col("seed").ne_missing(pl.col("seed_2")))["cell"].to_list())
    # Realisations of other numbers are other realisations: nothing of them is lost.
    fewer = pl.col("kept") < pl.col("before")
    lost = fewer & pl.col("cell").is_in(list(set(both["cell"].to_list()) - moved))
    unequal = counts.filter((pl.col("gained") > 0) | pl.col("repeated") | (fewer & ~lost))
    every = set(frames[0]["cell"].to_list()) & set(frames[1]["cell"].to_list())
    return Pairing(
        frozenset(every - set(unequal["cell"].to_list()) - moved), counts.filter(lost).select("cell", "before", "kept")
    )


def pairs(before: pl.DataFrame, after: pl.DataFrame) -> pl.DataFrame:
    """Join the `harms` of two runs to pairs: `UNIT`, `baseline`, `tonight`; a row where both runs have a value."""
    first, second = before.rename({"value": "baseline"}), after.rename({"value": "tonight"})
    rows = first.filter(~_FALSE).join(second.filter(~_FALSE), on=(*UNIT, "true_id"), maintain_order="left")
    # A frame with highlights that has no row at all tonight is lost: it is not one without false detections.
    frame = ("cell", "realisation")
    lost = before.filter(~_FALSE).join(after, on=frame, how="anti")
    frames = first.filter(_FALSE).join(lost, on=frame, how="anti", maintain_order="left")
    frames = frames.join(second.filter(_FALSE), on=UNIT, how="full", coalesce=True, maintain_order="left_right")
    frames = frames.with_columns(pl.col("baseline", "tonight").fill_null(0.0))
    return pl.concat([table.select(*UNIT, "baseline", "tonight") for table in (rows, frames)])


def frames_taken(first: pl.DataFrame, second: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Return how many frames were taken of some cells, the fewer of two runs: `cell`, `frames`.

    Cells of which a run does not know it are left out. `cells` numbers the names of the cells as `cell`.
    """
    held = [
        run.filter(pl.col("quantity") == "frames").select(*CELL, pl.col("value").alias(name))
        for run, name in ((first, "before"), (second, "after"))
    ]
    found = cells.join(held[0], on=CELL).join(held[1], on=CELL)
    return found.select("cell", frames=pl.min_horizontal("before", "after").cast(pl.Int64))


def with_all_frames(values: pl.DataFrame, frames: pl.DataFrame, *rows: pl.DataFrame) -> pl.DataFrame:
    """Add a value of 0 for the false detections of each frame that has no row in the `harms` of `rows`.

    `values` holds `UNIT`, and numbers by run; `frames` is as of `frames_taken`.
    """
    held = values.filter(_FALSE).select("cell").unique()
    # Realisations of a choice (0, 2, 4) are no count: which frames have no row is then not known.
    for table in rows:
        last = table.group_by("cell").agg(last=pl.col("realisation").max())
        beyond = frames.join(last, on="cell").filter(pl.col("last") >= pl.col("frames"))
        frames = frames.join(beyond, on="cell", how="anti", maintain_order="left")
    numbered = frames.join(held, on="cell", how="semi").select("cell", realisation=pl.int_ranges("frames"))
    numbered = numbered.explode("realisation").drop_nulls().cast({"realisation": values.schema["realisation"]})
    for table in rows:
        numbered = numbered.join(table, on=("cell", "realisation"), how="anti", maintain_order="left")
    constants = {name: 0.0 for name in ("value", "baseline", "tonight") if name in values.columns}
    empty = numbered.with_columns(quantity=pl.lit("false"), **{name: pl.lit(v) for name, v in constants.items()})
    return pl.concat([values, empty], how="diagonal_relaxed") if empty.height else values


def digests(figures: pl.DataFrame) -> pl.DataFrame:
    """Return each cell's hash, in the order of the cells' names, and its number of true highlights, `highlights`."""
    counted = figures.filter(pl.col("quantity") == "n").select(*CELL, highlights="value").unique(CELL)
    return figures.select(*CELL, "digest").unique(CELL).join(counted, on=CELL, how="left").sort(CELL)


def missing_cells(baseline: pl.DataFrame, tonight: pl.DataFrame) -> pl.DataFrame:
    """Compare the cells that one of two runs lacks, by `n`: worse where tonight lacks them, else new; see `digests`."""
    zero, count = pl.lit(0.0), pl.col("highlights")
    # What vanishes is a regression until it is accepted; what is new is not.
    gone, new = (
        one.join(other, on=CELL, how="anti", maintain_order="left")
        for one, other in ((baseline, tonight), (tonight, baseline))
    )
    gone = gone.select(*CELL, baseline=count, tonight=zero, difference=-count, margin=zero, outcome=pl.lit("worse"))
    new = new.select(*CELL, tonight=count, outcome=pl.lit("new"))
    return pl.concat([gone, new], how="diagonal").with_columns(
        quantity=pl.lit("n"), unit=pl.lit(""), method=pl.lit("none")
    )


def lost_highlights(lost: pl.DataFrame, cells: pl.DataFrame, comparable: frozenset[int]) -> pl.DataFrame:
    """Compare the cells that have lost highlights of the baseline, by `n`; see `Pairing`.

    `cells` names the cells by their number. In `comparable` ones seeds mean the same in both runs; in others a loss is
    reported, and not judged.
    """
    before, kept = pl.col("before").cast(pl.Float64), pl.col("kept").cast(pl.Float64)
    judged = pl.col("cell").is_in(list(comparable))
    return lost.sort("cell").join(cells, on="cell", maintain_order="left").select(
        *CELL, quantity=pl.lit("n"), unit=pl.lit(""), method=pl.lit("paired"), baseline=before, tonight=kept,
        difference=kept - before, margin=pl.lit(0.0),
        outcome=pl.when(judged).then(pl.lit("worse")).otherwise(pl.lit("undecided")),
    )  # fmt: skip


class Step(NamedTuple):
    """How far a number may move: both parts must be exceeded, `share` as a share of the smaller of both values."""

    value: pl.Expr
    unit: str
    absolute: float
    share: float
    of_answers: bool = True  # compared where both runs answered; else for every true highlight


STEPS = {
    "error": Step(pl.col("error_deg"), "deg", 0.01, 1.0),
    "better error": Step(pl.col("error_oracle_deg"), "deg", 0.01, 1.0),
    "law": Step(pl.col("error_law_deg"), "deg", 0.01, 0.02),
    "region": Step(REGION_DEG, "deg", 0.002, 0.5),
    "noise part": Step(pl.col("budget_noise_deg"), "deg", 0.002, 0.5),
    "axis ratio": Step(pl.col("axis_ratio"), "", 0.02, 0.05),
    "gain error": Step(pl.col("gain_error"), "", 0.05, 1.0),
    "direction": Step(pl.col("direction_error_deg"), "deg", 1.0, 1.0),
    "light": Step(pl.col("eps_over_d"), "", 1e-6, 1e-3, of_answers=False),
    "peak": Step(pl.col("peak_snr"), "", 0.1, 0.02, of_answers=False),
    "distance": Step(pl.col("distance_mm"), "mm", 1e-4, 1e-4, of_answers=False),
    "curvature": Step(pl.col("kd_min"), "", 1e-4, 1e-3, of_answers=False),
    "larger curvature": Step(pl.col("kd_max"), "", 1e-4, 1e-3, of_answers=False),
}  # fmt: skip
"""Numbers of a result by name. Other rounding moved errors by 3.2e-5 deg at most (docs/measured/gate.md)."""

_KEY = (*CELL, "realisation", "true_id", "seed")
_LOST_HALF = 0.5


def moved(before: pl.DataFrame, after: pl.DataFrame) -> pl.DataFrame:
    """Compare the results of two runs one by one, as comparisons; a row for each cell and number that moved.

    Unchanged code gives the same result again, to the last digits: what moved by more than rounding could move it was
    moved by the code, without a test. The rows are those of cells whose seeds mean the same in both runs. `n` counts
    the results that moved; `baseline` and `tonight` are those of the one that moved farthest, of the status the numbers
    of answers, of flags those of answers with a flag, of false detections their numbers. "worse" where half of a cell's
    answers are lost, else "changed".
    """
    chosen = (*_KEY, "answered", "status", "flags", *STEPS)
    first, second = (
        rows.filter(IS_TRUE).with_columns(
            answered=ANSWERED, **{name: step.value.cast(pl.Float64) for name, step in STEPS.items()}
        ).select(chosen).unique(_KEY, keep="first", maintain_order=True)
        for rows in (before, after)
    )  # fmt: skip
    both = first.join(second, on=_KEY, suffix="_2", nulls_equal=True, maintain_order="left")
    was, now = pl.col("answered"), pl.col("answered_2")
    answered = both.filter(was & now)
    # An answer whose error is no number is none, whatever its status.
    other = pl.col("status").ne_missing(pl.col("status_2")) | (was != now)
    lost = (was & ~now).sum()
    many = (lost > 0) & (lost >= _LOST_HALF * was.sum())
    made = [_told(both, "single answers", "", other.sum(), was.sum(), now.sum(), many)]
    was, now = (pl.col(name).fill_null("") for name in ("flags", "flags_2"))
    made.append(_told(answered, "single flags", "", (was != now).sum(), (was != "").sum(), (now != "").sum()))
    was, now = pl.col("found").fill_null(0), pl.col("found_2").fill_null(0)
    false = _false_by_frame(before, after)
    made.append(_told(false, "single false", "", (was != now).sum(), was.sum(), now.sum()))
    made += [_number(answered if step.of_answers else both, name, step) for name, step in STEPS.items()]
    return pl.concat(made, how="diagonal").with_columns(method=pl.lit(SINGLE), margin=pl.lit(0.0))


def _told(
    results: pl.DataFrame, quantity: str, unit: str, n: pl.Expr, baseline: pl.Expr, tonight: pl.Expr,
    worse: pl.Expr | None = None,
) -> pl.DataFrame:  # fmt: skip
    """Return comparisons of cells, by what is aggregated of their results; those without a moved one are left out."""
    found = results.group_by(CELL, maintain_order=True).agg(
        n=n.cast(pl.Int64), baseline=baseline.cast(pl.Float64), tonight=tonight.cast(pl.Float64),
        worse=pl.lit(False) if worse is None else worse,
    )  # fmt: skip
    return found.filter(pl.col("n") > 0).select(
        *CELL, "n", "baseline", "tonight", quantity=pl.lit(quantity), unit=pl.lit(unit),
        difference=pl.col("tonight") - pl.col("baseline"),
        outcome=pl.when(pl.col("worse")).then(pl.lit("worse")).otherwise(pl.lit("changed")),
    )  # fmt: skip


def _false_by_frame(before: pl.DataFrame, after: pl.DataFrame) -> pl.DataFrame:
    """Count the false detections of each frame, `found` before and `found_2` after."""
    frame = (*CELL, "realisation")
    first, second = (
        rows.group_by(frame, maintain_order=True).agg(found=is_false(rows).sum().cast(pl.Int64))
        for rows in (before, after)
    )
    return first.join(second, on=frame, how="full", coalesce=True, suffix="_2", maintain_order="left_right")


def _number(results: pl.DataFrame, name: str, step: Step) -> pl.DataFrame:
    was, now = pl.col(name), pl.col(f"{name}_2")
    size = (now - was).abs()
    far = (size > step.absolute) & (size > step.share * pl.min_horizontal(was.abs(), now.abs()))
    # A number that appears or vanishes has moved as well.
    far = far.fill_null(False) | (was.is_finite().fill_null(False) != now.is_finite().fill_null(False))
    marked = results.with_columns(far=far, size=size.fill_nan(None).fill_null(float("inf")))
    worst = pl.col("size").filter("far").arg_max()
    farthest = (value.filter("far").get(worst, null_on_oob=True) for value in (was, now))
    return _told(marked, f"single {name}", step.unit, pl.col("far").sum(), *farthest)
