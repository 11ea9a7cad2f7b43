"""Draws the article's figures as PNG with matplotlib."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.pages import style
from simtest.pages.style import NEUTRAL, Array
from simtest.report.curves import finite
from simtest.report.paper.isocurves import KAPPA, REACH, Branch, IsocurveFigure
from simtest.report.paper.sweeps import Sweep, SweepFigure
from simtest.report.static import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ISOPHOTE_COLOUR, BRANCH_COLOUR = "#0072B2", "#D55E00"
LAW_STYLE, BOUND_STYLE = "--", "-."
BOUND_NAME = "Cramér-Rao bound (an RMS angle)"
LAW_NAME = "predicted bias of the smoothing, no noise"


def log_limits(data: SweepFigure) -> tuple[float, float]:
    """Give the range of a logarithmic error axis: bars may leave it below, where they would squeeze the means."""
    means = finite(np.concatenate([sweep.mean for sweep in data.sweeps]))
    lows = finite(np.concatenate([sweep.least for sweep in data.sweeps]))
    tops = finite(np.concatenate([sweep.largest for sweep in data.sweeps]))
    least = max(float(lows[lows > 0].min(initial=np.inf)), float(means[means > 0].min()) / 12)
    return least / 1.3, float(tops.max()) * 1.4


def draw_sweep(data: SweepFigure, colours: Mapping[str, str]) -> "Figure":
    """Draw an error plot: means with both bars, bound and law, and below it the number of failures."""
    import matplotlib.pyplot as plt

    figure, (ax, below) = plt.subplots(
        2, 1, figsize=(7.8, 6.6), sharex=True, gridspec_kw={"height_ratios": [5, 1]}, layout="constrained"
    )
    marks = style.symbols(data.labels)
    for index, sweep in enumerate(data.sweeps):
        _draw_one(ax, data, index, colours[sweep.estimator], marks[sweep.label].matplotlib)
    _lines(ax, data)
    if data.x.scale == "log":
        ax.set_xscale("log")
    if data.y.scale == "log":
        ax.set_yscale("log")
        ax.set_ylim(*log_limits(data))
    elif data.y.limits:
        ax.set_ylim(*data.y.limits)
    for axis in (ax.yaxis, below.xaxis):
        _plain_ticks(axis)
    ax.set_ylabel(data.y.title)
    ax.set_title(data.title)
    _draw_failures(below, data, colours)
    figure.legend(handles=_handles(data, colours), loc="outside lower center", ncol=2, fontsize=8.5)
    return figure


def _plain_ticks(axis: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    if axis.get_scale() == "log":
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_minor_formatter(NullFormatter())


def _draw_one(ax: "Axes", data: SweepFigure, index: int, colour: str, mark: str) -> None:
    sweep, x = data.sweeps[index], data.places(index)
    mean = visible(sweep.mean, data.y)
    low, high = spread_bars(sweep, data)
    ax.errorbar(
        x, mean, np.nan_to_num(np.stack([sweep.mean - sweep.least, sweep.largest - sweep.mean])),
        fmt="none", ecolor=colour, elinewidth=0.9, capsize=4, capthick=0.9, zorder=2,
    )  # fmt: skip
    ax.vlines(x, low, high, color=colour, lw=5.5, alpha=0.38, zorder=3)
    ax.plot(x, mean, "-", color=colour, lw=1.5, marker=mark, ms=5, zorder=4)


def spread_bars(sweep: Sweep, data: SweepFigure) -> tuple[Array, Array]:
    """Give the ends of the standard deviation's bars, inside what the axis can show."""
    floor = log_limits(data)[0] if data.y.scale == "log" else 0.0
    return np.maximum(sweep.mean - sweep.std, floor), sweep.mean + sweep.std


def _lines(ax: "Axes", data: SweepFigure) -> None:
    for sweep in bounds(data):
        ax.plot(sweep.shown_x, visible(sweep.bound, data.y), BOUND_STYLE, color="#444", lw=1.3, zorder=1)
    for index, sweep in laws(data):
        ax.plot(data.places(index), visible(sweep.law, data.y), LAW_STYLE, color=NEUTRAL, lw=1.5, zorder=5)


def bounds(data: SweepFigure) -> list[Sweep]:
    """Give the sweeps whose Cramer-Rao bound is drawn: one a label, where it is not 0 everywhere."""
    seen: dict[str, Sweep] = {}
    for sweep in data.sweeps:
        if np.isfinite(sweep.bound).sum() > 1 and np.nanmax(sweep.bound) > 0:
            seen.setdefault(sweep.label, sweep)
    return list(seen.values())


def laws(data: SweepFigure) -> list[tuple[int, Sweep]]:
    """Give the sweeps whose law is drawn, with their indices: it is known at two settings, not 0 everywhere."""
    return [(i, s) for i, s in enumerate(data.sweeps) if np.isfinite(s.law).sum() > 1 and np.nanmax(s.law) > 1e-3]


