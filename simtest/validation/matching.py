"""Matches detections, which come from the frame alone, to true highlights, and estimates of clouds to clouds."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry.patch import encloses
from simtest.reconstruction.records import Specularity
from simtest.runtime.arrays import Array
from simtest.simulation.frame import RenderedView
from simtest.simulation.highlights import CloudRegions


def match(specularities: Sequence[Specularity], points_px: Sequence[Array]) -> dict[int, int]:
    """Match each detection to the nearest true point, px, inside its isophote at t = 0.5 (theory.md section 6).

    The points are the BPs of true highlights, or the peaks of visible ones.

    Returns
    -------
    dict
        Index of the point by index of the detection; a point is matched to the nearest of its detections only.
    """
    points = np.asarray(points_px, dtype=float).reshape(-1, 2)
    # Candidates: points that an isophote encloses, with their distance from its peak.
    pairs = []
    for i, specularity in enumerate(specularities):
        for j in _enclosed(specularity, points):
            distance = float(np.hypot(*(points[j] - peak_px(specularity))))
            pairs.append((_is_undetected(specularity), distance, i, j))
    # Detections before what a frame estimator alone saw, the nearest pair first; each detection and each point once.
    matched: dict[int, int] = {}
    for _, _, i, j in sorted(pairs):
        if i not in matched and j not in matched.values():
            matched[i] = j
    return matched


def on_instruments(
    specularities: Sequence[Specularity], matched: Mapping[int, int], view: RenderedView
) -> list[bool] | None:
    """Return which detections that match no true highlight have their peak on an instrument; None where none is listed.

    What shines there is the instrument: it is no answer about the tissue, and no false detection.
    """
    if not view.scene.instruments:
        return None
    if view.instruments is None:
        return [False] * len(specularities)
    height, width = view.instruments.shape
    pixels = [peak_px(specularity).astype(int) for specularity in specularities]
    peaks = [(min(max(row, 0), height - 1), min(max(column, 0), width - 1)) for column, row in pixels]
    return [i not in matched and bool(view.instruments[peak]) for i, peak in enumerate(peaks)]


def match_cloud(regions: CloudRegions, view: RenderedView, estimate: Estimate) -> list[int]:
    """Return the indices in `view.clouds`, whose `regions` are given, of those that an estimate is of, one a light.

    Of each light it is the one that most of the estimate's spots belong to; of several, the nearest to where the
    estimate looks. That of most spots comes first. Empty where they belong to none that is in view. A point that an
    instrument covers or shades counts too, since the spots around it still belong to it.
    """
    if estimate.cloud is None or not view.clouds:
        return []
    points, centres = estimate.cloud.points_px, list(view.clouds)
    votes: dict[int, int] = {}
    for light in sorted({centre.light for centre in centres}):
        owners = regions.assign(np.full(len(points), light), points)
        counts = Counter(n for n in owners if n is not None)
        if counts:
            best = [n for n, count in counts.items() if count == max(counts.values())]
            nearest = min(best, key=lambda n: float(np.hypot(*(centres[n].bp_px - estimate.look_px))))
            votes[nearest] = counts[nearest]
    return sorted(votes, key=lambda n: -votes[n])


def _is_undetected(specularity: Specularity) -> bool:
    """Return whether no detector found it: it has neither a patch nor a contrast."""
    return isinstance(specularity.patch, Failure) and specularity.region.contrast is None


def peak_px(specularity: Specularity) -> np.ndarray:
    """Return a detection's peak, px: sub-pixel where there is a patch."""
    if isinstance(specularity.patch, Failure):
        return np.array(specularity.region.peak) + PIXEL_CENTRE
    return specularity.patch.peak_px


def _enclosed(specularity: Specularity, points: Array) -> list[int]:
    """Return the indices of the points, shape (N, 2), px, that a detection's isophote encloses.

    Where the isophote does not close, the detection's region decides.
    """
    x, y, width, height = specularity.region.box
    # The isophote lies in the region. A frame on a relief has hundreds of regions and of points, far apart.
    inside = ((points >= [x, y]) & (points <= [x + width, y + height])).all(axis=1)
    near, patch = np.flatnonzero(inside).tolist(), specularity.patch
    if not near or isinstance(patch, Failure):
        return near
    contour = patch.isophote(HIGHLIGHT_ISOVALUE)
    return near if isinstance(contour, Failure) else [j for j in near if encloses(contour, points[j])]
