"""Measures a profile: its experiments, with their figures and the record of how they were made."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.nightly.gate.figures import setting_figures
from simtest.nightly.records import NightlyRun, RunRecord
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.processes import Engine, make_engine
from simtest.spec import Experiment, Profile, experiments_of
from simtest.validation.cases import Case, expand
from simtest.validation.fingerprints import definition
from simtest.validation.jobs import variant_of
from simtest.validation.runner import Progress, run_experiments


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
    """
    started, clock = datetime.now(UTC), time.monotonic()
    # Asked at the start: the checkout may have moved on before the run ends.
    origin = {**provenance.environment(), "source_hash": provenance.source_hash()}
    experiments, cases = planned or plan_run(profile)
    planned_pairs = list(zip(experiments, cases, strict=True))
    runs = run_experiments(
        [(experiment, folder / experiment.name) for experiment in experiments], options.command, options.variant,
        options.progress, options.engine or make_engine(workers=options.workers),
    )  # fmt: skip
    rows = pl.concat([run.results for run in runs], how="diagonal_relaxed")
    if not rows.height:
        raise InputError(f"profile {profile.name}: its experiments gave no rows; give it a setting with a highlight")
    record = {
        **_origin_of(profile, options),
        "id": run_id,
        "started": started.isoformat(timespec="seconds"),
        "duration_s": round(time.monotonic() - clock, 1),
        "definitions": {own.name: definition(own, of_own) for own, of_own in planned_pairs},
        "variants": {own.name: variant_of(of_own, options.variant) for own, of_own in planned_pairs},
        **origin,
    }
    return NightlyRun(RunRecord.model_validate(record), rows, setting_figures(rows, frames_of(experiments, cases)))


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


def frames_of(experiments: Sequence[Experiment], cases: Sequence[Sequence[Case]]) -> dict[tuple[str, str], int]:
    """Count the frames that experiments take, by experiment and setting; `cases` holds those of each experiment."""
    counted: Counter[tuple[str, str]] = Counter()
    for experiment, own in zip(experiments, cases, strict=True):
        for case in own:
            counted[experiment.name, case.setting] += case.realisations
    return dict(counted)
