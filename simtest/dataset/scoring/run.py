"""Scores a table of answers as a run's own estimators are scored: the same rows, summary and gallery."""

import hashlib
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.conventions import ON_INSTRUMENT
from simtest.dataset.scoring.answers import Answer, TableEstimator
from simtest.dataset.scoring.doubts import reversed_axes, stray_rows, wide_regions
from simtest.dataset.scoring.record import Record, Source, check_frame, open_source, read_record
from simtest.dataset.scoring.table import Answers, check_name, read_answers
from simtest.dataset.scoring.views import CaseViews, ShardViews, Shown, Views
from simtest.dataset.shard_writer import maker_of
from simtest.errors import InputError
from simtest.rendering import backend
from simtest.runtime import provenance
from simtest.runtime.files import are_nested
from simtest.runtime.locks import exclusive_folder
from simtest.runtime.processes import Engine, OnStep, make_engine
from simtest.validation.case_work import forget, gallery_cases
from simtest.validation.cases import swept_example
from simtest.validation.columns import Row, Value
from simtest.validation.columns import table as results_table
from simtest.validation.fingerprints import input_hashes
from simtest.validation.realisation import answer, keep_frame, realise
from simtest.validation.run_folder import EXPORT, check_folder, remove_folder
from simtest.validation.run_summary import ExperimentSummary, summarise_run, write_results
from simtest.validation.runner import Progress, Run, RunRecord
from simtest.validation.statistics import ANATOMY, summarise


@dataclass(frozen=True)
class ScorePart:
    """Some frames that one task scores.

    Parameters
    ----------
    views : Views
        The frames.
    folder : Path
        The run or dataset, for messages.
    names, hashes : mapping
        Name and SHA-256 of each frame, by number of the realisation or sample.
    answers : mapping
        By estimator and name of the frame; only those of these frames.
    swept : mapping
        An example of each swept value, for the columns' types.
    item : Path, optional
        Where to keep the first frame for the gallery.
    """

    views: Views
    folder: Path
    names: Mapping[int, str]
    hashes: Mapping[int, str]
    answers: Answers
    swept: Mapping[str, Value]
    item: Path | None = None

    def estimators(self, number: int) -> dict[str, TableEstimator]:
        """Return what answers for one frame, by estimator; those without a row answer for nothing."""
        nothing: tuple[Answer, ...] = ()
        return {
            name: TableEstimator(tuple(by_frame.get(self.names[number], nothing)))
            for name, by_frame in self.answers.items()
        }


