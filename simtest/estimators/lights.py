"""Which of several lights made a highlight: told by where the others' highlights are beside it."""

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Known
from simtest.conventions import PIXEL_CENTRE
from simtest.estimators.spot import Spot

Array = npt.NDArray[np.float64]

OTHER_PEAK = 0.3
"""Another highlight's peak stands at least this high, as a share of the patch's."""

VALLEY = 0.9
"""Between two highlights the intensity falls below this share of the lower peak."""

LARGEST_MISFIT = 0.25
"""Of the offsets that the mirror geometry predicts, as a share of their length."""

CLEAR = 2.0
"""The next best light must fit this many times worse."""


def light_of_highlight(spot: Spot, known: Known) -> int | None:
    """Tell which light made a highlight; None where that cannot be told.

    The highlights of lights at L_i lie at w_i in the image with M (w_i - w_j) = (L_i - L_j)_perp / (2 d): the bisector
    turns by half the light's angle, the normal against the sightline by M. M is the root of the lobe's H up to a
    factor, taken as positive: a surface that is not curved inwards beyond its centre. The factor is fitted.

    Parameters
    ----------
    spot : Spot
        The highlight; other peaks are sought in its patch.
    known : Known
        Its lights are used.

    Returns
    -------
    int or None
        Index of the light.
    """
    if len(known.lights_mm) == 1:
        return 0
    others = _other_peaks(spot)
    values, vectors = np.linalg.eigh(spot.moments)
    if not len(others) or values[0] <= 0:
        return None
    M = vectors @ np.diag(np.sqrt(values[0] / values)) @ vectors.T
    seen = others @ M
    places = known.lights @ spot.basis.T
    misfits = np.array([_misfit(seen, np.delete(places, i, axis=0) - place) for i, place in enumerate(places)])
    first, second = np.argsort(misfits, kind="stable")[:2]
    clear = misfits[first] < LARGEST_MISFIT and misfits[second] > max(CLEAR * misfits[first], LARGEST_MISFIT)
    return int(first) if clear else None


def _misfit(seen: Array, offsets: Array) -> float:
    """Give how badly the other peaks fit the other lights' offsets, any positive factor between them.

    Parameters
    ----------
    seen : ndarray, shape (K, 2)
        Offsets of the other peaks.
    offsets : ndarray, shape (L - 1, 2)
        Offsets of the other lights.

    Returns
    -------
    float
        RMS of what is left over RMS of the offsets; 0 is a perfect fit.
    """
    best = np.inf
    # Each pairing of the first peak sets the factor; the other peaks then take the nearest light.
    for offset in offsets:
        factor = max(float(seen[0] @ offset / (seen[0] @ seen[0])), 0.0)
        gaps = np.linalg.norm(factor * seen[:, None] - offsets[None], axis=2)
        taken = np.concatenate([[int(np.argmin(np.linalg.norm(offsets - offset, axis=1)))], gaps[1:].argmin(axis=1)])
        if len(set(taken.tolist())) < len(taken):
            continue
        matched = offsets[taken]
        factor = max(float(np.sum(seen * matched) / np.sum(seen * seen)), 0.0)
        best = min(best, float(np.linalg.norm(factor * seen - matched) / np.linalg.norm(matched)))
    return best


def _other_peaks(spot: Spot) -> Array:
    """Give where other highlights' peaks in the patch lie from the own one, tangents in the basis, shape (K, 2)."""
    patch = spot.patch
    values = np.asarray(patch.values, dtype=np.float32)
    box = np.argwhere(patch.inside(spot.isophotes[-1].isovalue))
    reach = max(3, int(np.ptp(box, axis=0).min()) // 4)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    high = (values >= cv2.dilate(values, kernel)) & (values > OTHER_PEAK * patch.peak_value)
    # The patch's border may cut a highlight anywhere but at its peak.
    high[[0, -1]] = high[:, [0, -1]] = False
    column, row = patch.peak_pixel
    found = []
    for other_row, other_column in np.argwhere(high):
        line = np.linspace([row, column], [other_row, other_column], 64).round().astype(int)
        if values[line[:, 0], line[:, 1]].min() < VALLEY * values[other_row, other_column]:
            found.append((other_column, other_row))
    if not found:
        return np.empty((0, 2))
    pixels = np.array(found) + PIXEL_CENTRE + patch.origin_px
    return np.asarray(spot.tangents(pixels) - spot.tangents(patch.peak_px[None]))
