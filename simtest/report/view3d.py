"""The 3D view: the visible surface of one gallery item with true and estimated normals, as the page turns it."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import ClassVar, NamedTuple

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.pages.chart import Mark
from simtest.pages.chart_web import PlotlyJson, rounded
from simtest.pages.style import LIGHT, NEUTRAL
from simtest.report.gallery import anchor
from simtest.report.run_folder import GalleryItem, Run
from simtest.runtime.arrays import Array, IntArray, Mask

MARGIN = {"l": 0, "r": 0, "t": 0, "b": 76}  # px; the legend stands below the scene, not on it
_GRID, _NORMALS = 72, 9  # samples of the surface along the longer side, and of the normals that are drawn all over it
_OCCLUSION = 1.25  # factor between the distances of neighbouring samples beyond which there is an edge
TRUE_COLOUR = "#C9A800"
BUTTONS = {"font": {"color": "#1b1f24"}, "bgcolor": "#e9ecf0", "bordercolor": "#7d828a"}
"""Look of the buttons that choose the surface's colours, readable on light and on dark."""
_TRUE, _AT_HIGHLIGHT, _SIGHTLINE = "true normals", "true normal at the highlight", "sightline from the camera"
_COLOURS = {_TRUE: "#5E8FBF", _SIGHTLINE: NEUTRAL, _AT_HIGHLIGHT: TRUE_COLOUR}
CURVATURE_COLOURS = ("#053061", "#2166ac", "#4393c3", "#92c5de", "#d1e5f0", "#f7f7f7", "#fddbc7", "#f4a582", "#d6604d",
                     "#b2182b", "#67001f")  # fmt: skip
"""From concave to convex: blue to red."""


class Segments(NamedTuple):
    """Line segments of one kind, camera frame."""

    name: str
    colour: str
    width: float
    start: Array  # shape (n, 3)
    end: Array


@dataclass(frozen=True)
class View3D:
    """A triangle mesh in the camera frame, and normals as segments; with key, height (px) and legend of its figure."""

    title: str
    vertices: Array
    triangles: IntArray
    intensity: Array  # grey value at the vertices
    segments: tuple[Segments, ...]
    unit: str
    curvature: Array | None  # principal one of larger size, at the vertices, where the run kept it
    lights: Array  # positions, shape (L, 3)
    key: ClassVar[str] = "surface3d"
    keys: ClassVar[tuple[Mark, ...]] = ()
    height: ClassVar[int] = 560

    @property
    def curvature_limit(self) -> float:
        """Curvature at which the colours end: a few sharp edges must not take them all."""
        assert self.curvature is not None
        finite = np.abs(self.curvature[np.isfinite(self.curvature)])
        return max(float(np.quantile(finite, 0.97)), 1e-4) if finite.size else 1.0

    @property
    def points(self) -> list[tuple[str, Array, str]]:
        """Camera and lights: name, positions and colour."""
        found = [("camera", np.zeros((1, 3)), NEUTRAL), ("light", self.lights, LIGHT)]
        return [entry for entry in found if len(entry[1])]


def view_3d(run: Run, colours: Mapping[str, str]) -> View3D | None:
    """Make the 3D view of the gallery item that most estimators answered, the most curved of these.

    Returns None where no item has a surface.
    """
    ranked = sorted(run.gallery, key=_interest, reverse=True)
    usable = (item for item in ranked if np.isfinite(item.position).all(axis=-1).sum() >= 16)
    chosen = next(usable, None)
    return None if chosen is None else _build(chosen, colours)


def _interest(item: GalleryItem) -> tuple[int, float]:
    answered = {estimate.estimator for estimate in item.meta.estimates if estimate.status == "ok"}
    sizes = (abs(size) for truth in item.meta.truth for size in (truth.kd_min, truth.kd_max) if size)
    return len(answered), min(max(sizes, default=0.0), 2.0)