def score_table(
    table: Path, on: Path, out: Path, name: str | None = None, command: str = "", engine: Engine | None = None,
    progress: Progress | None = None,
) -> Run:  # fmt: skip
    """Score a table of answers to the exported frames of a run or dataset.

    Parameters
    ----------
    table : Path
        CSV or Parquet (docs/howto/score.md).
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
    source = open_source(on, record)
    _check_apart(on, out)
    with exclusive_folder(out):
        check_folder(out)
        remove_folder(out / "gallery")
        (out / "gallery").mkdir(parents=True)
        results = _results(source, record, answers, out, engine or make_engine(), progress)
        for doubt in filter(None, [stray_rows(answers, record), *reversed_axes(results), *wide_regions(results)]):
            warnings.warn(f"{table}: {doubt}", stacklevel=2)
        made = _run_record(source, record.fingerprint, (table, on / EXPORT), command, started, clock)
        described = {each: f"Answers of {table.name}, made elsewhere." for each in answers}
        write_results(out, made, results, *_summary(source, results, described))
    return Run(out, 0, results)


def _check_apart(on: Path, out: Path) -> None:
    """Raise `InputError` where the scored run would replace, or lie in, a run whose frames were exported."""
    if are_nested(on, out):
        raise InputError(f"--out {out}: must be neither the run that is scored on nor inside or around it")
    if (out / EXPORT).exists():
        raise InputError(f"--out {out}: holds a run whose frames were exported; must be another folder")


def _run_record(
    source: Source, fingerprint: str, files: Sequence[Path], command: str, started: datetime, clock: float
) -> RunRecord:
    """Return how a scored run was made: of the run of this fingerprint, and of a table and a record of an export."""
    inputs = {str(path): provenance.file_hash(path) for path in files}
    return RunRecord(
        variant=source.variant,
        llvm=backend.library_in_use(),
        fingerprint=hashlib.sha256(f"{fingerprint} {sorted(inputs.values())}".encode()).hexdigest(),
        seed=_seed(source),
        realisations=_realisations(source),
        started=started.isoformat(timespec="seconds"),
        duration_s=round(time.monotonic() - clock, 1),
        command=command,
        inputs={**inputs, **input_hashes(list(source.cases))},
        cores={},
    )


def _seed(source: Source) -> int:
    if source.experiment is not None:
        return source.experiment.seed
    return 0 if source.dataset is None else source.dataset.seed


def _realisations(source: Source) -> int:
    return 1 if source.experiment is None else source.experiment.realisations


def _results(
    source: Source, record: Record, answers: Answers, out: Path, engine: Engine, progress: Progress | None
) -> pl.DataFrame:
    """Score all frames; return the rows in the order of cases and realisations."""
    parts = _parts(source, record, answers, out)
    total, done = sum(len(part.views) for part in parts), 0

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
    cases = list(source.cases)
    shown_cases = gallery_cases(cases) if cases else set()
    swept: Mapping[str, Value] = swept_example(cases) if cases else {ON_INSTRUMENT: False, ANATOMY: ""}
    by_key: dict[int, dict[int, str]] = {views.key: {} for views in source.views}
    if source.dataset is None:
        for use in record.uses:
            by_key.setdefault(use.case, {})[use.realisation] = use.frame
    else:
        names = {use.realisation: use.frame for use in record.uses}
        by_key = {views.key: names for views in source.views}
    parts = []
    for views in source.views:
        own = by_key[views.key]
        frames = set(own.values())
        part = ScorePart(
            views=views,
            folder=source.folder,
            names=own,
            hashes={number: record.frames[frame].sha256 for number, frame in own.items()},
            answers={
                name: {frame: rows for frame, rows in by_frame.items() if frame in frames}
                for name, by_frame in answers.items()
            },
            swept=swept,
            item=out / "gallery" / f"{views.key:04d}.npz" if views.key in shown_cases else None,
        )
        parts.append(part)
    return parts


def _summary(source: Source, results: pl.DataFrame, described: Mapping[str, str]) -> tuple[str, ExperimentSummary]:
    """Return the name of what was scored, and what summary.json says of the results."""
    if source.experiment is not None:
        rendered = [case for case in source.cases if not case.is_paper]
        return source.experiment.name, summarise_run(source.experiment, rendered, results, described)
    assert source.dataset is not None
    dataset = source.dataset
    return dataset.name, ExperimentSummary(
        title=dataset.title or dataset.name, description=dataset.description, estimators={**described},
        settings=summarise(results),
    )  # fmt: skip


# In a worker --------------------------------------------------------------------------------------------------------


def score_part(part: ScorePart, on_step: OnStep) -> pl.DataFrame:
    """Score the frames of a part; call `on_step` after each. Raises `InputError` where a frame comes out otherwise."""
    rows: list[Row] = []
    for count, each in enumerate(part.views):
        name = part.names.get(each.number)
        if name is None:
            raise InputError(f"{part.folder}: {each.setting} was not exported as a whole; export again")
        check_frame(part.folder, name, part.hashes[each.number], each.image)
        rows += _scored(part, each, part.item if count == 0 else None)
        on_step()
    return results_table(rows, part.swept)


def _scored(part: ScorePart, each: Shown, item: Path | None) -> list[Row]:
    """Score one frame, and keep it for the gallery where `item` names a file."""
    views, estimators = part.views, part.estimators(each.number)
    if isinstance(views, CaseViews):
        experiment, case = views.experiment, views.case
        made = realise(each.session, experiment, case, each.number, each.view, each.swept, estimators)
        if item is not None:
            keep_frame(item, each.session, experiment, case, made)
        return made.rows
    assert isinstance(views, ShardViews)
    maker = maker_of(views.dataset.model_dump_json(), views.variant)
    answers = answer(each.view, each.image, estimators)
    rows = maker.score(each.number, each.session, each.view, answers, estimators)
    return [row | {ANATOMY: each.anatomy} for row in rows]
