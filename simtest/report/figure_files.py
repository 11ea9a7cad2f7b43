"""The figures of a page: each described once and packed for the page; threads draw those that are files."""

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from simtest.pages.charts import Chart, png
from simtest.report.write import Progress

THREADS = 2
T = TypeVar("T")


@dataclass
class FigureFiles:
    """The figures of a page: charts that the page draws, and files in `folder`, drawn and written by `pool`."""

    folder: Path
    pool: ThreadPoolExecutor
    progress: Progress | None = None
    chart_files: bool = False  # whether charts are files too: each takes as long as all the rest of a small page
    charts: list[Chart] = field(default_factory=list)
    hashes: dict[str, str] = field(default_factory=dict)  # SHA-256 by file name, of what is written
    work: dict[Future[Any], str] = field(default_factory=dict)  # with what it draws

    def start(self, what: str, draw: Callable[..., T], *arguments: Any) -> "Future[T]":
        """Let the pool draw something; it is a step of the page."""
        future = self.pool.submit(draw, *arguments)
        self.work[future] = what
        return future

    def draw(self, name: str, charts: list[Chart]) -> list[Chart]:
        """Draw charts into the page, and into one file where that is asked for; returns them."""
        self.tell(f"describing {name}")
        if self.chart_files:
            self.start(name, self._draw_charts, name, charts)
        self.charts += charts
        return charts

    def _draw_charts(self, name: str, charts: list[Chart]) -> None:
        self.write(name, png(charts))

    def write(self, name: str, content: bytes) -> None:
        """Write a PNG file; a reader never meets half of one."""
        file = f"{name}.png"
        part = self.folder / f".{file}.part"
        part.write_bytes(content)
        os.replace(part, self.folder / file)
        self.hashes[file] = hashlib.sha256(content).hexdigest()

    def tell(self, what: str) -> None:
        """Report what is done now; writing the page is the last step. What `progress` raises stops what is drawn."""
        if self.progress:
            try:
                self.progress(sum(future.done() for future in self.work), len(self.work) + 1, what)
            except BaseException:
                self.pool.shutdown(cancel_futures=True)
                raise

    def finish(self) -> None:
        """Wait for all that is drawn, and tell of each that is done."""
        left = set(self.work)
        while left:
            # Name one that is being drawn: the earliest that is not done.
            self.tell("drawing " + next(name for future, name in self.work.items() if future in left))
            done, left = wait(left, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
        # Pictures of an earlier page.
        for old in (*self.folder.glob("*.png"), *self.folder.glob(".*.part")):
            if old.name not in self.hashes:
                old.unlink()
