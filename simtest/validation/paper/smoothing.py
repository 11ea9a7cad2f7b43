"""Predicts the bias of circle pose under smoothing: its error without noise (docs/concepts/theory.md, section 4)."""

import numpy as np

from simtest.errors import Failure
from simtest.geometry.cones import circle_pose
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2
from simtest.geometry.vectors import tangent_coordinates
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.isocurves import isophote_radius
from simtest.validation.paper.slanted_view import plane_from_image

MARGIN_WIDTHS = 2.0
"""The texture's window must go on for this many smoothing widths beyond the isophote for the law to hold."""


def smoothing_bias(setting: PaperSetting) -> float | None:
    """Predict the error of circle pose without noise, light at V.

    Let E be the matrix of second moments of the exact isophote's ellipse, p^T E^-1 p = 1 about its centre. The lobe
    that has this ellipse at t is Gaussian to second order, of covariance E / (-2 ln t). Smoothing by s adds s^2 I to
    the covariance, and t stays relative to the smoothed peak, so that

        E' = E + (-2 ln t) s^2 I + v (-2 ln t - 1) I,   v = 1/6 px^2.

    The last term is the contour's linear interpolation between pixels: at the ends of the axes it blurs along the axis,
    by the variance v, but leaves the peak, a pixel's value, as it is. Circle pose of E' misses the true normal.

    Parameters
    ----------
    setting : PaperSetting
        Its `sigma` does not enter.

    Returns
    -------
    float or None
        Error of the better candidate, rad; None with the light off V, or where the texture's window ends less than
        `MARGIN_WIDTHS` smoothing widths beyond the isophote.
    """
    radius = isophote_radius(setting.isovalue, setting.exponent, setting.height)
    if setting.eps > 0 or not _window_goes_on(setting, radius):
        return None
    # E of the exact isophote, a circle on the plane.
    H = plane_from_image(setting)
    C = H.T @ np.diag([1.0, 1.0, -(radius**2)]) @ H
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    level = -(C[2, 2] + C[:2, 2] @ centre)
    # E' with smoothing and interpolation.
    spread = -2 * np.log(setting.isovalue)
    added = spread * setting.smoothing_px**2 + LINEAR_INTERPOLATION_PX2 * (spread - 1)
    E = np.linalg.inv(C[:2, :2] / level) + added * np.eye(2)
    if np.linalg.eigvalsh(E)[0] <= 0:
        return None
    # Camera coordinates about the ellipse's centre: no digits are lost to the centre's distance from the origin.
    to_centre = np.array([[1.0, 0.0, -centre[0]], [0.0, 1.0, -centre[1]], [0.0, 0.0, 1.0]]) @ setting.camera.K
    smoothed = np.zeros((3, 3))
    smoothed[:2, :2], smoothed[2, 2] = np.linalg.inv(E), -1.0
    pose = circle_pose(to_centre.T @ smoothed @ to_centre)
    if isinstance(pose, Failure):
        return None
    return float(min(np.linalg.norm(tangent_coordinates(normal, setting.normal)) for normal in pose.normals))


def _window_goes_on(setting: PaperSetting, radius: float) -> bool:
    """Return whether the texture's window ends at least `MARGIN_WIDTHS` smoothing widths beyond the isophote."""
    half = setting.size / 2
    if radius >= half:
        return False
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    points = np.concatenate([np.stack([radius * directions, half * directions]), np.ones((2, 3, 1))], axis=-1)
    seen = points @ np.linalg.inv(plane_from_image(setting)).T
    if np.any(seen[..., 2] <= 0):
        return False
    on_isophote, on_edge = seen[..., :2] / seen[..., 2:]
    gaps = np.linalg.norm(on_edge - on_isophote, axis=-1)
    return bool(np.all(gaps >= MARGIN_WIDTHS * setting.smoothing_px))
