"""The worst cases of many results: the rows that missed by most, and their frames, reproduced from the seeds."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.spec import Experiment
from simtest.validation import gallery_items as gallery
from simtest.validation.cases import Case, expand
from simtest.validation.jobs import variant_of
from simtest.validation.paper.gallery_item import save_realisation
from simtest.validation.realisation import Realiser
from simtest.validation.results_table import Value

MOST = 8
"""Cases that are chosen."""

_CELL = ("experiment", "label", "surface", "setting", "estimator")


@dataclass(frozen=True)
class WorstCase:
    """A frame that is worth a look: the estimator that missed, and why, as a sentence with error and expectation."""

    experiment: str
    setting: str
    realisation: int
    estimator: str
    why: str


def worst_cases(results: pl.DataFrame, worse: pl.DataFrame | None = None, most: int = MOST) -> list[WorstCase]:
    """Choose the worst cases: first of the cells that got worse, then of each estimator in turn.

    Rows are ranked by how far the error of the better candidate exceeds the expected one: that of the law, or else the
    median of the setting and estimator. So the known failure of a model does not fill the gallery.

    Parameters
    ----------
    results : polars.DataFrame
        Rows of any experiments.
    worse : polars.DataFrame, optional
        Columns that name cells (experiment, label, surface, setting, estimator), the worst first; they get at most half
        of the cases.
    most : int
        Cases at most. A frame is chosen once.

    Returns
    -------
    list of WorstCase
    """
    # Excess over what is expected. A law that is not finite predicts nothing, and would be sorted before all numbers.
    results = results.with_columns(error_law_deg=pl.when(pl.col("error_law_deg").is_finite()).then("error_law_deg"))
    expected = pl.coalesce("error_law_deg", pl.col("error_oracle_deg").median().over(_CELL))
    # Only answers that were matched have an error.
    answered = (pl.col("status") == "ok") & pl.col("true_id").is_not_null() & pl.col("error_oracle_deg").is_finite()
    rows = results.filter(answered).with_columns(
        expected=expected, excess=pl.col("error_oracle_deg") - expected, row=pl.int_range(pl.len())
    )
    rows = rows.sort("excess", "row", descending=[True, False])
    # The worst row of each cell that got worse.
    queues: list[pl.DataFrame] = []
    if worse is not None:
        cells = worse.select(_CELL).unique(maintain_order=True)
        # Pooled comparisons and costs have no frame: they must not displace cells that have.
        cells = cells.join(rows, on=_CELL, how="semi", nulls_equal=True, maintain_order="left").head(most // 2)
        queues += [rows.join(cell, on=_CELL, nulls_equal=True).head(1) for cell in cells.iter_slices(1)]
    chosen: dict[tuple[str, str, int], WorstCase] = {}
    _take(chosen, [queue for queue in queues if queue.height], most // 2)
    # Then each estimator's worst rows, in turn.
    _take(chosen, [own for _, own in sorted(rows.group_by("estimator"), key=lambda item: str(item[0]))], most)
    return list(chosen.values())


def _take(chosen: dict[tuple[str, str, int], WorstCase], queues: list[pl.DataFrame], most: int) -> None:
    """Take the worst row of each queue in turn; each frame once, and each setting once for each queue."""
    waiting = [(own.iter_rows(named=True), set[tuple[str, str]]()) for own in queues]
    while waiting and len(chosen) < most:
        left = []
        for rows, settings in waiting:
            if len(chosen) >= most:
                break
            for row in rows:
                key = (row["experiment"], row["setting"], row["realisation"])
                if key not in chosen and key[:2] not in settings:
                    settings.add(key[:2])
                    chosen[key] = WorstCase(*key, row["estimator"], _why(row))
                    left.append((rows, settings))
                    break
        waiting = left


def _why(row: Mapping[str, Value]) -> str:
    beside = "its law says" if row["error_law_deg"] is not None else "the setting's median is"
    return f"{row['estimator']} missed by {row['error_oracle_deg']:.3g}°; {beside} {row['expected']:.3g}°."


def save_worst(
    cases: Iterable[WorstCase], experiments: Iterable[Experiment], folder: Path, variant: str | None = None
) -> tuple[Path, ...]:
    """Reproduce the frames of worst cases from their seeds, and keep them as gallery items.

    Parameters
    ----------
    cases : iterable of WorstCase
        Which.
    experiments : iterable of Experiment
        As they were run: name, seed and realisations.
    folder : Path
        Where the .npz files go, in the order of the cases; made if need be.
    variant : str, optional
        Mitsuba variant.

    Raises
    ------
    InputError
        If a case belongs to none of the experiments.
    """
    by_name = {experiment.name: experiment for experiment in experiments}
    expanded: dict[str, list[Case]] = {}
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    realiser = Realiser(variant)
    for i, worst in enumerate(cases):
        experiment = by_name.get(worst.experiment)
        if experiment is None:
            raise InputError(f"experiment {worst.experiment!r}: is none of {', '.join(by_name) or 'those given'}")
        if worst.experiment not in expanded:
            expanded[worst.experiment] = expand(experiment)
        case = _case(expanded[worst.experiment], worst)
        file = folder / f"worst-{i:02d}.npz"
        if case.is_paper:
            save_realisation(file, experiment, case, worst.realisation, worst.why)
        else:
            # The variant is the one that the experiment was run with.
            own = variant_of(expanded[worst.experiment], variant)
            realiser = realiser if realiser.variant == own else Realiser(own)
            made = realiser.make(experiment, case, worst.realisation, load_estimators(experiment.estimators))
            gallery.save(file, realiser.session, experiment, case, made, worst.why)
        files.append(file)
    return tuple(files)


def _case(cases: list[Case], worst: WorstCase) -> Case:
    for case in cases:
        if case.setting == worst.setting and worst.realisation in case.numbers():
            return case
    raise InputError(
        f"experiment {worst.experiment}: has no realisation {worst.realisation} of the setting {worst.setting!r}"
    )
