"""The closed-form laws that the renders confirm or refute (theory.md sections 3, 4 and 7).

Those of sections 3 and 4 are vectorised over their arguments; those of section 7 are of the glints on a gaussian relief
with light and camera together, lengths in mm, slopes in rad per axis. Angles are in radians; half-axes are tangents of
the half-angles of the back-projected cone. Arguments that recur:

- `kd`, `kd_min`, `kd_max`: d k, distance times signed (principal) curvature;
- `isovalue`: t in (0, 1); `exponent`: n of a Phong lobe;
- `lobe_curvature`: c = -(log f)''(0) of the reflectance, 4 n for Phong;
- `position`, `light`: surface point and light in the camera frame, mm, shape (..., 3).

Laws of the glints on a gaussian relief, light and camera together (section 7), have slopes in rad per axis and gains
m = 1 + d k of the base's principal curvatures.
"""

import math

import numpy as np
import numpy.typing as npt

from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2
from simtest.runtime.arrays import Array


def axis_ratio(kd_min: npt.ArrayLike, kd_max: npt.ArrayLike) -> Array:
    """Compute the isophotes' axis ratio to second order: abs(1 + d k)_min / abs(1 + d k)_max (section 3, item 3).

    abs(1 + d k) is the angle by which the normal turns per angle of the sightline. The ratio lies in [0, 1].
    """
    first, second = np.abs(1 + np.asarray(kd_min, float)), np.abs(1 + np.asarray(kd_max, float))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.minimum(first, second) / np.maximum(first, second))


def isophote_half_axes(
    isovalue: npt.ArrayLike, lobe_curvature: npt.ArrayLike, kd_min: npt.ArrayLike, kd_max: npt.ArrayLike
) -> tuple[Array, Array]:
    """Compute the half-axes of an isophote, second order in the image angle (section 3, items 1 and 3).

    -log t = (c m^2 + 2 m) w^2 / 2 along a principal direction with m = 1 + d k; the 2 m is the falloff with 1/d^2.

    Returns
    -------
    a, b : ndarray
        a >= b, tangents of the half-angles; inf where the isophote does not close.
    """
    c, level = np.asarray(lobe_curvature, float), -2 * np.log(np.asarray(isovalue, float))

    def half_axis(kd: npt.ArrayLike) -> Array:
        m = 1 + np.asarray(kd, float)
        stiffness = c * m**2 + 2 * m
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(stiffness > 0, np.sqrt(level / stiffness), np.inf))

    first, second = half_axis(kd_min), half_axis(kd_max)
    return np.maximum(first, second), np.minimum(first, second)


def isophote_half_width(isovalue: npt.ArrayLike, exponent: npt.ArrayLike, kd: npt.ArrayLike) -> Array:
    """Compute the half-width of a Phong isophote across a circle, at any isovalue (section 3, item 3).

    The light is at the camera. With w the image angle and m = 1 + d k, the law of sines gives
    sin(theta) = abs(m) sin(w) for the angle theta between normal and view, and
    r = (m + 1) / (m cos(w) + cos(theta)) for the distance over d, so that

        log t = n log(1 - 2 m^2 sin^2 w) - 2 log r,

    which `isophote_half_axes` approximates to second order. `kd` is that of the principal section; the half-width is
    inf where the isophote does not close.
    """
    t, n, m = np.broadcast_arrays(*(np.asarray(v, float) for v in (isovalue, exponent, 1 + np.asarray(kd, float))))

    def excess(squared_sine: Array) -> Array:
        """Return log radiance over t, which falls from above 0."""
        cosine, normal = np.sqrt(1 - squared_sine), np.sqrt(1 - m**2 * squared_sine)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Each form where it has no cancellation.
            reach = np.where(m < 0, (m * cosine - normal) / (m - 1), (m + 1) / (m * cosine + normal))
            return np.asarray(n * np.log1p(-2 * m**2 * squared_sine) - 2 * np.log(reach) - np.log(t))

    # Bisection for the squared sine of w.
    with np.errstate(divide="ignore"):
        high = np.minimum(1.0, 1 / (2 * m**2)) * (1 - 1e-12)
    open_ended, low = ~(excess(high) < 0), np.zeros_like(high)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        above = excess(middle) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(open_ended, np.inf, np.sqrt(low / (1 - low)))


_BISECTIONS = 60
"""Halvings that narrow an interval down to rounding."""