def _build(item: GalleryItem, colours: Mapping[str, str]) -> View3D | None:
    # The surface, thinned.
    step = max(1, -(-max(item.position.shape[:2]) // _GRID))
    position = item.position[::step, ::step].astype(float)
    normal = item.normal[::step, ::step].astype(float)
    valid = np.isfinite(position).all(axis=-1)
    triangles = grid_triangles(position, _OCCLUSION)
    if not len(triangles):
        return None
    vertices = position[valid]
    kept, setting = item.pictures.get("curvature"), item.meta.setting
    # Normals as long as the surface is far away.
    reach = 0.12 * float(np.median(np.linalg.norm(vertices, axis=1)))
    segments = _everywhere(position, normal, valid, reach), *_at_highlights(item, 2.5 * reach, colours)
    return View3D(
        setting if setting.startswith(item.title) else f"{item.title}: {setting}", vertices, triangles,
        _intensity(item, position.shape[:2], step)[valid], segments, item.meta.length_unit,
        None if kept is None else kept[::step, ::step].astype(float)[valid],
        np.array(item.meta.lights, dtype=float).reshape(-1, 3),
    )  # fmt: skip


def grid_triangles(position: Array, occlusion: float) -> IntArray:
    """Join neighbouring samples of a surface, shape (h, w, 3), camera frame, NaN where there is none.

    Where the distances of neighbours differ by more than the factor `occlusion`, they lie on both sides of an edge and
    stay apart. Returns the triangles' corners, shape (n, 3), as indices into the samples that are a surface.
    """
    valid = np.isfinite(position).all(axis=-1)
    index = np.where(valid, np.cumsum(valid).reshape(valid.shape) - 1, -1)
    distance = np.linalg.norm(position, axis=-1)
    corners = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    a, b, c, d = (index[corner].ravel() for corner in corners)
    depth = np.stack([distance[corner].ravel() for corner in corners])
    with np.errstate(invalid="ignore"):
        whole = (np.stack([a, b, c, d]) >= 0).all(axis=0) & (depth.max(axis=0) < occlusion * depth.min(axis=0))
    return np.concatenate([np.stack([a, c, b], axis=1)[whole], np.stack([b, c, d], axis=1)[whole]])


def _intensity(item: GalleryItem, shape: tuple[int, int], step: int) -> Array:
    frame = item.frame if item.frame.ndim == 2 else item.frame.mean(axis=-1)
    rows, columns = item.position.shape[:2]
    y = ((np.arange(shape[0]) * step + PIXEL_CENTRE) / rows * frame.shape[0]).astype(int)
    x = ((np.arange(shape[1]) * step + PIXEL_CENTRE) / columns * frame.shape[1]).astype(int)
    return np.clip(frame[np.ix_(y, x)], 0, 1).astype(float)


def _everywhere(position: Array, normal: Array, valid: Mask, reach: float) -> Segments:
    rows, columns = (np.linspace(0, n - 1, min(n, _NORMALS + 2)).round().astype(int)[1:-1] for n in position.shape[:2])
    kept = np.zeros_like(valid)
    kept[np.ix_(rows, columns)] = True
    kept &= valid & np.isfinite(normal).all(axis=-1)
    start = position[kept]
    return Segments(_TRUE, _COLOURS[_TRUE], 2, start, start + reach * normal[kept])


def _at_highlights(item: GalleryItem, reach: float, colours: Mapping[str, str]) -> list[Segments]:
    """Collect the normals at the highlights: the true ones, then each estimator's with all its candidates."""
    true = [(np.array(t.position), np.array(t.normal)) for t in item.meta.truth if t.position and t.normal]
    groups: dict[str, list[tuple[Array, Array]]] = {_AT_HIGHLIGHT: true}
    for estimate in item.meta.estimates:
        point = anchor(item, estimate)
        if point is not None:
            groups.setdefault(estimate.estimator, []).extend((point, normal) for normal in estimate.normals)
    segments = []
    for name, pairs in groups.items():
        if pairs:
            start, normals = (np.array(part) for part in zip(*pairs, strict=True))
            # The true normal is longer, so that it shows where an estimate lies on top of it.
            length, width = (1.4 * reach, 4) if name == _AT_HIGHLIGHT else (reach, 7)
            colour = _COLOURS.get(name) or colours[name]
            segments.append(Segments(name, colour, width, start, start + length * normals))
    if true:
        ends = np.array([point for point, _ in true])
        segments.append(Segments(_SIGHTLINE, _COLOURS[_SIGHTLINE], 2, np.zeros_like(ends), ends))
    return segments


def view_json(data: View3D) -> PlotlyJson:
    """Return plotly's data and layout of the view; it can be turned and zoomed."""
    x, y, z = (rounded(side) for side in data.vertices.T)
    i, j, k = (side.tolist() for side in data.triangles.T)
    mesh = {"type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "name": "surface", "hoverinfo": "skip"}
    picture = {
        "intensity": rounded(np.sqrt(data.intensity)), "cmin": -0.35, "cmax": 1, "colorscale": "Greys",
        "showscale": False, "lighting": {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0, "roughness": 1.0},
    }  # fmt: skip
    lines = [lines_json(part) for part in data.segments]
    points = [
        scatter_json(name, positions, "markers") | {"marker": {"size": 4, "color": colour, "symbol": symbol}}
        for (name, positions, colour), symbol in zip(data.points, ("diamond", "circle"), strict=False)
    ]
    axes = {f"{a}axis": {"title": {"text": f"{a} ({data.unit})"}, "nticks": 5} for a in "xyz"}
    camera = {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 1.5, "y": -1.14, "z": -1.68}}
    made: PlotlyJson = {"height": data.height, "scene": {"aspectmode": "data", "camera": camera, **axes},
                        "dragmode": "orbit", "margin": MARGIN}  # fmt: skip
    if data.curvature is None:
        return {"data": [mesh | picture, *lines, *points], "layout": made}
    title = f"curvature of<br>larger size (1/{data.unit}),<br>convex positive"
    limit = data.curvature_limit
    curved = {
        "intensity": rounded(np.nan_to_num(data.curvature)), "cmin": -limit, "cmax": limit,
        "colorscale": [[i / 10, colour] for i, colour in enumerate(CURVATURE_COLOURS)],
        "lighting": {"ambient": 0.9, "diffuse": 0.2, "specular": 0.0},
        "colorbar": {"title": {"text": title, "font": {"size": 12}}, "thickness": 12, "len": 0.6, "x": 1.0},
    }  # fmt: skip
    # Buttons that show one of the two surfaces, the traces 1 and 0.
    buttons = [
        {"label": name, "method": "restyle", "args": [{"visible": which}, [0, 1]]}
        for name, which in (("curvature", [False, True]), ("picture", [True, False]))
    ]
    made["updatemenus"] = [{"type": "buttons", "direction": "right", "buttons": buttons, "x": 0, "y": 1,
                            "xanchor": "left", "yanchor": "top", **BUTTONS}]  # fmt: skip
    return {"data": [mesh | picture | {"visible": False}, mesh | curved, *lines, *points], "layout": made}


def scatter_json(name: str, points: Array, mode: str) -> PlotlyJson:
    """Return plotly's trace of points, shape (n, 3), or of lines through them; NaN parts lines."""
    x, y, z = (rounded(side) for side in points.T)
    return {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": mode, "name": escape(name), "hoverinfo": "name"}


def lines_json(part: Segments) -> PlotlyJson:
    """Return plotly's trace of line segments."""
    gaps = np.full_like(part.start, np.nan)
    points = np.stack([part.start, part.end, gaps], axis=1).reshape(-1, 3)
    return scatter_json(part.name, points, "lines") | {"line": {"color": part.colour, "width": part.width}}
