"""Draws gallery frames: isophotes, fitted ellipses, brightest points and normals over the frame."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from simtest.pages.style import NEUTRAL, TRUTH, Array
from simtest.report.run_folder import GalleryItem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GAMMA = 2.2
"""Frames are linear; they are shown with this display gamma. Isophotes are those of the linear frame."""

_WIDTH = 3.6
_ARROW = 0.2
_ARROW_ENLARGED = 0.4
_TRUTH_EDGE = "#332B00"
_ISOPHOTE_MAP = "cool"


def grey(frame: npt.NDArray[np.float32]) -> Array:
    """Give the mean over the channels of a frame, shape (H, W)."""
    return np.asarray(frame if frame.ndim == 2 else frame.mean(axis=-1), dtype=float)


def vector(value: Any, size: int) -> Array | None:
    """Read a list of numbers of a given length; None where it is missing or not finite."""
    if value is None:
        return None
    try:
        data = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return data if data.shape == (size,) and np.isfinite(data).all() else None


def estimated_normals(estimate: Mapping[str, Any]) -> list[Array]:
    """Give the candidates of an estimate, or its single normal; empty where it failed."""
    found = [vector(value, 3) for value in estimate.get("candidates") or []]
    candidates = [value for value in found if value is not None]
    if candidates:
        return candidates
    normal = vector(estimate.get("normal"), 3)
    return [] if normal is None else [normal]


def anchor(item: GalleryItem, estimate: Mapping[str, Any]) -> Array | None:
    """Give the surface point from which an estimate's normals are drawn, mm, camera frame.

    It is the true highlight that the estimate was matched to; for a false detection it is the point of the truth map
    at the brightest point; None where there is no surface.
    """
    truth = item.true_highlight(estimate)
    point = vector(truth.get("position"), 3) if truth else None
    if point is not None:
        return point
    pixel = vector(estimate.get("bp_px"), 2)
    if pixel is None:
        return None
    rows, columns = item.position.shape[:2]
    row, column = int(pixel[1] / item.camera.height * rows), int(pixel[0] / item.camera.width * columns)
    if not (0 <= row < rows and 0 <= column < columns):
        return None
    return vector(item.position[row, column], 3)


def draw_item(item: GalleryItem, colours: Mapping[str, str]) -> "Figure":
    """Draw one frame and, below it, the neighbourhood of its main highlight.

    Parameters
    ----------
    item : GalleryItem
        What to draw.
    colours : mapping of str to str
        Colour by estimator.

    Returns
    -------
    matplotlib.figure.Figure
        3.6 inches wide; the caller closes it.
    """
    import matplotlib.pyplot as plt

    window = _window(item)
    aspect = item.frame.shape[0] / item.frame.shape[1]
    heights = [3.1 * aspect] + ([3.1] if window else [])
    figure, axes = plt.subplots(
        len(heights), 1, figsize=(_WIDTH, sum(heights) + 0.5 * len(heights) + 0.8), squeeze=False,
        gridspec_kw={"height_ratios": heights}, layout="constrained",
    )  # fmt: skip
    reach = _ARROW if window is None else _ARROW_ENLARGED * (window[1] - window[0]) / item.camera.fx
    spots = [vector(t.get("bp_px"), 2) for t in item.truth]
    for i, ax in enumerate(axes[:, 0]):
        _draw_frame(ax, item)
        detailed = i > 0 or window is None
        _draw_overlay(ax, item, colours, detailed, reach if i > 0 else _ARROW)
        ax.set_title("frame" if i == 0 else "largest highlight", fontsize=8)
        for spot in spots if i == 0 and window else ():
            if spot is not None:
                ax.plot(*spot, "o", ms=11, mfc="none", mec=TRUTH, mew=0.8)
        if i > 0 and window:
            ax.set_xlim(window[0], window[1])
            ax.set_ylim(window[3], window[2])
    _legend(figure, item, colours)
    return figure


def _draw_frame(ax: "Axes", item: GalleryItem) -> None:
    height, width = item.frame.shape[:2]
    picture = np.nan_to_num(np.clip(item.frame, 0, 1)) ** (1 / GAMMA)
    ax.imshow(picture, cmap="gray", vmin=0, vmax=1, extent=(0, width, height, 0), interpolation="nearest")
    ax.grid(False)
    ax.set_xlabel("x (px)", fontsize=7.5)
    ax.set_ylabel("y (px)", fontsize=7.5)
    ax.tick_params(labelsize=7.5)
    ax.set_autoscale_on(False)


def _draw_overlay(ax: "Axes", item: GalleryItem, colours: Mapping[str, str], detailed: bool, reach: float) -> None:
    from matplotlib.patheffects import withStroke

    drawn: set[tuple[Any, Any]] = set()
    for estimate in item.estimates:
        colour = colours.get(str(estimate.get("estimator")), NEUTRAL)
        for isophote in estimate.get("isophotes") or []:
            key = (estimate.get("specularity"), isophote.get("t"))
            if key not in drawn and isophote.get("t") is not None:
                drawn.add(key)
                _closed(ax, isophote.get("points"), isophote_colour(float(isophote["t"])), 1.6 if detailed else 0.8)
        for curve in (estimate.get("curves") or []) if detailed else []:
            points = np.asarray(curve, dtype=float)
            if points.ndim == 2 and points.shape[1] == 2:
                ax.plot(points[:, 0], points[:, 1], "--", color=colour, lw=1.1, dashes=(4, 3))
    for truth in item.truth:
        point, normal = vector(truth.get("position"), 3), vector(truth.get("normal"), 3)
        if point is not None and normal is not None:
            _arrow(ax, item, (point, normal), TRUTH, 3.0 if detailed else 1.6, reach)
        spot = vector(truth.get("bp_px"), 2)
        if spot is not None and detailed:
            edge = [withStroke(linewidth=3.6, foreground=_TRUTH_EDGE)]
            ax.plot(*spot, "+", color=TRUTH, ms=16, mew=1.8, zorder=6, path_effects=edge)
    for estimate in item.estimates:
        colour = colours.get(str(estimate.get("estimator")), NEUTRAL)
        surface = anchor(item, estimate)
        for normal in estimated_normals(estimate) if surface is not None else ():
            _arrow(ax, item, (np.asarray(surface), normal), colour, 1.6 if detailed else 1.0, reach)
        spot = vector(estimate.get("bp_px"), 2)
        if spot is not None and detailed:
            edge = [withStroke(linewidth=2.6, foreground="white")]
            ax.plot(*spot, "x", color=colour, ms=7, mew=1.4, zorder=7, path_effects=edge)


def isophote_colour(isovalue: float) -> tuple[float, float, float, float]:
    """Give the colour of an isophote at t in 0..1."""
    import matplotlib

    red, green, blue, alpha = matplotlib.colormaps[_ISOPHOTE_MAP](float(np.clip(isovalue, 0, 1)))
    return red, green, blue, alpha


def isovalues(items: Iterable[GalleryItem]) -> list[float]:
    """Give the isovalues that gallery items draw, sorted."""
    estimates = [estimate for item in items for estimate in item.estimates]
    drawn = [isophote.get("t") for estimate in estimates for isophote in estimate.get("isophotes") or ()]
    return sorted({round(float(t), 3) for t in drawn if isinstance(t, int | float)})


def _closed(ax: "Axes", points: Any, colour: Any, width: float) -> None:
    data = np.asarray(points or [], dtype=float)
    if data.ndim == 2 and data.shape[1] == 2:
        ax.plot(*np.vstack([data, data[:1]]).T, color=colour, lw=width)


def _arrow(ax: "Axes", item: GalleryItem, foot: tuple[Array, Array], colour: str, width: float, reach: float) -> None:
    """Draw a normal from its surface point, projected; one that points at the camera is a dot."""
    from matplotlib.patches import FancyArrowPatch

    point, normal = foot
    ends = item.camera.project(np.stack([point, point + reach * np.linalg.norm(point) * normal]))
    if not np.isfinite(ends).all():
        return
    ax.plot(*ends[0], ".", color=colour, ms=2.5 * width + 2, zorder=4)
    if np.linalg.norm(ends[1] - ends[0]) > 2:
        tail, head = (float(ends[0, 0]), float(ends[0, 1])), (float(ends[1, 0]), float(ends[1, 1]))
        patch = FancyArrowPatch(
            tail, head, arrowstyle="-|>", color=colour, lw=width, shrinkA=0, shrinkB=0, mutation_scale=9, zorder=5
        )
        ax.add_patch(patch)


def _window(item: GalleryItem) -> tuple[float, float, float, float] | None:
    """Frame the main highlight (x0, x1, y0, y1); None where it fills the frame or nothing was found."""
    groups: dict[Any, list[Array]] = {}
    for estimate in item.estimates:
        for isophote in estimate.get("isophotes") or []:
            data = np.asarray(isophote.get("points") or [], dtype=float)
            if data.ndim == 2 and data.shape[1] == 2:
                groups.setdefault(estimate.get("specularity"), []).append(data)
    if not groups:
        return None
    points = max((np.vstack(v) for v in groups.values()), key=lambda p: float(np.ptp(p, axis=0).max()))
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(0.8 * float((high - low).max()), 10.0)
    if 2 * half > 0.9 * min(item.frame.shape[:2]):
        return None
    x, y = (low + high) / 2
    return float(x - half), float(x + half), float(y - half), float(y + half)


def _legend(figure: "Figure", item: GalleryItem, colours: Mapping[str, str]) -> None:
    from matplotlib.lines import Line2D

    names = list(dict.fromkeys(str(e.get("estimator")) for e in item.estimates))
    levels = sorted({float(i["t"]) for e in item.estimates for i in e.get("isophotes") or [] if i.get("t") is not None})
    handles = [Line2D([], [], color=TRUTH, marker="+", lw=3, ms=9, mew=2, label="truth")]
    handles += [Line2D([], [], color=colours.get(n, NEUTRAL), marker="x", ls="--", label=_short(n)) for n in names]
    step = -(-len(levels) // 5) or 1
    handles += [Line2D([], [], color=isophote_colour(t), lw=2, label=f"isophote t = {t:g}") for t in levels[::step]]
    figure.legend(handles=handles, loc="outside lower center", ncol=2, fontsize=7.5, frameon=False)


def _short(name: str, most: int = 24) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"
