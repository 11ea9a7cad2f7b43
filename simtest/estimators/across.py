"""A normal as the camera sees it: its tilt, and its covariance across the view."""

import numpy as np

from simtest.estimators.protocol import Estimate
from simtest.geometry import Array, chi_squared
from simtest.geometry.vectors import basis_across

CHI95 = chi_squared.quantile(0.95, 2)
"""Of a covariance across the view: the ellipse of this squared Mahalanobis distance holds 95 % of the errors."""


def tilt_deg(estimate: Estimate) -> float:
    """Return the angle between the normal and the direction against the optical axis, deg."""
    return float(np.degrees(np.arccos(np.clip(-estimate.normal[2], -1, 1))))


def covariance_across(estimate: Estimate) -> Array | None:
    """Return the covariance of the normal's x and y, camera frame, shape (2, 2); None where none is stated."""
    if estimate.covariance is None:
        return None
    # The stated one is that of the tangent plane, whose two directions are the rows.
    basis = basis_across(estimate.normal)[:, :2]
    return np.asarray(basis.T @ estimate.covariance @ basis)
