"""A smooth invertible map of space at one moment, with exact derivatives; and what it does to normals and curvatures.

Each part is a displacement u with a Lipschitz bound below 1, so X -> X + u(X) is invertible (Banach's fixed-point
theorem), and so is the composition. For a level set F = 0 that is carried along, G = F o phi^-1 has the gradient
g = J^-T grad F and the Hessian J^-T (Hess F - sum_i g_i Hess phi_i) J^-1, with J the Jacobian of phi. Normals and shape
operators follow from these.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simtest.geometry.vectors import rotation
from simtest.runtime.arrays import Array
from simtest.spec.deformation import MAX_STRETCH, Breathing, Deformation, Dent, Peristalsis

CONVERGED_MM = 1e-12
"""Residual at which the inverse is found; rounding ends the steps earlier for coordinates of 1000 mm and more."""

INVERSE_STEPS = 400
"""Enough for the fixed-point iteration alone: 0.9^400 of any start."""


@dataclass(frozen=True)
class MapJets:
    """A map of space at points, with its first two derivatives.

    Parameters
    ----------
    value : ndarray, shape (N, 3)
        Images, mm.
    jacobian : ndarray, shape (N, 3, 3)
        Derivative of component i along axis j at [:, i, j].
    hessian : ndarray, shape (N, 3, 3, 3)
        Second derivative of component i along axes j and k at [:, i, j, k], 1/mm.
    """

    value: Array
    jacobian: Array
    hessian: Array

    @cached_property
    def inverse_transpose(self) -> Array:
        """J^-T, shape (N, 3, 3)."""
        return np.asarray(np.swapaxes(np.linalg.inv(self.jacobian), 1, 2))

    def carry(self, gradient: Array, hessian: Array) -> tuple[Array, Array]:
        """Return gradient, (N, 3), and Hessian, (N, 3, 3), of F o phi^-1 at the images, from those of F.

        For a derivative of a normal field within a plane in place of a Hessian, the result is that of J^-T N.
        """
        K = self.inverse_transpose
        g = np.einsum("nij,nj->ni", K, gradient)
        bent = hessian - (g[:, None] @ self.hessian.reshape(-1, 3, 9)).reshape(-1, 3, 3)
        return g, np.asarray(K @ bent @ np.swapaxes(K, 1, 2))


class _Part(ABC):
    """A displacement at one moment, followed by a rigid turn about `centre`."""

    turn: Array = np.eye(3)
    centre: Array = np.zeros(3)

    @abstractmethod
    def displacement(self, points: Array, order: int) -> tuple[Array, ...]:
        """Return u, and its first and second derivatives up to an order, at points, shape (N, 3)."""

    def jets(self, points: Array) -> MapJets:
        u, first, second = self.displacement(points, 2)
        R = self.turn
        second = (R @ second.reshape(-1, 3, 9)).reshape(-1, 3, 3, 3)
        return MapJets(self._turned(points + u), R @ (np.eye(3) + first), second)

    def moved(self, points: Array) -> Array:
        return self._turned(points + self.displacement(points, 0)[0])

    def _turned(self, points: Array) -> Array:
        return np.asarray((points - self.centre) @ self.turn.T + self.centre)

    def at_rest(self, points: Array) -> Array:
        """Invert: Newton's method, with fixed-point steps where it does not contract as these do."""
        target = (points - self.centre) @ self.turn + self.centre
        X = target.copy()
        # NaN stays NaN.
        open_ = np.flatnonzero(np.isfinite(target).all(axis=1))
        u, J = self.displacement(X[open_], 1)
        residual = target[open_] - X[open_] - u
        size = np.linalg.norm(residual, axis=1)
        for _ in range(INVERSE_STEPS):
            kept = size > CONVERGED_MM * np.maximum(1.0, np.linalg.norm(target[open_], axis=1) / 100)
            open_, J, residual, size = open_[kept], J[kept], residual[kept], size[kept]
            if not len(open_):
                break
            step = np.linalg.solve(np.eye(3) + J, residual[..., None])[..., 0]
            tried = X[open_] + step
            u, J = self.displacement(tried, 1)
            left = target[open_] - tried - u
            now = np.linalg.norm(left, axis=1)
            slow = now > MAX_STRETCH * size
            if slow.any():
                # X + residual = target - u(X): the residual shrinks by the Lipschitz bound at least.
                tried[slow] = X[open_][slow] + residual[slow]
                u, J[slow] = self.displacement(tried[slow], 1)
                left[slow] = target[open_][slow] - tried[slow] - u
                now = np.linalg.norm(left, axis=1)
            X[open_], residual, size = tried, left, now
        return X


