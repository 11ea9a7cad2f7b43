"""The figure of runs on motion: which share of the curvatures' signs it tells, over the length of the motion."""

from collections.abc import Sequence

import numpy as np
import polars as pl

from simtest.estimators.motion_signs import WRONG_SHARE
from simtest.pages.charts import Axis, Chart, Mark, Panel
from simtest.pages.palette import SERIES
from simtest.pages.style import number, symbols
from simtest.report.relief_figures import ReliefFigure
from simtest.report.run_folder import Run
from simtest.validation.motion import MotionCounts, motion_counts, motion_rows

LENGTH = "views.length_mm"


def motion_figures(run: Run) -> list[ReliefFigure]:
    """Compute the figure of a run with further views; none for other runs."""
    rows = motion_rows(run.results)
    if rows.is_empty():
        return []
    pooled = motion_counts(rows)
    share, _, high = pooled.wrong_share
    measured = [
        f"Of {pooled.told} told signs {pooled.wrong} are wrong: {number(100 * share)} % of those asked, at most "
        f"{number(100 * high)} % (95 % interval); stated is at most "
        f"{number(100 * WRONG_SHARE)} %."
    ]
    labels = rows["label"].unique(maintain_order=True).to_list()
    parts = {label: rows.filter(pl.col("label") == label) for label in labels}
    measured += [_sentence(label, motion_counts(part)) for label, part in parts.items()]
    chart = Chart(
        "motion", "Motion: signs of the curvature that are told",
        (Panel(Axis("motion over distance", "log"), Axis("share of signs told", limits=(0.0, 1.05)),
               tuple(_marks({label: part for label, part in parts.items() if _is_swept(part)}))),), 440,
    )  # fmt: skip
    about = (
        "A second view from a known position tells which sign 1 + d k has along each principal direction: convex or "
        "concave. A sign is told where its likelihood is more than 100 times that of the other one, and some curvature "
        "explains both views."
    )
    caption = (
        "Each point is a setting: told signs over all signs of its true highlights, two each. A motion along one "
        "principal direction tells one of two."
    )
    return [ReliefFigure(chart, about, tuple(measured), caption)]


def _is_swept(rows: pl.DataFrame) -> bool:
    return LENGTH in rows.columns and rows[LENGTH].drop_nulls().n_unique() > 1


def _marks(parts: dict[str, pl.DataFrame]) -> list[Mark]:
    """Draw the share of told signs of each label over the motion's length."""
    made, held = [], symbols(parts)
    for i, (label, rows) in enumerate(parts.items()):
        by_length = [(_over_distance(own), motion_counts(own)) for _, own in rows.group_by(LENGTH, maintain_order=True)]
        by_length.sort(key=lambda each: each[0])
        x, y = np.array([at for at, _ in by_length]), np.array([counts.told_share for _, counts in by_length])
        hover = [f"{label}\n{_sentence(number(at), counts)}" for at, counts in by_length]
        colour = SERIES[i % len(SERIES)]
        made.append(Mark(x, y, colour, label, line="solid", width=0.9, symbol=held[label], hover=hover))
    return made


def _over_distance(rows: pl.DataFrame) -> float:
    values: Sequence[float] = rows["motion_over_d"].drop_nulls().to_list()
    return float(np.median(values)) if values else np.nan


def _sentence(what: str, counts: MotionCounts) -> str:
    told = f"{what}: {counts.told} of {counts.signs} signs told, {counts.wrong} wrong"
    return told + (f"; no curvature explains {counts.misfits} of {counts.judged} highlights" if counts.misfits else "")
