"""The nightly page with its longest history: its size, how long it takes to make, how soon it can be used."""

import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from benchmarks.browser import OPENINGS, openings
from benchmarks.measuring import Figure
from benchmarks.nights import history_of, run_of, verdict_of
from simtest.nightly.page import write_nightly_page
from simtest.nightly.records import JudgedRun
from simtest.nightly.store import NEWEST
from simtest.spec import load_experiment
from simtest.validation.runner import run_experiment

FIGURES_A_NIGHT = 3000
"""As many as a full night has: the real rows stand several times, under other names."""

STARTED = datetime(2026, 11, 1, 2, 30, tzinfo=UTC)
MB = 1e6

FILTERED = """
() => {
  const started = performance.now(), choice = document.getElementById("filter-outcome");
  choice.value = "worse";
  choice.dispatchEvent(new Event("change", {bubbles: true}));
  document.querySelector("[data-switch=trends]").dispatchEvent(new Event("change"));
  document.body.getBoundingClientRect();
  return performance.now() - started;
}
"""
"""Use the page: filter its table, draw another trend, lay it out."""


def figures() -> list[Figure]:
    """Make the page of a run with a long history, and open it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        judged = _judged(folder)
        wall, processor = time.monotonic(), time.process_time()
        page = write_nightly_page(folder / "page", judged)
        wall, processor = time.monotonic() - wall, time.process_time() - processor
        about = f"{NEWEST} nights of {judged.run.figures.height} figures"
        made = [
            Figure("nightly page: size", page.stat().st_size / MB, 8.0, unit="MB", about=about),
            Figure("nightly page: time to make", wall, 20.0, unit="s", about=f"{processor:.1f} s of processor"),
        ]
        return made + _opened(page)


def _judged(folder: Path) -> JudgedRun:
    """Run a small experiment, and return it as a whole nightly run with its verdict and history."""
    experiment = load_experiment("overview", {"realisations": 1})
    rows = run_experiment(experiment, folder / "run").results
    copies = 1
    run = run_of(rows, STARTED)
    while run.figures.height < FIGURES_A_NIGHT:
        copies += 1
        named = [
            rows.with_columns(pl.format("{} {}", "experiment", pl.lit(i)).alias("experiment")) for i in range(copies)
        ]
        run = run_of(pl.concat(named), STARTED)
    return JudgedRun(run, verdict_of(run), history_of(run, NEWEST))


def _opened(page: Path) -> list[Figure]:
    """Open the page, and use it."""
    times, processor, used = openings(page, "#trends svg.marks", FILTERED)
    middle = OPENINGS // 2
    about = f"of {OPENINGS} openings; the page's thread {processor[middle]:.2f} s of processor"
    return [
        Figure("nightly page: until it can be used", times[middle], 3.0, unit="s", about=about),
        Figure("nightly page: a filter and another trend", used[middle], 0.5, unit="s", about=""),
    ]
