"""What triangles alone cost, from studies/fineness.py: the figures on pages of runs over anatomies."""

from pathlib import Path

import numpy as np
from pydantic import BaseModel

from simtest.conventions import EDGES_PER_HALF_WIDTH
from simtest.pages.charts import Axis, Chart, Mark, Panel, label_keys, log_range
from simtest.pages.palette import NEUTRAL, SERIES
from simtest.pages.style import symbols

DATA = Path(__file__).with_name("triangle_cost.json")

SHADINGS = {
    "flat": (SERIES[1], "flat triangles"),
    "estimated": (SERIES[0], "normals from the triangles"),
    "exact": (SERIES[2], "exact vertex normals"),
}
"""Colour and name of each way to shade, by its name in the data."""

PANELS = (
    ("normal_deg", "Error of the normal", "error of the normal (deg)", 1, 1e-5),
    ("axis_ratio", "Error of the axis ratio", "error of the axis ratio (%)", 100, 1e-3),
)
"""Field, heading, axis, factor and the least value that is drawn: what is smaller is rounding."""

X_TITLE = "edge length over the highlight's half-width"


class FinenessCurve(BaseModel):
    """Nine in ten errors on one surface with one shading are below these, by edge length."""

    surface: str
    shading: str
    normal_deg: list[float]
    axis_ratio: list[float]  # share of it


class Fineness(BaseModel):
    """The study: curves over the edge lengths, in highlights' half-widths."""

    edge_over_half_width: list[float]
    distance_mm: float
    exponent: float
    curves: list[FinenessCurve]

    def sentence(self) -> str:
        """State what the rule of `simtest mesh check` costs on the most curved surface."""
        at = int(np.argmin(np.abs(np.array(self.edge_over_half_width) - 1 / EDGES_PER_HALF_WIDTH)))
        worst = [curve for curve in self.curves if curve.shading == "estimated"]
        normal, ratio = max(c.normal_deg[at] for c in worst), 100 * max(c.axis_ratio[at] for c in worst)
        return (
            f"With {EDGES_PER_HALF_WIDTH:g} edges in a half-width, which simtest mesh check asks for, triangles with "
            f"normals of their own cost at most {normal:.2g}° and {ratio:.2g} % of the axis ratio here."
        )


def read_study() -> Fineness:
    """Read the shipped study."""
    return Fineness.model_validate_json(DATA.read_bytes())


def fineness_charts(study: Fineness) -> list[Chart]:
    """Describe the study: a chart of normals, one of axis ratios; the dashed line is the rule for meshes."""
    shapes = symbols(curve.surface for curve in study.curves)
    edges = study.edge_over_half_width
    x = Axis(X_TITLE, "log", named=tuple((edge, f"{edge:g}") for edge in edges))
    charts = []
    for key, title, name, factor, least in PANELS:
        marks = []
        for curve in study.curves:
            colour, shading = SHADINGS[curve.shading]
            values = factor * np.array(getattr(curve, key))
            hover = [
                f"{curve.surface}, {shading}\nedge {edge:g}: {name} {value:.2g}"
                for edge, value in zip(edges, values, strict=True)
            ]
            y, symbol = np.maximum(values, least), shapes[curve.surface]
            marks.append(Mark(edges, y, colour, shading, line="solid", width=1.2, symbol=symbol, hover=hover))
        ends = log_range([mark.y for mark in marks])
        rule = Mark([1 / EDGES_PER_HALF_WIDTH] * 2, ends, NEUTRAL, line="dash", width=1.2)
        panel = Panel(x, Axis(name, "log", ends), (rule, *marks))
        charts.append(Chart(f"fineness_{key}", title, (panel,), 400, label_keys(shapes)))
    return charts
