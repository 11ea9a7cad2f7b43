"""The gate: tonight against the baseline."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl

from simtest.nightly.gate.causes import causes
from simtest.nightly.gate.contrasts import Outcomes, paired, unpaired
from simtest.nightly.gate.holm import holm
from simtest.nightly.gate.limits import Limits
from simtest.nightly.gate.missing_results import digests, lost_highlights, missing_cells
from simtest.nightly.gate.notes import large_and_undecided, notes_on, redefined
from simtest.nightly.gate.pairing import frames_taken, pairing, pairs, with_all_frames
from simtest.nightly.gate.pairing_units import paired_sums, sums
from simtest.nightly.gate.pooling import pooled
from simtest.nightly.gate.quantities import (
    OPTIONAL_COLUMNS,
    RESULT_COLUMNS,
    SAME_AS,
    WHERE_MIXED,
    Quantity,
    harms,
    quantities,
    told_twice,
)
from simtest.nightly.gate.single_results import moved
from simtest.nightly.records import CELL, COMPARISONS, POOLED, Cell, NightlyRun, RunRecord, Verdict, to_explain
from simtest.validation.columns import SCHEMA

DEFAULTS = Limits()

_WORK = {**COMPARISONS, "better": pl.Float64(), "within": pl.Boolean()}
"""Columns of comparisons before `_judged`: `p` is that of a rise, `better` that of a fall, `within` as in `Outcomes`;
an outcome that is set already stands."""


def compare(tonight: NightlyRun, baseline: NightlyRun | None, limits: Limits = DEFAULTS) -> Verdict:
    """Compare a run with the baseline; without one there is nothing to compare, and the causes are faults alone.

    Cells whose results are the same bytes are the same; the others are tested, pair by pair where seeds and versions
    are the same, with all tests as one family (docs/concepts/gate.md).

    Returns
    -------
    Verdict
        "regression" where a comparison is worse, "changed" where one is better or has changed, else "fine"; "no
        baseline" without one. What tonight lacks (a cell, true highlights of a cell whose seeds are the same) is worse.
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
    tested, unmatched, short = _tested(*aligned, shared.filter(~equal).select(CELL), limits, same_machine)
    made = [missing_cells(first, second), _same(shared.filter(equal).select(CELL), tonight.figures), *tested]
    held = [table for table in made if table.height]
    comparisons = _judged(pl.concat([pl.DataFrame(schema=_WORK), *held], how="diagonal_relaxed"), limits)
    notes = notes_on(baseline, tonight, bit_equal, unmatched, short, absent, limits)
    notes += large_and_undecided(comparisons)
    found = causes(comparisons, tonight, baseline)
    return Verdict(_state(comparisons), bit_equal, comparisons, notes, baseline.record, found)


def _state(comparisons: pl.DataFrame) -> str:
    if (comparisons["outcome"] == "worse").any():
        return "regression"
    return "changed" if comparisons.filter(to_explain()).height else "fine"


def _machine(record: RunRecord) -> tuple[str | None, ...]:
    """Return what else than the code decides the last digits of a result."""
    return record.processor, record.variant, record.llvm, record.python


def _versions(record: RunRecord) -> dict[str, str]:
    """Return the versions of the packages that numbers depend on."""
    # simtest's own version does not count: the gate is there to judge it.
    return {**record.versions, "simtest": ""}


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
    baseline: NightlyRun, tonight: NightlyRun, differing: pl.DataFrame, limits: Limits, same_machine: bool
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
    of_pairs = paired_sums(with_all_frames(pairs(*(run.filter(in_pairs) for run in chosen)), taken, before, after))
    of_each = [sums(with_all_frames(run.filter(~in_pairs), taken, run)) for run in chosen]
    # Test
    for name, quantity in quantities(limits).items():
        own = of_pairs.filter(pl.col("quantity") == name).sort("cell")
        first, second = _shared(*(table.filter(pl.col("quantity") == name) for table in of_each))
        for table, outcomes, method in (
            (own, paired(own, quantity), "paired"), (first, unpaired(first, second, quantity), "unpaired")
        ):  # fmt: skip
            names = table.select("cell").join(cells, on="cell", maintain_order="left").select(CELL)
            made.append(_compared(names, name, quantity, outcomes, method, quantity.unit))
            made += _pooled(names, name, quantity, outcomes, method)
        if name not in SAME_AS and name not in WHERE_MIXED:
            rest = cells.join(own, on="cell", how="anti").join(first, on="cell", how="anti").sort("cell")
            made.append(_untested(rest, name, quantity, before, after))
    return made, cells.height - len(matched.cells), matched.lost.height


