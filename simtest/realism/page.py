"""Writes a comparison: realism.json, figures as PNG, and one HTML file that needs nothing else."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from simtest.pages import WRITTEN, pixels
from simtest.pages.charts import NOTHING, Axis, Chart, Line, Mark, Panel, embedded, finite, log_range, png
from simtest.pages.html import environment
from simtest.pages.pixels import Pixels, font
from simtest.pages.style import NEUTRAL, SERIES, number, symbols
from simtest.realism.compare import (
    LEAST_SCENES,
    NEAR,
    VERDICTS,
    Comparison,
    Progress,
    Quartiles,
    SetOfFrames,
    StatisticDistance,
    distance_text,
    mean_distribution,
    plain,
)
from simtest.reconstruction.statistics import STATISTICS, FrameColumn, Statistic
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, Picture
from simtest.runtime.files import make_folder, write_atomically, write_json, written_together

PAGE, RESULT = "index.html", "realism.json"

REAL, GENERATED = SERIES[:2]
"""Colours of the two sides; their lines differ too: solid and dashed."""

VERDICT_COLOURS = dict(zip(VERDICTS, (SERIES[2], SERIES[5], SERIES[1], NEUTRAL), strict=True))
VERDICT_SYMBOLS = symbols(VERDICTS)

LEAST_DISTANCE, MOST_DISTANCE = 0.1, 100.0
"""Distances beyond are drawn here; the table holds the numbers."""

_DOT = "●"
_POINTS, _CURVE = 120, 240
_BOX = 0.3  # half the height of a box, whose row is 1 high

STRIP_HEIGHT_PX, GAP_PX, TITLE_PX, CAPTION_PX = 200, 8, 26, 16
_INK, _SOFT = "#1b1f24", "#59616b"

_STEPS = ("the strip of frames", "the distances", "the distributions", "the page")


def write_comparison(
    found: Comparison, out: Path, against: str, command: str = "", progress: Progress | None = None
) -> Path:
    """Write a comparison into a folder, which is made if need be; return the page.

    Pictures of real frames stand in the page and in the strip, nowhere else. `against` names the generated side,
    `command` is how the comparison was called; what `progress` raises stops the writing between two files.
    """

    def tell(step: int) -> None:
        if progress:
            progress(step, len(_STEPS), f"drawing {_STEPS[step]}")

    def write(name: str, content: bytes) -> None:
        write_atomically(out / "figures" / f"{name}.png", lambda part: part.write_bytes(content))

    make_folder(out / "figures")
    tell(0)
    rows = [("real", found.real.pictures), ("generated", found.generated.pictures)]
    write("strip", pixels.png(draw_strip([row for row in rows if row[1]], STRIP_HEIGHT_PX)))
    tell(1)
    distance, columns = distance_chart(found), distribution_charts(found)
    write("distances", png([distance]))
    tell(2)
    write("distributions", png(columns))
    tell(3)
    html = _render(found, against, command, distance, columns)
    # These come last, so that a stopped command leaves the earlier ones.
    record = {"against": against, "command": command, **provenance.environment()}
    with written_together(out, (RESULT, PAGE)) as new:
        write_json(new / RESULT, {**found.to_json(), "run": record})
        write_atomically(new / PAGE, lambda part: part.write_text(html, encoding="utf-8"))
    if progress:
        progress(len(_STEPS), len(_STEPS), WRITTEN)
    return out / PAGE


def _render(found: Comparison, against: str, command: str, distance: Chart, columns: list[Chart]) -> str:
    """Fill in the page's template."""
    about, chart = provenance.environment(), iter(columns)
    sides = (("real", found.real), ("generated", found.generated))
    return environment().get_template("realism.html.j2").render(
        found=found, title=Path(against).stem or against, command=command, distance=distance,
        groups=[(statistic, [next(chart) for _ in statistic.columns]) for statistic in STATISTICS],
        sides=[(name, _counted(held)) for name, held in sides],
        strips=[(name, [(title, pixels.data_address(picture)) for title, picture in held.pictures])
                for name, held in sides],
        colours={"real": REAL, "generated": GENERATED},
        verdicts={word: (symbol, VERDICT_COLOURS[word]) for word, symbol in VERDICT_SYMBOLS.items()},
        text=distance_text, finite=plain, near=NEAR, least=LEAST_SCENES,
        provenance={"commit": about["commit"] or "–", "simtest": about["version"], "python": about["python"]},
        **embedded([distance, *columns]),
    )  # fmt: skip


