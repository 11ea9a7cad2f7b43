"""The nightly page with a history of 1,000 nights: its size, how long it takes to make, how soon it can be used."""

import os
import shutil
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from benchmarks.measuring import Figure
from benchmarks.nights import history_of, run_of, verdict_of
from simtest.nightly.ladder import ladder_figures
from simtest.nightly.page import write_nightly_page
from simtest.nightly.records import JudgedRun
from simtest.spec import load_experiment
from simtest.validation.runner import run_experiment
from simtest.validation.worst import save_worst, worst_cases

NIGHTS = 1000
FIGURES_A_NIGHT = 3000
"""As many as a full night has: the real rows stand several times, under other names."""

STARTED = datetime(2026, 11, 1, 2, 30, tzinfo=UTC)
MB = 1e6
OPENINGS = 5
BROWSERS = ("chromium", "chromium-browser", "google-chrome")

FILTERED = """
() => {
  const started = performance.now(), choice = document.getElementById("filter-outcome");
  choice.value = "worse";
  choice.dispatchEvent(new Event("change", {bubbles: true}));
  document.getElementById("trend-quantity").dispatchEvent(new Event("change"));
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
        about = f"{NIGHTS} nights of {judged.run.figures.height} figures, {len(judged.gallery)} worst cases"
        made = [
            Figure("nightly page: size", page.stat().st_size / MB, 8.0, unit="MB", about=about),
            Figure("nightly page: time to make", wall, 20.0, unit="s", about=f"{processor:.1f} s of processor"),
        ]
        return made + _opened(page)


def _judged(folder: Path) -> JudgedRun:
    """Run a small experiment, and return it as a whole nightly run with its verdict, history and worst cases."""
    experiment = load_experiment("overview", {"realisations": 1})
    rows = run_experiment(experiment, folder / "run").results
    gallery = save_worst(worst_cases(rows), [experiment], folder / "worst")
    copies = 1
    run = run_of(rows, STARTED)
    while run.figures.height < FIGURES_A_NIGHT:
        copies += 1
        named = [
            rows.with_columns(pl.format("{} {}", "experiment", pl.lit(i)).alias("experiment")) for i in range(copies)
        ]
        run = run_of(pl.concat(named), STARTED)
    run = replace(run, figures=pl.concat([run.figures, ladder_figures()]))
    return JudgedRun(run, verdict_of(run), history_of(run, NIGHTS), tuple(gallery))


def _opened(page: Path) -> list[Figure]:
    """Open the page in the system's Chromium; without one the benchmark fails, for its figures would be missing."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise SystemExit(f"benchmark nightly_page: no browser; install one of {', '.join(BROWSERS)}")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise SystemExit("benchmark nightly_page: needs playwright; install simtest[bench]") from None
    times, processor, used = [], [], []
    with sync_playwright() as driver:
        # The sandbox does not start under root.
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        chromium = driver.chromium.launch(executable_path=browser, args=options)
        for _ in range(OPENINGS):
            tab = chromium.new_page()
            meter = tab.context.new_cdp_session(tab)
            meter.send("Performance.enable", {"timeDomain": "threadTicks"})
            started = time.monotonic()
            tab.goto(page.as_uri(), wait_until="commit")
            tab.wait_for_selector("#trend-chart .main-svg")
            times.append(time.monotonic() - started)
            measured = {entry["name"]: entry["value"] for entry in meter.send("Performance.getMetrics")["metrics"]}
            processor.append(measured["TaskDuration"])
            used.append(tab.evaluate(FILTERED) / 1e3)
            tab.close()
        chromium.close()
    middle = OPENINGS // 2
    about = f"of {OPENINGS} openings; the page's thread {sorted(processor)[middle]:.2f} s of processor"
    return [
        Figure("nightly page: until it can be used", sorted(times)[middle], 3.0, unit="s", about=about),
        Figure("nightly page: a filter and another trend", sorted(used)[middle], 0.5, unit="s", about=""),
    ]
