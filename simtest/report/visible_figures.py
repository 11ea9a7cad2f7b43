"""The figure of detection on relief, scored on what can be seen: theory.md 7.1b."""

from itertools import pairwise

import numpy as np
import polars as pl

from simtest.conventions import HIGHLIGHT_CONTRAST_SIGMA, ON_INSTRUMENT
from simtest.pages.charts import Axis, Chart, Mark, Panel
from simtest.pages.palette import NEUTRAL, SERIES
from simtest.pages.style import number
from simtest.report.relief_figures import ReliefFigure
from simtest.report.run_folder import Run
from simtest.validation.statistics import row_kind

_NEEDED = {"visible_id", "visible_snr", "frame_visible"}
_FOUND, _FALSE = "●", "✖"
_FRAME = ["setting", "realisation"]


def visible_figures(run: Run) -> list[ReliefFigure]:
    """Compute how many of a frame's visible highlights are detected; none for runs on smooth surfaces."""
    if not {*run.results.columns} >= _NEEDED:
        return []
    rows = run.results.filter(pl.col("frame_visible").is_not_null())
    # What shines on an instrument is none of the frame's visible highlights.
    detections = rows.filter(pl.col("specularity").is_not_null() & (row_kind(rows) != ON_INSTRUMENT))
    detections = detections.unique([*_FRAME, "specularity"], maintain_order=True)
    if detections.is_empty():
        return []
    # Without noise, no peak has a finite ratio to it, and the column is null.
    over_noise = pl.col("visible_snr").fill_null(np.inf) >= HIGHLIGHT_CONTRAST_SIGMA
    bright = pl.col("visible_id").is_not_null() & over_noise
    found = detections.group_by(_FRAME).agg(
        bright.sum().alias("found"), pl.col("visible_id").is_null().sum().alias("none")
    )
    frames = rows.unique(_FRAME, maintain_order=True).select(*_FRAME, "frame_visible")
    frames = frames.join(found, on=_FRAME, how="left").with_columns(pl.col("found", "none").fill_null(0))
    x = frames["frame_visible"].to_numpy().astype(float)
    marks = [
        Mark(x, frames[column].to_numpy().astype(float), colour, name, symbol=symbol,
             hover=f"{{x}} visible, {{y}} {name}")
        for column, name, colour, symbol in (
            ("found", "found", SERIES[0], _FOUND), ("none", "detections of nothing visible", SERIES[1], _FALSE),
        )
    ]  # fmt: skip
    ends = np.array([0.0, max(float(x.max()), 1.0)])
    marks.insert(0, Mark(ends, ends, NEUTRAL, "all of them", line="dash", width=1.5))
    total, seen, none = (int(frames[name].sum()) for name in ("frame_visible", "found", "none"))
    share = number(100 * seen / total) if total else "0"
    chart = Chart("relief_detection", "Detection: visible highlights of a frame that were found",
                  (Panel(Axis("visible highlights of at least 10 sigma in the frame"), Axis("number in the frame"),
                         tuple(marks)),), 400)  # fmt: skip
    bins = [
        f"{_share(frames, low, high)} where a frame holds {low} to {high - 1}"
        for low, high in pairwise((1, 10, 30, 100))
    ]
    return [
        ReliefFigure(
            chart,
            "Detection is scored on what can be seen (theory, section 7): the relief melts glints, and spots without a "
            "glint shine too.",
            (f"{share} % of {total} visible highlights are found ({'; '.join(bins)}); "
             f"{none} of {detections.height} detections show nothing visible.",),
            "A point is a frame; dashes are where all are found. A detector of isolated highlights leaves out what "
            "stands too close to a brighter one.",
        )
    ]  # fmt: skip


def _share(frames: pl.DataFrame, low: int, high: int) -> str:
    """Return which share of their visible highlights is found in frames that hold so many, in per cent."""
    own = frames.filter((pl.col("frame_visible") >= low) & (pl.col("frame_visible") < high))
    total = int(own["frame_visible"].sum())
    return f"{number(100 * int(own['found'].sum()) / total)} %" if total else "no frame"