def _draw_failures(ax: "Axes", data: SweepFigure, colours: Mapping[str, str]) -> None:
    marks = style.symbols(data.labels)
    ax.grid(False)
    rows = len(data.sweeps)
    for index, sweep in enumerate(data.sweeps):
        y = rows - 1 - index
        ax.plot([0.012], [y], marks[sweep.label].matplotlib, color=colours[sweep.estimator], ms=5, clip_on=False,
                transform=ax.get_yaxis_transform())  # fmt: skip
        for x, failed in zip(sweep.shown_x, sweep.failed, strict=True):
            look: dict[str, Any] = {"fontweight": "bold", "color": "#B00020"} if failed else {"color": "#555"}
            ax.text(x, y, f"{failed:.0f}", ha="center", va="center", fontsize=8.5, **look)
    ax.set_ylim(-0.8, rows - 0.2)
    ax.set_yticks([])
    ax.set_ylabel(failures_title(data), fontsize=9)
    ax.set_xlabel(data.x.title)


def failures_title(data: SweepFigure) -> str:
    """Give the title of the failures' strip: of how many realisations."""
    totals = sorted({int(total) for sweep in data.sweeps for total in sweep.failed + sweep.answered})
    return f"failures\nof {' or '.join(str(total) for total in totals)}"


def _handles(data: SweepFigure, colours: Mapping[str, str]) -> list[Any]:
    from matplotlib.lines import Line2D

    marks = style.symbols(data.labels)
    handles = [
        Line2D([], [], color=colours[s.estimator], marker=marks[s.label].matplotlib, ms=5,
               label=f"mean, {s.estimator}: {s.label}")
        for s in data.sweeps
    ]  # fmt: skip
    handles.append(
        Line2D([], [], color="#777", marker="|", ms=9, mew=5, ls="", alpha=0.5, label="± standard deviation")
    )
    handles.append(Line2D([], [], color="#777", marker="|", ms=11, mew=0.9, ls="", label="least and largest error"))
    if bounds(data):
        handles.append(Line2D([], [], color="#444", ls=BOUND_STYLE, label=BOUND_NAME))
    if laws(data):
        handles.append(Line2D([], [], color=NEUTRAL, ls=LAW_STYLE, label=LAW_NAME))
    return handles


def draw_isocurves(data: IsocurveFigure) -> "Figure":
    """Draw Figure 1: the isocurves with the light at the camera and beside it, and the radii against kappa."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(14.2, 5.4), layout="constrained")
    _plane(axes[0], data.together, f"light at the camera, κ = {KAPPA}")
    axes[0].plot(0, 0, "+", color="#222", ms=9, mew=1.6, label="camera's foot = light's foot = BP")
    for radius, name in ((data.inner, "isophote r−"), (data.outer, "r+")):
        axes[0].text(0, radius + 0.12, f"{name} = {radius:.5f} |V_Z|", fontsize=9.5, ha="center", va="bottom")
    _plane(axes[1], data.apart, f"light beside the camera, κ = {KAPPA}")
    axes[1].plot(0, 0, "+", color="#222", ms=9, mew=1.6, label="camera's foot")
    axes[1].plot(2 * data.bp[0], 2 * data.bp[1], "*", color="#B8860B", ms=11, label="light's foot")
    axes[1].plot(*data.bp, "x", color="#222", ms=7, mew=1.6, label="BP")
    for ax in axes[:2]:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), fontsize=9, ncol=1)
    _radii(axes[2], data)
    return figure


def _plane(ax: "Axes", branches: tuple[Branch, ...], title: str) -> None:
    for branch in branches:
        colour, line = (ISOPHOTE_COLOUR, "-") if branch.is_isophote else (BRANCH_COLOUR, "--")
        name = "isophote: cos β = τ" if branch.is_isophote else "cos β = −τ: of the quartic, but no isophote"
        ax.plot(*branch.points.T, line, color=colour, lw=2, label=name)
    ax.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal", title=title)
    ax.set_xlabel("x (|V_Z|)")
    ax.set_ylabel("y (|V_Z|)")


def _radii(ax: "Axes", data: IsocurveFigure) -> None:
    ax.plot(data.kappa, data.inner_of_kappa, "-", color=ISOPHOTE_COLOUR, lw=2, label="r−/|V_Z|, the isophote")
    ax.plot(data.kappa, data.outer_of_kappa, "--", color=BRANCH_COLOUR, lw=2, label="r+/|V_Z|, no isophote")
    ax.plot([KAPPA, KAPPA], [data.inner, data.outer], "o:", color="#222", ms=5, lw=1, label=f"κ = {KAPPA}")
    ax.axhline(1, color=NEUTRAL, lw=1)
    ax.set(yscale="log", xlim=(0, 1), ylim=(1e-2, 1e2), title="radii: r− r+ = V_Z²")
    ax.set_xlabel("κ = 1 − τ²")
    ax.set_ylabel("radius (|V_Z|)")
    _plain_ticks(ax.yaxis)
    from matplotlib.ticker import LogLocator

    ax.yaxis.set_major_locator(LogLocator())
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), fontsize=9, ncol=1)
