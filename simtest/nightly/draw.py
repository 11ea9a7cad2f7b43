"""Draws a judged run: the reports of the experiments with findings, the page, and the files beside it."""

import dataclasses
from pathlib import Path

import polars as pl

from simtest.nightly.outputs import FILES, write_outputs
from simtest.nightly.page import REPORTS, write_nightly_page
from simtest.nightly.records import JudgedRun, to_explain
from simtest.nightly.storage import LATEST_ROWS, save_run
from simtest.report import write_report

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
