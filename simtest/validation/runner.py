"""Runs an experiment case by case; each finished case is kept, so that a stopped run can go on."""

import itertools
import json
import re
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.errors import InputError
from simtest.estimators.process import is_core
from simtest.estimators.process.naming import absolute_names, close_cores, core_records
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.engines import Engine, make_engine
from simtest.runtime.files import Json, require_plain, write_atomically, write_json
from simtest.runtime.locks import LOCK
from simtest.runtime.machine_errors import write_error
from simtest.runtime.resources import shown
from simtest.spec import Experiment
from simtest.spec.paper import PaperSetting
from simtest.validation.cases import Case, expand, swept_example
from simtest.validation.fingerprints import fingerprint, input_hashes

if TYPE_CHECKING:
    import polars as pl

    from simtest.validation.execution import Part

GALLERY_ITEMS = 18
RESULTS = "results.parquet"
MOST_DIGEST_BYTES = 1000
PARTS = "parts"
"""Folder of the finished cases of a run that is not finished."""
EXPORT = "export.json"
"""What was exported of a run (`simtest.dataset.export`); it stands in the run's folder."""
EXPORTING = "exporting"
"""Folder of the lists of a run's export that is not finished."""

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

    Raises
    ------
    InputError
        If the experiment does not fit the schema, an estimator is unknown or the folder holds something else.
    BackendError
        If the rendering backend cannot be used.
    """
    return run_experiments([(experiment, folder)], command, variant, progress, engine)[0]


def is_coloured(cases: Sequence[Case]) -> bool:
    """Return whether a scene has the colour of tissue."""
    return any("albedo" in case.data.get("reflectance", {}) for case in cases)


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
    # The variant is chosen here: a worker on another machine may have another environment.
    expanded = [expand(experiment) for experiment, _ in wanted]
    variant = backend.requested_variant(variant, coloured=any(map(is_coloured, expanded)))
    jobs = [
        _Job(experiment, folder, cases, fingerprint(experiment, cases, variant))
        for (experiment, folder), cases in zip(wanted, expanded, strict=True)
    ]
    finished = {job.folder: held for job in jobs if (held := _finished(job.folder, job.digest, len(job.cases)))}
    left = [job for job in jobs if job.folder not in finished]
    _warn_of_kept([job for job in jobs if job.folder in finished])
    # Check: everything that may be refused is refused before a folder is touched.
    cores = _check_estimators(left)
    for job in jobs:
        check_folder(job.folder)
    # Run what is not finished.
    for job in left:
        _warn_of_another(job)
        _prepare(job.folder, job.digest)
    try:
        resumed = _work(left, variant, engine or make_engine(), progress)
        # Write results and summaries, which describe the estimators.
        for job in left:
            record = RunRecord(
                variant=variant,
                llvm=backend.library_in_use(),
                fingerprint=job.digest,
                seed=job.experiment.seed,
                realisations=job.experiment.realisations,
                started=started.isoformat(timespec="seconds"),
                duration_s=round(time.monotonic() - clock, 1),
                command=command,
                inputs=input_hashes(job.cases),
                cores=cores[job.folder],
            )
            finished[job.folder] = _finish(job, record, resumed[job.folder])
    finally:
        close_cores()
    return [finished[job.folder] for job in jobs]


@dataclass(frozen=True)
class _Job:
    """An experiment with the folder that it is run in."""

    experiment: Experiment
    folder: Path
    cases: list[Case]
    digest: str

    def missing(self) -> list[int]:
        """Return the indices of the cases that are not done yet."""
        return [index for index in range(len(self.cases)) if not _part_file(self.folder / PARTS, index).exists()]


def _warn_of_kept(finished: Sequence[_Job]) -> None:
    """Warn that the answers of a core are those of an earlier run: not all that it reads is known."""
    kept = [job.folder for job in finished if any(map(is_core, job.experiment.estimators))]
    if kept:
        warnings.warn(
            f"{shown(kept[0])}: is kept, since the core's command and files are the same; other files that it reads "
            "are not compared (core.files of its TOML file names them)", stacklevel=4,
        )  # fmt: skip


def _check_estimators(jobs: Sequence[_Job]) -> dict[Path, Cores]:
    """Raise `InputError` for unknown estimators; return what the records of the runs, by folder, say of cores.

    The workers load them; a finished run names none that is unknown.
    """
    if jobs:
        from simtest.estimators.registry import load_estimators
    for job in jobs:
        load_estimators(job.experiment.estimators)
    return {job.folder: core_records(job.experiment.estimators) for job in jobs}


def _finish(job: _Job, record: RunRecord, resumed: int) -> Run:
    """Join the parts of an experiment, and write its results and summary."""
    import polars as pl

    from simtest.validation.run_summary import run_summary, write_results

    folder, parts = job.folder, job.folder / PARTS
    results = pl.concat([pl.read_parquet(_part_file(parts, i)) for i in range(len(job.cases))])
    write_results(folder, record, results, run_summary(job.experiment, job.cases, results))
    # The parts go last: until the summary stands, a run that is stopped can go on.
    remove_folder(parts)
    return Run(folder, resumed, results)


def _work(jobs: Sequence[_Job], variant: str | None, engine: Engine, progress: Progress | None) -> dict[Path, int]:
    """Run the cases that are not done yet; return how many of each folder were done before."""
    if not jobs:
        return {}
    # Imported here: finished runs need no renderer, and nobody reads their rows.
    import polars as pl

    from simtest.validation.execution import forget, make_rows, parts_of

    total = sum(case.realisations for job in jobs for case in job.cases)
    missing = {job.folder: job.missing() for job in jobs}
    # Split the missing cases into parts, which an engine may run in any order.
    parts: list[tuple[_Job, int, Part]] = []
    for job in jobs:
        in_gallery, swept = gallery_cases(job.cases), swept_example(job.cases)
        # A worker, on another machine of a cluster for one, may have another current folder.
        absolute = absolute_names(job.experiment.estimators)
        experiment = job.experiment.model_copy(update={"estimators": absolute})
        for index in missing[job.folder]:
            item = job.folder / "gallery" / f"{index:04d}.npz" if index in in_gallery else None
            parts += [(job, index, part) for part in parts_of(experiment, job.cases[index], swept, item, variant)]
    case_of = [(job.folder, index) for job, index, _ in parts]
    waiting = Counter(case_of)
    made: dict[tuple[Path, int], dict[int, pl.DataFrame]] = {case: {} for case in waiting}
    # Progress counts the realisations of earlier, stopped runs as done.
    done = total - sum(job.cases[index].realisations for job in jobs for index in missing[job.folder])
    names = _told([part.case for *_, part in parts])
    name = names[0] if names else ""

    def step() -> None:
        nonlocal done
        done += 1
        if progress and done < total:
            progress(done, total, name)

    if progress and parts:
        progress(done, total, f"starting with {name}")
    # Parts come back in any order.
    for number, rows in engine.run(make_rows, [part for *_, part in parts], step):
        folder, index = case = case_of[number]
        made[case][number] = rows
        # A case is kept once all its parts are there.
        if len(made[case]) == waiting[case]:
            rows = pl.concat([rows for _, rows in sorted(made.pop(case).items())])
            write_atomically(_part_file(folder / PARTS, index), rows.write_parquet)
        name = names[min(number + 1, len(parts) - 1)]
        # Tell what comes now, before it is done.
        if progress and done < total:
            progress(done, total, name)
    forget()
    if progress:
        progress(total, total, "done")
    return {job.folder: len(job.cases) - len(missing[job.folder]) for job in jobs}


def _told(cases: Sequence[Case]) -> list[str]:
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


def gallery_cases(cases: list[Case]) -> set[int]:
    """Choose the cases whose first realisation is kept: evenly spaced ones, and the published protocol's defaults."""
    count = min(GALLERY_ITEMS, len(cases))
    chosen = set(np.linspace(0, len(cases) - 1, count).round().astype(int).tolist())
    at_defaults = (i for i, case in enumerate(cases) if case.is_paper and case.paper_setting() == PaperSetting())
    return chosen | set(itertools.islice(at_defaults, 1))


