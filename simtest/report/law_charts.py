"""Charts of the error laws: measured against predicted, and departures over what is allowed."""

from collections.abc import Mapping, Sequence

import numpy as np

from simtest.pages.axes import Axis, log_range
from simtest.pages.chart import Chart, Mark, Panel
from simtest.pages.style import ESTIMATOR_COLOURS, NEUTRAL, Symbol, symbols
from simtest.report.error_laws import SLOPE, LawResult

_COLOURS = (*ESTIMATOR_COLOURS.values(), "#A6761D", "#7A8B99")

_LEAST_SHARE = 1e-4
"""Departures over what is allowed: smaller ones are drawn here on the logarithmic axis."""


def law_colours(results: Sequence[LawResult]) -> dict[str, str]:
    """Return the colour of each law by its name."""
    return {result.name: _COLOURS[i % len(_COLOURS)] for i, result in enumerate(results)}


def law_charts(results: Sequence[LawResult]) -> list[Chart]:
    """Describe the laws: a chart of angles and one of ratios, where there are any, and one of all departures."""
    colours = law_colours(results)
    (dot,) = symbols([""]).values()
    kept = [result for result in results if result.settings]
    angles = [result for result in kept if result.law.is_angle and result.name != SLOPE]
    ratios = [result for result in kept if not result.law.is_angle and result.name != SLOPE]
    charts = []
    if angles:
        ends = log_range([part for result in angles for part in (result.measured, result.predicted)])
        axes = Axis("predicted (deg)", "log", ends), Axis("measured (deg)", "log", ends)
        charts.append(_diagonal("laws_angles", "Angles: measured against predicted (deg)", axes, angles, colours, dot))
    if ratios:
        axes = Axis("predicted", limits=(0.0, 1.05)), Axis("measured", limits=(0.0, 1.05))
        charts.append(_diagonal("laws_ratios", "Axis ratios: measured against predicted", axes, ratios, colours, dot))
    return [*charts, _departures(kept, colours, dot)]


def _diagonal(
    key: str, title: str, axes: tuple[Axis, Axis], shown: Sequence[LawResult], colours: Mapping[str, str], dot: Symbol
) -> Chart:
    x, y = axes
    assert x.limits is not None
    line = Mark(x.limits, x.limits, NEUTRAL, line="dash", width=1.5)
    marks = [
        Mark(
            result.predicted, result.measured, colours[result.name], result.law.title, symbol=dot, hover=_hover(result)
        )
        for result in shown
    ]
    return Chart(key, title, (Panel(x, y, (line, *marks)),))


def _departures(kept: Sequence[LawResult], colours: Mapping[str, str], dot: Symbol) -> Chart:
    marks = []
    for row, result in enumerate(kept):
        share = np.maximum(np.abs(result.gap) / result.tolerance, _LEAST_SHARE)
        y = np.full(share.size, float(row))
        marks.append(Mark(share, y, colours[result.name], symbol=dot, hover=_hover(result)))
    # The first law stands on top.
    ends = len(kept) - 0.5, -0.5
    limit = Mark([1.0, 1.0], ends, NEUTRAL, line="dash", width=1.5)
    x = Axis("|measured − predicted| / allowed; beyond 1 the law is not met", "log")
    y_axis = Axis("", limits=ends, named=tuple((float(i), result.law.title) for i, result in enumerate(kept)))
    return Chart("laws_departures", "Departure over what is allowed", (Panel(x, y_axis, (limit, *marks)),))


def _hover(result: LawResult) -> list[str]:
    return [
        f"{result.law.title}\n{setting}\nmeasured {result.text(m)}, predicted {result.text(p)}\n"
        f"allowed ± {result.text(a)}"
        for setting, m, p, a in zip(result.settings, result.measured, result.predicted, result.tolerance, strict=True)
    ]
