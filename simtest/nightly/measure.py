"""Measures a profile: its experiments, the canaries, and what they cost."""

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.nightly import cost
from simtest.nightly.canaries import randomness as noise
from simtest.nightly.canaries import run_canaries
from simtest.nightly.canaries.canary import or_failed_canary
from simtest.nightly.canaries.signs import wrong_signs
from simtest.nightly.gate.figures import setting_figures
from simtest.nightly.ladder import ladder_canary, ladder_figures, ladder_values
from simtest.nightly.records import FIGURES, NightlyRun, RunRecord, figure_table
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.engines import make_engine
from simtest.runtime.engines.engine import Engine
from simtest.runtime.measuring import PeakMemory
from simtest.spec import Experiment, Profile, experiments_of
from simtest.validation.cases import Case, expand
from simtest.validation.fingerprints import definition
from simtest.validation.jobs import variant_of
from simtest.validation.runner import Progress, run_experiments

_LOOK_S = 0.5
"""Time between two looks at the memory: each takes some milliseconds of a big process."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is made; its rows depend neither on the engine nor on the workers."""

    command: str = ""  # how it was called, for its record
    variant: str | None = None  # of Mitsuba
    engine: Engine | None = None  # does the work; default `workers` processes of this machine
    workers: int = 1  # how many work at once
    progress: Progress | None = None


DEFAULTS = RunOptions()


Planned = tuple[list[Experiment], list[list[Case]]]
"""A profile's experiments, and the cases of each."""


def plan_run(profile: Profile) -> Planned:
    """Return what a profile runs; raise `InputError` for whatever is malformed, before anything is made."""
    experiments = experiments_of(profile)
    for experiment in experiments:
        load_estimators(experiment.estimators)
    return experiments, [expand(experiment) for experiment in experiments]


def measure_run(
    profile: Profile, folder: Path, run_id: str, options: RunOptions = DEFAULTS, planned: Planned | None = None
) -> NightlyRun:
    """Run a profile.

    Parameters
    ----------
    profile : Profile
        What to run.
    folder : Path
        Scratch: each experiment's run stands in a folder of its name afterwards.
    run_id : str
        For the run's record.
    options : RunOptions
        How.
    planned : tuple, optional
        What `plan_run` returned, where it was asked before.

    Raises
    ------
    SimtestError
        If an experiment is malformed or cannot be run, or nothing was measured.
    """
    started, clock = datetime.now(UTC), time.monotonic()
    # Asked at the start: the checkout may have moved on before the run ends.
    origin = {**provenance.environment(), "source_hash": provenance.source_hash()}
    experiments, cases = planned or plan_run(profile)
    planned_pairs = list(zip(experiments, cases, strict=True))
    steps = _Steps(options.progress, sum(case.realisations for of_own in cases for case in of_own))
    figures: list[pl.DataFrame] = []
    with PeakMemory(os.getpid(), _LOOK_S) as peak:
        # Canaries first: a fault that they see is known before the experiments run.
        if profile.canaries:
            steps.show("canaries")
            figures += [run_canaries(None, options.variant), or_failed_canary("error ladder", measured_ladder)]
        before = time.monotonic()
        runs = run_experiments(
            [(experiment, folder / experiment.name) for experiment in experiments], options.command, options.variant,
            steps.within("experiments"), options.engine or make_engine(workers=options.workers),
        )  # fmt: skip
        took_s = time.monotonic() - before
        rows = pl.concat([run.results for run in runs], how="diagonal_relaxed")
        figures.insert(0, setting_figures(rows, frames_of(experiments, cases)))
        if profile.canaries:
            figures.append(or_failed_canary("noises_of", lambda: figure_table(noise.noises_of(rows, experiments))))
            figures.append(or_failed_canary("wrong_signs", lambda: figure_table(wrong_signs(rows))))
    if profile.costs:
        steps.show("costs")
        figures.append(or_failed_canary("costs", lambda: cost.run_times(options.variant)))
        figures.append(cost.memory(peak.peak_mib, options.workers))
    steps.end()
    table = pl.concat([each.select(*FIGURES) for each in figures])
    if not table.height:
        raise InputError(
            f"profile {profile.name}: its experiments gave no rows, and canaries and costs are off; "
            "give it settings with a highlight in view, or canaries = true"
        )
    record = {
        **_origin_of(profile, options),
        "id": run_id,
        "started": started.isoformat(timespec="seconds"),
        "duration_s": round(time.monotonic() - clock, 1),
        "experiments_s": round(took_s, 1),
        "definitions": {own.name: definition(own, of_own) for own, of_own in planned_pairs},
        "variants": {own.name: variant_of(of_own, options.variant) for own, of_own in planned_pairs},
        **origin,
    }
    return NightlyRun(RunRecord.model_validate(record), rows, table)


def _origin_of(profile: Profile, options: RunOptions) -> dict[str, object]:
    """Return what a run's record says of the profile and of how the run was made."""
    library = backend.library_in_use()
    return {
        "profile": profile.name,
        "title": profile.title or profile.name,
        "workers": options.workers,
        "command": options.command,
        "variant": backend.requested_variant(options.variant),
        # Its name alone: runs of two machines are compared, where it lies elsewhere.
        "llvm": None if library is None else Path(library).name,
    }


def measured_ladder() -> pl.DataFrame:
    """Measure the error ladder; return its figures and its canaries."""
    figures = ladder_figures()
    return pl.concat([figures, ladder_canary(figures), ladder_values(figures)])


class _Steps:
    """The whole run's progress: each part moves the bar by its share."""

    def __init__(self, progress: Progress | None, realisations: int) -> None:
        # Canaries, costs, verdict and page count as some realisations each.
        self._progress, self._total, self._done = progress, realisations + max(3, realisations // 20), 0

    def within(self, part: str) -> Callable[[int, int, str], None] | None:
        """Return the callable that moves the bar within a part; its last step is not the run's."""

        def move(done: int, total: int, what: str) -> None:
            self._done = done
            self.show(what if done < total else part)

        return move if self._progress else None

    def show(self, what: str) -> None:
        """Show what is done now."""
        if self._progress:
            self._progress(self._done, self._total, what)

    def end(self) -> None:
        """Show that all is measured."""
        self._done = self._total
        self.show("done")


def frames_of(experiments: Sequence[Experiment], cases: Sequence[Sequence[Case]]) -> dict[tuple[str, str], int]:
    """Count the frames that experiments take, by experiment and setting; `cases` holds those of each experiment."""
    counted: Counter[tuple[str, str]] = Counter()
    for experiment, own in zip(experiments, cases, strict=True):
        for case in own:
            counted[experiment.name, case.setting] += case.realisations
    return dict(counted)
