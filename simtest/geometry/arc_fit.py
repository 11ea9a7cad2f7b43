"""Gradient-weighted ellipse fit [Sampson 1982] of contours that are seen in part.

The direct algebraic fit weights points by the conic's gradient. Where a part of the contour is missing, that shortens
the ellipse on the missing side (theory.md section 6). Here each residual is the distance from the conic to first order.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason
from simtest.geometry.ellipse_fit import MAX_AXIS_RATIO, FittedConic, fit_ellipse
from simtest.runtime.arrays import Array

MIN_ARC_RAD = np.radians(120.0)
"""Shorter arcs do not determine the ellipse: at this length the centre is already a hundred times as noisy as that of
a whole ellipse."""

MAX_EVALUATIONS = 30
TOLERANCE = 1e-10


@dataclass(frozen=True)
class FittedArc:
    """An ellipse fitted to a part of its contour.

    Parameters
    ----------
    conic : FittedConic
        As of `simtest.geometry.fit_ellipse`.
    arc : float
        Range of eccentric anomalies that the points cover: 2 pi less their largest gap, rad.
    residual : float
        RMS distance of the points from the ellipse over the ellipse's mean radius, sqrt(a b).
    """

    conic: FittedConic
    arc: float
    residual: float


def fit_arc(points: npt.ArrayLike) -> FittedArc | Failure:
    """Fit an ellipse to an arc, array_like of shape (N, 2): the least sum of `(F / |grad F|)^2`, F the conic's value.

    The ellipse is `|L^T (x - c)| = 1` with L lower triangular, so every step stays an ellipse. The direct fit is the
    starting point. A Failure where `fit_ellipse` fails, where the fit does not converge to an ellipse, and, with the
    reason ``too_few_points``, for arcs shorter than 120 deg.

    Raises
    ------
    InputError
        If the points are no numbers of shape (N, 2).
    """
    # start: the direct fit, in its centred and scaled coordinates
    start = fit_ellipse(points)
    if isinstance(start, Failure):
        return start
    T = start.normalised_from_image
    xy = np.asarray(points, dtype=float) @ T[:2, :2].T + T[:2, 2]
    C = start.normalised
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    L = np.linalg.cholesky(C[:2, :2] / -(C[2, 2] + C[:2, 2] @ centre))
    first = np.array([*centre, L[0, 0], L[1, 0], L[1, 1]])
    # Imported here: it takes longer to load than a picture to reconstruct, and not every picture has arcs.
    from scipy.optimize import least_squares

    # refine by Levenberg and Marquardt's method
    with np.errstate(all="ignore"):
        # Residuals that are not finite make least_squares raise a ValueError.
        try:
            found = least_squares(
                lambda p: _residuals(xy, p)[0], first, lambda p: _residuals(xy, p)[1], method="lm",
                xtol=TOLERANCE, ftol=TOLERANCE, gtol=TOLERANCE, max_nfev=MAX_EVALUATIONS,
            )  # fmt: skip
        except ValueError:
            return Failure(Reason.NOT_CONVERGED, "the arc's fit left the ellipses")
    if not found.success:
        return Failure(Reason.NOT_CONVERGED, "the arc's fit did not converge")
    return _checked_arc(xy, found.x, T, float(np.sqrt(np.mean(found.fun**2))))


def angular_extent(vectors: Array) -> float:
    """Return the angle that vectors, shape (N, 2), cover around the origin: 2 pi less their largest gap, rad."""
    phases = np.sort(np.arctan2(vectors[:, 1], vectors[:, 0]))
    return 2 * np.pi - float(np.max(np.diff(phases, append=phases[0] + 2 * np.pi)))


def _residuals(xy: Array, parameters: Array) -> tuple[Array, Array]:
    """Return F / |grad F| of each point, shape (N,), and its derivatives, shape (N, 5)."""
    L = np.array([[parameters[2], 0.0], [parameters[3], parameters[4]]])
    y = xy - parameters[:2]
    u = y @ L
    F = np.sum(u * u, axis=1) - 1
    g = 2 * u @ L.T
    size = np.sqrt(np.sum(g * g, axis=1))
    by_F, by_g = 1 / size, -(F / size**3)[:, None] * g
    J = np.empty((len(xy), 5))
    J[:, :2] = -by_F[:, None] * g - 2 * by_g @ (L @ L.T)
    turned = by_g @ L
    for column, (i, j) in enumerate(((0, 0), (1, 0), (1, 1)), start=2):
        # F moves by 2 u_j y_i with L_ij, grad F by 2 (e_i u_j + L e_j y_i).
        J[:, column] = 2 * (by_F * u[:, j] * y[:, i] + by_g[:, i] * u[:, j] + turned[:, j] * y[:, i])
    return F / size, J


def _checked_arc(xy: Array, parameters: Array, T: Array, rms: float) -> FittedArc | Failure:
    """Return the fitted arc, or a Failure where the conic is no ellipse or the arc too short."""
    centre = parameters[:2]
    L = np.array([[parameters[2], 0.0], [parameters[3], parameters[4]]])
    Q = L @ L.T
    # reject what is no ellipse, or one so long that it is a line
    low, high = np.linalg.eigvalsh(Q) if np.isfinite(Q).all() else (np.nan, np.nan)
    if not (np.isfinite(centre).all() and low > 0 and high <= MAX_AXIS_RATIO**2 * low):
        return Failure(Reason.NOT_AN_ELLIPSE, "the arc's conic is no ellipse")
    u = (xy - centre) @ L
    arc = angular_extent(u)
    if arc < MIN_ARC_RAD:
        least = np.degrees(MIN_ARC_RAD)
        return Failure(Reason.TOO_FEW_POINTS, f"an arc of {np.degrees(arc):.0f} deg; at least {least:.0f} are needed")
    # (x - c)^T Q (x - c) = 1 as a homogeneous conic
    linear = -Q @ centre
    C = np.array([[*Q[0], linear[0]], [*Q[1], linear[1]], [*linear, centre @ Q @ centre - 1]])
    return FittedArc(FittedConic(C / np.linalg.norm(C), T), arc, rms * float(low * high) ** 0.25)
