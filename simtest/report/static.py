"""Draws the figures as PNG with matplotlib."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from simtest.pages import style
from simtest.pages.style import LIGHT, NEUTRAL, Array, Axis
from simtest.report.curves import Curve, finite
from simtest.report.gallery import draw_item
from simtest.report.run_folder import GalleryItem
from simtest.report.series import LineFigure
from simtest.report.surface3d import Surface3D
from simtest.report.tables import HeatMap, SurfaceFigure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
GALLERY_DPI = 178
_RC = {
    "font.size": 10, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True, "axes.titlesize": 11,
    "legend.frameon": False, "figure.facecolor": "white", "text.parse_math": False, "axes.unicode_minus": False,
}  # fmt: skip


def save(figure: "Figure", path: Path, dpi: int = DPI) -> Path:
    """Write a figure as PNG and close it."""
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
    return path


def settings() -> Any:
    """Give the context in which all figures are drawn; chooses the Agg backend, which needs no display."""
    import matplotlib

    matplotlib.use("Agg")
    return matplotlib.rc_context(cast(Any, _RC))


def draw_lines(data: LineFigure, colours: Mapping[str, str]) -> "Figure":
    """Draw curves with intervals and laws; colour is the estimator, the marker is the label."""
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    figure, ax = plt.subplots(figsize=(7.6, 5.4), layout="constrained")
    marks = style.symbols(data.labels)
    for curve in data.curves:
        colour, mark = colours[curve.estimator], marks[curve.label].matplotlib
        if has_law(curve, data.y):
            law = NEUTRAL if data.shared_law else colour
            x, y = data.x.place(curve.law_x), visible(curve.law_y, data.y)
            ax.plot(x, y, "--" if curve.joined else "_", color=law, lw=1.3, ms=9, zorder=2)
        x = data.x.place(curve.x)
        bars = np.nan_to_num(np.abs(np.stack([curve.y - curve.low, curve.high - curve.y])))
        ax.errorbar(x, visible(curve.y, data.y), bars, fmt=mark, color=colour, ms=5, capsize=2.5, lw=1.1, zorder=3)
        if curve.joined:
            ax.plot(x, visible(curve.y, data.y), "-", color=colour, lw=0.6, alpha=0.5, zorder=1)
    _scale(ax, data)
    handles = [Line2D([], [], color=colours[n], marker="o", lw=1, label=n) for n in data.estimators]
    if len(data.labels) > 1:
        handles += [Line2D([], [], color="#444", marker=marks[n].matplotlib, ls="", label=n) for n in data.labels]
    if any(has_law(curve, data.y) for curve in data.curves):
        handles.append(Line2D([], [], color=NEUTRAL if data.shared_law else "#444", ls="--", label=data.law_name))
    figure.legend(handles=handles, loc="outside lower center", ncol=min(4, len(handles)), fontsize=9)
    ax.set_title(data.title)
    return figure


def visible(values: Array, axis: Axis) -> Array:
    """Give the values that can be drawn on an axis; NaN for the others."""
    return np.where(values > 0, values, np.nan) if axis.scale == "log" else values


def has_law(curve: Curve, axis: Axis) -> bool:
    """Tell whether a curve's law shows: a law of zero has no place on a logarithmic axis."""
    return bool(np.isfinite(visible(curve.law_y, axis)).any())


def _scale(ax: "Axes", data: LineFigure) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    ax.set_xlabel(data.x.title)
    ax.set_ylabel(data.y.title)
    ticks = data.x.ticks(np.concatenate([curve.x for curve in data.curves]))
    if ticks:
        ax.set_xticks(ticks[0], ticks[1])
    if data.y.scale == "log":
        ax.set_yscale("log")
        ax.set_ylim(*log_range([v for c in data.curves for v in (c.y, c.low, c.high)]))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    if data.y.limits:
        ax.set_ylim(*data.y.limits)


def log_range(arrays: Sequence[Array]) -> tuple[float, float]:
    """Give a range for a logarithmic axis from the positive values, with a margin; laws may leave it."""
    values = finite(np.concatenate([np.asarray(a, float).ravel() for a in arrays])) if arrays else np.empty(0)
    values = values[values > 0]
    if not values.size:
        return 0.1, 100.0
    return float(values.min()) / 1.6, float(values.max()) * 1.6


def heat_range(maps: Sequence[HeatMap]) -> tuple[float, float]:
    """Give the common colour range of heat maps, deg."""
    values = np.concatenate([finite(m.mean_deg) for m in maps])
    values = values[values > 0]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.1, 1.0)
    return (low, high) if high > low else (low / 2, low * 2)