class _Contraction(_Part):
    """Peristalsis: u = -a w(z) r exp((1 - |r|^2/R^2)/2), a = A/R, r = P (X - c) the part across the axis."""

    def __init__(self, spec: Peristalsis, time_s: float) -> None:
        self._axis, self._origin = _unit(spec.axis), np.array(spec.centre_mm)
        self._across = np.eye(3) - np.outer(self._axis, self._axis)
        self._a, self._R2 = spec.amplitude_mm / spec.radius_mm, spec.radius_mm**2
        self._k, self._cycle = 2 * math.pi / spec.wavelength_mm, 2 * math.pi * spec.cycles(time_s)

    def displacement(self, points: Array, order: int) -> tuple[Array, ...]:
        P, e, R2, k = self._across, self._axis, self._R2, self._k
        gap = points - self._origin
        angle = k * (gap @ e) - self._cycle
        r = gap @ P
        w = (1 + np.cos(angle)) / 2
        g = -self._a * np.exp((1 - np.sum(r * r, axis=1) / R2) / 2)
        # The scalar f = w g, u = f r; its gradient is g w' e - f r/R^2.
        f = w * g
        parts = [f[:, None] * r]
        if order:
            along = -k / 2 * np.sin(angle) * g
            df = along[:, None] * e - f[:, None] * r / R2
            parts.append(f[:, None, None] * P + r[:, :, None] * df[:, None, :])
        if order > 1:
            # Hess f = g w'' e e^T - (w' g/R^2)(e r^T + r e^T) - f P/R^2 + f r r^T/R^4.
            bent = -(k * k) / 2 * np.cos(angle) * g
            er = e[None, :, None] * r[:, None, :]
            hess = (
                bent[:, None, None] * np.outer(e, e)
                - (along / R2)[:, None, None] * (er + np.swapaxes(er, 1, 2))
                - (f / R2)[:, None, None] * P
                + (f / R2**2)[:, None, None] * r[:, :, None] * r[:, None, :]
            )
            # d2 u_i/dX_j dX_k = P_ij df_k + P_ik df_j + r_i Hess f_jk
            parts.append(
                np.einsum("ij,nk->nijk", P, df) + np.einsum("ik,nj->nijk", P, df) + np.einsum("ni,njk->nijk", r, hess)
            )
        return tuple(parts)


class _Along(_Part):
    """A displacement along one direction: u = v f(X)."""

    def __init__(self, direction: Array) -> None:
        self._direction = direction

    @abstractmethod
    def amount(self, points: Array, order: int) -> tuple[Array, ...]:
        """Return f, and its gradient and Hessian up to an order."""

    def displacement(self, points: Array, order: int) -> tuple[Array, ...]:
        v = self._direction
        return tuple(np.asarray(np.multiply.outer(v, part).swapaxes(0, 1)) for part in self.amount(points, order))


