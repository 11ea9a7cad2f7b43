"""Which of several lights made a highlight: told by where the others' highlights are beside it."""

import numpy as np
import numpy.typing as npt

from simtest.calibration import Priors
from simtest.estimators.isophote_family import IsophoteFamily

Array = npt.NDArray[np.float64]

LARGEST_MISFIT = 0.25
"""Of the offsets that the mirror geometry predicts, as a share of their length."""

CLEAR = 2.0
"""The next best light must fit this many times worse."""


def light_of_highlight(spot: IsophoteFamily, priors: Priors) -> int | None:
    """Tell which light made a highlight; None where that cannot be told.

    The highlights of lights at L_i lie at w_i in the image with M (w_i - w_j) = (L_i - L_j)_perp / (2 d): the bisector
    turns by half the light's angle, the normal against the sightline by M. M is the root of the lobe's H up to a
    factor, taken as positive: a surface that is not curved inwards beyond its centre. The factor is fitted.

    Parameters
    ----------
    spot : IsophoteFamily
        The highlight; its patch names the frame's others, of which the nearest are taken, one a light.
    priors : Priors
        Its lights are used.

    Returns
    -------
    int or None
        Index of the light.
    """
    if len(priors.lights_mm) == 1:
        return 0
    others = _other_peaks(spot)[: len(priors.lights_mm) - 1]
    values, vectors = np.linalg.eigh(spot.moments)
    if not len(others) or values[0] <= 0:
        return None
    M = vectors @ np.diag(np.sqrt(values[0] / values)) @ vectors.T
    seen = others @ M
    places = priors.lights @ spot.basis.T
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


def _other_peaks(spot: IsophoteFamily) -> Array:
    """Give where the nearest other highlights lie from the own one, tangents in the basis, shape (K, 2)."""
    others = np.array(spot.patch.others_px).reshape(-1, 2)
    gaps = np.linalg.norm(others - spot.patch.peak_px, axis=1)
    return np.asarray(spot.tangents(others[np.argsort(gaps, kind="stable")]) - spot.tangents(spot.patch.peak_px[None]))
