"""Charts of the error laws: measured against predicted, and departures over what is allowed."""

from collections.abc import Sequence

import numpy as np

from simtest.pages.charts import Axis, Chart, Mark, Panel, log_range
from simtest.pages.palette import FURTHER, NEUTRAL, SERIES
from simtest.pages.style import symbols
from simtest.report.error_laws import SLOPE, LawResult

_COLOURS = (*SERIES, *FURTHER)
_LEAST_SHARE = 1e-4  # departures over what is allowed: smaller ones are drawn here on the logarithmic axis


def law_colours(results: Sequence[LawResult]) -> dict[str, str]:
    """Return the colour of each law by its name."""
    return {result.name: _COLOURS[i % len(_COLOURS)] for i, result in enumerate(results)}


def law_charts(results: Sequence[LawResult]) -> list[Chart]:
    """Describe the laws: a chart of angles and one of ratios, where there are any, and one of all departures."""
    colours, dot = law_colours(results), symbols([""])[""]
    kept = [result for result in results if result.settings]
    charts, departures = [], []
    for is_angle, key, title, unit in (
        (True, "laws_angles", "Angles: measured against predicted (deg)", " (deg)"),
        (False, "laws_ratios", "Axis ratios: measured against predicted", ""),
    ):
        shown = [result for result in kept if result.law.is_angle == is_angle and result.name != SLOPE]
        both = [part for result in shown for part in (result.measured, result.predicted)]
        ends = log_range(both) if is_angle else (0.0, 1.05)
        x, y = (Axis(side + unit, "log" if is_angle else "linear", ends) for side in ("predicted", "measured"))
        marks = [Mark(ends, ends, NEUTRAL, line="dash", width=1.5)]
        for result in shown:
            name, colour = result.law.title, colours[result.name]
            marks.append(Mark(result.predicted, result.measured, colour, name, symbol=dot, hover=_hover(result)))
        if shown:
            charts.append(Chart(key, title, (Panel(x, y, tuple(marks)),)))

    for row, result in enumerate(kept):
        share = np.maximum(np.abs(result.gap) / result.tolerance, _LEAST_SHARE)
        at = np.full(share.size, float(row))
        departures.append(Mark(share, at, colours[result.name], symbol=dot, hover=_hover(result)))
    # The first law stands on top.
    ends = len(kept) - 0.5, -0.5
    limit = Mark([1.0, 1.0], ends, NEUTRAL, line="dash", width=1.5)
    x = Axis("|measured − predicted| / allowed; beyond 1 the law is not met", "log")
    y = Axis("", limits=ends, named=tuple((float(i), result.law.title) for i, result in enumerate(kept)))
    panel = Panel(x, y, (limit, *departures))
    return [*charts, Chart("laws_departures", "Departure over what is allowed", (panel,))]


def _hover(result: LawResult) -> list[str]:
    return [
        f"{result.law.title}\n{setting}\nmeasured {result.text(m)}, predicted {result.text(p)}\n"
        f"allowed ± {result.text(a)}"
        for setting, m, p, a in zip(result.settings, result.measured, result.predicted, result.tolerance, strict=True)
    ]
