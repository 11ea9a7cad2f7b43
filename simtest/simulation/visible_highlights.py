"""Visible highlights of a noise-free frame, and the glints that each holds (theory.md 7.1b).

On a relief glints melt, and minima of the misfit above 0 shine too: a visible spot may hold several glints or none. A
visible highlight is a local maximum of the light behind the lens whose saddle to any brighter one is below 0.8 of it.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.runtime.arrays import Array, Image, IntArray, Mask, short_repr
from simtest.runtime.files import Json
from simtest.simulation.true_highlights import TrueHighlight

SADDLE = 0.8
"""A maximum counts if its saddle to any brighter one is below this share of it."""

LEAST_SPECULAR = 1 - SADDLE
"""So the lobe must give at least this share of the light at the maximum: the rest is no highlight."""

DARK = 1e-6
"""Light below this share of the frame's maximum is darkness."""


@dataclass(frozen=True)
class VisibleHighlight:
    """A spot that can be seen.

    Parameters
    ----------
    peak_px : ndarray, shape (2,)
        Centre of its brightest pixel, px.
    value : float
        Direct light behind the lens at the peak, radiance.
    specular : float
        The part of it that comes off the lobe.
    peak_snr : float
        The specular part, up to where the sensor clips, over the noise at the peak; inf without noise.
    area_px : int
        Pixels above half of the lobe's peak, without those of brighter neighbours.
    centroid_px : ndarray, shape (2,)
        Of these pixels, weighted by the lobe's light, px.
    axis_ratio : float
        Minor over major axis of their second moments.
    whole : bool
        Whether they stay clear of the frame's border and of the view mask.
    light, cloud : int or None
        Index of the light and number of the cloud of its brightest glint, or else of the nearest lit one.
    glints : tuple of int
        Indices of the lit glints in it, the brightest first.
    instrument : int or None
        Index of the instrument on which its peak lies; it is no highlight of the surface then, and has no light, cloud
        or glints.
    """

    peak_px: Array
    value: float
    specular: float
    peak_snr: float
    area_px: int
    centroid_px: Array
    axis_ratio: float
    whole: bool
    light: int | None
    cloud: int | None
    glints: tuple[int, ...]
    instrument: int | None = None

    __repr__ = short_repr

    @property
    def radius_px(self) -> float:
        """Radius of the circle of its area, px."""
        return float(np.sqrt(self.area_px / np.pi))

    def to_json(self) -> dict[str, Json]:
        """Return the fields as JSON."""
        of_instrument: dict[str, Json] = {} if self.instrument is None else {"instrument": self.instrument}
        return {
            "peak_px": self.peak_px.tolist(),
            "value": self.value,
            "specular": self.specular,
            "peak_snr": self.peak_snr if np.isfinite(self.peak_snr) else None,
            "area_px": self.area_px,
            "centroid_px": self.centroid_px.tolist(),
            "axis_ratio": self.axis_ratio,
            "whole": self.whole,
            "light": self.light,
            "cloud": self.cloud,
            "glints": list(self.glints),
            **of_instrument,
        }


@dataclass(frozen=True)
class Spots:
    """Maxima of a frame and the pixels of each.

    Parameters
    ----------
    rows, columns : ndarray of int, shape (N,)
        Peaks, the brightest first.
    regions : ndarray of int, shape (H, W)
        Number of the maximum whose pixel it is, from 1; 0 where none.
    """

    rows: IntArray
    columns: IntArray
    regions: IntArray


def find_spots(light: Image, specular: Image, seen: Mask | None = None) -> Spots:
    """Find the maxima of a noise-free frame that are highlights.

    Parameters
    ----------
    light : ndarray, shape (H, W)
        Radiance behind the lens.
    specular : ndarray, shape (H, W)
        The part of it that comes directly off the lobe.
    seen : ndarray of bool, shape (H, W), optional
        Pixels inside the view mask; default all.
    """
    from skimage.measure import label
    from skimage.morphology import local_maxima, reconstruction
    from skimage.segmentation import watershed

    light = np.where(np.isfinite(light), light, 0.0).astype(np.float64)
    if seen is not None:
        light = np.where(seen, light, 0.0)
    empty = Spots(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.zeros(light.shape, dtype=np.int64))
    if light.max() <= 0:
        return empty
    # Maxima: in logarithms the ratio of saddle and peak is a height, and these are the h-maxima.
    log = np.log(np.maximum(light, DARK * light.max()))
    flooded = reconstruction(log + np.log(SADDLE), log, method="dilation")
    summits, count = label(local_maxima(flooded), connectivity=2, return_num=True)
    if count == 0:
        return empty
    # The brightest pixel of each; only those that shine.
    order = np.argsort(-light, axis=None, kind="stable")
    order = order[summits.ravel()[order] > 0]
    _, first = np.unique(summits.ravel()[order], return_index=True)
    peaks = order[np.sort(first)]
    peaks = peaks[specular.ravel()[peaks] >= LEAST_SPECULAR * light.ravel()[peaks]]
    if not len(peaks):
        return empty
    rows, columns = np.unravel_index(peaks, light.shape)
    # Pixels: above half of the lobe's peak, shared out by watershed, connected to the peak.
    markers = np.zeros(light.shape, dtype=np.int32)
    markers[rows, columns] = np.arange(1, len(peaks) + 1)
    half = specular[rows, columns] / 2
    owners = watershed(-specular, markers, mask=specular >= half.min())
    owners[specular < np.concatenate([[np.inf], half])[owners]] = 0
    pieces = label(owners, background=0, connectivity=1)
    # A component keeps its number only if it holds its own peak.
    held = np.zeros(pieces.max() + 1, dtype=np.int64)
    held[pieces[rows, columns]] = np.arange(1, len(peaks) + 1)
    held[0] = 0
    return Spots(np.asarray(rows), np.asarray(columns), held[pieces])


