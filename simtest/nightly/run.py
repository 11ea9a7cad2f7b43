"""A night from start to end: measured, judged, kept in the history, published."""

import dataclasses
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from simtest.nightly.baseline import load_baseline
from simtest.nightly.gate.compare import compare
from simtest.nightly.gate.records import Night, Verdict
from simtest.nightly.history import (
    TREND_COLUMNS,
    TRENDS,
    append,
    clock_note,
    history_rows,
    read_history,
    trend_columns,
)
from simtest.nightly.layout import Reports, new_run_id, remove_dead, replace_folder, scratch, turn
from simtest.nightly.measure import measure_night
from simtest.nightly.outputs import FILES, write_outputs
from simtest.nightly.overview import ordered, without_canaries
from simtest.nightly.page import Extras, write_nightly_page
from simtest.nightly.storage import TONIGHT_ROWS, save_night, told_in_one_line
from simtest.runtime.engines.engine import Engine
from simtest.spec import Profile, experiments_of
from simtest.validation.runner import Progress
from simtest.validation.worst import save_worst, worst_cases

FINE, REGRESSION = 0, 1
"""Exit codes of a night that was run."""


@dataclass(frozen=True)
class Outcome:
    """A night that was measured and judged.

    Parameters
    ----------
    night : Night
        The night.
    verdict : Verdict
        Of the gate.
    folder : Path
        Holds the page and the outputs for machines.
    history_file : Path
        The night's file in the history.
    """

    night: Night
    verdict: Verdict
    folder: Path
    history_file: Path

    @property
    def exit_code(self) -> int:
        """`FINE` or `REGRESSION`."""
        return exit_code(self.verdict)


def exit_code(verdict: Verdict) -> int:
    """Give the exit code of a verdict; a night without a baseline is fine unless a canary failed."""
    return REGRESSION if verdict.state == "regression" else FINE


def run_nightly(
    profile: Profile,
    reports: Reports,
    command: str = "",
    variant: str | None = None,
    engine: Engine | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Outcome:
    """Run a night.

    Parameters
    ----------
    profile : Profile
        What to run.
    reports : Reports
        Where history, baseline and page lie; made if need be.
    command : str
        How the night was called, for the page.
    variant : str, optional
        Mitsuba variant.
    engine : Engine, optional
        Who does the work; default `workers` processes of this machine.
    workers : int
        How many work at once.
    progress : callable, optional
        See `Progress`.

    Returns
    -------
    Outcome

    Raises
    ------
    SimtestError
        If the night could not be run: bad input, a damaged baseline, no rendering backend, no space on the disk. What
        was written by earlier nights is as it was.
    """
    with told_in_one_line(reports.root, "the night could not be written; what earlier nights wrote is as it was"):
        reports.make()
        # A damaged baseline is told before the work, not after it.
        baseline = load_baseline(reports, profile.name)
        remove_dead(reports)
        run_id = new_run_id(datetime.now(UTC))
        with scratch(reports, run_id) as folder:
            night = measure_night(profile, folder, run_id, command, variant, engine, workers, progress)
            verdict = judge(night, baseline)
            history, notes = read_history(reports.history, profile.name, TREND_COLUMNS, TRENDS)
            late = clock_note(history, datetime.fromisoformat(night.run["started"]))
            worst, lacking = _gallery(profile, night, verdict, folder / "worst", variant)
            notes = [*verdict.notes, *([late] if late else []), *notes, *lacking]
            verdict = dataclasses.replace(verdict, notes=tuple(notes))
            rows = history_rows(night, verdict)
            history = pl.concat([history, trend_columns(rows, quantities=TRENDS)])
            page = make_page(folder / "tonight", night, verdict, history, worst)
            file = _keep(reports, night, rows, page)
    return Outcome(night, verdict, reports.tonight(profile.name), file)


def _gallery(
    profile: Profile, night: Night, verdict: Verdict, folder: Path, variant: str | None
) -> tuple[tuple[Path, ...], list[str]]:
    """Make the worst cases again; a failure is a note, for the night is measured and must not be lost over pictures."""
    try:
        worse = ordered(without_canaries(night, verdict), "worse")
        return save_worst(worst_cases(night.rows, worse), experiments_of(profile), folder, variant), []
    except Exception as error:
        return (), [
            f"The worst cases could not be made again ({type(error).__name__}: {' '.join(str(error).split())})."
        ]


def _keep(reports: Reports, night: Night, rows: pl.DataFrame, page: Path) -> Path:
    """Put a night that is whole into the history, and its page in the place of the last; gives the history's file."""
    target, run_id = reports.tonight(night.run["profile"]), night.run["id"]
    try:
        file = append(reports.history, rows)
        with turn(target):
            replace_folder(page, target)
    except KeyboardInterrupt:
        if any(reports.history.glob(f"date=*/commit=*/{run_id}.parquet")):
            raise KeyboardInterrupt("this night is in the history; its page may not have been published") from None
        raise
    return file


def judge(night: Night, baseline: Night | None) -> Verdict:
    """Hold a night against its baseline; without one, say how to make it."""
    verdict = compare(night, baseline)
    if baseline is not None:
        return verdict
    profile = night.run["profile"]
    note = (
        f"No baseline for the profile {profile}: look at the figures, then run simtest nightly accept "
        '--reason "..." with the --profile and --reports of this night.'
    )
    return dataclasses.replace(verdict, notes=(*verdict.notes, note))


def make_page(
    folder: Path, night: Night, verdict: Verdict, history: pl.DataFrame, worst: tuple[Path, ...] = ()
) -> Path:
    """Write the page and all that lies beside it.

    Parameters
    ----------
    folder : Path
        Where; made.
    night : Night
        The night.
    verdict : Verdict
        Of the gate.
    history : polars.DataFrame
        Columns `TREND_COLUMNS`, the night's own among them.
    worst : tuple of Path
        Gallery items of the worst cases.

    Returns
    -------
    Path
        The folder.
    """
    folder.mkdir()
    save_night(folder, night, TONIGHT_ROWS)
    write_outputs(folder, night, verdict)
    write_nightly_page(folder, night, verdict, history, Extras(gallery=worst, files=FILES))
    return folder
