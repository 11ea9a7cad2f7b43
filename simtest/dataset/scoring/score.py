"""Scores a table of answers as a run's own estimators are scored: the same rows, summary and gallery."""

import hashlib
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.dataset.scoring.answers import (
    Answer,
    Answers,
    TableEstimator,
    check_name,
    read_answers,
    reversed_axes,
    stray_rows,
    wide_regions,
)
from simtest.dataset.scoring.frames import Frames, Record, Source, named, open_source, read_record
from simtest.errors import InputError
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.files import are_nested
from simtest.runtime.locks import exclusive_folder
from simtest.runtime.processes import Engine, OnStep, make_engine
from simtest.spec import Experiment
from simtest.spec.recipes import CoreRegions
from simtest.validation.case_work import forget
from simtest.validation.columns import Row, Value
from simtest.validation.columns import table as results_table
from simtest.validation.fingerprints import input_hashes
from simtest.validation.run_folder import EXPORT, check_folder, remove_folder
from simtest.validation.run_summary import write_results
from simtest.validation.runner import Progress, Run, RunRecord


@dataclass(frozen=True)
class ScorePart:
    """Some frames that one task scores."""

    frames: Frames
    folder: Path  # the run or dataset, for messages
    names: Mapping[int, str]  # name of each frame, by number of the realisation or sample
    hashes: Mapping[str, str]  # SHA-256 of each frame, by name
    answers: Answers  # by estimator and name of the frame; only those of these frames
    swept: Mapping[str, Value]  # an example of each swept value, for the columns' types
    item: Path | None = None  # where to keep the first frame for the gallery


def score_table(
    table: Path, on: Path, out: Path, name: str | None = None, command: str = "", engine: Engine | None = None,
    progress: Progress | None = None, regions: CoreRegions | None = None,
) -> Run:  # fmt: skip
    """Score a table of answers to the exported frames of a run or dataset.

    Parameters
    ----------
    table : Path
        CSV or Parquet (docs/howto/scoring.md).
    on : Path
        Folder of the run or dataset, which has an export.json.
    out : Path
        Folder of the scored run: empty, new, or that of an earlier one.
    name : str, optional
        Of the method in the results, where the table has no column `estimator`; default the file's stem.
    command : str
        How this was called, for the report.
    engine : Engine, optional
        Runs the tasks; by default this process does. The rows do not depend on it.
    progress : callable, optional
        Called with frames done, frames in all, and what is being done.
    regions : CoreRegions, optional
        The method's calibration.

    Returns
    -------
    Run
        With results.parquet, summary.json and gallery/; `simtest.report.write_report` makes its page.
    """
    started, clock = datetime.now(UTC), time.monotonic()
    method = table.stem if name is None else name
    check_name(method, "--name")
    record = read_record(on)
    answers = read_answers(table, record, method)
    source = open_source(on, record).with_regions(regions)
    calibrations = [] if regions is None else [Path(file) for file in regions.files]
    if are_nested(on, out):
        raise InputError(f"--out {out}: must be neither the run that is scored on nor inside or around it")
    if (out / EXPORT).exists():
        raise InputError(f"--out {out}: holds a run whose frames were exported; must be another folder")
    with exclusive_folder(out):
        check_folder(out)
        remove_folder(out / "gallery")
        (out / "gallery").mkdir(parents=True)
        results = _results(source, record, answers, out, engine or make_engine(), progress)
        for doubt in filter(None, [stray_rows(answers, record), *reversed_axes(results), *wide_regions(results)]):
            warnings.warn(f"{table}: {doubt}", stacklevel=2)
        kind = record.fingerprint if regions is None else record.fingerprint + regions.model_dump_json()
        made = _run_record(source, kind, (table, on / EXPORT, *calibrations), command, started, clock)
        described = {each: f"Answers of {table.name}, made elsewhere." for each in answers}
        write_results(out, made, results, source.recipe.name, source.summary(results, described))
    return Run(out, 0, results)


def _run_record(
    source: Source, fingerprint: str, files: Sequence[Path], command: str, started: datetime, clock: float
) -> RunRecord:
    """Return how a scored run was made: of the run of this fingerprint, and of a table, an export and calibrations."""
    inputs = {str(path): provenance.file_hash(path) for path in files}
    return RunRecord(
        variant=source.variant,
        llvm=backend.library_in_use(),
        fingerprint=hashlib.sha256(f"{fingerprint} {sorted(inputs.values())}".encode()).hexdigest(),
        seed=source.recipe.seed,
        realisations=source.recipe.realisations if isinstance(source.recipe, Experiment) else 1,
        started=started.isoformat(timespec="seconds"),
        duration_s=round(time.monotonic() - clock, 1),
        command=command,
        inputs={**inputs, **input_hashes(list(source.cases))},
        cores={},
    )


def _results(
    source: Source, record: Record, answers: Answers, out: Path, engine: Engine, progress: Progress | None
) -> pl.DataFrame:
    """Score all frames; return the rows in the order of cases and realisations."""
    parts = _parts(source, record, answers, out)
    total, done = sum(len(part.frames) for part in parts), 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total, "scoring")

    made = dict(engine.run(score_part, parts, step))
    forget()
    return pl.concat([rows for _, rows in sorted(made.items())])


def _parts(source: Source, record: Record, answers: Answers, out: Path) -> list[ScorePart]:
    """Split the frames into tasks, each with the answers to its own frames."""
    names, hashes, shown, swept = record.names(), record.hashes, source.shown_cases, source.swept_example
    parts = []
    for frames in source.parts:
        own = names.get(frames.case, {})
        used = set(own.values())
        part = ScorePart(
            frames=frames,
            folder=source.folder,
            names=own,
            hashes={name: hashes[name] for name in used},
            answers={
                estimator: {frame: rows for frame, rows in by_frame.items() if frame in used}
                for estimator, by_frame in answers.items()
            },
            swept=swept,
            item=out / "gallery" / f"{frames.key:04d}.npz" if frames.key in shown else None,
        )
        parts.append(part)
    return parts


# In a worker --------------------------------------------------------------------------------------------------------


def score_part(part: ScorePart, on_step: OnStep) -> pl.DataFrame:
    """Score the frames of a part; call `on_step` after each. Raises `InputError` where a frame comes out otherwise."""
    rows: list[Row] = []
    nothing: tuple[Answer, ...] = ()
    for count, each in enumerate(part.frames):
        frame = named(each, part.folder, part.names, part.hashes)
        # Estimators without a row answer for nothing.
        estimators = {
            name: TableEstimator(tuple(by_frame.get(frame.name, nothing))) for name, by_frame in part.answers.items()
        }
        rows += part.frames.score(frame, estimators, part.item if count == 0 else None)
        on_step()
    return results_table(rows, part.swept)
