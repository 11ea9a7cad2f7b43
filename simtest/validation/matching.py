"""Matches detections, which come from the frame alone, to the true highlights."""

import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.errors import Failure
from simtest.geometry.isophotes import encloses
from simtest.reconstruction.pipeline import Specularity
from simtest.simulation.true_highlights import JudgedHighlight


def match(specularities: list[Specularity], truths: list[JudgedHighlight]) -> dict[int, int]:
    """Match each detection to the nearest true BP inside its isophote at t = 0.5 (theory.md section 6).

    Parameters
    ----------
    specularities : list of Specularity
        Detections.
    truths : list of JudgedHighlight
        The highlights that count as true.

    Returns
    -------
    dict
        Index of the truth by index of the detection; each truth is given to the nearest of its detections only.
    """
    pairs = []
    for i, specularity in enumerate(specularities):
        for j, truth in enumerate(truths):
            if _holds(specularity, truth.highlight.bp_px):
                peak = _peak(specularity)
                pairs.append((float(np.hypot(*(truth.highlight.bp_px - peak))), i, j))
    matched: dict[int, int] = {}
    for _, i, j in sorted(pairs):
        if i not in matched and j not in matched.values():
            matched[i] = j
    return matched


def _peak(specularity: Specularity) -> np.ndarray:
    """Give a detection's peak, px: sub-pixel where there is a patch."""
    if isinstance(specularity.patch, Failure):
        return np.array(specularity.region.peak) + PIXEL_CENTRE
    return specularity.patch.peak_px


def _holds(specularity: Specularity, point: np.ndarray) -> bool:
    """Tell whether a detection's isophote encloses a point; where it does not close, its region decides."""
    contour = (
        specularity.patch if isinstance(specularity.patch, Failure) else specularity.patch.isophote(HIGHLIGHT_ISOVALUE)
    )
    if not isinstance(contour, Failure):
        return encloses(contour, point)
    x, y, width, height = specularity.region.box
    return bool(x <= point[0] <= x + width and y <= point[1] <= y + height)