class _Breath(_Along):
    """Breathing: f = A s (1 - warp (1 - cos(k b))/2), then a turn."""

    def __init__(self, spec: Breathing, time_s: float) -> None:
        super().__init__(_unit(spec.direction))
        share = spec.share(time_s)
        self.centre = np.array(spec.centre_mm)
        self.turn = rotation(math.radians(spec.turn_deg) * share * _unit(spec.axis))
        self._along, self._k = _unit(spec.along), 2 * math.pi / spec.wavelength_mm
        self._amplitude, self._warp = spec.amplitude_mm * share, spec.warp

    def amount(self, points: Array, order: int) -> tuple[Array, ...]:
        b, k, A, warp = self._along, self._k, self._amplitude, self._warp
        angle = k * ((points - self.centre) @ b)
        parts = [A * (1 - warp * (1 - np.cos(angle)) / 2)]
        if order:
            parts.append((-A * warp * k / 2 * np.sin(angle))[:, None] * b)
        if order > 1:
            parts.append((-A * warp * k * k / 2 * np.cos(angle))[:, None, None] * np.outer(b, b))
        return tuple(parts)


class _Press(_Along):
    """Dent: f = A s exp(-|X - c|^2/(2 w^2))."""

    def __init__(self, spec: Dent, time_s: float) -> None:
        super().__init__(_unit(spec.direction))
        self._origin, self._w2 = np.array(spec.centre_mm), spec.radius_mm**2
        self._amplitude = spec.amplitude_mm * spec.share(time_s)

    def amount(self, points: Array, order: int) -> tuple[Array, ...]:
        gap, w2 = points - self._origin, self._w2
        f = self._amplitude * np.exp(-np.sum(gap * gap, axis=1) / (2 * w2))
        parts = [f]
        if order:
            parts.append(-f[:, None] / w2 * gap)
        if order > 1:
            outer = gap[:, :, None] * gap[:, None, :]
            parts.append(f[:, None, None] * (outer / w2**2 - np.eye(3) / w2))
        return tuple(parts)


class DeformationAt:
    """A deformation of space at one moment: parts that are applied one after the other.

    Parameters
    ----------
    parts : sequence of Deformation
        Their descriptions.
    time_s : float
        The moment, s.

    Examples
    --------
    >>> import numpy as np
    >>> from simtest.spec.deformation import Dent
    >>> dent = Dent(amplitude_mm=2.0, period_s=2.0, direction=(0, 0, 1), radius_mm=5.0)
    >>> pressed = DeformationAt([dent], time_s=1.0)
    >>> pressed.moved(np.zeros((1, 3))).tolist()
    [[0.0, 0.0, 2.0]]
    """

    def __init__(self, parts: Sequence[Deformation], time_s: float) -> None:
        self._parts = [_part(spec, time_s) for spec in parts]

    def moved(self, points: Array) -> Array:
        """Return where points at rest, shape (N, 3), model frame, mm, are now."""
        for part in self._parts:
            points = part.moved(points)
        return points

    def at_rest(self, points: Array) -> Array:
        """Return where the points that are now at `points`, shape (N, 3), model frame, mm, are at rest."""
        for part in reversed(self._parts):
            points = part.at_rest(points)
        return points

    def jets(self, points: Array) -> MapJets:
        """Return the map and its derivatives at points at rest, shape (N, 3), model frame, mm."""
        jets = self._parts[0].jets(points)
        for part in self._parts[1:]:
            # Chain rule; H = J2 H1 + H2[J1, J1].
            own, J = part.jets(jets.value), jets.jacobian
            bent = (own.jacobian @ jets.hessian.reshape(-1, 3, 9)).reshape(-1, 3, 3, 3)
            bent += np.swapaxes(J, 1, 2)[:, None] @ own.hessian @ J[:, None]
            jets = MapJets(own.value, own.jacobian @ J, bent)
        return jets


def _part(spec: Deformation, time_s: float) -> _Part:
    match spec:
        case Peristalsis():
            return _Contraction(spec, time_s)
        case Breathing():
            return _Breath(spec, time_s)
        case Dent():
            return _Press(spec, time_s)


def _unit(vector: Sequence[float]) -> Array:
    values = np.array(vector, dtype=float)
    return np.asarray(values / np.linalg.norm(values))
