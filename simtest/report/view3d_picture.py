"""Draws the 3D view in a file: from beside the camera, parallel lines of sight, the farthest triangles first."""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages.axes import Tick, even_ticks
from simtest.pages.chart import NOTHING, Mark
from simtest.pages.chart_png import PX, draw_legend
from simtest.pages.pixels import GAMMA, Pixels
from simtest.pages.sheet import Sheet
from simtest.pages.style import Symbol, rgb
from simtest.report.view3d import CURVATURE_COLOURS, View3D
from simtest.runtime.arrays import Array

_WIDTH, _HEIGHT = 792, 682  # px
_PT = 110 / 72  # a point, px
_SPACE = (70.0, 60.0, 590.0, 545.0)  # the box about the surface: left, top, right, low, px
_BAR = (690.0, 205.0, 706.0, 511.0)  # the curvature's colours: left, top, right, low, px
_ELEVATION_DEG, _AZIMUTH_DEG = 28.0, -65.0
_TEXT, _TITLE = 10 * _PT, 11 * _PT
_PANE, _GRID, _INK = "#F3F3F3", "#B0B0B0", "#000000"
_MARGIN = 0.03  # of the box about what it holds, share of its sides
_TICK_PX, _NAME_PX = 20.0, 52.0  # distance of ticks' texts and of the names from the box
_DIAMOND, _DOT = Symbol("D", "diamond", "◆"), Symbol("o", "circle", "●")


class _Space(NamedTuple):
    """The box about the surface and how it is seen: plot coordinates (x, depth, up) to px."""

    low: Array  # corners, shape (3,)
    high: Array
    axes: Array  # right, up and towards the viewer, rows
    scale: float  # px a unit
    shift: Array  # px of the origin

    def px(self, points: npt.ArrayLike) -> Array:
        """Return points on the picture, shape (..., 2)."""
        seen = np.asarray(points, float) @ self.axes[:2].T * (self.scale, -self.scale)
        return np.asarray(seen + self.shift)


def view_picture(data: View3D) -> Pixels:
    """Draw the surface seen from beside the camera, by curvature or shaded by the frame, with its normals; RGB."""
    sheet, space = Sheet.white(_WIDTH, _HEIGHT), _space(data)
    _draw_box(sheet, space, data.unit)
    # The surface, then the normals that stand on it, then camera and lights.
    corners = _upright(data.vertices)[data.triangles]
    order = np.argsort(corners.mean(axis=1) @ space.axes[2], kind="stable")
    sheet.triangles(space.px(corners)[order], _colours(data)[order])
    handles = []
    for part in data.segments:
        width = (0.9 if part.width < 3 else 2.2) * _PT
        for ends in space.px(np.stack([_upright(part.start), _upright(part.end)], axis=1)):
            sheet.line(ends, part.colour, width)
        handles.append(Mark(NOTHING, NOTHING, part.colour, part.name, line="solid", width=width / (PX * _PT)))
    for (name, positions, colour), symbol in zip(data.points, (_DIAMOND, _DOT), strict=False):
        sheet.markers(space.px(_upright(positions)), symbol.letter, 4.2 * _PT, colour, _PT)
        handles.append(Mark(NOTHING, NOTHING, colour, name, symbol=symbol))
    if data.curvature is not None:
        _draw_colours(sheet, data)
    sheet.text(((_SPACE[0] + _SPACE[2]) / 2, 26), data.title, _TITLE)
    draw_legend(sheet, handles, 3, _WIDTH / 2, _HEIGHT - 4, _PT)
    return sheet.pixels