def axis_ratio_seen(
    isovalue: npt.ArrayLike,
    exponent: npt.ArrayLike,
    kd_min: npt.ArrayLike,
    kd_max: npt.ArrayLike,
    smoothing_px: npt.ArrayLike = 0.0,
    pixel: npt.ArrayLike = 0.0,
) -> Array:
    """Compute the axis ratio of an isophote as it is traced: `axis_ratio` with its corrections (section 3, item 3).

    Falloff and finite isovalue are those of `isophote_half_width`. Smoothing by s and the linear interpolation between
    pixels widen both squared half-axes alike (section 4, smoothing): by -2 ln t s^2 + (-2 ln t - 1) v, v = 1/6 px^2.
    `pixel` is the angle of a pixel at the BP, rad; 0: a picture without pixels. The ratio lies in (0, 1]; it is NaN
    where the isophote does not close.
    """
    # Added to both squared half-axes.
    level = -2 * np.log(np.asarray(isovalue, float))
    s2 = np.asarray(smoothing_px, float) ** 2
    added = (level * s2 + (level - 1) * LINEAR_INTERPOLATION_PX2) * np.asarray(pixel, float) ** 2
    # Both principal sections at once: each bisection is many small steps.
    t, n, added, *kd = np.broadcast_arrays(
        *(np.asarray(values, float) for values in (isovalue, exponent, added, kd_min, kd_max))
    )
    first, second = isophote_half_width(t, n, np.stack(kd)) ** 2 + added
    smaller, larger = np.minimum(first, second), np.maximum(first, second)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(larger), np.sqrt(smaller / larger), np.nan)


def circle_pose_error(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Compute the error of circle pose on a curved surface (section 4): sin(error) = sqrt((1 - (b/a)^2)/(1 + b^2)).

    a >= b are the half-axes. The error is the angle between either candidate and the true normal, rad; NaN where the
    isophote does not close.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(a), np.arcsin(np.sqrt(np.clip((1 - (b / a) ** 2) / (1 + b**2), 0, 1))), np.nan)


def offset_error(eps_over_d: npt.ArrayLike) -> Array:
    """Compute the sightline's error under light offset, rad (section 4): about atan(eps_perp / d) / 2.

    `eps_over_d` is the light offset perpendicular to the sightline, over the distance.
    """
    return np.asarray(np.arctan(np.asarray(eps_over_d, float)) / 2)


def bisector_angle(position: npt.ArrayLike, light: npt.ArrayLike) -> Array:
    """Compute half the angle between light and camera at a surface point, rad: the exact form of `offset_error`."""
    P = np.asarray(position, float)
    to_light = np.asarray(light, float) - P
    sine = np.linalg.norm(np.cross(-P, to_light), axis=-1)
    return np.asarray(np.arctan2(sine, np.sum(-P * to_light, axis=-1)) / 2)


def vignetting_shift(
    off_axis: npt.ArrayLike,
    power: npt.ArrayLike,
    lobe_curvature: npt.ArrayLike,
    kd: npt.ArrayLike = 0.0,
    isovalue: npt.ArrayLike = 1.0,
) -> Array:
    """Compute the error that unknown falloff cos^k about the optical axis causes, rad (section 4).

    With w the image angle away from the axis and m = 1 + d k, equal in all directions,
    -log I = (c m^2 + 2 m) w^2 / 2 - k log(cos(phi + w)), so the peak moves towards the axis by
    k tan(phi) / (c m^2 + 2 m + k + k tan(phi)^2); for small k and phi that is k tan(phi) / (4 n + 2) on a plane.
    The axis of the cone of an isophote of half-width r about that peak moves by 1 / (1 + r^2) of it.

    Parameters
    ----------
    off_axis : array_like
        phi, angle of the highlight from the optical axis, rad.
    power : array_like
        k; vignetting's and emission's add up.
    lobe_curvature : array_like
        c.
    kd : array_like
        d times both principal curvatures, which are equal.
    isovalue : array_like
        t in (0, 1]; 1 is the peak.

    Returns
    -------
    ndarray
        Angle, rad, >= 0; NaN where there is no peak.
    """
    k, m = np.asarray(power, float), 1 + np.asarray(kd, float)
    tangent, across = np.tan(np.asarray(off_axis, float)), np.asarray(lobe_curvature, float) * m**2 + 2 * m + k
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.where(across > 0, k * tangent / (across + k * tangent**2), np.nan)
        return np.asarray(shift / (1 - 2 * np.log(np.asarray(isovalue, float)) / across))


def branch_point_error(ratio_error: npt.ArrayLike) -> Array:
    """Compute the tilt, rad, that circle pose makes of a small error of a round cone's axes (section 4): sqrt(2 delta).

    `ratio_error` is delta = 1 - b/a of a cone that should be right-circular.
    """
    return np.asarray(np.sqrt(2 * np.asarray(ratio_error, float)))


