"""What is predicted of the published protocol: the bias of circle pose under smoothing, and the Cramer-Rao bound."""

import numpy as np

from simtest.errors import Failure
from simtest.geometry.cones import circle_pose
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime.arrays import Array, Mask
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.isocurves import isophote_radius
from simtest.validation.paper.protocol import plane_from_image, region_of_interest

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


_STEPS = np.array([1e-5, 1e-5, 1e-2, 1e-2, 1e-4, 1e-2, 1e-3])
"""Central-difference steps of the parameters: tilts (rad), BP (px), log scale, n, c."""


MOST_CONDITION = 1e13
"""Largest condition of the scaled information matrix: beyond it the inverse is rounding."""

LARGEST_RAD = 0.5
"""The bound holds for small angles."""


def cramer_rao_bound(setting: PaperSetting) -> float | None:
    """Compute the bound on the RMS angle between estimated and true normal (theory.md section 2).

    The frame is c max(0, cos beta)^n on the slanted plane with white noise. Unknown are two tilts, the BP (two), the
    scale of the scene, n and c. Scale and n are nearly degenerate, which does not affect the normal. Light at V; the
    setting's `eps`, `isovalue` and `smoothing_px` do not enter.

    Returns
    -------
    float or None
        rad; 0 without noise; None where the frame does not determine the parameters, or only to half a radian.
    """
    if setting.sigma == 0:
        return 0.0
    # Jacobian of the frame by central differences.
    nominal = np.array([0.0, 0.0, 0.0, 0.0, 0.0, setting.exponent, 1.0])
    inside = _inside_window(setting)
    columns = []
    for index, step in enumerate(_STEPS):
        change = np.zeros(len(nominal))
        change[index] = step
        difference = _model(setting, nominal + change) - _model(setting, nominal - change)
        columns.append((difference / (2 * step))[inside])
    J = np.stack(columns, axis=1)
    # Fisher information.
    information = J.T @ J / setting.sigma**2
    diagonal = np.diag(information)
    if not (np.isfinite(diagonal).all() and (diagonal > 0).all()):
        return None
    # Scaled to unit diagonal: the parameters' units differ by orders of magnitude.
    scale = 1 / np.sqrt(diagonal)
    scaled = information * scale[:, None] * scale
    if np.linalg.cond(scaled) > MOST_CONDITION:
        return None
    covariance = np.linalg.inv(scaled) * scale[:, None] * scale
    bound = float(np.sqrt(covariance[0, 0] + covariance[1, 1]))
    return bound if bound < LARGEST_RAD else None


def _sightlines(setting: PaperSetting) -> Array:
    """Return the sightlines of the region of interest's pixels at unit depth, shape (h, w, 3)."""
    x, y, width, height = region_of_interest(setting)
    pixels = setting.camera.pixel_centres()[y : y + height, x : x + width]
    xy = (pixels - setting.size / 2) / setting.size
    return np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)


def _model(setting: PaperSetting, parameters: Array) -> Array:
    """Compute the frame of a plane through V_Z times the BP's sightline; the tilts turn its normal."""
    tilt_x, tilt_y, bp_x, bp_y, log_scale, exponent, peak = parameters
    first = np.array([1.0, 0.0, 0.0])
    normal = setting.normal + tilt_x * first + tilt_y * np.cross(setting.normal, first)
    normal /= np.linalg.norm(normal)
    foot = setting.height * np.array([bp_x / setting.size, bp_y / setting.size, 1.0])
    rays = _sightlines(setting)
    points = rays * ((normal @ foot) / (rays @ normal))[..., None]
    squared = np.sum((points - foot) ** 2, axis=-1)
    height2 = (setting.height * np.exp(log_scale)) ** 2
    cosine = (height2 - squared) / (height2 + squared)
    return np.asarray(peak * np.maximum(cosine, 0) ** exponent)


def _inside_window(setting: PaperSetting) -> Mask:
    """Return which pixels see the texture's window in front of the camera, shape (h, w) like the sightlines."""
    rays = _sightlines(setting)
    theta, centre = np.radians(setting.theta_deg), np.array([0.0, 0.0, setting.height])
    depth = (setting.normal @ centre) / (rays @ setting.normal)
    points = rays * depth[..., None] - centre
    half = setting.size / 2
    y = points @ np.array([0.0, np.cos(theta), np.sin(theta)])
    return np.asarray((depth > 0) & (np.abs(points[..., 0]) < half) & (np.abs(y) < half))
