"""Runs experiments case by case; each finished case is kept, so that a stopped run can go on."""

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from simtest.estimators.names import close_cores, core_records, short_names
from simtest.estimators.process import is_core
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.files import Json
from simtest.runtime.processes import Engine, make_engine
from simtest.spec import Experiment
from simtest.validation.cases import Case, expand
from simtest.validation.fingerprints import fingerprint, input_hashes, region_hashes
from simtest.validation.run_folder import (
    PARTS,
    RESULTS,
    check_folder,
    holds_finished,
    part_file,
    prepare,
    record_in,
    remove_folder,
)

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class Job:
    """An experiment with the folder that it is run in.

    Parameters
    ----------
    experiment : Experiment
        What is run.
    folder : Path
        Of the run.
    cases : list of Case
        The experiment's.
    variant : str
        Mitsuba variant of all its cases.
    digest : str
        Hash of everything that determines the results.
    """

    experiment: Experiment
    folder: Path
    cases: list[Case]
    variant: str
    digest: str

    def missing(self) -> list[int]:
        """Return the indices of the cases that are not done yet."""
        return [index for index in range(len(self.cases)) if not part_file(self.folder / PARTS, index).exists()]


def make_jobs(wanted: Sequence[tuple[Experiment, Path]], variant: str | None) -> list[Job]:
    """Expand experiments, each paired with its folder, and choose the variant of each."""
    jobs = []
    for experiment, folder in wanted:
        cases = expand(experiment)
        # Chosen here: a worker on another machine may have another environment.
        own = variant_of(cases, variant)
        jobs.append(Job(experiment, folder, cases, own, fingerprint(experiment, cases, own)))
    return jobs


def variant_of(cases: Sequence[Case], variant: str | None = None) -> str:
    """Return the Mitsuba variant of an experiment, given that which was asked for (see `backend.requested_variant`).

    The variant depends on the experiment's own scenes alone, never on the other experiments of a run: in a colour
    variant even a grey scene has three channels, each with its own noise, and their mean is less noisy.
    """
    return backend.requested_variant(variant, coloured=any(case.is_coloured for case in cases))


Cores = dict[str, dict[str, object]]
"""What a record says of each core, by the estimator's name."""

Progress = Callable[[int, int, str], None]
"""Called with realisations done, realisations in all, and the name of the setting."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    Parameters
    ----------
    folder : Path
        Holds results.parquet, summary.json and gallery/.
    resumed : int
        Cases that an earlier, interrupted run had finished.
    made : polars.DataFrame, optional
        All rows, where they are at hand.
    """

    folder: Path
    resumed: int
    made: "pl.DataFrame | None" = None

    @cached_property
    def results(self) -> "pl.DataFrame":
        """All rows; read at first use, since nobody asks for those of a run whose page is up to date."""
        import polars as pl

        return pl.read_parquet(self.folder / RESULTS) if self.made is None else self.made


@dataclass(frozen=True)
class RunRecord:
    """How a run was made, as its summary.json tells.

    Parameters
    ----------
    variant, llvm : str
        Mitsuba variant, and the libLLVM in use, if any.
    fingerprint : str
        Hash of everything that determines the results.
    seed, realisations : int
        The experiment's.
    started, duration_s
        ISO 8601, UTC, and wall time.
    command : str
        How the run was called.
    inputs : dict
        SHA-256 by input file.
    cores : dict
        Command, greeting and files of each estimator that is a core of its own process.
    results : str
        SHA-256 of results.parquet.
    """

    variant: str
    llvm: str | None
    fingerprint: str
    seed: int
    realisations: int
    started: str
    duration_s: float
    command: str
    inputs: dict[str, str]
    cores: Cores
    results: str = ""

    def to_json(self) -> Json:
        """Return the record with the environment that the run was made in."""
        return {**provenance.environment(), **vars(self)}


