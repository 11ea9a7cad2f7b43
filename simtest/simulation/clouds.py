"""Which cloud a glint belongs to: that of the base's highlight point to which the base's misfit descends from it."""

from collections.abc import Sequence

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.rendering import HighlightPoint, Session
from simtest.runtime.arrays import Array, Image, IntArray
from simtest.runtime.files import Json

REACH_PX = 4.0
"""A descent that ends farther than this from all highlight points of the base belongs to none in view."""


def assign(session: Session, lights: IntArray, points_px: Array, centres: list[HighlightPoint]) -> list[int | None]:
    """Assign image points to the clouds around the base's highlight points.

    Parameters
    ----------
    session : Session
        At the scene.
    lights : ndarray of int, shape (N,)
        Light of each point.
    points_px : ndarray, shape (N, 2)
        px.
    centres : list of HighlightPoint
        Of the base, of all lights in view.

    Returns
    -------
    list of int or None
        Index in `centres`, of one with the same light; None where the descent leaves the view, or ends at a fold.
    """
    clouds: list[int | None] = [None] * len(points_px)
    for light in np.unique(lights):
        own, _, regions = _regions(session, light, centres)
        if not own:
            continue
        height, width = regions.shape
        for i in np.flatnonzero(lights == light):
            column, row = (min(int(v), size - 1) for v, size in zip(points_px[i], (width, height), strict=True))
            if regions[row, column] >= 0:
                clouds[i] = own[regions[row, column]]
    return clouds


def edges(session: Session, centres: Sequence[HighlightPoint]) -> list[float]:
    """Return the least misfit of the base at the edge of each cloud's region: the sine of the angle to the bisector.

    A region is what belongs to the cloud (`assign`). It ends at the frame's border, at the view mask, where the surface
    ends, and next to another cloud. A glint lies where the base's misfit is the relief's slope, so a cloud is as good
    as wholly in view where the misfit at the edge is several slopes.
    """
    least, seen = np.zeros(len(centres)), session.camera.seen
    for light in {centre.light for centre in centres}:
        own, size, regions = _regions(session, light, centres)
        regions = np.where(np.isfinite(size) & (True if seen is None else seen), regions, -1)
        around = np.pad(regions, 1, constant_values=-1)
        beside = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
        edge = np.logical_or.reduce([regions != other for other in beside])
        for i, number in enumerate(own):
            least[number] = size[edge & (regions == i)].min(initial=np.inf)
    return np.where(np.isfinite(least), least, 0.0).tolist()


def _regions(session: Session, light: int, centres: Sequence[HighlightPoint]) -> tuple[list[int], Image, IntArray]:
    """Return the indices of a light's centres, the base's misfit, and where each pixel belongs, shape (H, W).

    The latter is an index in the first, or -1 for none.
    """
    own = [number for number, centre in enumerate(centres) if centre.light == light]
    maps = session.misfits()
    inside = slice(maps.margin, -maps.margin)
    w = maps.base[light][:, inside, inside]
    size, ends = np.hypot(w[0], w[1]), _ends(w)
    height, width = size.shape
    if not own:
        return own, size, np.full((height, width), -1)
    # Where descents end, and which centre is near.
    target = ends[..., 0] * width + ends[..., 1]
    bottoms = np.flatnonzero((target.ravel() == np.arange(target.size)) & np.isfinite(size.ravel()))
    at = np.stack([bottoms % width, bottoms // width], axis=1) + PIXEL_CENTRE
    gap = np.linalg.norm(at[:, None] - np.array([centres[number].bp_px for number in own]), axis=2)
    nearest = np.full(target.size, -1)
    nearest[bottoms] = np.where(gap.min(axis=1) < REACH_PX, gap.argmin(axis=1), -1)
    return own, size, nearest[target]


def _ends(w: Image) -> IntArray:
    """Return where the steepest descent of a misfit, shape (2, H, W), ends: row and column, shape (H, W, 2)."""
    size = np.hypot(w[0], w[1])
    height, width = size.shape
    padded = np.pad(np.where(np.isfinite(size), size, np.inf), 1, constant_values=np.inf)
    # Each pixel points at the lowest of itself and its neighbours.
    lowest, target = padded[1:-1, 1:-1].copy(), np.arange(height * width).reshape(height, width)
    index = np.pad(target, 1)
    for down in range(3):
        for right in range(3):
            value = padded[down : down + height, right : right + width]
            lower = value < lowest
            lowest[lower] = value[lower]
            target[lower] = index[down : down + height, right : right + width][lower]
    # Follow the pointers, twice as far each time.
    flat = target.ravel()
    while True:
        farther = flat[flat]
        if np.array_equal(farther, flat):
            break
        flat = farther
    return np.stack(np.divmod(flat, width), axis=-1).reshape(height, width, 2)


def cloud_json(centre: HighlightPoint) -> dict[str, Json]:
    """Describe a highlight point of the base, with its normal and curvatures."""
    return {
        "light": centre.light,
        "bp_px": centre.bp_px.tolist(),
        "position_mm": centre.position.tolist(),
        "normal_base": centre.normal_base.tolist(),
        "distance_mm": centre.distance,
        "kd_min_base": centre.kd_min_base,
        "kd_max_base": centre.kd_max_base,
        "lit": centre.lit,
    }
