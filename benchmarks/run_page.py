"""The page of the shipped overview: its size, and how soon its guide can be read."""

import tempfile
from pathlib import Path

from benchmarks.browser import OPENINGS, openings
from benchmarks.measuring import Figure
from simtest.report import write_report
from simtest.spec import load_experiment
from simtest.validation.runner import run_experiment

MB = 1e6


def figures() -> list[Figure]:
    """Run the overview, and open its page."""
    with tempfile.TemporaryDirectory() as scratch:
        run = run_experiment(load_experiment("overview"), Path(scratch) / "run")
        page = write_report(run.folder)
        made = [Figure("run page: size", page.stat().st_size / MB, 1.5, unit="MB", about="of experiment overview")]
        # What a reader comes for is the guide; charts are drawn where the reader comes by.
        wall, processor, _ = openings(page, "#guide tbody tr")
        middle = OPENINGS // 2
        about = f"of {OPENINGS} openings; the page's thread {processor[middle]:.2f} s of processor"
        return [*made, Figure("run page: until the guide is there", wall[middle], 1.0, unit="s", about=about)]