def _upright(points: Array) -> Array:
    """Turn camera coordinates (y down, z forward) into those of the plot: x, depth, up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def _space(data: View3D) -> _Space:
    """Fit the box about all that is drawn into its part of the picture."""
    parts = [data.vertices, *(ends for part in data.segments for ends in (part.start, part.end))]
    held = _upright(np.concatenate([*parts, *(positions for _, positions, _ in data.points)]))
    low, high = held.min(axis=0), held.max(axis=0)
    margin = _MARGIN * np.maximum(high - low, 1e-9 + 0.05 * (high - low).max())
    low, high = low - margin, high + margin
    up, round_ = np.radians([_ELEVATION_DEG, _AZIMUTH_DEG])
    axes = np.array([
        (-np.sin(round_), np.cos(round_), 0.0),
        (-np.sin(up) * np.cos(round_), -np.sin(up) * np.sin(round_), np.cos(up)),
        (np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)),
    ])  # fmt: skip
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ axes[:2].T
    left, top, right, below = _SPACE
    first, last = corners.min(axis=0), corners.max(axis=0)
    scale = float(min((right - left) / (last[0] - first[0]), (below - top) / (last[1] - first[1])))
    middle = (first + last) / 2
    shift = np.array([(left + right) / 2 - scale * middle[0], (top + below) / 2 + scale * middle[1]])
    return _Space(low, high, axes, scale, shift)


def _colours(data: View3D) -> Pixels:
    """Return the colour of each triangle, RGB, shape (n, 3)."""
    if data.curvature is None:
        grey = data.intensity[data.triangles].mean(axis=1) ** (1 / GAMMA)
        share = (np.clip(grey, -0.35, 1) + 0.35) / 1.35
        return np.repeat(np.rint(255 * share).astype(np.uint8)[:, None], 3, axis=1)
    limit = data.curvature_limit
    mean = np.nan_to_num(data.curvature[data.triangles].mean(axis=1))
    return _curvature_colours(mean / (2 * limit) + 0.5)


def _curvature_colours(share: Array) -> Pixels:
    """Return the colours of curvature at shares of the scale, shape (n, 3)."""
    anchors = np.array([rgb(colour) for colour in CURVATURE_COLOURS], float)
    at = np.linspace(0, 1, len(anchors))
    return np.rint(np.stack([np.interp(share, at, side) for side in anchors.T], axis=-1)).astype(np.uint8)


# Box -----------------------------------------------------------------------------------------------------------------


def _draw_box(sheet: Sheet, space: _Space, unit: str) -> None:
    """Draw the three planes behind the surface with their grids, and ticks along the box's near edges."""
    low, high = space.low, space.high
    behind = np.where(space.axes[2] > 0, low, high)
    front = low + high - behind
    ticks = [even_ticks(a, b, 6) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    ticks = [[(at, text) for at, text in each if a <= at <= b] for each, a, b in zip(ticks, low, high, strict=True)]
    for axis in range(3):
        one, other = (i for i in range(3) if i != axis)
        plane = np.tile(behind, (5, 1))
        plane[:, one] = np.array([low, high, high, low, low])[range(5), one]
        plane[:, other] = np.array([low, low, high, high, low])[range(5), other]
        sheet.outline(space.px(plane), _PANE)
        for along, across in ((one, other), (other, one)):
            for at, _ in ticks[along]:
                line = np.tile(behind, (2, 1))
                line[:, along], line[:, across] = at, (low[across], high[across])
                sheet.line(space.px(line), _GRID, 1.0)
    # x and depth along the lower near edges, up along the right one.
    edges = ((0, front * (0, 1, 0) + behind * (0, 0, 1)), (1, front * (1, 0, 0) + behind * (0, 0, 1)))
    names = (f"x ({unit})", f"z, depth ({unit})", f"−y, up ({unit})")
    middle = space.px((low + high) / 2)
    for axis, foot in (*edges, (2, front * (1, 0, 0) + behind * (0, 1, 0))):
        _draw_axis(sheet, space, axis, foot, ticks[axis], names[axis], middle)


def _draw_axis(
    sheet: Sheet, space: _Space, axis: int, foot: Array, ticks: list[Tick], name: str, middle: Array
) -> None:
    """Draw an edge of the box with its ticks and its name, away from the middle of the box, px."""
    ends = np.tile(foot, (2, 1))
    ends[:, axis] = space.low[axis], space.high[axis]
    line = space.px(ends)
    along = (line[1] - line[0]) / max(float(np.hypot(*(line[1] - line[0]))), 1e-9)
    away = np.array([-along[1], along[0]])
    is_upright = abs(along[1]) > 0.95
    away = away if away @ (line.mean(axis=0) - middle) > 0 else -away
    sheet.line(line, _INK, 1.2)
    for at, text in ticks:
        point = foot.copy()
        point[axis] = at
        x, y = space.px(point)
        sheet.line([(x, y), tuple((x, y) + 5 * away)], _INK, 1.2)
        if is_upright:
            sheet.text(tuple((x, y) + 9 * away), text, _TEXT, across=0.0)
        else:
            sheet.text(tuple((x, y) + _TICK_PX * away), text, _TEXT)
    x, y = line.mean(axis=0) + _NAME_PX * away
    sheet.text((x, y), name, _TEXT, turn_deg=90 if is_upright else 0, across=0.5 if axis != 1 else 0.0)


def _draw_colours(sheet: Sheet, data: View3D) -> None:
    """Draw the scale of curvature."""
    left, top, right, low = _BAR
    limit, height = data.curvature_limit, low - top
    bar = sheet.part(left, top, right, low)
    bar.pixels[...] = _curvature_colours(np.linspace(1, 0, bar.pixels.shape[0]))[:, None]
    cv2.rectangle(sheet.pixels, (int(left), int(top)), (int(right), int(low)), rgb(_INK), 1)
    wide = 0
    for at, text in even_ticks(-limit, limit, 8):
        y = low - (at / limit + 1) / 2 * height
        sheet.box(right, y - 0.5, right + 5, y + 0.5, _INK)
        wide = max(wide, sheet.text((right + 9, y), text, _TEXT, across=0.0)[0])
    name = f"curvature of larger size (1/{data.unit}), convex positive"
    sheet.text((right + 14 + wide, (top + low) / 2), name, _TEXT, across=0.0, turn_deg=90)