def _finished(folder: Path, digest: str, cases: int) -> Run | None:
    """Return the finished run that a folder holds, if it is the same and its results are as they were written."""
    record = _record_in(folder)
    if record is None or record["fingerprint"] != digest:
        return None
    try:
        whole = provenance.file_hash(folder / RESULTS) == record.get("results")
    except OSError:
        return None
    return Run(folder, cases) if whole else None


def _warn_of_another(job: _Job) -> None:
    """Warn if the folder holds the finished run of something else, which will be replaced."""
    record = _record_in(job.folder)
    if record is not None and record["fingerprint"] != job.digest:
        what = "holds another run, or one of another version of simtest"
        warnings.warn(f"{job.folder}: {what}; it is replaced", stacklevel=4)


def _record_in(folder: Path) -> dict[str, Any] | None:
    """Return how the finished run in a folder was made; None where there is none."""
    try:
        if (folder / PARTS).is_dir():
            # Beside the parts of a stopped run anything may be incomplete.
            return None
        record = json.loads(require_plain(folder / "summary.json", "record_bytes").read_text(encoding="utf-8"))["run"]
        return dict(record) if "fingerprint" in record else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _prepare(folder: Path, digest: str) -> None:
    """Make the run's folder; keep the finished cases of the same run, stopped, and drop those of another."""
    parts = folder / PARTS
    record = parts / "fingerprint.json"
    try:
        if not (record.is_file() and record.stat().st_size < MOST_DIGEST_BYTES and _told_digest(record) == digest):
            # Results of an earlier run stay until the new ones replace them.
            remove_folder(parts)
            remove_folder(folder / "gallery")
        parts.mkdir(parents=True, exist_ok=True)
        (folder / "gallery").mkdir(exist_ok=True)
        write_json(record, digest)
    except OSError as error:
        raise write_error(error, folder) from error