def bisector_residual(position: npt.ArrayLike, light: npt.ArrayLike, distance_error: npt.ArrayLike) -> Array:
    """Compute the error of the bisector of light and camera for a wrong distance, rad (section 4).

    It is the difference of the angles between bisector and sightline, which all lie in one plane. `distance_error`,
    shape (...), is a share of the distance, > -1.
    """
    P = np.asarray(position, float)
    moved = P * (1 + np.asarray(distance_error, float))[..., None]
    return np.asarray(np.abs(bisector_angle(moved, light) - bisector_angle(P, light)))


def look_error(miss: npt.ArrayLike, kd_min: npt.ArrayLike, kd_max: npt.ArrayLike) -> Array:
    """Compute the error of a miss w against the normal where the estimate looks, rad (section 4): abs((I + d S) w).

    Against the normal at the BP it is abs(w). `miss`, shape (..., 2), is w along the principal directions of k_min and
    k_max, rad.
    """
    w = np.asarray(miss, float)
    return np.hypot((1 + np.asarray(kd_min, float)) * w[..., 0], (1 + np.asarray(kd_max, float)) * w[..., 1])


Gains = tuple[float, float]
"""1 + d k of both principal curvatures of the base."""

NODES = 48
"""Of the quadrature along each of the Hessian's three independent components."""

CENTROID_FACTORS = (1.3, 1.8)
"""What stands in place of 1.25 in `independent_centroid_error` for glints of one relief, from and to (7.5)."""


def glint_count(slope: float, wavelength: float, distance: float, gains: Gains = (1.0, 1.0)) -> float:
    """Return the expected number of glints of a whole cloud: E abs(det(M/d - H)) d^2 / abs(det M) (7.2).

    The Hessian H of an isotropic field is independent of its slope at a point. With m4 = 2 slope^2 (2 pi/wavelength)^2
    its mean (H11 + H22)/2 has variance m4/4, its half-difference and H12 have m4/8 each. The expectation is exact but
    for its quadrature.
    """
    m4 = 2 * slope**2 * (2 * math.pi / wavelength) ** 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    mean, half, mixed = np.meshgrid(
        nodes * math.sqrt(m4 / 4), nodes * math.sqrt(m4 / 8), nodes * math.sqrt(m4 / 8), indexing="ij"
    )
    first, second = (gain / distance for gain in gains)
    determinant = (first - mean - half) * (second - mean + half) - mixed**2
    expected = np.einsum("i,j,k,ijk->", weights, weights, weights, np.abs(determinant))
    return float(expected * distance**2 / abs(gains[0] * gains[1]))


def cloud_covariance(slope: float, distance: float, gains: Gains = (1.0, 1.0)) -> Array:
    """Return the covariance of a cloud of glints in the base's tangent plane, mm^2: d^2 M^-1 Sigma M^-T (7.1)."""
    return np.diag([(distance * slope / gain) ** 2 for gain in gains])


def cloud_axis_ratio(gains: Gains) -> float:
    """Return the minor over the major axis of a cloud on isotropic relief (7.1)."""
    low, high = sorted(abs(gain) for gain in gains)
    return low / high


def relief_error(slope: npt.ArrayLike) -> Array:
    """Return the mean error of a glint's fine normal against the base's at the same point, rad (7.4).

    sqrt(pi/2) s, about 1.25 s, the mean of a Rayleigh distribution: over all glints of a cloud that is wholly in view,
    whatever the estimator, the curvature and the distance. `slope` is s, the standard deviation of an isotropic
    gaussian relief's slope along one direction, rad.
    """
    return np.asarray(np.sqrt(np.pi / 2) * np.asarray(slope, float))


def relief_error_share(error: npt.ArrayLike, slope: npt.ArrayLike) -> Array:
    """Return the share of a cloud's glints whose error against the base is below `error`, rad (7.4).

    Rayleigh: 1 - exp(-(error/s)^2 / 2); `slope` as in `relief_error`.
    """
    return np.asarray(-np.expm1(-((np.asarray(error, float) / np.asarray(slope, float)) ** 2) / 2))


def independent_centroid_error(slope: npt.ArrayLike, count: npt.ArrayLike, gains: Gains = (1.0, 1.0)) -> Array:
    """Return the mean error of the mean sightline of so many glints, rad, if they were independent (7.5).

    1.25 s / sqrt(N) on a plane. A glint's sightline is off the base's highlight by M^-1 times its slope (7.1), so on a
    bent base it is E abs(M^-1 g) / sqrt(N) of a gaussian g, a complete elliptic integral. Glints of one relief are not
    independent; `CENTROID_FACTORS` hold what was measured in place of 1.25.
    """
    from scipy.special import ellipe

    low, high = sorted(abs(gain) for gain in gains)
    mean = math.sqrt(2 / math.pi) * float(ellipe(1 - (low / high) ** 2)) / low
    return np.asarray(mean * np.asarray(slope, float) / np.sqrt(np.asarray(count, float)))
