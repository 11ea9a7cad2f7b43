"""How far a highlight may be off because it is a near miss, in frames that show many highlights.

Where a surface is rough or folded, a bright spot need not hold a point at which the normal bisects the directions to
light and camera: a minimum of the misfit tau above 0 shines too (theory.md 7.1b). Such a near miss looks like any other
spot, and the estimate is off by abs(tau) in an unknown direction. What the frame tells is its brightness: a Gaussian
lobe of standard deviation s gives a near miss the radiance I0 exp(-abs(tau)^2 / (2 s^2)), with I0 that of a highlight
point at the same place. So

    abs(tau)^2 = 2 s^2 ln(I0 / I).

The brightest of the spots around stands for I0. Smaller spots are also dimmed by the point spread, and clipped ones
are brighter than they look; both are part of what was fitted.
"""

import numpy as np

from simtest.calibration import Priors
from simtest.estimators.budget import Budget
from simtest.geometry import Patch
from simtest.runtime.fitted import fitted_number

CROWD = 3
"""A frame with more highlights than this for each light shows relief or folds: a smooth patch shows one for each."""

AROUND = 12
"""The brightest of so many nearest highlights stands for a highlight point's radiance."""

BRIGHT = np.radians(fitted_number("near_misses.bright")) ** 2
FAINT = np.radians(fitted_number("near_misses.faint")) ** 2
USUAL, MOST = fitted_number("near_misses.usual"), fitted_number("near_misses.most")
RARER = fitted_number("near_misses.rarer")

APART = 3
"""Lights of a larger number are a ring, whose highlights melt: it counts as so many."""

SEVERAL = 0.5
"""Share of the variance under two or three lights. Which light made a highlight is then seldom known, and that error is
as large as the part of the budget that stands for it, or smaller, never several times larger: the sum of both parts
would hold 99 % and more."""

UNTOLD_FAINTNESS = 1.0
"""ln(I0 / I) where the patch does not know how bright the others are; two thirds of the spots have less."""


def near_miss_parts(patch: Patch, priors: Priors) -> Budget:
    """Return the part ``shape`` of a highlight that may be a near miss; a plane that is told has none."""
    variance = 0.0 if priors.plane else near_miss_variance(patch, max(len(priors.lights_mm), 1))
    return {"shape": variance * np.eye(2)} if variance > 0 else {}


def near_miss_variance(patch: Patch, lights: int) -> float:
    """Return the variance of a highlight's normal along each axis by the chance that it is a near miss, rad^2.

    Parameters
    ----------
    patch : Patch
        The highlight, with the frame's other ones.
    lights : int
        How many lights there are, at least 1.

    Returns
    -------
    float
        0 in a frame that does not show more than `CROWD` highlights for each light; where the patch does not know the
        frame's others, that of the usual number.
    """
    count = USUAL if patch.others_px is None else (len(patch.others_px) + 1) / min(lights, APART)
    if count <= CROWD:
        return 0.0
    scale = (USUAL / min(count, MOST)) ** RARER * (SEVERAL if 1 < lights <= APART else 1.0)
    return float(scale * (BRIGHT + FAINT * _faintness(patch)))


def _faintness(patch: Patch) -> float:
    """Return ln(I0 / I) of a highlight, 0 for one that is brighter than those around."""
    values = np.array(patch.others_value)
    if len(values) == 0 or len(values) != len(patch.neighbours_px):
        return UNTOLD_FAINTNESS
    away = np.sum((patch.neighbours_px - patch.peak_px) ** 2, axis=1)
    brightest = float(values[np.argsort(away, kind="stable")[:AROUND]].max())
    return max(float(np.log(brightest / patch.peak_value)), 0.0) if brightest > 0 else 0.0
