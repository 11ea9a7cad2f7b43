"""Which of several lights made a highlight: decided by the positions of the other highlights around it."""

import numpy as np

from simtest.calibration import Priors
from simtest.estimators.highlight_fit import HighlightAxis
from simtest.geometry import Array

LARGEST_MISFIT = 0.25
"""Largest misfit of the offsets that the mirror geometry predicts, as a share of their length."""

CLEAR = 2.0
"""The next best light must fit this many times worse for the choice to be clear."""

ALONE = 3.0
"""The highlights of one place must lie this many times nearer together than the next one does. On rough tissue glints
meet the lights' arrangement by chance: of two lights 16 times in 100, half of them wrongly; of three 3 times in 100,
which are half of all choices that seem clear there."""


def light_of_highlight(family: HighlightAxis, priors: Priors) -> int | None:
    """Return the index of the light that made a highlight; None where that is not clear.

    The highlights of lights at L_i lie at w_i in the image with M (w_i - w_j) = (L_i - L_j)_perp / (2 d): the bisector
    turns by half the light's angle, the normal turns against the sightline by M. M is the root of the lobe's H up to a
    factor, which is fitted. It is taken as positive: no surface that is concave beyond its centre of curvature. Of the
    frame's other highlights, which the patch names, the nearest are used, one for each other light; with them the
    highlight must stand alone (`ALONE`).
    """
    if len(priors.lights_mm) == 1:
        return 0
    # observed offsets, turned by M into those of the lights up to a factor
    peaks = _other_peaks(family)
    others = peaks[: len(priors.lights_mm) - 1]
    if not _stand_alone(peaks, len(others)):
        return None
    values, vectors = np.linalg.eigh(family.moments)
    if not len(others) or values[0] <= 0:
        return None
    M = vectors @ np.diag(np.sqrt(values[0] / values)) @ vectors.T
    seen = others @ M
    # misfit if light i made this highlight
    lights = priors.lights @ family.basis.T
    misfits = np.array([_misfit(seen, np.delete(lights, i, axis=0) - light) for i, light in enumerate(lights)])
    first, second = np.argsort(misfits, kind="stable")[:2]
    clear = misfits[first] < LARGEST_MISFIT and misfits[second] > max(CLEAR * misfits[first], LARGEST_MISFIT)
    return int(first) if clear else None


def _stand_alone(peaks: Array, count: int) -> bool:
    """Return whether the first so many of other peaks, nearest first, shape (K, 2), are far nearer than the next."""
    gaps = np.linalg.norm(peaks[: count + 1], axis=1)
    return len(gaps) <= count or bool(gaps[count] > ALONE * gaps[count - 1])


def _misfit(seen: Array, offsets: Array) -> float:
    """Return how badly other peaks, shape (K, 2), fit the other lights' offsets, shape (L - 1, 2), up to a factor > 0.

    The misfit is the RMS of the residual over that of the offsets; 0 is a perfect fit.
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
        # refine the factor with all pairs
        factor = max(float(np.sum(seen * matched) / np.sum(seen * seen)), 0.0)
        best = min(best, float(np.linalg.norm(factor * seen - matched) / np.linalg.norm(matched)))
    return best


def _other_peaks(family: HighlightAxis) -> Array:
    """Return the offsets of the other highlights, the nearest first, tangents in the basis, shape (K, 2)."""
    others, peak = family.patch.neighbours_px, family.patch.peak_px
    order = np.argsort(np.linalg.norm(others - peak, axis=1), kind="stable")
    return np.asarray(family.tangents(others[order]) - family.tangents(peak[None]))