def run_experiment(
    experiment: Experiment,
    folder: Path,
    command: str = "",
    variant: str | None = None,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> Run:
    """Run an experiment, or go on with an interrupted run of the same.

    Parameters
    ----------
    experiment : Experiment
        What to run.
    folder : Path
        Made if need be. A folder that holds something other than a run is refused; the same run, finished, is
        returned as it is.
    command, variant, progress, engine
        See `simtest.validate`; by default this process does the work. The rows do not depend on the engine.
    """
    return run_experiments([(experiment, folder)], command, variant, progress, engine)[0]


def run_experiments(
    wanted: Sequence[tuple[Experiment, Path]],
    command: str = "",
    variant: str | None = None,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> list[Run]:
    """Run several experiments as one piece of work, so that an engine's processes start once; see `run_experiment`.

    `wanted` pairs each experiment with its folder; the runs are returned in the same order.
    """
    started, clock = datetime.now(UTC), time.monotonic()
    jobs = make_jobs(wanted, variant)
    finished = {job.folder: Run(job.folder, len(job.cases)) for job in jobs if holds_finished(job.folder, job.digest)}
    left = [job for job in jobs if job.folder not in finished]
    _warn_of_kept([job for job in jobs if job.folder in finished])
    # Check: everything that may be refused is refused before a folder is touched.
    cores = _checked_cores(left)
    for job in jobs:
        check_folder(job.folder)
    # Run what is not finished.
    for job in left:
        _warn_of_another(job)
        prepare(job.folder, job.digest)
    try:
        resumed = _make_cases(left, engine or make_engine(), progress)
        # Write results and summaries, which describe the estimators.
        for job in left:
            record = RunRecord(
                variant=job.variant,
                llvm=backend.library_in_use(),
                fingerprint=job.digest,
                seed=job.experiment.seed,
                realisations=job.experiment.realisations,
                started=started.isoformat(timespec="seconds"),
                duration_s=round(time.monotonic() - clock, 1),
                command=command,
                inputs=input_hashes(job.cases) | region_hashes(job.experiment),
                cores=cores[job.folder],
            )
            finished[job.folder] = _finish(job, record, resumed[job.folder])
    finally:
        close_cores()
    return [finished[job.folder] for job in jobs]


def _make_cases(jobs: Sequence[Job], engine: Engine, progress: Progress | None) -> dict[Path, int]:
    """Make the cases that are not done yet; return how many of each folder were done before."""
    if not jobs:
        return {}
    # Imported here: finished runs need no renderer, and nobody reads their rows.
    from simtest.validation.case_work import make_cases

    return make_cases(jobs, engine, progress)


def _warn_of_kept(finished: Sequence[Job]) -> None:
    """Warn that the answers of a core are those of an earlier run: not all that it reads is known."""
    kept = [job.folder for job in finished if any(map(is_core, job.experiment.estimators))]
    if kept:
        warnings.warn(
            f"{kept[0]}: is kept, since the core's command and files are the same; other files that it reads "
            "are not compared (core.files of its TOML file names them)", stacklevel=4,
        )  # fmt: skip


def _warn_of_another(job: Job) -> None:
    """Warn if the folder holds the finished run of something else, which will be replaced."""
    record = record_in(job.folder)
    if record is not None and record["fingerprint"] != job.digest:
        what = "holds another run, or one of another version of simtest"
        warnings.warn(f"{job.folder}: {what}; it is replaced", stacklevel=4)


def check_estimators(names: Sequence[str]) -> None:
    """Raise `InputError` for estimators that are unknown; the workers load them."""
    from simtest.estimators.names import load_estimators

    load_estimators(names)


def _checked_cores(jobs: Sequence[Job]) -> dict[Path, Cores]:
    """Return what the records of the runs, by folder, say of cores; a finished run names no unknown estimator."""
    for job in jobs:
        check_estimators(job.experiment.estimators)
        if (regions := job.experiment.regions) is not None:
            # Imported here: few runs have calibrations.
            from simtest.reconstruction.regions import calibrations_of

            calibrations_of(regions, short_names(job.experiment.estimators))
    return {job.folder: core_records(job.experiment.estimators) for job in jobs}


def _finish(job: Job, record: RunRecord, resumed: int) -> Run:
    """Join the parts of an experiment, and write its results and summary."""
    import polars as pl

    from simtest.validation.run_summary import summarise_run, write_results

    folder, parts = job.folder, job.folder / PARTS
    results = pl.concat([pl.read_parquet(part_file(parts, i)) for i in range(len(job.cases))])
    summary = summarise_run(job.experiment, job.cases, results)
    write_results(folder, record, results, job.experiment.name, summary)
    # The parts go last: until the summary stands, a run that is stopped can go on.
    remove_folder(parts)
    return Run(folder, resumed, results)
