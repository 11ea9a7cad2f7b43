"""Draws gallery frames: isophotes, fitted ellipses, brightest points and normals over the frame."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from simtest.conventions import ON_INSTRUMENT
from simtest.pages import pixels
from simtest.pages.pixels import Canvas, Pixels, Window
from simtest.pages.style import NEUTRAL, TRUTH, degrees, hexadecimal
from simtest.runtime.arrays import Array
from simtest.validation.kept_frames import KeptEstimate, KeptItem

HEIGHT_PX, PAGE_PX = 400, 300  # height of a picture in its file and in the page
_GAP_PX = 6

_NO_HIGHLIGHT = {
    "false": "false detection", "in_spot": "in a spot of several glints or of none", ON_INSTRUMENT: "on an instrument",
}  # fmt: skip
"""Kinds of detections that are of no true highlight, in words."""

_ARROW, _ARROW_ENLARGED = 0.2, 0.4
"""Length of a normal over the distance in the frame, and over the width that the enlargement shows."""

_TRUTH_EDGE, _ESTIMATE_EDGE = "#332B00", "#FFFFFF"
_MOST_LEVELS = 5


class Shown(NamedTuple):
    """A gallery item as the page shows it: pictures as data addresses, each with width over height, and results."""

    item: KeptItem
    pictures: list[tuple[str, float]]

    @property
    def results(self) -> list[tuple[KeptEstimate, str]]:
        """Each estimate, with what it came to."""
        return [(estimate, result_of(estimate)) for estimate in self.item.meta.estimates]


def result_of(estimate: KeptEstimate) -> str:
    """Return what an estimate came to: an error, a failure's reason, or that it is of no true highlight."""
    ok, value, better = estimate.status == "ok", degrees(estimate.error_deg), degrees(estimate.error_oracle_deg)
    if estimate.kind in _NO_HIGHLIGHT:
        return _NO_HIGHLIGHT[estimate.kind] if ok else f"{estimate.status} ({_NO_HIGHLIGHT[estimate.kind]})"
    told = len(estimate.normals) > 1 and better not in ("–", value)
    return estimate.status if not ok else f"{value} (better candidate {better})" if told else value


def file_name(index: int) -> str:
    """Return the name of a frame's picture among the figures, without its suffix."""
    return f"gallery_{index:03d}"


def draw_shown(item: KeptItem, colours: Mapping[str, str]) -> tuple[Shown, bytes]:
    """Return what the page shows of a frame, and its picture with legend as PNG."""
    parts, legend = draw_item(item, colours)
    gap = np.full((HEIGHT_PX, _GAP_PX, 3), 255, np.uint8)
    whole = np.hstack([part for each in parts for part in (gap, each)][1:])
    strip = pixels.legend(whole.shape[1], legend)
    pictures = [(pixels.data_address(part, PAGE_PX), part.shape[1] / part.shape[0]) for part in parts]
    return Shown(item, pictures), pixels.png(np.vstack([whole, strip]))


def anchor(item: KeptItem, estimate: KeptEstimate) -> Array | None:
    """Return the surface point from which an estimate's normals are drawn, camera frame.

    It is the true highlight that the estimate was matched to; for a false detection it is the point of the truth map
    at the brightest point; None where there is no surface.
    """
    truth = item.true_highlight(estimate)
    if truth is not None and truth.position is not None:
        return np.array(truth.position)
    if estimate.bp_px is None:
        return None
    rows, columns = item.position.shape[:2]
    x, y = estimate.bp_px
    row, column = int(y / item.camera.height * rows), int(x / item.camera.width * columns)
    if not (0 <= row < rows and 0 <= column < columns):
        return None
    point = item.position[row, column].astype(float)
    return point if np.isfinite(point).all() else None


def draw_item(item: KeptItem, colours: Mapping[str, str]) -> tuple[list[Pixels], list[tuple[str, str]]]:
    """Draw one frame and the neighbourhood of its main highlight, RGB; returned with the legend as (colour, text)."""
    window = _window(item)
    whole = Canvas(item.frame, None, HEIGHT_PX)
    _draw_overlay(whole, item, colours, window is None, _ARROW)
    if not window:
        return [whole.pixels], _legend(item, colours, window)
    for truth in item.meta.truth:
        if truth.bp_px is not None:
            whole.ring(truth.bp_px, TRUTH, 11)
    part = Canvas(item.frame, window, HEIGHT_PX)
    _draw_overlay(part, item, colours, True, _ARROW_ENLARGED * (window[1] - window[0]) / item.camera.fx)
    return [whole.pixels, part.pixels], _legend(item, colours, window)