def _counted(held: SetOfFrames) -> str:
    """Return how many scenes and frames a side has, in words."""
    scenes, frames = len(held.scenes), held.frames
    text = f"{scenes} {'scene' if scenes == 1 else 'scenes'}, {frames} {'frame' if frames == 1 else 'frames'}"
    return text + (f", {held.without_highlights} without a highlight" if held.without_highlights else "")


# Charts ---------------------------------------------------------------------------------------------------------------


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
    return [_distribution(found, statistic, column) for statistic in STATISTICS for column in statistic.columns]


def _distribution(found: Comparison, statistic: Statistic, column: FrameColumn) -> Chart:
    """Describe a column: distribution functions above, and boxes with points below."""
    sides: tuple[tuple[str, SetOfFrames, str, Line, float], ...] = (
        ("real", found.real, REAL, "solid", 1.0),
        ("generated", found.generated, GENERATED, "dash", 0.0),
    )
    pooled = [np.concatenate([values[column.name] for values in held.scenes.values()]) for _, held, *_ in sides]
    x = _axis(column.axis, pooled)
    low, high = x.ends(pooled)
    at = np.geomspace(low, high, _CURVE) if x.scale == "log" else np.linspace(low, high, _CURVE)
    curves, boxes = [], []
    for (name, held, colour, line, row), values in zip(sides, pooled, strict=True):
        share = mean_distribution(held.scenes, column.name, at)
        curves.append(Mark(at, share, colour, name, line=line, width=2.2, hover=f"{name}: {{y}} are up to {{x}}"))
        boxes += _box(name, held.quartiles(column.name), values, (low, high), colour, row)
    rows = Axis("", limits=(-0.6, 1.6), named=((1.0, "real"), (0.0, "generated")))
    above = Panel(x, Axis("share of values", limits=(-0.02, 1.02)), tuple(curves), 2.0)
    heading = statistic.title if len(statistic.columns) == 1 else column.axis[:1].upper() + column.axis[1:]
    return Chart(f"column_{column.name}", heading, (above, Panel(x, rows, tuple(boxes), 1.0)), 330)


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


# Strip ----------------------------------------------------------------------------------------------------------------


def draw_strip(rows: Sequence[tuple[str, Sequence[tuple[str, Picture]]]], height: int) -> Pixels:
    """Draw rows of named pictures, RGB, brought to a height, px: each row below its title."""
    from PIL import Image, ImageDraw

    fitted = [(title, [(name, _fitted(picture, height)) for name, picture in held]) for title, held in rows]
    widths = [sum(picture.shape[1] + GAP_PX for _, picture in held) for _, held in fitted]
    large, small = font(0.7 * TITLE_PX, bold=True), font(0.75 * CAPTION_PX)
    titles = [round(large.getlength(title)) + GAP_PX for title, _ in rows]
    line = TITLE_PX + height + CAPTION_PX + 2 * GAP_PX
    size = max([*widths, *titles], default=0) + GAP_PX, line * len(rows) + GAP_PX
    sheet = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(sheet)
    for row, (title, held) in enumerate(fitted):
        x, y = GAP_PX, GAP_PX + row * line
        pen.text((x, y), title, fill=_INK, font=large)
        y += TITLE_PX
        for name, picture in held:
            sheet.paste(Image.fromarray(picture), (x, y))
            text = name
            while len(text) > 4 and small.getlength(text) > picture.shape[1]:
                text = text[: -2 if text == name else -3].rstrip(".…") + "…"
            pen.text((x, y + height + 2), text, fill=_SOFT, font=small)
            x += picture.shape[1] + GAP_PX
    return np.asarray(sheet)


def _fitted(picture: Picture, height: int) -> Picture:
    share = height / picture.shape[0]
    how = cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC
    size = (max(round(picture.shape[1] * share), 1), height)
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)
