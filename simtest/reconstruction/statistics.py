"""What is measured of a frame, real or generated, by one detector: its highlights, tissue, detail and noise.

Lengths are shares of the frame's width or of a highlight's radius where frames of different sizes are compared; the
spectrum and the noise are those of the recorded pixels. A fit takes each frame's values as `summarise` makes them one
vector of numbers that are near normal.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from simtest.calibration import Calibration, Frame, Response
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection.colour import ColourDetector
from simtest.detection.detector import Highlight
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.reconstruction.images import is_coloured
from simtest.runtime.arrays import Array, Image, Mask
from simtest.runtime.fitted import fitted_number

CLIPPED = 250 / 255
"""A highlight is clipped where a channel of its peak reaches this encoded value: coding leaves few peaks at 1."""

LEAST_SIDE = 64
"""Frames below this size, px, hold no spectrum between 4 and 64 px."""

RING_PX, AROUND_PX = (1.0, 3.5), (6.0, 9.0)
"""Distances from a highlight's half-height region in which its halo and its surroundings are measured, px."""

WAVELENGTHS_PX = (4.0, 64.0)

MID_GREY = (0.3, 0.7)
"""Luma of the tissue where the noise is measured."""

NOISE_BLOCK, NOISE_PERCENTILE = 8, 20.0
"""Noise is that of the smoothest fifth of blocks of so many pixels along a side: the others hold detail."""

NOISE_SHOWN = fitted_number("noise.shown")

VESSEL_SHARES = (1 / 400, 1 / 100)
"""Standard deviations of the two Gaussians whose difference is the band of vessels, shares of the width."""

_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)

LEAST_VALUES = 3
"""Of fewer highlights no spread is taken."""

Measured = Mapping[str, Array]
"""By column: one number of a frame, or one of each highlight; empty where the frame does not tell."""


# The table ------------------------------------------------------------------------------------------------------------

REDUCTIONS: dict[str, Callable[[Array], Any]] = {
    "value": lambda v: v[0],
    "log": lambda v: np.log(np.maximum(v[0], 1e-4)),
    "log of count": lambda v: np.log1p(v[0]),
    "log of area": lambda v: np.log(v[0] + 1e-4),
    "median": np.median,
    "mean of log": lambda v: np.mean(np.log(np.maximum(v, 1e-6))),
    # Of near equal values the logarithm of the spread has no lower end.
    "spread of log": lambda v: np.std(np.log(np.maximum(v, 1e-6))) if len(v) >= LEAST_VALUES else np.nan,
    "log of spread": lambda v: np.log(np.std(v) + 1e-3) if len(v) >= LEAST_VALUES else np.nan,
}
"""How a column's values become one number that is near normal."""


@dataclass(frozen=True)
class FrameColumn:
    """Numbers of a frame: one, or one of each highlight."""

    name: str  # key of what `measure` returns
    axis: str  # quantity and unit
    summaries: Mapping[str, str] = field(default_factory=dict)  # by name, which of `REDUCTIONS` (see `summarise`)


@dataclass(frozen=True)
class Statistic:
    """A property of frames, measured by one or more columns; its distance is the mean of theirs."""

    name: str
    title: str
    columns: tuple[FrameColumn, ...]


