"""The work of a run: the missing cases are split into parts, an engine makes their rows, finished cases are kept."""

import itertools
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import polars as pl

from simtest.estimators import AnyEstimator, load_estimators
from simtest.estimators.names import absolute_names, forgive_cores
from simtest.runtime.files import write_parquet
from simtest.runtime.processes import Engine, OnStep
from simtest.spec import Experiment
from simtest.spec.recipes import PaperSetting
from simtest.surfaces import forget_meshes
from simtest.validation.cases import Case, swept_example
from simtest.validation.columns import Row, Value, swept_columns, table
from simtest.validation.paper.gallery_item import save_realisation
from simtest.validation.paper.predictions import cramer_rao_bound
from simtest.validation.paper.rows import paper_rows, pipeline_with
from simtest.validation.realisation import Realiser, keep_frame
from simtest.validation.run_folder import PARTS, part_file
from simtest.validation.runner import Job

if TYPE_CHECKING:
    from simtest.validation.runner import Progress


PAPER_CHUNK = 125
"""Realisations of the published protocol that a part makes: a second's work."""

GALLERY_ITEMS = 18
"""Cases of an experiment that are kept for the gallery."""


@dataclass(frozen=True)
class Part:
    """Some realisations of a case.

    Parameters
    ----------
    swept : mapping
        An example of each swept value of the experiment, for the columns' types.
    item : Path or None
        Where to keep the first realisation for the gallery.
    variant : str or None
        Mitsuba variant.
    """

    experiment: Experiment
    case: Case
    numbers: range
    swept: Mapping[str, Value]
    item: Path | None
    variant: str | None


@lru_cache(maxsize=1)
def realiser_of(variant: str | None) -> Realiser:
    """Return this process's realiser, which stays from part to part; that of another variant is let go."""
    return Realiser(variant)


@lru_cache(maxsize=1)
def _estimators(names: tuple[str, ...]) -> dict[str, AnyEstimator]:
    """Return the estimators of the last parts: to find them the metadata of all installed packages are read."""
    return load_estimators(names)


@lru_cache(maxsize=1)
def _forget_meshes_of_others(experiment: str, label: str) -> None:
    """Let the meshes of the last label go: the next one's anatomy is another, and each takes a tenth of a gigabyte."""
    forget_meshes()


def forget() -> None:
    """Let this process's rendering session and estimators go."""
    realiser_of.cache_clear()
    _estimators.cache_clear()
    pipeline_with.cache_clear()


def gallery_cases(cases: list[Case]) -> set[int]:
    """Choose the cases whose first realisation is kept: evenly spaced ones, and the published protocol's defaults."""
    count = min(GALLERY_ITEMS, len(cases))
    chosen = set(np.linspace(0, len(cases) - 1, count).round().astype(int).tolist())
    at_defaults = (i for i, case in enumerate(cases) if case.is_paper and case.paper_setting() == PaperSetting())
    return chosen | set(itertools.islice(at_defaults, 1))


def parts_of(
    experiment: Experiment, case: Case, swept: Mapping[str, Value], item: Path | None, variant: str | None
) -> list[Part]:
    """Split a case into parts: the published protocol into chunks, a rendered case not at all."""
    # A rendered case shares its view between realisations; the protocol's realisations have nothing in common.
    numbers = case.numbers()
    size = PAPER_CHUNK if case.is_paper else max(1, len(numbers))
    return [
        Part(experiment, case, numbers[first : first + size], swept, None if first else item, variant)
        for first in range(0, len(numbers), size)
    ]


def make_rows(part: Part, tell: OnStep) -> pl.DataFrame:
    """Make a part's rows, in the order of its realisations; `tell` is called after each."""
    # The rows must not depend on the parts that this process has made before.
    forgive_cores()
    _forget_meshes_of_others(part.experiment.name, part.case.label)
    if part.case.is_paper:
        rows = _published(part)
        for _ in part.numbers:
            tell()
    else:
        rows = _rendered(part, tell)
    return table(rows, part.swept)


def _rendered(part: Part, tell: OnStep) -> list[Row]:
    experiment, case, realiser = part.experiment, part.case, realiser_of(part.variant)
    estimators = _estimators(tuple(experiment.estimators))
    rows: list[Row] = []
    for number in part.numbers:
        made = realiser.make(experiment, case, number, estimators)
        rows += made.rows
        if part.item and number == part.numbers[0]:
            keep_frame(part.item, realiser.session, experiment, case, made)
        tell()
    return rows


def _published(part: Part) -> list[Row]:
    experiment, case, setting = part.experiment, part.case, part.case.paper_setting()
    seeds = [case.noise_seed(experiment, number) for number in part.numbers]
    if part.item:
        save_realisation(part.item, experiment, case, part.numbers[0])
    swept = {**case.paper_columns(), **case.swept, "bound_deg": _bound_deg(setting)}
    common: Row = {"experiment": experiment.name, "label": case.label, "setting": case.setting, **swept_columns(swept)}
    return paper_rows(setting, common, part.numbers, seeds, experiment.estimators)


