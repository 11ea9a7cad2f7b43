"""What triangles alone cost, from studies/fineness.py: the figure on pages of runs over anatomies."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.pages import style
from simtest.pages.style import NEUTRAL, Array
from simtest.surfaces.fineness import EDGES_PER_HALF_WIDTH

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from matplotlib.figure import Figure

DATA = Path(__file__).with_name("triangle_cost.json")

SHADINGS = {
    "flat": ("#D55E00", "flat triangles"),
    "estimated": ("#0072B2", "normals from the triangles"),
    "exact": ("#009E73", "exact vertex normals"),
}
"""Colour and name of each way to shade, by its name in the data."""

PANELS = (("normal_deg", "error of the normal (deg)"), ("axis_ratio_percent", "error of the axis ratio (%)"))
X_TITLE = "edge length over the highlight's half-width"
LEAST = {"normal_deg": 1e-5, "axis_ratio_percent": 1e-3}
"""What is smaller is drawn here: rounding."""


@dataclass(frozen=True)
class FinenessCurve:
    """Nine in ten errors on one surface with one shading are below these, by edge length."""

    surface: str
    shading: str
    normal_deg: Array
    axis_ratio_percent: Array


@dataclass(frozen=True)
class Fineness:
    """The study.

    Parameters
    ----------
    edges : ndarray, shape (n,)
        Edge length over the highlight's half-width.
    curves : tuple of FinenessCurve
        Each of n values.
    distance_mm, exponent : float
        What was looked at.
    """

    edges: Array
    curves: tuple[FinenessCurve, ...]
    distance_mm: float
    exponent: float

    @property
    def surfaces(self) -> list[str]:
        """Names of the surfaces in order."""
        return list(dict.fromkeys(curve.surface for curve in self.curves))

    def sentence(self) -> str:
        """Say what the rule of `simtest mesh check` costs on the most curved surface."""
        at = int(np.argmin(np.abs(self.edges - 1 / EDGES_PER_HALF_WIDTH)))
        worst = [curve for curve in self.curves if curve.shading == "estimated"]
        normal = max(float(curve.normal_deg[at]) for curve in worst)
        ratio = max(float(curve.axis_ratio_percent[at]) for curve in worst)
        return (
            f"With {EDGES_PER_HALF_WIDTH:g} edges in a half-width, which `simtest mesh check` asks for, triangles with "
            f"normals of their own cost at most {normal:.2g}° and {ratio:.2g} % of the axis ratio here."
        )


def read_study() -> Fineness:
    """Read the shipped study."""
    content = json.loads(DATA.read_text(encoding="utf-8"))
    curves = tuple(
        FinenessCurve(c["surface"], c["shading"], np.array(c["normal_deg"]), 100 * np.array(c["axis_ratio"]))
        for c in content["curves"]
    )
    return Fineness(np.array(content["edge_over_half_width"]), curves, content["distance_mm"], content["exponent"])


def draw(study: Fineness) -> "Figure":
    """Draw the study with matplotlib: a panel for normals, one for axis ratios."""
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    marks = style.symbols(study.surfaces)
    for ax, (key, title) in zip(axes, PANELS, strict=True):
        for curve in study.curves:
            values = np.maximum(getattr(curve, key), LEAST[key])
            ax.loglog(study.edges, values, color=SHADINGS[curve.shading][0], lw=1, ms=5,
                      marker=marks[curve.surface].matplotlib)  # fmt: skip
        ax.axvline(1 / EDGES_PER_HALF_WIDTH, color=NEUTRAL, ls="--", lw=1)
        ax.set(xlabel=X_TITLE, ylabel=title)
        ax.set_xticks(study.edges, [f"{edge:g}" for edge in study.edges])
        ax.minorticks_off()
    handles = [Line2D([], [], color=colour, label=name) for colour, name in SHADINGS.values()]
    handles += [Line2D([], [], color="#444", ls="", marker=marks[s].matplotlib, label=s) for s in study.surfaces]
    figure.legend(handles=handles, loc="outside lower center", ncol=4, fontsize=9)
    return figure


def interactive(study: Fineness) -> "go.Figure":
    """Draw the study with plotly."""
    import plotly.graph_objects as go

    from simtest.report.interactive import layout

    figure = go.Figure()
    marks = style.symbols(study.surfaces)
    named: set[str] = set()
    for curve in study.curves:
        colour, name = SHADINGS[curve.shading]
        for axis, (key, title) in zip(("", "2"), PANELS, strict=True):
            values, place = getattr(curve, key), f"{curve.surface}, {name}"
            figure.add_trace(
                go.Scatter(
                    x=study.edges, y=np.maximum(values, LEAST[key]), customdata=values, mode="lines+markers",
                    xaxis=f"x{axis}", yaxis=f"y{axis}", name=name, legendgroup=name, showlegend=name not in named,
                    line={"color": colour, "width": 1.2},
                    marker={"symbol": marks[curve.surface].plotly, "size": 7, "color": colour},
                    hovertemplate=f"{place}<br>edge %{{x:g}}: {title} %{{customdata:.2g}}<extra></extra>",
                )
            )  # fmt: skip
            named.add(name)
    figure.update_layout(layout(440, **_axes(study)))
    return figure


def _axes(study: Fineness) -> dict[str, Any]:
    ticks = {"tickvals": study.edges.tolist(), "ticktext": [f"{edge:g}" for edge in study.edges]}
    x: dict[str, Any] = {"title": {"text": X_TITLE}, "type": "log", "automargin": True, **ticks}
    y: dict[str, Any] = {"type": "log", "dtick": 1, "exponentformat": "none", "automargin": True}
    rule = {"type": "line", "x0": 1 / EDGES_PER_HALF_WIDTH, "x1": 1 / EDGES_PER_HALF_WIDTH, "y0": 0, "y1": 1,
            "line": {"color": NEUTRAL, "dash": "dash", "width": 1.2}}  # fmt: skip
    (_, left), (_, right) = PANELS
    return {
        "xaxis": {**x, "domain": [0, 0.46]}, "yaxis": {**y, "title": {"text": left}},
        "xaxis2": {**x, "domain": [0.56, 1], "anchor": "y2"},
        "yaxis2": {**y, "title": {"text": right}, "anchor": "x2"},
        "shapes": [{**rule, "xref": "x", "yref": "paper"}, {**rule, "xref": "x2", "yref": "paper"}],
    }  # fmt: skip
