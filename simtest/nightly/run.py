"""A nightly run from start to end: measure -> judge -> draw, then publish."""

import dataclasses
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.errors import InputError
from simtest.nightly.compare import compare
from simtest.nightly.outputs import FILES, write_outputs
from simtest.nightly.page import REPORTS, write_nightly_page
from simtest.nightly.quantities import setting_figures
from simtest.nightly.records import JudgedRun, NightlyRun, RunRecord, Verdict, to_explain
from simtest.nightly.store import (
    LATEST_ROWS,
    Reports,
    append,
    clock_note,
    disk_errors_in_one_line,
    exclusive_replacement,
    history_rows,
    load_baseline,
    log_note,
    new_run_id,
    only_night,
    read_history,
    replace_folder,
    save_run,
    trend_rows,
)
from simtest.rendering import backend
from simtest.report import write_report
from simtest.runtime import provenance
from simtest.runtime.processes import Engine, make_engine
from simtest.spec import Experiment, Profile, experiments_of
from simtest.validation.cases import Case, expand
from simtest.validation.fingerprints import definition
from simtest.validation.runner import Progress, check_estimators, run_experiments, variant_of


@dataclass(frozen=True)
class RunOptions:
    """How a run is made; its rows depend neither on the engine nor on the workers."""

    command: str = ""  # how it was called, for its record
    variant: str | None = None  # of Mitsuba
    engine: Engine | None = None  # does the work; default `workers` processes of this machine
    workers: int = 1  # how many work at once
    progress: Progress | None = None


DEFAULTS = RunOptions()


@dataclass(frozen=True)
class Outcome:
    """A run that was measured, judged and published: page and outputs in `folder`, its file in the history."""

    judged: JudgedRun
    folder: Path
    history_file: Path


def run_nightly(profile: Profile, reports: Reports, options: RunOptions = DEFAULTS) -> Outcome:
    """Run a profile, compare it with the baseline, keep it in the history and publish its page.

    Raises `SimtestError` if the run could not be made: bad input, a damaged baseline, no rendering backend, no space on
    the disk. What earlier runs wrote is as it was.
    """
    # Before any folder is touched.
    planned = plan_run(profile)
    disk = disk_errors_in_one_line(
        reports.root, "the night could not be written", "what earlier nights wrote is as it was"
    )
    with disk:
        # Before the work, and before a folder is made: a damaged baseline must not cost a run.
        baseline = load_baseline(reports, profile.name)
        with only_night(reports, profile.name) as folder:
            run = measure_run(profile, folder, new_run_id(datetime.now(UTC)), options, planned)
            judged = draw(judge(run, baseline, reports), folder / "tonight")
            return _published(reports, judged, folder / "tonight")


def _published(reports: Reports, judged: JudgedRun, page: Path) -> Outcome:
    """Add a run that is whole to the history, and replace the last page by its own."""
    record = judged.run.record
    target, history = reports.latest(record.profile), reports.history(record.profile)
    try:
        file = append(history, history_rows(judged.run, judged.verdict), page.parent)
        with exclusive_replacement(target):
            replace_folder(page, target)
    except KeyboardInterrupt:
        if (history / f"{record.id}.parquet").exists():
            raise KeyboardInterrupt("this night is in the history; its page may not have been published") from None
        raise
    return Outcome(judged, target, file)


Planned = tuple[list[Experiment], list[list[Case]]]
"""A profile's experiments, and the cases of each."""


def plan_run(profile: Profile) -> Planned:
    """Return what a profile runs; raise `InputError` for whatever is malformed, before anything is made."""
    experiments = experiments_of(profile)
    for experiment in experiments:
        check_estimators(experiment.estimators)
    return experiments, [expand(experiment) for experiment in experiments]


