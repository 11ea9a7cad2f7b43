"""A nightly run from start to end: measure -> judge -> draw, then publish."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from simtest.nightly.baseline import load_baseline
from simtest.nightly.draw import draw
from simtest.nightly.history import append, history_rows
from simtest.nightly.layout import (
    Reports,
    exclusive_replacement,
    new_run_id,
    only_night,
    remove_dead,
    replace_folder,
    scratch,
)
from simtest.nightly.measure import DEFAULTS, RunOptions, measure_run, plan_run
from simtest.nightly.records import JudgedRun
from simtest.nightly.storage import disk_errors_in_one_line
from simtest.nightly.verdict import judge
from simtest.spec import Profile


@dataclass(frozen=True)
class Outcome:
    """A run that was measured, judged and published: page and outputs in `folder`, its file in the history."""

    judged: JudgedRun
    folder: Path
    history_file: Path


def run_nightly(profile: Profile, reports: Reports, options: RunOptions = DEFAULTS) -> Outcome:
    """Run a profile, compare it with the baseline, keep it in the history and publish its page."""
    # Before any folder is touched.
    planned = plan_run(profile)
    left = "what earlier nights wrote is as it was"
    disk = disk_errors_in_one_line(reports.root, "the night could not be written", left)
    with disk, only_night(reports, profile.name):
        # Before the work: a damaged baseline must not cost a run.
        baseline = load_baseline(reports, profile.name)
        remove_dead(reports)
        run_id = new_run_id(datetime.now(UTC))
        with scratch(reports, run_id) as folder:
            run = measure_run(profile, folder, run_id, options, planned)
            judged = judge(run, baseline, reports)
            judged = draw(judged, folder / "tonight")
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