def _draw_overlay(canvas: Canvas, item: KeptItem, colours: Mapping[str, str], detailed: bool, reach: float) -> None:
    # Lines first, then the truth, then the estimates on top of it.
    seen: set[tuple[int | None, float]] = set()
    for estimate in item.meta.estimates:
        for isophote in estimate.isophotes:
            if isophote.points and (estimate.specularity, isophote.t) not in seen:
                seen.add((estimate.specularity, isophote.t))
                canvas.line(isophote.points, isophote_colour(isophote.t), 2 if detailed else 1)
        for curve in estimate.curves if detailed else ():
            canvas.line(curve, colours.get(estimate.estimator, NEUTRAL), 1, dashed=True)
    for truth in item.meta.truth:
        if truth.position is not None and truth.normal is not None:
            canvas.arrow(
                _projected(item, np.array(truth.position), np.array(truth.normal), reach), TRUTH, 3 if detailed else 2
            )
        if truth.bp_px is not None and detailed:
            canvas.cross(truth.bp_px, TRUTH, _TRUTH_EDGE, 26)
    for estimate in item.meta.estimates:
        colour, point = colours.get(estimate.estimator, NEUTRAL), anchor(item, estimate)
        if point is not None:
            for normal in estimate.normals:
                canvas.arrow(_projected(item, point, normal, reach), colour, 2 if detailed else 1)
        if estimate.bp_px is not None and detailed:
            canvas.cross(estimate.bp_px, colour, _ESTIMATE_EDGE, 12, tilted=True)


def _projected(item: KeptItem, point: Array, normal: Array, reach: float) -> Array:
    """Return both ends of a normal drawn from a surface point, px, shape (2, 2)."""
    ends = np.stack([point, point + reach * np.linalg.norm(point) * normal])
    return np.asarray(item.camera.project(ends))


def isophote_colour(isovalue: float) -> str:
    """Return the colour of an isophote at t in 0..1: from cyan to magenta."""
    share = float(np.clip(isovalue, 0, 1))
    return hexadecimal((share, 1 - share, 1))


def isophote_keys(items: Iterable[KeptItem]) -> list[tuple[float, str]]:
    """Return the isovalues that gallery items draw, sorted, with their colours."""
    drawn = {round(part.t, 3) for item in items for estimate in item.meta.estimates for part in estimate.isophotes}
    return [(t, isophote_colour(t)) for t in sorted(drawn)]


def _window(item: KeptItem) -> Window | None:
    """Return the square about the main highlight; None where it fills the frame or nothing was found."""
    groups: dict[int | None, list[Array]] = {}
    for estimate in item.meta.estimates:
        for isophote in estimate.isophotes:
            if isophote.points:
                groups.setdefault(estimate.specularity, []).append(np.array(isophote.points))
    if not groups:
        return None
    points = max((np.vstack(group) for group in groups.values()), key=lambda p: float(np.ptp(p, axis=0).max()))
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(0.8 * float((high - low).max()), 10.0)
    if 2 * half > 0.9 * min(item.frame.shape[:2]):
        return None
    x, y = (low + high) / 2
    return float(x - half), float(x + half), float(y - half), float(y + half)


def _legend(item: KeptItem, colours: Mapping[str, str], window: Window | None) -> list[tuple[str, str]]:
    names = dict.fromkeys(estimate.estimator for estimate in item.meta.estimates)
    entries = [(TRUTH, "truth"), *((colours.get(name, NEUTRAL), name) for name in names)]
    levels = isophote_keys([item])
    entries += [(colour, f"isophote t = {t:g}") for t, colour in levels[:: -(-len(levels) // _MOST_LEVELS) or 1]]
    if window:
        x0, x1, y0, y1 = window
        entries.append(("#FFFFFF", f"enlarged: x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f} px"))
    return entries
