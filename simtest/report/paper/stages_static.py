"""Draws Figure 2, the pipeline in pictures, with matplotlib."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.pages.style import NEUTRAL, TRUTH, Array
from simtest.report.gallery import GAMMA
from simtest.report.paper.stages import Stages

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ISOPHOTE = "#00C2D1"
_DARK = "#332B00"


def draw_stages(data: Stages, colour: str) -> "Figure":
    """Draw all panels in one figure; `colour` is the estimator's."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(13.6, 8.4), layout="constrained")
    for ax, panel in zip(axes.flat, _PANELS, strict=True):
        panel(ax, data, colour)
    return figure


def draw_panels(data: Stages, colour: str) -> list["Figure"]:
    """Draw each panel in a figure of its own, for narrow pages."""
    import matplotlib.pyplot as plt

    x0, x1, y1, y0 = data.extent
    flat = min(4.0 * (y1 - y0) / (x1 - x0), 4.0)
    heights: dict[Any, float] = {_clean: flat + 0.8, _noisy: flat + 0.8, _smoothed: flat + 1.3}
    figures = []
    for panel in _PANELS:
        figure, ax = plt.subplots(figsize=(4.6, heights.get(panel, 4.7)), layout="constrained")
        panel(ax, data, colour)
        figures.append(figure)
    return figures


def _texture(ax: "Axes", data: Stages, _colour: str) -> None:
    half = data.side / 2
    _picture(ax, data.texture, "1  texture of the specular term", (-half, half, half, -half))
    ax.set(xlabel="x on the plane (texture units)", ylabel="y on the plane (texture units)")


def _clean(ax: "Axes", data: Stages, _colour: str) -> None:
    _picture(ax, data.clean, "2  slanted view, no noise", data.extent)


def _noisy(ax: "Axes", data: Stages, _colour: str) -> None:
    _picture(ax, data.noisy, "3  with noise", data.extent)


def _smoothed(ax: "Axes", data: Stages, colour: str) -> None:
    _picture(ax, data.smoothed, "4  smoothed, normalised; isophote, ellipse", data.extent)
    if data.isophote is not None:
        closed = np.vstack([data.isophote, data.isophote[:1]])
        ax.plot(*closed.T, "-", color=_ISOPHOTE, lw=2.2, label=f"isophote t = {data.isovalue:g}")
    if data.ellipse is not None:
        ax.plot(*data.ellipse.T, "--", color=colour, lw=1.6, label="fitted ellipse")
    if data.isophote is not None:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.27), fontsize=9, ncol=2)


def _picture(ax: "Axes", picture: Any, title: str, extent: tuple[float, float, float, float]) -> None:
    ax.imshow(
        np.clip(picture, 0, 1) ** (1 / GAMMA), cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest"
    )
    ax.grid(False)
    ax.set(xlabel="x (px)", ylabel="y (px)", title=title)


def _side_view(ax: "Axes", data: Stages, colour: str) -> None:
    """Draw the normals in the plane of the tilt, seen from the side: the camera looks along z."""
    ax.plot([0, 0], [0, -1.12], ":", color=NEUTRAL, lw=1.2)
    ax.text(0, -1.14, "towards the camera", ha="center", va="bottom", fontsize=9)
    theta = np.radians(data.theta_deg)
    ends = 0.95 * np.array([[-np.cos(theta), -np.sin(theta)], [np.cos(theta), np.sin(theta)]])
    ax.plot(*ends.T, "-", color="#444", lw=2.5, label=f"plane, slant {data.theta_deg:g}°")
    ax.add_patch(_arrow(data.truth, TRUTH, 6.0))
    ax.plot([], [], "-", color=TRUTH, lw=5, label="true normal")
    for index, candidate in enumerate(data.candidates):
        better = index == data.better
        ax.add_patch(_arrow(candidate, colour, 2.0, "-" if better else (0, (3, 2))))
        name = "better candidate" if better else "other candidate"
        ax.plot(
            [], [], "-" if better else "--", color=colour, lw=2, label=f"{name}, off by {data.errors_deg[index]:.2f}°"
        )
    ax.set(xlim=(-1.25, 1.25), ylim=(1.05, -1.35), aspect="equal", title="5  normals from the side")
    ax.set_xlabel("y of the unit normal")
    ax.set_ylabel("z of the unit normal")
    if not data.candidates:
        ax.text(0, 0.8, f"no normal: {data.status}", ha="center", fontsize=10)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), fontsize=9, ncol=2)


def _arrow(normal: Array, colour: str, width: float, line: Any = "-") -> Any:
    from matplotlib.patches import FancyArrowPatch

    tip = (float(normal[1]), float(normal[2]))
    return FancyArrowPatch(
        (0.0, 0.0), tip, arrowstyle="-|>", color=colour, lw=width, linestyle=line, shrinkA=0, shrinkB=0,
        mutation_scale=12 + 2 * width, zorder=3,
    )  # fmt: skip


def _close_up(ax: "Axes", data: Stages, colour: str) -> None:
    """Draw the better candidate about the truth: slant error up, the error across it to the right, deg."""
    ax.set_title("6  better candidate about the truth")
    ax.set_xlabel("error of the tilt's direction (deg)")
    ax.set_ylabel("error of the slant (deg)")
    ax.plot(0, 0, "o", color=TRUTH, mec=_DARK, ms=11, label="true normal")
    if data.candidates:
        candidate, error = data.candidates[data.better], data.errors_deg[data.better]
        across = np.array([1.0, 0.0, 0.0])
        miss = np.degrees(np.array([candidate @ across, candidate @ np.cross(data.truth, across)]))
        size = np.linalg.norm(miss)
        miss = miss * (error / size) if size > 0 else miss
        angle = np.linspace(0, 2 * np.pi, 120)
        ax.plot(error * np.cos(angle), error * np.sin(angle), "-", color=NEUTRAL, lw=1)
        ax.plot([0, miss[0]], [0, miss[1]], "-", color=colour, lw=1.5)
        ax.plot(*miss, "X", color=colour, ms=10, label=f"better candidate, error {error:.2f}°")
        ax.set(xlim=(-1.35 * error, 1.35 * error), ylim=(-1.35 * error, 1.35 * error))
    ax.set_aspect("equal")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), fontsize=9, ncol=2)


_PANELS: tuple[Callable[["Axes", Stages, str], None], ...] = (
    _texture, _clean, _noisy, _smoothed, _side_view, _close_up,
)  # fmt: skip
