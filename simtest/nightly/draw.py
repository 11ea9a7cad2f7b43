"""Draws a judged run: the worst cases, the page, and the files beside it."""

import dataclasses
from pathlib import Path

import polars as pl

from simtest.nightly.outputs import FILES, write_outputs
from simtest.nightly.page import write_nightly_page
from simtest.nightly.records import JudgedRun
from simtest.nightly.storage import LATEST_ROWS, save_run
from simtest.spec import Profile, experiments_of
from simtest.validation.worst import save_worst, worst_cases


def draw(judged: JudgedRun, profile: Profile, folder: Path, variant: str | None = None) -> JudgedRun:
    """Write the page of a run and all that lies beside it into a folder, which is made.

    The worst cases' gallery items go into ``worst`` beside the folder. Returns the run with its gallery, and a note
    where the worst cases could not be rendered.
    """
    judged = _with_worst_cases(judged, profile, folder.with_name("worst"), variant)
    folder.mkdir()
    save_run(folder, judged.run, LATEST_ROWS)
    write_outputs(folder, judged)
    write_nightly_page(folder, judged, FILES)
    return judged


def _with_worst_cases(judged: JudgedRun, profile: Profile, folder: Path, variant: str | None) -> JudgedRun:
    """Render the worst cases again; a failure is a note, for a run that is measured must not be lost over pictures."""
    try:
        findings = pl.concat([judged.with_outcome(name) for name in ("worse", "changed", "better")])
        chosen = worst_cases(judged.run.rows, findings)
        files = save_worst(chosen, experiments_of(profile), folder, variant)
        return dataclasses.replace(judged, gallery=tuple(files), cases=tuple(chosen))
    except Exception as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        notes = (*judged.verdict.notes, f"The worst cases could not be made again ({why}).")
        return dataclasses.replace(judged, verdict=dataclasses.replace(judged.verdict, notes=notes))
