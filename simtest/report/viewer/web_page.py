"""The page of a scene in 3D, to turn and zoom: one file that needs nothing else."""

from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.pages.chart_web import PlotlyJson, packed, packed_plotly, rounded
from simtest.pages.html import environment
from simtest.pages.palette import LIGHT, NEUTRAL, colours, hexadecimal
from simtest.report.view3d import BUTTONS, CURVATURE_COLOURS, MARGIN, TRUE_COLOUR, Segments, lines_json, scatter_json
from simtest.report.viewer.content import CAMERA, TRUE, TRUE_BASE, Content, estimators
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.files import write_atomically

BASE_COLOUR = "#8A7A2E"
KEY, HEIGHT_PX = "scene", 680
CURVATURE_QUANTILE, CURVATURE_ROOM = 0.97, 1.4
"""Curvature's colours end at this quantile of its size, times the factor: a few sharp edges must not take them all, and
a surface of one curvature must not get the darkest one."""


def check_page(path: Path) -> None:
    """Raise `InputError` where it is plain, before anything is rendered, that there can be no page."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--page {path}: suffix {path.suffix!r}; must be .html")


def write_scene_page(content: Content, path: Path, title: str) -> None:
    """Write the page of a scene; raises `InputError` if the file cannot be written."""
    check_page(path)
    html = environment().get_template("scene.html.j2").render(
        title=title, height=HEIGHT_PX, key=KEY, errors=errors_deg(content), figures=packed({KEY: scene_json(content)}),
        colours=colours(estimators(content)), plotly=packed_plotly(), true_colour=TRUE_COLOUR,
        highlights=int((content.names == TRUE).sum()), rough=bool((content.names == TRUE_BASE).any()),
        compared=compared_with(content),
    )  # fmt: skip
    write_atomically(path, lambda part: part.write_text(html, encoding="utf-8"))


def scene_json(content: Content) -> PlotlyJson:
    """Return plotly's data and layout: the surface in two colourings, camera, lights and normals."""
    x, y, z = (rounded(side) for side in content.vertices.T)
    i, j, k = (side.tolist() for side in content.faces.T)
    mesh = {"type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "hoverinfo": "skip"}
    lit = mesh | {
        "name": "lit surface", "vertexcolor": [hexadecimal(colour) for colour in content.lit],
        "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
    }  # fmt: skip
    limit = curvature_limit(content.curvature)
    curved = mesh | {
        "name": "curvature", "visible": False, "intensity": rounded(np.nan_to_num(content.curvature)),
        "cmin": -limit, "cmax": limit,
        "colorscale": [[at / 10, colour] for at, colour in enumerate(CURVATURE_COLOURS)],
        "lighting": {"ambient": 0.7, "diffuse": 0.5, "specular": 0.0},
        "colorbar": {"title": {"text": "curvature<br>of larger<br>size (1/mm),<br>convex<br>positive",
                               "font": {"size": 12}}, "thickness": 12, "len": 0.6, "x": 1.0},
    }  # fmt: skip
    eyes = [("camera", np.zeros((1, 3)), NEUTRAL, "diamond"), ("light", content.lights, LIGHT, "circle")]
    points = [
        scatter_json(name, positions, "markers")
        | {"marker": {"size": 5, "color": colour, "symbol": symbol}, "showlegend": True}
        for name, positions, colour, symbol in eyes
        if len(positions)
    ]
    buttons = [
        {"label": name, "method": "restyle", "args": [{"visible": shown}, [0, 1]]}
        for name, shown in (("lit surface", [True, False]), ("curvature", [False, True]))
    ]
    axes = {f"{a}axis": {"title": {"text": f"{a} (mm)"}, "nticks": 5} for a in "xyz"}
    layout: PlotlyJson = {
        "height": HEIGHT_PX, "margin": MARGIN, "dragmode": "orbit",
        "scene": {"aspectmode": "data", **axes,
                  "camera": {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 1.5, "y": -1.14, "z": -1.68}}},
        "updatemenus": [{"type": "buttons", "direction": "right", "buttons": buttons, "x": 0, "y": 1,
                         "xanchor": "left", "yanchor": "top", **BUTTONS}],
    }  # fmt: skip
    lines = [lines_json(part) | {"showlegend": True} for part in _segments(content)]
    return {"data": [lit, curved, *lines, *points], "layout": layout}


def curvature_limit(curvature: Array) -> float:
    """Return the curvature, 1/mm, at which its colours end."""
    finite = np.abs(curvature[np.isfinite(curvature)])
    return max(CURVATURE_ROOM * float(np.quantile(finite, CURVATURE_QUANTILE)), 1e-4) if finite.size else 1.0


def errors_deg(content: Content) -> dict[str, list[float]]:
    """Return the angles of each estimator's normals to the nearest true one, deg; none where nothing is true.

    True normals are those of the fine surface, or else those of the base (`compared_with`).
    """
    is_true = content.names == compared_with(content)
    if not is_true.any():
        return {name: [] for name in estimators(content)}
    made: dict[str, list[float]] = {}
    for name in estimators(content):
        own = content.names == name
        starts = content.starts[own]
        nearest = np.linalg.norm(starts[:, None] - content.starts[is_true][None], axis=2).argmin(axis=1)
        cosine = (_directions(content, own) * _directions(content, is_true)[nearest]).sum(axis=1)
        made[name] = np.degrees(np.arccos(np.clip(cosine, -1, 1))).tolist()
    return made


def compared_with(content: Content) -> str:
    """Return the name of the true normals that the estimates are compared with."""
    return TRUE if (content.names == TRUE).any() else TRUE_BASE


def _directions(content: Content, own: Mask) -> Array:
    along = content.ends[own] - content.starts[own]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


def _segments(content: Content) -> list[Segments]:
    """Return the lines of camera, true normals and estimates, in the order of the legend."""
    names = estimators(content)
    palette = {CAMERA: NEUTRAL, TRUE: TRUE_COLOUR, TRUE_BASE: BASE_COLOUR, **colours(names)}
    # The shorter lines are the wider ones, so that all show where they lie on each other.
    widths = {CAMERA: 2.0, TRUE: 3.0, TRUE_BASE: 3.0, **{name: 4.0 + 2 * i for i, name in enumerate(names)}}
    shown = [name for name in palette if (content.names == name).any()]
    return [
        Segments(
            name if name != CAMERA else "field of view", palette[name], widths[name],
            content.starts[content.names == name], content.ends[content.names == name],
        )
        for name in shown
    ]  # fmt: skip