STATISTICS = (
    Statistic("count", "Number of highlights", (
        FrameColumn("per_frame", "highlights in a frame", {"count": "log of count"}),
        FrameColumn("per_megapixel", "highlights in a megapixel of the view"),
    )),
    Statistic("radius", "Radius of highlights", (
        FrameColumn("radius", "radius (share of the frame's width)",
                    {"radius": "mean of log", "radius spread": "spread of log"}),
    )),
    Statistic("axis_ratio", "Axis ratio of highlights", (
        FrameColumn("axis_ratio", "minor over major axis", {"axis ratio": "median"}),
    )),
    Statistic("clipped", "Clipped highlights", (
        FrameColumn("clipped", "share of a frame's highlights", {"clipped": "value"}),
    )),
    Statistic("area", "Area of highlights", (FrameColumn("area", "share of the view", {"area": "log of area"}),)),
    Statistic("clustering", "Nearest highlight", (
        FrameColumn("clustering", "distance (radii of the highlight)", {"clustering": "mean of log"}),
    )),
    Statistic("halo", "Depth of halos", (
        FrameColumn("halo", "luma of the surroundings less the halo's",
                    {"halo": "median", "halo spread": "log of spread"}),
    )),
    Statistic("colour", "Colour of the tissue", (
        FrameColumn("l_mean", "mean of L* (CIELAB)", {"lightness": "value"}),
        FrameColumn("l_sd", "spread of L* (CIELAB)", {"lightness spread": "log"}),
        FrameColumn("a_mean", "mean of a* (CIELAB)", {"red-green": "value"}),
        FrameColumn("a_sd", "spread of a* (CIELAB)", {"red-green spread": "log"}),
        FrameColumn("b_mean", "mean of b* (CIELAB)", {"yellow-blue": "value"}),
        FrameColumn("b_sd", "spread of b* (CIELAB)", {"yellow-blue spread": "log"}),
    )),
    Statistic("falloff", "Brightness over image radius", (
        FrameColumn("falloff", "log of linear light, corner less centre", {"falloff": "value"}),
    )),
    Statistic("spectrum", "Slope of the power spectrum", (
        FrameColumn("spectrum", "log power over log frequency, 4 to 64 px", {"spectrum": "value"}),
    )),
    Statistic("vessels", "Contrast of vessels", (
        FrameColumn("vessels", "log of green over red", {"vessels": "log"}),
    )),
    Statistic("noise", "Noise at mid grey", (
        FrameColumn("noise", "standard deviation of the luma", {"noise": "log"}),
    )),
)  # fmt: skip

COLUMNS = tuple(column.name for statistic in STATISTICS for column in statistic.columns)

SUMMARIES = tuple((name, column.name, REDUCTIONS[how]) for statistic in STATISTICS for column in statistic.columns
                  for name, how in column.summaries.items())  # fmt: skip
"""Name of each summary, the column that it is of, and how it is taken."""

NAMES = tuple(name for name, _, _ in SUMMARIES)
"""Of the summaries."""


