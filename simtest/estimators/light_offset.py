"""What a light that is known to be beside the camera means for estimators that take it to be at the camera.

The picture itself does not show it: on a plane 10 mm away a light 1 mm aside moves the highlight by 2.8 deg and leaves
its isophotes ellipses, so that no test of the fit finds it. Only what is known of the rig does.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import Priors
from simtest.estimators.bisector import bisect
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import tangent_basis, tangent_coordinates

Array = npt.NDArray[np.float64]

AT_CAMERA_MM = 1e-9
"""A light nearer than this to the sightline is on it."""

NEGLIGIBLE = 0.1
"""Of the stated variance: a smaller square of the error is left out."""


def add_light_offset_uncertainty(estimate: Estimate, priors: Priors) -> Estimate:
    """Say how far a light beside the camera may have moved a normal that was taken as the reverse of a sightline.

    Parameters
    ----------
    estimate : Estimate
        Its normal is the reverse of the highlight's sightline.
    priors : Priors
        Its lights and distance are used.

    Returns
    -------
    Estimate
        As it was where no light is known, or all are at the camera. Else with the flag ``light_offset``; its covariance
        holds, where a distance is known, the mean square over the lights of half their angle at the surface point,
        and is None where it is not: the error may then be anything.
    """
    if not priors.lights_mm:
        return estimate
    across = priors.lights @ np.stack([basis[0] for basis in tangent_basis(estimate.normal[None])]).T
    if np.linalg.norm(across, axis=1).max() < AT_CAMERA_MM:
        return estimate
    flagged = replace(estimate, flags=(*estimate.flags, "light_offset"))
    if priors.distance_mm is None:
        return replace(flagged, covariance=None)
    position = -priors.distance_mm * estimate.normal
    moved = np.array([tangent_coordinates(estimate.normal, bisect(position, light)) for light in priors.lights])
    squares = moved.T @ moved / len(moved)
    if estimate.covariance is None:
        return flagged
    if np.trace(squares) < NEGLIGIBLE * np.trace(estimate.covariance):
        return estimate
    return replace(flagged, covariance=estimate.covariance + squares)
