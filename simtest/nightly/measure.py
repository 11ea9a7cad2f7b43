"""Runs a profile: its experiments, the canaries, and what they cost."""

import os
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.estimators import load_estimators
from simtest.nightly import cost
from simtest.nightly.canaries import Canary, run_canaries
from simtest.nightly.canaries import randomness as noise
from simtest.nightly.canaries.record import as_figures
from simtest.nightly.gate.figures import setting_figures
from simtest.nightly.gate.records import FIGURES, Night
from simtest.nightly.ladder import ladder_canary, ladder_figures
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.engines import make_engine
from simtest.runtime.engines.engine import Engine
from simtest.runtime.measuring import PeakMemory
from simtest.spec import Profile, experiments_of
from simtest.validation.cases import expand
from simtest.validation.runner import Progress, definition, run_experiments

_LOOK_S = 0.5
"""Time between two looks at the memory: each takes some milliseconds of a big process."""


def measure_night(
    profile: Profile,
    folder: Path,
    run_id: str,
    command: str = "",
    variant: str | None = None,
    engine: Engine | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Night:
    """Run a profile.

    Parameters
    ----------
    profile : Profile
        What to run.
    folder : Path
        Scratch: each experiment's run stands in a folder of its name afterwards.
    run_id, command : str
        For the night's record.
    variant : str, optional
        Mitsuba variant.
    engine : Engine, optional
        Who does the work; default `workers` processes of this machine.
    workers : int
        How many work at once.
    progress : callable, optional
        See `simtest.validation.runner.Progress`.

    Returns
    -------
    Night
        The rows do not depend on engine and workers.

    Raises
    ------
    SimtestError
        If an experiment is malformed or cannot be run.
    """
    started, clock = datetime.now(UTC), time.monotonic()
    # Told at the start: the checkout may have moved on before the night ends.
    origin = {**provenance.environment(), "source_hash": provenance.source_hash()}
    experiments = experiments_of(profile)
    cases = [expand(experiment) for experiment in experiments]
    for experiment in experiments:
        # Refused before the canaries, not after them.
        load_estimators(experiment.estimators)
    definitions = {own.name: definition(own, of_own) for own, of_own in zip(experiments, cases, strict=True)}
    steps = _Steps(progress, sum(case.realisations for of_own in cases for case in of_own))
    figures: list[pl.DataFrame] = []
    with PeakMemory(os.getpid(), _LOOK_S) as peak:
        if profile.canaries:
            steps.tell("canaries")
            figures += [run_canaries(None, variant), *_guarded("error ladder", _ladder)]
        before = time.monotonic()
        runs = run_experiments(
            [(experiment, folder / experiment.name) for experiment in experiments], command, variant,
            steps.of("experiments"), engine or make_engine(workers=workers),
        )  # fmt: skip
        took_s = time.monotonic() - before
        rows = pl.concat([run.results for run in runs], how="diagonal_relaxed")
        figures.insert(0, setting_figures(rows))
        if profile.canaries:
            figures += _guarded("noises_of", lambda: [as_figures(noise.noises_of(rows, experiments))])
    if profile.costs:
        steps.tell("costs")
        figures += _guarded("costs", lambda: [cost.run_times(variant)])
        figures.append(cost.memory(peak.peak_mib, workers))
    steps.end()
    library = backend.library_in_use()
    run = {
        "id": run_id,
        "profile": profile.name,
        "title": profile.title or profile.name,
        "started": started.isoformat(timespec="seconds"),
        "duration_s": round(time.monotonic() - clock, 1),
        "experiments_s": round(took_s, 1),
        "workers": workers,
        "definitions": definitions,
        "command": command,
        **origin,
        "variant": backend.requested_variant(variant),
        # Its name: where it lies says nothing of the numbers, and nights of two machines are compared.
        "llvm": None if library is None else Path(library).name,
    }
    return Night(run, rows, pl.concat([table.select(*FIGURES) for table in figures]))


def _ladder() -> list[pl.DataFrame]:
    figures = ladder_figures()
    return [figures, ladder_canary(figures)]


def _guarded(name: str, measure: Callable[[], list[pl.DataFrame]]) -> list[pl.DataFrame]:
    """Give figures, or in their place a canary that failed: a fault of one part must not lose a night."""
    try:
        return measure()
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
        return [as_figures([Canary(name, "error", "", float("nan"), 0.0, n=0, about=why)])]


class _Steps:
    """The whole night's progress: each part moves the bar by its share."""

    def __init__(self, progress: Progress | None, realisations: int) -> None:
        # Canaries, costs, verdict and page count as some realisations each.
        self._progress, self._total, self._done = progress, realisations + max(3, realisations // 20), 0

    def of(self, part: str) -> Callable[[int, int, str], None] | None:
        """Give the callable that moves the bar within a part; its last step is not the night's."""

        def move(done: int, total: int, what: str) -> None:
            self._done = done
            self.tell(what if done < total else part)

        return move if self._progress else None

    def tell(self, what: str) -> None:
        """Say what is done now."""
        if self._progress:
            self._progress(self._done, self._total, what)

    def end(self) -> None:
        """Say that all is measured."""
        self._done = self._total
        self.tell("done")
