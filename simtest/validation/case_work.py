"""The work of a run: the missing cases are split into parts, an engine makes their rows, finished cases are kept."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import polars as pl

from simtest.estimators.names import absolute_names
from simtest.runtime.files import write_atomically
from simtest.runtime.processes import Engine
from simtest.validation.cases import Case, swept_example
from simtest.validation.execution import Part, forget, gallery_cases, make_rows, parts_of
from simtest.validation.jobs import Job
from simtest.validation.run_folder import PARTS, part_file

if TYPE_CHECKING:
    from simtest.validation.runner import Progress


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
    for number, rows in engine.run(make_rows, parts, bar.step):
        case = cases[number]
        made[case][number] = rows
        if len(made[case]) == waiting[case]:
            whole = pl.concat([rows for _, rows in sorted(made.pop(case).items())])
            write_atomically(part_file(case.folder / PARTS, case.number), whole.write_parquet)
        bar.begin(number + 1)
    forget()
    bar.end()
    return {job.folder: len(job.cases) - len(missing[job.folder]) for job in jobs}


def by_variant(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs, those of one variant together: a process that changes its variant compiles its kernels anew."""
    order = list(dict.fromkeys(job.variant for job in jobs))
    return sorted(jobs, key=lambda job: order.index(job.variant))


def _parts(job: Job, missing: Sequence[int]) -> list[tuple[CaseOf, Part]]:
    """Split the missing cases of a job into parts, which an engine may run in any order."""
    in_gallery, swept = gallery_cases(job.cases), swept_example(job.cases)
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
