"""The bias of assuming a co-located light, where the light is known to be beside the camera.

The picture itself does not show the offset: on a plane 10 mm away, a light 1 mm beside the camera moves the highlight
by 2.8 deg and leaves its isophotes ellipses. No test of the fit finds that; only what is known of the rig does.
"""

from dataclasses import replace

import numpy as np

from simtest.calibration import Priors
from simtest.estimators.bisector import bisect
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import basis_across, tangent_coordinates

AT_CAMERA_MM = 1e-9
"""A light nearer than this to the sightline is on it."""

NEGLIGIBLE = 0.1
"""A squared error below this share of the stated variance is left out."""


def add_light_offset_uncertainty(estimate: Estimate, priors: Priors) -> Estimate:
    """Inflate the covariance for the bias of assuming a co-located light.

    The estimate's normal is the reverse of the highlight's sightline. It is unchanged where no light is known, or all
    are at the camera. Else it gets the flag ``light_offset``. Where the distance is known, the mean square over the
    lights of half their angle at the surface point is added to the covariance; where it is not, the covariance is None,
    since the error may be anything.
    """
    if not priors.lights_mm:
        return estimate
    across = priors.lights @ basis_across(estimate.normal).T
    if np.linalg.norm(across, axis=1).max() < AT_CAMERA_MM:
        return estimate
    flagged = replace(estimate, flags=(*estimate.flags, "light_offset"))
    if priors.distance_mm is None:
        return flagged.without_uncertainty()
    # bias of each light at the surface point
    position = -priors.distance_mm.mean * estimate.normal
    moved = np.array([tangent_coordinates(estimate.normal, bisect(position, light)) for light in priors.lights])
    squares = moved.T @ moved / len(moved)
    if estimate.covariance is None:
        return flagged
    if np.trace(squares) < NEGLIGIBLE * np.trace(estimate.covariance):
        return estimate
    return flagged.with_parts(light_offset=squares)
