"""Charts of a comparison: the distance of each statistic, and both distributions of each column side by side."""

from collections.abc import Sequence

import numpy as np

from simtest.pages.charts import NOTHING, Axis, Chart, Line, Mark, Panel, finite, log_range
from simtest.pages.style import NEUTRAL, SERIES, number, symbols
from simtest.realism.comparison import Comparison, Quartiles, SetOfFrames, statistic_of
from simtest.realism.distance import NEAR, VERDICTS, StatisticDistance, distance_text, mean_distribution
from simtest.realism.frame_statistics import COLUMNS
from simtest.runtime.arrays import Array

REAL, GENERATED = SERIES[:2]
"""Colours of the two sides; their lines differ too: solid and dashed."""

VERDICT_COLOURS = dict(zip(VERDICTS, (SERIES[2], SERIES[5], SERIES[1], NEUTRAL), strict=True))
VERDICT_SYMBOLS = symbols(VERDICTS)

LEAST_DISTANCE, MOST_DISTANCE = 0.1, 100.0
"""Distances beyond are drawn here; the table holds the numbers."""

_DOT = "●"
_POINTS, _STEPS = 120, 240
_BOX = 0.3  # half the height of a box, whose row is 1 high


def distance_chart(found: Comparison) -> Chart:
    """Describe the distances of all statistics with their intervals, the first one on top."""
    ends = (len(found.distances) - 0.5, -0.5)
    marks = [
        Mark([1.0, 1.0], ends, NEUTRAL, "a real scene from the others", line="dot", width=1.5),
        Mark([NEAR, NEAR], ends, VERDICT_COLOURS["near"], f"near up to {NEAR:g}", line="dash", width=1.5),
    ]
    for row, d in enumerate(found.distances):
        marks += _distance_marks(row, d)
    values = finite([mark.x for mark in marks])
    x = Axis("distance (in spreads)", "log", log_range([values, [0.3, 5.0]]))
    y = Axis("", limits=ends, named=tuple((float(i), d.statistic.title) for i, d in enumerate(found.distances)))
    present = {d.verdict for d in found.distances}
    keys = tuple(Mark(NOTHING, NOTHING, VERDICT_COLOURS[word], word, symbol=VERDICT_SYMBOLS[word], size=9)
                 for word in VERDICTS if word in present)  # fmt: skip
    return Chart("distances", "Distance of each statistic", (Panel(x, y, tuple(marks)),), 460, keys)


def _distance_marks(row: int, d: StatisticDistance) -> list[Mark]:
    colour, told = VERDICT_COLOURS[d.verdict], f"{d.statistic.title}: {d.verdict}"
    if np.isnan(d.distance):
        return []
    low, high = map(distance_text, d.interval)
    told += f"\ndistance {distance_text(d.distance)}\n95 % interval {low} to {high}"
    value, *interval = np.clip([d.distance, *d.interval], LEAST_DISTANCE, MOST_DISTANCE)
    point = Mark([value], [row], colour, symbol=VERDICT_SYMBOLS[d.verdict], size=10, hover=[told])
    if np.isnan(d.interval).any():
        return [point]
    return [Mark(interval, [row, row], colour, line="solid", width=2.5), point]


def distribution_charts(found: Comparison) -> list[Chart]:
    """Describe both distributions of each column, in the order of the statistics."""
    return [_distribution(found, column) for column in COLUMNS]


def _distribution(found: Comparison, column: str) -> Chart:
    """Describe a column: distribution functions above, and boxes with points below."""
    sides: tuple[tuple[str, SetOfFrames, str, Line, float], ...] = (
        ("real", found.real, REAL, "solid", 1.0),
        ("generated", found.generated, GENERATED, "dash", 0.0),
    )
    statistic, title = statistic_of(column)
    pooled = [_pooled(held, column) for _, held, *_ in sides]
    x = _axis(title, pooled)
    low, high = x.ends(pooled)
    at = np.geomspace(low, high, _STEPS) if x.scale == "log" else np.linspace(low, high, _STEPS)
    curves, boxes = [], []
    for (name, held, colour, line, row), values in zip(sides, pooled, strict=True):
        share = mean_distribution(held.scenes, column, at)
        curves.append(Mark(at, share, colour, name, line=line, width=2.2, hover=f"{name}: {{y}} are up to {{x}}"))
        boxes += _box(name, held.quartiles(column), values, (low, high), colour, row)
    rows = Axis("", limits=(-0.6, 1.6), named=((1.0, "real"), (0.0, "generated")))
    above = Panel(x, Axis("share of values", limits=(-0.02, 1.02)), tuple(curves), 2.0)
    heading = statistic.title if len(statistic.columns) == 1 else title[:1].upper() + title[1:]
    return Chart(f"column_{column}", heading, (above, Panel(x, rows, tuple(boxes), 1.0)), 330)


def _pooled(held: SetOfFrames, column: str) -> Array:
    return np.concatenate([values[column] for values in held.scenes.values()])


def _axis(title: str, pooled: Sequence[Array]) -> Axis:
    """Return the axis of a column: logarithmic where the values are positive and span a factor of 30."""
    values = finite(pooled)
    if not values.size:
        return Axis(title)
    # The ends of each side, so that a large side does not hide a small one; a few stray values do not count.
    ends = np.array([np.quantile(side, [0.01, 0.99]) for side in pooled if side.size])
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    if values.min() > 0 and high > 30 * low:
        return Axis(title, "log", (low / 1.3, high * 1.3))
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return Axis(title, limits=(low - margin, high + margin))


def _box(
    name: str, quartiles: Quartiles | None, values: Array, ends: tuple[float, float], colour: str, row: float
) -> list[Mark]:
    """Return a side's points, evenly spaced order statistics where there are many, and the box of its quartiles."""
    if quartiles is None:
        return []
    low, middle, high = quartiles
    kept = np.sort(values)[np.linspace(0, len(values) - 1, min(len(values), _POINTS)).round().astype(int)]
    # The golden ratio spreads neighbours in rank evenly over the row, the same way in every run.
    jitter = (np.arange(len(kept)) * 0.6180339887 % 1 - 0.5) * 0.5
    inside = (kept >= ends[0]) & (kept <= ends[1])
    told = f"{name}: median {number(middle)}\nquartiles {number(low)} and {number(high)}\n{len(values)} values"
    outline = np.array([(low, -1), (low, 1), (high, 1), (high, -1), (low, -1)])
    return [
        Mark(kept[inside], (row + jitter)[inside], colour, symbol=_DOT, size=5, opacity=0.45),
        Mark(outline[:, 0], row + _BOX * outline[:, 1], colour, line="solid", width=1.5),
        Mark([middle] * 3, [row - _BOX, row, row + _BOX], colour, line="solid", width=3.5, hover=[told] * 3),
    ]
