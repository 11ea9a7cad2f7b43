"""The Cramer-Rao bound of the published protocol: how well any unbiased method could do on its frames."""

import numpy as np

from simtest.runtime.arrays import Array, Mask
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.slanted_view import region_of_interest

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