@lru_cache(maxsize=1)
def _bound_deg(setting: PaperSetting) -> float | None:
    """Return the bound of a setting, whose parts all state it: that of the light at V."""
    bound = cramer_rao_bound(setting) if setting.eps == 0 else None
    return None if bound is None else float(np.degrees(bound))


class CaseOf(NamedTuple):
    """A case of a run: the run's folder and the number of the case."""

    folder: Path
    number: int


def make_cases(jobs: Sequence[Job], engine: Engine, progress: "Progress | None") -> dict[Path, int]:
    """Make the cases that are not done yet; return how many of each folder were done before."""
    missing = {job.folder: job.missing() for job in jobs}
    planned = [part for job in by_variant(jobs) for part in _parts(job, missing[job.folder])]
    cases, parts = [case for case, _ in planned], [part for _, part in planned]
    total = sum(case.realisations for job in jobs for case in job.cases)
    # Realisations of earlier, stopped runs count as done.
    left = sum(job.cases[index].realisations for job in jobs for index in missing[job.folder])
    bar = _Bar(progress, total, total - left, names_of([part.case for part in parts]))
    waiting = Counter(cases)
    made: dict[CaseOf, dict[int, pl.DataFrame]] = {case: {} for case in waiting}
    # Parts come back in any order; a case is kept once all its parts are there.
    for number, rows in _run(engine, parts, bar.step):
        case = cases[number]
        made[case][number] = rows
        if len(made[case]) == waiting[case]:
            whole = pl.concat([rows for _, rows in sorted(made.pop(case).items())])
            write_parquet(part_file(case.folder / PARTS, case.number), whole)
        bar.begin(number + 1)
    forget()
    bar.end()
    return {job.folder: len(job.cases) - len(missing[job.folder]) for job in jobs}


def _run(engine: Engine, parts: Sequence[Part], on_step: OnStep) -> Iterator[tuple[int, pl.DataFrame]]:
    """Yield the number and the rows of each part; a variant has its own processes: memory of the last one is freed."""
    first = 0
    for _, group in itertools.groupby(parts, key=lambda part: part.variant):
        own = list(group)
        for number, rows in engine.run(make_rows, own, on_step):
            yield first + number, rows
        first += len(own)


def by_variant(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs, those of one variant together: a process that changes its variant compiles its kernels anew."""
    order = list(dict.fromkeys(job.variant for job in jobs))
    return sorted(jobs, key=lambda job: order.index(job.variant))


def _parts(job: Job, missing: Sequence[int]) -> list[tuple[CaseOf, Part]]:
    """Split the missing cases of a job into parts, which an engine may run in any order."""
    in_gallery, swept = gallery_cases(job.cases), swept_example(job.cases, job.experiment.regions)
    # A worker, on another machine of a cluster for one, may have another current folder.
    absolute = absolute_names(job.experiment.estimators)
    experiment = job.experiment.model_copy(update={"estimators": absolute})
    made = []
    for index in missing:
        item = job.folder / "gallery" / f"{index:04d}.npz" if index in in_gallery else None
        parts = parts_of(experiment, job.cases[index], swept, item, job.variant)
        made += [(CaseOf(job.folder, index), part) for part in parts]
    return made


class _Bar:
    """The progress of all parts together: tells what comes now, before it is done."""

    def __init__(self, progress: "Progress | None", total: int, done: int, names: Sequence[str]) -> None:
        self._progress, self._total, self._done, self._names = progress, total, done, names
        self._name = names[0] if names else ""
        if names:
            self._show(f"starting with {self._name}")

    def _show(self, what: str) -> None:
        if self._progress:
            self._progress(self._done, self._total, what)

    def step(self) -> None:
        """Count a realisation."""
        self._done += 1
        # The last step is told by `end`, once everything is kept.
        if self._done < self._total:
            self._show(self._name)

    def begin(self, part: int) -> None:
        """Name the part that comes now; after the last one the name stays."""
        self._name = self._names[min(part, len(self._names) - 1)]
        if self._done < self._total:
            self._show(self._name)

    def end(self) -> None:
        """Show that all is done."""
        self._done = self._total
        self._show("done")


def names_of(cases: Sequence[Case]) -> list[str]:
    """Return what the bar tells while each case runs: its setting, and where an anatomy must be made first."""
    made: set[str] = set()
    names = []
    for case in cases:
        surface = case.data.get("surface", {})
        is_anatomy = surface.get("type") == "anatomy"
        shape = json.dumps([surface.get(key) for key in ("path", "seed", "recipe")], default=str)
        names.append(case.setting + (": making the surface" if is_anatomy and shape not in made else ""))
        if is_anatomy:
            made.add(shape)
    return names
