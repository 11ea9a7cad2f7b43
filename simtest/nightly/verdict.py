"""The verdict on a run: compares it with the baseline, and puts it into its history."""

import dataclasses

import polars as pl

from simtest.nightly.baseline import log_note
from simtest.nightly.gate.compare import compare
from simtest.nightly.history import clock_note, history_rows, read_history, trend_rows
from simtest.nightly.layout import Reports
from simtest.nightly.records import JudgedRun, NightlyRun, Verdict


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