def _told_digest(record: Path) -> str:
    return record.read_text(encoding="utf-8", errors="replace").strip().strip('"')


def check_folder(folder: Path) -> None:
    """Raise `InputError` if a folder holds something other than a run; remove what a killed run was writing."""
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"--out {shown(folder)}: is a file; must be a folder")
        # Leftovers of a killed run.
        held = {path.name: path for path in folder.iterdir()} if folder.is_dir() else {}
        for name in [name for name in held if re.fullmatch(r"\.(results|summary|guide|index)\.\d+\.part\.\w+", name)]:
            held.pop(name).unlink()
        for left in (*folder.glob(f"{PARTS}/.*.part.*"), *folder.glob("gallery/.*.part.*")):
            left.unlink()
    except OSError as error:
        raise InputError(f"--out {shown(folder)}: cannot be used ({error.strerror})") from error
    # What is no part of a run.
    held.pop(LOCK, None)
    own = {"results.parquet", "summary.json", "gallery", "figures", "guide.json", "index.html"}
    own |= {PARTS, EXPORT, EXPORTING}
    strangers = sorted(held.keys() - own)
    # Folders of those names alone may be anyone's, and a run would replace them.
    if not strangers and not held.keys() & {"results.parquet", PARTS}:
        strangers = sorted(held)
    if strangers:
        stranger = shown(strangers[0])
        raise InputError(
            f"--out {shown(folder)}: holds {stranger}, which is no part of a run; must be empty or hold a run"
        )


def _part_file(parts: Path, index: int) -> Path:
    return parts / f"case-{index:05d}.parquet"


def remove_folder(folder: Path) -> None:
    """Remove a folder of plain files that a run has made."""
    if folder.is_dir():
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
