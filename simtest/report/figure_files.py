"""The figures of a page: each described once, written as a file and packed for the page."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from simtest.pages import chart_png, chart_web, pixels
from simtest.pages.chart import Chart
from simtest.pages.pixels import Pixels


@dataclass
class FigureFiles:
    """The figures of a page: files in `folder`, written by `pool`, and plotly's JSON by key."""

    folder: Path
    pool: ThreadPoolExecutor
    json: dict[str, chart_web.PlotlyJson] = field(default_factory=dict)
    writing: list[Future[None]] = field(default_factory=list)

    def draw(self, name: str, charts: list[Chart]) -> list[Chart]:
        """Draw charts into one file and into the page; returns them."""
        self.write(name, chart_png.draw(charts)[0])
        self.json |= {chart.key: chart_web.figure(chart) for chart in charts}
        return charts

    def write(self, name: str, picture: Pixels) -> None:
        """Write a picture as a file."""
        self.writing.append(self.pool.submit(pixels.write_png, self.folder / f"{name}.png", picture))

    def packed(self) -> str:
        """Wait for the files, and return plotly's JSON of all charts, packed."""
        for file in self.writing:
            file.result()
        return chart_web.packed(self.json)