def _comparable(baseline: RunRecord, tonight: RunRecord, cells: pl.DataFrame) -> frozenset[int]:
    """Return the cells whose seeds mean the same in both runs: of the same definition, made by the same versions."""
    if _versions(baseline) != _versions(tonight):
        return frozenset()
    moved_on = redefined(baseline, tonight)
    return frozenset(cells.filter(~pl.col("experiment").is_in(moved_on))["cell"].to_list())


def _not_tested(harms: pl.DataFrame, *twice: pl.DataFrame) -> pl.DataFrame:
    """Return the cells and quantities of two runs' harms that are not tested.

    A quantity that is another one in both runs would be tested twice (`twice`, of each run); an indicator of
    `WHERE_MIXED` is tested in the cells where it takes both values across the two runs.
    """
    found = harms.group_by("cell", "quantity").agg(kinds=pl.col("value").n_unique())
    alike = found.filter(pl.col("quantity").is_in(WHERE_MIXED), pl.col("kinds") == 1)
    first, second = twice
    both = first.join(second, on=("cell", "quantity"), how="semi")
    return pl.concat([both, alike.select("cell", "quantity")])


def _shared(first: pl.DataFrame, second: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return the rows of cells that both tables hold, in the order of the cells."""
    kept = [one.join(other, on="cell", how="semi").sort("cell") for one, other in ((first, second), (second, first))]
    return kept[0], kept[1]


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


def _judged(made: pl.DataFrame, limits: Limits) -> pl.DataFrame:
    """Correct the p-values, of one family of both sides, and settle the outcomes."""
    # Correct both sides together: a fall is a finding as a rise is.
    family = made["p"].is_not_null().to_numpy()
    weights = _weights((made["setting"] == POOLED).fill_null(False).to_numpy()[family], limits.pooled_weight)
    p = np.stack([made[name].to_numpy()[family] for name in ("p", "better")])
    corrected = np.full((2, made.height), np.nan)
    corrected[:, family] = holm(p.ravel(), np.tile(weights, 2)).reshape(p.shape)
    made = made.with_columns(rises=corrected[0], falls=corrected[1]).with_columns(
        pl.col("rises", "falls").fill_nan(None)
    )
    # Settle
    margin = pl.col("margin")
    inside = (pl.col("low") >= -margin) & (pl.col("high") <= margin)
    level = pl.col("quantity").is_in([name for name, own in quantities(limits).items() if own.level])
    changed = pl.min_horizontal("rises", "falls") <= limits.alpha
    outcome = (
        pl.when(pl.col("outcome").is_not_null()).then("outcome")
        .when(level & changed).then(pl.lit("changed"))
        .when(pl.col("rises") <= limits.alpha).then(pl.lit("worse"))
        .when(pl.col("falls") <= limits.alpha).then(pl.lit("better"))
        .when(inside.fill_null(False) | pl.col("within").fill_null(False)).then(pl.lit("equivalent"))
        .otherwise(pl.lit("undecided"))
    )  # fmt: skip
    # Of both sides the surer one is shown.
    fell = (pl.col("falls") < pl.col("rises")).fill_null(False)
    shown = {"p": pl.when(fell).then("better").otherwise("p"), "p_holm": pl.when(fell).then("falls").otherwise("rises")}
    return made.with_columns(outcome=outcome, **shown).select(*COMPARISONS)


def _weights(is_pooled: np.ndarray, share: float) -> np.ndarray:
    """Return each test's weight in the family: the pooled ones share a part of it, where there are both."""
    if is_pooled.all() or not is_pooled.any():
        return np.ones(len(is_pooled))
    return np.where(is_pooled, share / is_pooled.sum(), (1 - share) / (~is_pooled).sum())