def draw_heat_maps(maps: Sequence[HeatMap], colours: Mapping[str, str]) -> "Figure":
    """Draw heat maps with a common logarithmic colour scale, one panel an estimator and label."""
    import matplotlib
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FuncFormatter, NullFormatter

    columns = min(3, len(maps))
    rows = -(-len(maps) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.6 * columns + 0.8, 3.9 * rows), squeeze=False, layout="constrained"
    )
    norm = LogNorm(*heat_range(maps))
    cmap = matplotlib.colormaps[style.SEQUENTIAL]
    for ax, item in zip(axes.flat, maps, strict=False):
        ax.grid(False)
        picture = ax.imshow(item.mean_deg, norm=norm, cmap=cmap, origin="lower", aspect="auto")
        ax.set_xticks(range(len(item.kd)), item.column_names)
        ax.set_yticks(range(len(item.eps_over_d)), item.row_names)
        ax.set(xlabel="k d", ylabel="light offset over distance, ε/d")
        ax.set_title(f"{item.estimator}\n{item.label}", color=colours[item.estimator])
        for (row, column), value in np.ndenumerate(item.mean_deg):
            dark = np.isfinite(value) and norm(max(value, norm.vmin or value)) < 0.55
            text = style.number(float(value), 2) if np.isfinite(value) else "–"
            ax.text(column, row, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    for ax in list(axes.flat)[len(maps) :]:
        ax.set_visible(False)
    bar = figure.colorbar(picture, ax=axes, label="mean angular error (deg)", shrink=0.9)
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    return figure


def draw_surfaces(data: SurfaceFigure, colours: Mapping[str, str]) -> "Figure":
    """Draw boxes and points of the errors per surface."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch
    from matplotlib.ticker import FuncFormatter, NullFormatter

    figure, ax = plt.subplots(figsize=(max(6.4, 2.0 + 1.6 * len(data.surfaces)), 5.0), layout="constrained")
    floor = log_range([box.points for box in data.boxes])[0]
    for box in data.boxes:
        colour = colours[box.estimator]
        stats = {"med": box.median, "q1": box.q1, "q3": box.q3, "whislo": box.low, "whishi": box.high, "label": ""}
        stats = {k: max(v, floor) if isinstance(v, float) else v for k, v in stats.items()}
        line = {"color": colour, "linewidth": 1.4}
        ax.bxp(
            [stats], positions=[box.place], widths=[box.width], showfliers=False, manage_ticks=False,
            boxprops=line, medianprops={"color": colour, "linewidth": 2.4}, whiskerprops=line, capprops=line,
        )  # fmt: skip
        ax.plot(box.points_place, np.maximum(box.points, floor), ".", color=colour, ms=3.5, alpha=0.45)
    ax.set_yscale("log")
    ax.set_ylim(*log_range([box.points for box in data.boxes]))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xticks(range(len(data.surfaces)), data.surfaces)
    ax.set_xlim(-0.6, len(data.surfaces) - 0.4)
    ax.set_ylabel("angular error (deg)")
    ax.set_title("Errors per surface")
    names = style.estimator_order(box.estimator for box in data.boxes)
    handles = [Patch(color=colours[name], label=name) for name in names]
    figure.legend(handles=handles, loc="outside lower center", ncol=min(4, len(handles)), fontsize=9)
    return figure


def draw_surface_3d(data: Surface3D, colours: Mapping[str, str]) -> "Figure":
    """Draw the surface seen from beside the camera, by curvature or shaded by the frame, with its normals."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(7.2, 6.2), layout="constrained")
    ax: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    x, y, z = _upright(data.vertices)
    colour_map = "gray" if data.curvature is None else "RdBu_r"
    mesh = ax.plot_trisurf(x, y, z, triangles=data.triangles, cmap=colour_map, linewidth=0, antialiased=False, zorder=1)
    if data.curvature is None:
        mesh.set_array(data.intensity[data.triangles].mean(axis=1) ** (1 / 2.2))
        mesh.set_clim(-0.35, 1)
    else:
        mesh.set_array(data.curvature[data.triangles].mean(axis=1))
        mesh.set_clim(-data.curvature_limit, data.curvature_limit)
        figure.colorbar(mesh, ax=ax, shrink=0.5, label=f"curvature of larger size (1/{data.unit}), convex positive")
    for part in data.segments:
        colour = colours[part.estimator] if part.estimator else segment_colour(part.name)
        for i, (start, end) in enumerate(zip(part.start, part.end, strict=True)):
            ends = _upright(np.stack([start, end]))
            width = 0.9 if part.name in ("true normals", "sightline from the camera") else 2.2
            ax.plot(*ends, color=colour, lw=width, label=part.name if i == 0 else None, zorder=2)
    for name, places, marker, colour in (
        ("camera", np.zeros((1, 3)), "D", NEUTRAL),
        ("light", data.lights, "o", LIGHT),
    ):
        ax.scatter(*_upright(places), color=colour, marker=marker, s=18, label=name if len(places) else None, zorder=3)
    ax.set_aspect("equal")
    ax.set(xlabel=f"x ({data.unit})", ylabel=f"z, depth ({data.unit})", zlabel=f"−y, up ({data.unit})")
    ax.view_init(elev=28, azim=-65)
    ax.set_title(data.title)
    handles, names = ax.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncol=3, fontsize=9)
    return figure


def segment_colour(name: str) -> str:
    """Give the colour of normals and lines that belong to no estimator."""
    return {"true normals": "#5E8FBF", "sightline from the camera": NEUTRAL}.get(name, "#C9A800")


def _upright(points: Array) -> tuple[Array, Array, Array]:
    """Turn camera coordinates (y down, z forward) into those of the plot (z up)."""
    return points[:, 0], points[:, 2], -points[:, 1]


def draw_gallery(
    items: Sequence[GalleryItem], colours: Mapping[str, str], folder: Path, dpi: int = GALLERY_DPI
) -> list[Path]:
    """Write gallery_000.png, ... and give their paths."""
    return [save(draw_item(item, colours), folder / f"gallery_{i:03d}.png", dpi) for i, item in enumerate(items)]
