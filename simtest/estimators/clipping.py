"""What clipping hides of a highlight: its pixels, and how far the peak may lie from where the isophotes put it."""

import math

import cv2
import numpy as np

from simtest.geometry import Array, Mask, Patch
from simtest.runtime.fitted import fitted_number

NEARLY_CLIPPED = 0.93
"""Pixels above this share of the clipped ones' intensity count as clipped: coding blurs the plateau."""

AROUND_PX = 17
"""Side of the square around a pixel whose clipped ones are meant: where a falloff was divided away, those elsewhere are
brighter or darker."""

PLATEAU_SHARE, BENT_SHARE = fitted_number("plateau.share"), fitted_number("plateau.bent_share")
BENT_RESIDUAL, MOST_BENT = fitted_number("plateau.bent_residual"), fitted_number("plateau.most_bent")


def clipped_pixels(patch: Patch) -> Mask | None:
    """Return the clipped pixels of a patch, and those as bright as they are, shape (h, w); None where there is none."""
    if patch.saturated is None or not patch.saturated.any():
        return None
    raw = patch.values if patch.raw is None else patch.raw
    inside = patch.saturated.astype(np.float32)
    share, sums = (cv2.blur(each, (AROUND_PX, AROUND_PX)) for each in (inside, inside * raw.astype(np.float32)))
    nearly = (share > 0.5 / AROUND_PX**2) & (raw * share >= NEARLY_CLIPPED * sums)
    return np.asarray(patch.saturated | nearly)


def plateau_area_px(patch: Patch, isovalue: float) -> int:
    """Return how many pixels inside an isophote are clipped; where the region cuts it, inside it and the cut."""
    clipped = clipped_pixels(patch)
    return 0 if clipped is None else int(np.count_nonzero(clipped & patch.inside(isovalue, cut=True)))


def hidden_peak_moments(area_px: int, moments: Array, px2: Array, residual: float) -> Array:
    """Return the covariance of the peak's sightline about the isophotes' axis, rad^2, shape (2, 2).

    The peak lies somewhere on the clipped plateau, which has the isophotes' shape.

    Parameters
    ----------
    area_px : int
        Pixels of the plateau.
    moments : ndarray, shape (2, 2)
        Second moments of the isophotes, rad^2, of any scale.
    px2 : ndarray, shape (2, 2)
        1 px^2 in squared tangents.
    residual : float
        RMS distance of the innermost isophote from its ellipse, over its radius.
    """
    # a uniform ellipse of area A has moments of determinant (A / 4 pi)^2
    scale = area_px / (4 * math.pi) * math.sqrt(max(float(np.linalg.det(px2)), 0.0))
    size = math.sqrt(max(float(np.linalg.det(moments)), 0.0))
    shape = moments / size if size > 0 else px2 / math.sqrt(float(np.linalg.det(px2)))
    share = PLATEAU_SHARE + BENT_SHARE * min(residual / BENT_RESIDUAL, MOST_BENT) ** 3
    return np.asarray(share * scale * shape)
