"""Two pictures of a highlight from known positions distinguish convex from concave [Z89].

With light and camera at one position the highlight follows the camera over the surface: with a motion delta across the
sightline the BP moves by u = (I + dS)^-1 delta, and its normal, hence its sightline, by dS u / d. One picture gives the
sizes of 1 + d k (theory.md section 3, item 3), the motion their signs.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.calibration import Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array
from simtest.geometry.vectors import basis_across, tangent_coordinates

GAIN_SD = 0.03
"""Default relative standard deviation of the first picture's abs(1 + d k)."""

LEAST_SD = 1e-4
"""Standard deviation of a normal that states none, rad, and least allowance for the patch's third order."""

CLEAR = 9.21
"""Difference of two squared Mahalanobis distances that 1 % of normal pairs exceed by chance."""

STEPS = 30
STEP = 1e-5


@dataclass(frozen=True)
class RankedHypotheses:
    """The curvatures that one picture allows, ordered by how well they explain the second one.

    Parameters
    ----------
    hypotheses : ndarray, shape (H, 2)
        1 + d k along the first picture's principal directions, the best first.
    distance2 : ndarray, shape (H,)
        Squared Mahalanobis distance of the second picture's normal from the predicted one; inf where the patch has no
        highlight nearby for the second position.
    predicted : ndarray, shape (H, 3)
        Predicted normals in the second camera's frame; NaN where there is none.
    """

    hypotheses: Array
    distance2: Array
    predicted: Array

    @property
    def margin(self) -> float:
        """Distance of the second best less that of the best: twice the log of their likelihood ratio."""
        return float(self.distance2[1] - self.distance2[0])

    @property
    def is_clear(self) -> bool:
        """Whether the best one stands clear of all others."""
        return self.margin > CLEAR


def rank_by_motion(
    first: Estimate, second: Estimate, second_from_first: npt.ArrayLike, priors: Priors, gain_sd: float = GAIN_SD
) -> RankedHypotheses | Failure:
    """Rank the first picture's curvature hypotheses by the highlight's position in a second picture.

    Each hypothesis is a quadric patch, on which the point is solved whose normal points at the second camera. A motion
    along one principal direction determines that direction's sign alone: two hypotheses then remain equally good.

    Parameters
    ----------
    first : Estimate
        Of `curved` or `inverse_rendering` with the lobe known, so that it has hypotheses.
    second : Estimate
        Of the same highlight, of any estimator for a light at the camera.
    second_from_first : array_like, shape (4, 4)
        The camera's motion: from the first camera's frame to the second one's, mm.
    priors : Priors
        For the distance in the first picture; without it, or hypotheses, a Failure ``not_known``.
    gain_sd : float
        Relative standard deviation of the first picture's abs(1 + d k), > 0.

    Raises
    ------
    InputError
        If the motion is not rigid.
    """
    R, t = _motion(second_from_first)
    if first.curvature is None or first.curvature.hypotheses is None or priors.distance_mm is None:
        return Failure(Reason.NOT_KNOWN, "needs curvature hypotheses of the first picture, and its distance")
    position, distance = -R.T @ t, priors.distance_mm
    seen = R.T @ second.normal
    hypotheses, distances, predictions = first.curvature.hypotheses, [], []
    spread = np.array([1.0, 1.0, distance.sd / distance.mean, gain_sd, gain_sd])
    for gains in hypotheses:
        # predict the second picture's normal
        values = np.array([0.0, 0.0, distance.mean, *gains])
        predicted = _predicted(first, values, position)
        if predicted is None:
            distances.append(np.inf)
            predictions.append(np.full(3, np.nan))
            continue
        # its distance from the one seen, by the noise of both, distance and gains
        sources = _covariance_of_sources(first, spread)
        J = _jacobian(first, values, position, predicted)
        covariance = _turned(second, R, predicted) + LEAST_SD**2 * np.eye(2)
        if J is not None:
            covariance = covariance + J @ sources @ J.T
        miss = tangent_coordinates(predicted, seen)
        distances.append(float(miss @ np.linalg.solve(covariance, miss)))
        predictions.append(R @ predicted)
    order = np.argsort(distances, kind="stable")
    return RankedHypotheses(hypotheses[order], np.array(distances)[order], np.array(predictions)[order])


def _motion(second_from_first: npt.ArrayLike) -> tuple[Array, Array]:
    """Return rotation and translation of a rigid motion, checked."""
    T = np.asarray(second_from_first, dtype=float)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"second_from_first: shape {T.shape}; must be a finite 4 x 4 matrix")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError("second_from_first: must be a rotation and a translation")
    return R, T[:3, 3]


def _predicted(first: Estimate, values: Array, position: Array) -> Array | None:
    """Solve for the patch's normal that points at a position; None where Newton's method finds none.

    `values`: rotation of the first normal in its tangent basis (2), rad, distance, and 1 + d k (2).
    """
    assert first.curvature is not None
    turned, distance, gains = values[:2], values[2], values[3:]
    N = first.normal + turned @ basis_across(first.normal)
    N /= np.linalg.norm(N)
    e = first.curvature.directions[0] - (first.curvature.directions[0] @ N) * N
    e /= np.linalg.norm(e)
    across = np.stack([e, np.cross(N, e)])
    # In units of the distance the first camera is at (0, 0, 1), the second one at v.
    v = np.append(across @ position, N @ position) / distance + [0.0, 0.0, 1.0]
    K = gains - 1
    x = v[:2] / gains
    # Newton's method for the point x whose normal points at v, from the linear solution
    for _ in range(STEPS):
        height = v[2] + np.sum(K * x * x) / 2
        off = v[:2] - x - height * K * x
        slope = -np.diag(1 + height * K) - np.outer(K * x, K * x)
        try:
            step = np.linalg.solve(slope, off)
        except np.linalg.LinAlgError:
            return None
        x = x - step
        if not np.isfinite(x).all() or np.abs(x).max() > 10:  # diverged, or far off the patch
            return None
        if np.abs(step).max() < 1e-12:
            normal = np.append(K * x, 1.0)
            return np.asarray(normal @ np.concatenate([across, N[None]]) / np.linalg.norm(normal))
    return None


def _jacobian(first: Estimate, values: Array, position: Array, predicted: Array) -> Array | None:
    """Differentiate the predicted normal, in its tangent basis, by rotation (2), log d and log(1 + d k); (2, 5)."""
    basis, columns = basis_across(predicted), []
    for i in range(5):
        step = np.zeros(5)
        step[i] = STEP if i < 2 else STEP * values[i]
        moved = _predicted(first, values + step, position)
        if moved is None:
            return None
        columns.append(basis @ (moved - predicted) / STEP)
    return np.stack(columns, axis=1)


def _covariance_of_sources(first: Estimate, spread: Array) -> Array:
    """Return the covariance of what the prediction depends on, in the order of `_jacobian`, shape (5, 5)."""
    made = np.diag(spread**2)
    made[:2, :2] = LEAST_SD**2 * np.eye(2) if first.covariance is None else first.covariance
    return made


def _turned(second: Estimate, R: Array, predicted: Array) -> Array:
    """Return the second normal's covariance in the predicted one's tangent basis, first camera's frame."""
    if second.covariance is None:
        return np.zeros((2, 2))
    turn = basis_across(predicted) @ (basis_across(second.normal) @ R).T
    return np.asarray(turn @ second.covariance @ turn.T)
