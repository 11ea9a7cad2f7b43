"""Opens a page in the system's Chromium: how soon it can be used, in wall and in processor time."""

import os
import shutil
import time
from pathlib import Path

OPENINGS = 5
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def openings(page: Path, selector: str, use: str | None = None) -> tuple[list[float], list[float], list[float]]:
    """Open a page several times; without a browser the benchmark fails, for its figures would be missing.

    Parameters
    ----------
    page : Path
        The page.
    selector : str
        What must be there for the page to be usable.
    use : str, optional
        Script that uses the page and returns the milliseconds that it took.

    Returns
    -------
    wall, processor, used : list of float
        Of each opening, ascending, s: until the page can be used, of the page's thread until then, and of `use`.
    """
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise SystemExit(f"benchmark {page.name}: no browser; install one of {', '.join(BROWSERS)}")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise SystemExit(f"benchmark {page.name}: needs playwright; install simtest[bench]") from None
    wall, processor, used = [], [], []
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
            tab.wait_for_selector(selector)
            wall.append(time.monotonic() - started)
            measured = {entry["name"]: entry["value"] for entry in meter.send("Performance.getMetrics")["metrics"]}
            processor.append(measured["TaskDuration"])
            used.append(tab.evaluate(use) / 1e3 if use else 0.0)
            tab.close()
        chromium.close()
    return sorted(wall), sorted(processor), sorted(used)
