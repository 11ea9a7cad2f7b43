"""The quadric patch of one curvature hypothesis, and the normal that it shows to a camera elsewhere [Z89]."""

from dataclasses import dataclass

import numpy as np

from simtest.estimators.protocol import Estimate
from simtest.geometry import Array
from simtest.geometry.vectors import basis_across

STEPS = 30
STEP = 1e-5

SOURCES = ("rotation", "rotation", "log distance", "log gain", "log gain", "turn of the principal directions")
"""What predictions of one first picture share, in the order of `FirstPicture.jacobian`; rad, or shares."""

MOST_TURN = 0.5
"""Greatest standard deviation of the principal directions, rad; those of a round highlight are not known at all."""


@dataclass(frozen=True)
class Prediction:
    """What a patch shows to a camera at another position.

    Parameters
    ----------
    position : ndarray, shape (3,)
        Of the camera, mm, first camera's frame.
    normal : ndarray, shape (3,)
        That points at it, unit, first camera's frame.
    place : ndarray, shape (2,)
        Of its point along the principal directions, in units of the first picture's distance.
    curvatures : ndarray, shape (2,)
        d k of the patch.
    """

    position: Array
    normal: Array
    place: Array
    curvatures: Array

    def shape_sd(self, change_sd: float) -> float:
        """Return how far a surface's normal may be from the patch's at the predicted place, rad per axis.

        The curvatures may change by a share of `change_sd` over the distance d (third order), and a sphere's normal
        differs from its paraboloid's by (k u)^3 / 2 (fourth order).
        """
        bend, reach = float(np.abs(self.curvatures).max()), float(np.linalg.norm(self.place))
        return change_sd * bend * reach**2 / 2 + (bend * reach) ** 3 / 2


@dataclass(frozen=True)
class FirstPicture:
    """The first picture's highlight under one hypothesis.

    Parameters
    ----------
    first : Estimate
        With curvature.
    distance : float
        Of the surface, mm.
    gains : ndarray, shape (2,)
        1 + d k along its principal directions.
    """

    first: Estimate
    distance: float
    gains: Array

    def predict(self, position: Array) -> Prediction | None:
        """Solve for the patch's normal that points at a position; None where Newton's method finds none."""
        return self._predict(position, np.zeros(6))

    def jacobian(self, at: Prediction) -> Array | None:
        """Differentiate a predicted normal, in its tangent basis, by `SOURCES`, shape (2, 6)."""
        basis, columns = basis_across(at.normal), []
        for step in STEP * np.eye(6):
            moved = self._predict(at.position, step)
            if moved is None:
                return None
            columns.append(basis @ (moved.normal - at.normal) / STEP)
        return np.stack(columns, axis=1)

    def by_position(self, at: Prediction) -> Array:
        """Differentiate a predicted normal, in its tangent basis, by the camera's position, 1/mm, shape (2, 3)."""
        basis, columns = basis_across(at.normal), []
        for step in STEP * self.distance * np.eye(3):
            moved = self._predict(at.position + step, np.zeros(6))
            columns.append(np.zeros(2) if moved is None else basis @ (moved.normal - at.normal))
        return np.stack(columns, axis=1) / (STEP * self.distance)

    def sources(self, covariance: Array, distance_sd: float, gain_sd: float, lobe_sd: float = 0.0) -> Array:
        """Return the covariance of `SOURCES`, shape (6, 6).

        Noise that changes the gains by `gain_sd` turns the axes of the highlight's second moments by
        sqrt(2) gain_sd r / (1 - r^2), with r the axis ratio: those of a round highlight are not known. A lobe that is
        not known exactly changes both gains alike, by `lobe_sd`.
        """
        low, high = np.sort(np.abs(self.gains))
        ratio = float(low / high)
        turn = min(MOST_TURN, np.sqrt(2) * gain_sd * ratio / max(1 - ratio**2, 1e-9))
        made = np.diag([0.0, 0.0, distance_sd, gain_sd, gain_sd, turn]) ** 2
        made[:2, :2] = covariance
        made[3:5, 3:5] += lobe_sd**2
        return made

    def _predict(self, position: Array, change: Array) -> Prediction | None:
        """Predict with the sources changed, in the order of `SOURCES`."""
        assert self.first.curvature is not None
        distance, gains = self.distance * (1 + change[2]), self.gains * (1 + change[3:5])
        N = self.first.normal + change[:2] @ basis_across(self.first.normal)
        N /= np.linalg.norm(N)
        e = self.first.curvature.directions[0] - (self.first.curvature.directions[0] @ N) * N
        e /= np.linalg.norm(e)
        e = np.cos(change[5]) * e + np.sin(change[5]) * np.cross(N, e)
        across = np.stack([e, np.cross(N, e)])
        # In units of the distance the first camera is at (0, 0, 1), the other one at v.
        v = np.append(across @ position, N @ position) / distance + [0.0, 0.0, 1.0]
        K = gains - 1
        x = _place(K, v)
        if x is None:
            return None
        normal = np.append(K * x, 1.0) @ np.concatenate([across, N[None]])
        return Prediction(position, normal / np.linalg.norm(normal), x, K)


def _place(K: Array, v: Array) -> Array | None:
    """Solve for the point of the patch z = -x^T diag(K) x / 2 whose normal points at v, shape (2,)."""
    x = v[:2] / (1 + K)
    # Newton's method, from the linear solution
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
            return np.asarray(x)
    return None