def glints_of(spots: Spots, glints: list[TrueHighlight]) -> list[tuple[int, ...]]:
    """Return which lit glints, by index, each spot holds, or has next to its pixels."""
    from skimage.segmentation import expand_labels

    held: list[list[int]] = [[] for _ in spots.rows]
    if not len(spots.rows):
        return []
    # A glint lies up to a pixel beside the light that it makes.
    around = expand_labels(spots.regions, distance=1)
    height, width = around.shape
    for number, glint in enumerate(glints):
        column, row = min(int(glint.bp_px[0]), width - 1), min(int(glint.bp_px[1]), height - 1)
        if glint.lit and around[row, column]:
            held[around[row, column] - 1].append(number)
    return [tuple(numbers) for numbers in held]


@dataclass(frozen=True)
class SpotShape:
    """Size and shape of a spot (fields as in `VisibleHighlight`)."""

    area_px: int
    centroid_px: Array
    axis_ratio: float
    whole: bool


def shape_of(spots: Spots, number: int, specular: Image, seen: Mask | None = None) -> SpotShape:
    """Measure the spot of a number, from 0, by the lobe's light, shape (H, W)."""
    # Only around the peak: a region is connected, and far smaller than the frame.
    rows, columns = _pixels(spots, number)
    weight = specular[rows, columns].astype(np.float64)
    points = np.stack([columns, rows], axis=1) + PIXEL_CENTRE
    centroid = weight @ points / weight.sum()
    gap = points - centroid
    # A pixel has a moment of its own.
    moments = np.einsum("n,ni,nj->ij", weight, gap, gap) / weight.sum() + np.eye(2) / 12
    small, large = np.linalg.eigvalsh(moments)
    height, width = spots.regions.shape
    whole = rows.min() > 0 and columns.min() > 0 and rows.max() < height - 1 and columns.max() < width - 1
    if whole and seen is not None:
        whole = all(seen[rows + down, columns + right].all() for down in (-1, 1) for right in (-1, 1))
    return SpotShape(len(rows), centroid, float(np.sqrt(small / large)), bool(whole))


def _pixels(spots: Spots, number: int) -> tuple[IntArray, IntArray]:
    """Return the rows and columns of a spot, found in windows around its peak that grow until they hold it."""
    row, column = int(spots.rows[number]), int(spots.columns[number])
    height, width = spots.regions.shape
    reach = 16
    while True:
        top, left = max(row - reach, 0), max(column - reach, 0)
        bottom, right = min(row + reach + 1, height), min(column + reach + 1, width)
        inside = spots.regions[top:bottom, left:right] == number + 1
        border = [(top, inside[0]), (left, inside[:, 0]), (height - bottom, inside[-1]), (width - right, inside[:, -1])]
        if all(room == 0 or not edge.any() for room, edge in border):
            rows, columns = np.nonzero(inside)
            return rows + top, columns + left
        reach *= 2


def describe(
    spots: Spots, light: Image, specular: Image, sigma: Array, glints: list[TrueHighlight], seen: Mask | None = None,
    instruments: npt.NDArray[np.uint8] | None = None, clip: float = np.inf,
) -> list[VisibleHighlight]:  # fmt: skip
    """Describe the spots of a frame, the brightest first.

    Parameters
    ----------
    spots : Spots
        Of `find_spots`, for the same `light`, `specular` and `seen`.
    light, specular : ndarray, shape (H, W)
        As there.
    sigma : ndarray, shape (N,)
        Noise at each peak, radiance.
    glints : list of TrueHighlight
        All of the frame. A spot's light and cloud are those of its brightest glint, or else of the nearest lit one.
    instruments : ndarray of uint8, shape (H, W), optional
        1 + the index of the instrument that is seen, 0 where none is.
    clip : float
        Radiance at which the sensor's values end.
    """
    lit = [number for number, glint in enumerate(glints) if glint.lit]
    at = np.array([glints[number].bp_px for number in lit]).reshape(-1, 2)
    described = []
    for number, held in enumerate(glints_of(spots, glints)):
        row, column = int(spots.rows[number]), int(spots.columns[number])
        peak = np.array([column, row]) + PIXEL_CENTRE
        owner = 0 if instruments is None else int(instruments[row, column])
        held = () if owner else held
        nearest = held[0] if held else None
        if not (held or owner) and lit:
            nearest = lit[int(np.linalg.norm(at - peak, axis=1).argmin())]
        shape = shape_of(spots, number, specular, seen)
        value, lobe = float(light[row, column]), float(specular[row, column])
        shown = min(value, clip) - min(value - lobe, clip)
        described.append(
            VisibleHighlight(
                peak_px=peak,
                value=value,
                specular=lobe,
                peak_snr=shown / sigma[number] if sigma[number] > 0 else np.inf,
                area_px=shape.area_px,
                centroid_px=shape.centroid_px,
                axis_ratio=shape.axis_ratio,
                whole=shape.whole,
                light=None if nearest is None else glints[nearest].light,
                cloud=None if nearest is None else glints[nearest].cloud,
                glints=held,
                instrument=owner - 1 if owner else None,
            )
        )
    return described