def measure(picture: Image) -> Measured:
    """Measure a frame of sRGB values in [0, 1], shape (H, W, 3), float32."""
    if not is_coloured(picture):
        raise InputError(f"frame of shape {picture.shape} has no colours: realism takes colour frames, (H, W, 3)")
    height, width = picture.shape[:2]
    if min(height, width) < LEAST_SIDE:
        raise InputError(f"frame of {width} x {height} px: must be at least {LEAST_SIDE} px along both sides")
    # One detector for real and generated frames; the view is found in the picture.
    calibration = Calibration(Camera.from_fov(60.0, width, height), response=Response("srgb"), saturation_level=1.0)
    frame = Frame(picture, calibration, DEFAULT_SMOOTHING_PX)
    found = ColourDetector(isolated=False).detect(frame, calibration.camera)
    assert found.view is not None
    seen = np.ones((height, width), dtype=bool) if found.view.seen is None else found.view.seen
    luma = picture @ _LUMA
    bright = _bright(found.highlights, luma.shape)
    tissue = seen & (cv2.dilate(bright.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0) & (luma > 0.02)
    values = _highlights(found.highlights, picture, luma, seen, bright) | _tissue(picture, frame.channels, luma, tissue)
    values |= {"spectrum": _spectrum(luma, seen), "noise": _noise(luma, tissue)}
    return {name: np.atleast_1d(np.asarray(values[name], dtype=float)) for name in COLUMNS}


def summarise(measured: Measured) -> Array:
    """Return a frame's summaries, shape (S,); NaN where the frame does not tell one, such as without highlights."""
    return np.array([reduce(measured[column]) if len(measured[column]) else np.nan for _, column, reduce in SUMMARIES])


# Highlights -----------------------------------------------------------------------------------------------------------


def _bright(highlights: Sequence[Highlight], size: tuple[int, ...]) -> Mask:
    """Return the pixels above half of each highlight's peak, shape (H, W)."""
    marks = np.zeros(size, dtype=np.uint8)
    outlines = [np.rint((h.outline - 0.5) * 16).astype(np.int32) for h in highlights if len(h.outline)]
    cv2.fillPoly(marks, outlines, 1, shift=4)
    for h in highlights:
        if not len(h.outline):
            cv2.circle(marks, h.region.peak, max(round(_radius(h)), 1), 1, -1)
    return marks > 0


def _radius(highlight: Highlight) -> float:
    return float(np.sqrt(highlight.area_px / np.pi))


def _highlights(
    highlights: Sequence[Highlight], picture: Image, luma: Image, seen: Mask, bright: Mask
) -> dict[str, Array]:
    """Measure count, size, shape, clipping, area, clustering and halos of a frame's highlights."""
    area, width = int(np.count_nonzero(seen)), picture.shape[1]
    radii = np.array([_radius(h) for h in highlights])
    clipped = picture.max(axis=2) >= CLIPPED
    tops = [bool(clipped[h.region.peak[::-1]]) for h in highlights]
    return {
        "per_frame": np.array([len(highlights)]),
        "per_megapixel": np.array([len(highlights) / area * 1e6 if area else np.nan]),
        "radius": radii / width,
        "axis_ratio": np.array([h.axis_ratio for h in highlights if h.axis_ratio is not None]),
        "clipped": np.array([np.mean(tops)] if tops else []),
        "area": np.array([sum(h.area_px for h in highlights) / area if area else np.nan]),
        "clustering": _clustering(np.array([h.region.peak for h in highlights], dtype=float), radii),
        "halo": _halos(bright, luma, seen),
    }


def _clustering(peaks: Array, radii: Array) -> Array:
    """Return each highlight's distance to the nearest other one, over its radius."""
    if len(peaks) < 2:
        return np.empty(0)
    gaps = np.hypot(*(peaks[:, None] - peaks[None]).transpose(2, 0, 1))
    np.fill_diagonal(gaps, np.inf)
    return np.asarray(gaps.min(axis=1) / radii)


def _halos(bright: Mask, luma: Image, seen: Mask) -> Array:
    """Return how much darker the ring around each highlight is than what lies farther out, encoded luma.

    Positive is a dark halo, as sharpening draws it; the skirt of a highlight's lobe is negative.
    """
    away = cv2.distanceTransform((~bright).astype(np.uint8), cv2.DIST_L2, 5)
    reach = int(AROUND_PX[1]) + 1
    depths = []
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(bright.astype(np.uint8))
    for label in range(1, count):
        x, y, width, height = (int(v) for v in boxes[label, :4])
        crop = np.s_[max(y - reach, 0) : y + height + reach, max(x - reach, 0) : x + width + reach]
        own = cv2.distanceTransform((labels[crop] != label).astype(np.uint8), cv2.DIST_L2, 5)
        # Pixels that are nearer to another highlight belong to its ring.
        near = seen[crop] & (own <= away[crop] + 0.1)
        ring = near & (own >= RING_PX[0]) & (own <= RING_PX[1])
        around = near & (own >= AROUND_PX[0]) & (own <= AROUND_PX[1])
        if min(np.count_nonzero(ring), np.count_nonzero(around)) >= 8:
            depths.append(_quantile(luma[crop][around], 0.5) - _quantile(luma[crop][ring], 0.2))
    return np.array(depths)


def _quantile(values: Image, share: float) -> float:
    """Return a quantile, linear between order statistics; of few values NumPy's own takes ten times as long."""
    ordered = np.sort(values)
    at = share * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return float(ordered[low] + (ordered[high] - ordered[low]) * (at - low))


# Tissue ---------------------------------------------------------------------------------------------------------------


def _tissue(picture: Image, linear: Image, luma: Image, tissue: Mask) -> dict[str, Array]:
    """Measure the tissue's colour, how its brightness falls towards the border, and its vessels."""
    names = ("l_mean", "l_sd", "a_mean", "a_sd", "b_mean", "b_sd", "falloff", "vessels")
    if np.count_nonzero(tissue) < LEAST_SIDE**2:
        return {name: np.empty(0) for name in names}
    levels = np.stack(cv2.meanStdDev(cv2.cvtColor(picture, cv2.COLOR_RGB2Lab), mask=tissue.astype(np.uint8)), axis=1)
    values = dict(zip(names, levels.reshape(-1, 1), strict=False))
    return values | {"falloff": _falloff(linear, tissue), "vessels": _vessels(linear, tissue)}


def _falloff(linear: Image, tissue: Mask) -> Array:
    """Return the slope of the log of the tissue's light over the squared radius, which is 1 at the frame's corner."""
    height, width = tissue.shape
    across, down = (np.square((np.arange(n) + 0.5 - n / 2) * 2) for n in (width, height))
    squared = ((down[:, None] + across) / (width**2 + height**2))[tissue]
    light = np.log(np.maximum(cv2.transform(linear, np.full((1, 3), 1 / 3))[tissue], 1e-3)).astype(float)
    # The least-squares line in closed form.
    squared -= squared.mean()
    return np.array([squared @ (light - light.mean()) / (squared @ squared)])


def _vessels(linear: Image, tissue: Mask) -> Array:
    """Return the contrast of narrow dark lines in green over red: the darkest twentieth below the median, band-passed.

    Blood absorbs green light, so the ratio shows vessels and hardly shading.
    """
    ratio = np.log(np.maximum(linear[..., 1], 2e-3) / np.maximum(linear[..., 0], 2e-3)).astype(np.float32)
    weight = tissue.astype(np.float32)
    bands = []
    for share in VESSEL_SHARES:
        sigma = max(share * tissue.shape[1], 0.8)
        # Means over the tissue alone.
        spread, cover = (cv2.GaussianBlur(v, (0, 0), sigma) for v in (ratio * weight, weight))
        bands.append(spread / np.maximum(cover, 1e-3))
    inside = cv2.erode(tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    if np.count_nonzero(inside) < LEAST_SIDE**2:
        return np.empty(0)
    values = (bands[0] - bands[1])[inside]
    return np.array([np.median(values) - np.percentile(values, 5)])


# Detail ---------------------------------------------------------------------------------------------------------------


def _spectrum(luma: Image, seen: Mask) -> Array:
    """Return the slope of the power spectrum between wavelengths of 4 and 64 px, over squares that cover the view."""
    side, corners = _largest_squares(seen)
    if side < LEAST_SIDE:
        return np.empty(0)
    window = np.outer(np.hanning(side), np.hanning(side))
    squares = [luma[top : top + side, left : left + side].astype(float) for top, left in corners]
    power = np.mean([np.abs(np.fft.rfft2((values - values.mean()) * window)) ** 2 for values in squares], axis=0)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    # Means over rings that are even in the logarithm.
    low, high = (1 / v for v in reversed(WAVELENGTHS_PX))
    edges = np.geomspace(low, high, 13)
    ring = np.digitize(frequency, edges)
    means = np.array([power[ring == i].mean() if (ring == i).any() else np.nan for i in range(1, len(edges))])
    known = np.isfinite(means) & (means > 0)
    if np.count_nonzero(known) < 6:
        return np.empty(0)
    centres = np.sqrt(edges[1:] * edges[:-1])
    return np.array([np.polyfit(np.log(centres[known]), np.log(means[known]), 1)[0]])


def _largest_squares(seen: Mask) -> tuple[int, list[tuple[int, int]]]:
    """Return the side of the largest squares about the view's middle line, and the first pixels of those that cover it.

    A wide view has many such squares, one beside the other: one of them would show a part of it.
    """
    padded = np.pad(seen.astype(np.uint8), 1)
    away = cv2.distanceTransform(padded, cv2.DIST_C, 3)[1:-1, 1:-1]
    half = int(away.max()) - 1
    centres = np.argwhere(away == away.max())
    extent = np.ptp(centres, axis=0)
    # From end to end of the line of centres.
    ordered = centres[np.argsort(centres[:, int(extent.argmax())], kind="stable")]
    # Of an even number of rows the middle two are centres alike.
    count = 1 + math.ceil((int(extent.max()) - 1) / max(2 * half, 1))
    chosen = ordered[np.linspace(0, len(ordered) - 1, count).round().astype(int)]
    return 2 * half, [(int(row) - half, int(column) - half) for row, column in chosen]


def _noise(luma: Image, tissue: Mask) -> Array:
    """Return the standard deviation of the noise where the tissue is mid grey, from its smoothest blocks."""
    # Second differences both ways cancel slopes; their weights' root of squares is 6 (Immerkaer 1996).
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    detail = cv2.filter2D(luma, -1, kernel) / np.float32(6)
    grey = tissue & (luma > MID_GREY[0]) & (luma < MID_GREY[1])
    size = (luma.shape[1] // NOISE_BLOCK, luma.shape[0] // NOISE_BLOCK)
    cropped = np.s_[: size[1] * NOISE_BLOCK, : size[0] * NOISE_BLOCK]
    share = cv2.resize(grey[cropped].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    power = cv2.resize(np.square(detail[cropped]), size, interpolation=cv2.INTER_AREA)
    blocks = power[share > 0.99]
    if len(blocks) < 20:
        return np.empty(0)
    return np.array([np.sqrt(np.percentile(blocks, NOISE_PERCENTILE)) / NOISE_SHOWN])