def measure_run(
    profile: Profile, folder: Path, run_id: str, options: RunOptions = DEFAULTS, planned: Planned | None = None
) -> NightlyRun:
    """Run a profile; each experiment's run stands in a folder of its name in the scratch `folder` afterwards.

    `planned` is what `plan_run` returned, where it was asked before. Raises `SimtestError` if an experiment is
    malformed or cannot be run, or nothing was measured.
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
    library = backend.library_in_use()
    record = {
        "profile": profile.name,
        "title": profile.title or profile.name,
        "workers": options.workers,
        "command": options.command,
        "variant": backend.requested_variant(options.variant),
        # Its name alone: runs of two machines are compared, where it lies elsewhere.
        "llvm": None if library is None else Path(library).name,
        "id": run_id,
        "started": started.isoformat(timespec="seconds"),
        "duration_s": round(time.monotonic() - clock, 1),
        "definitions": {own.name: definition(own, of_own) for own, of_own in planned_pairs},
        "variants": {own.name: variant_of(of_own, options.variant) for own, of_own in planned_pairs},
        **origin,
    }
    return NightlyRun(RunRecord.model_validate(record), rows, setting_figures(rows, frames_of(experiments, cases)))


def frames_of(experiments: Sequence[Experiment], cases: Sequence[Sequence[Case]]) -> dict[tuple[str, str], int]:
    """Count the frames that experiments take, by experiment and setting; `cases` holds those of each experiment."""
    counted: Counter[tuple[str, str]] = Counter()
    for experiment, own in zip(experiments, cases, strict=True):
        for case in own:
            counted[experiment.name, case.setting] += case.realisations
    return dict(counted)


def judge(run: NightlyRun, baseline: NightlyRun | None, reports: Reports) -> JudgedRun:
    """Compare a run with its profile's baseline, if there is one, and read the history that it belongs to."""
    verdict = verdict_on(run, baseline)
    history, skipped = read_history(reports.history(run.record.profile))
    told = [clock_note(history, run.record.start), log_note(reports, run.record.profile)]
    verdict = dataclasses.replace(verdict, notes=(*verdict.notes, *filter(None, told), *skipped))
    own = trend_rows(history_rows(run, verdict))
    return JudgedRun(run, verdict, pl.concat([history, own]))


def verdict_on(run: NightlyRun, baseline: NightlyRun | None) -> Verdict:
    """Compare a run with its baseline; without one, note how to make it."""
    verdict = compare(run, baseline)
    if baseline is not None:
        return verdict
    note = (
        f"No baseline for the profile {run.record.profile}: look at the figures, then run simtest nightly accept "
        '--reason "..." with the --profile and --reports of this night.'
    )
    return dataclasses.replace(verdict, notes=(*verdict.notes, note))


MOST_REPORTS = 5
"""Experiments whose own page is made: those with the most regressions, then with the most to explain."""


def draw(judged: JudgedRun, folder: Path) -> JudgedRun:
    """Write the page of a run and all that lies beside it into a folder, which is made.

    Beside the folder lie the experiments' run folders, each of its name; those of experiments with findings come along.
    Returns the run with their names, and a note where one could not be drawn.
    """
    folder.mkdir()
    judged = _with_reports(judged, folder)
    save_run(folder, judged.run, LATEST_ROWS)
    write_outputs(folder, judged)
    write_nightly_page(folder, judged, FILES)
    return judged


def _with_reports(judged: JudgedRun, folder: Path) -> JudgedRun:
    """Draw the reports; a failure is a note, for a run that is measured must not be lost over pictures."""
    worse = pl.col("outcome") == "worse"
    found = judged.verdict.comparisons.filter(worse | to_explain()).group_by("experiment").agg(worse.sum(), n=pl.len())
    ranked = found.sort("outcome", "n", "experiment", descending=[True, True, False])["experiment"]
    # Of what is missing tonight, or over all experiments, there is no run.
    runs = [folder.with_name(name) for name in ranked if folder.with_name(name).is_dir()]
    drawn, notes = [], list(judged.verdict.notes)
    for run in runs[:MOST_REPORTS]:
        try:
            write_report(run)
            (folder / REPORTS).mkdir(exist_ok=True)
            run.rename(folder / REPORTS / run.name)
            drawn.append(run.name)
        except Exception as error:
            why = f"{type(error).__name__}: {' '.join(str(error).split())}"
            notes.append(f"The report of {run.name} could not be drawn ({why}).")
    verdict = dataclasses.replace(judged.verdict, notes=tuple(notes))
    return dataclasses.replace(judged, verdict=verdict, reports=tuple(drawn))
