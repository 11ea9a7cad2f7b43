"""A smooth invertible map of space at one moment, with exact derivatives; and what it does to normals and curvatures.

Each part is a displacement u with a Lipschitz bound below 1, so X -> X + u(X) is invertible (Banach's fixed-point
theorem), and so is the composition. For a level set F = 0 that is carried along, G = F o phi^-1 has the gradient
g = J^-T grad F and the Hessian J^-T (Hess F - sum_i g_i Hess phi_i) J^-1, with J the Jacobian of phi. Normals and shape
operators follow from these.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simtest.geometry.vectors import rotation
from simtest.runtime.arrays import Array, Mask
from simtest.spec.surfaces import MAX_STRETCH, Breathing, Contractions, Deformation, Dent, Peristalsis
from simtest.surfaces.model import (
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    implicit_shape_operator,
    pack_points,
    shape_operator,
)
from simtest.surfaces.relief_field import HeightJets, ReliefField

CONVERGED_MM = 1e-12
"""Residual at which the inverse is found; rounding ends the steps earlier for coordinates of 1000 mm and more."""

RING_REACH = 9.0
"""In radii or widths of a ring of contraction; beyond, exp(-9^2/2) = 3e-18 is less than rounding."""

INVERSE_STEPS = 400
"""Enough for the fixed-point iteration alone: 0.9^400 of any start."""


@dataclass(frozen=True)
class MapJets:
    """A map of space at points, with its first two derivatives."""

    value: Array  # (N, 3): images, mm
    jacobian: Array  # (N, 3, 3): derivative of component i along axis j at [:, i, j]
    hessian: Array  # (N, 3, 3, 3): second derivative of component i along axes j and k at [:, i, j, k], 1/mm

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

    def near(self, points: Array) -> Mask | None:
        """Return which points, shape (N, 3), the part moves by more than rounding; None: it may move all."""
        return None

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


def _inward(P: Array, r: Array, amount: Sequence[Array]) -> tuple[Array, ...]:
    """Return u = f r and its derivatives from f and its own; r = P (X - c), shape (N, 3), P a projection."""
    f = amount[0]
    parts = [f[:, None] * r]
    if len(amount) > 1:
        df = amount[1]
        parts.append(f[:, None, None] * P + r[:, :, None] * df[:, None, :])
    if len(amount) > 2:
        # d2 u_i/dX_j dX_k = P_ij df_k + P_ik df_j + r_i Hess f_jk
        parts.append(
            np.einsum("ij,nk->nijk", P, df) + np.einsum("ik,nj->nijk", P, df) + np.einsum("ni,njk->nijk", r, amount[2])
        )
    return tuple(parts)


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
        amount = [f]
        if order:
            along = -k / 2 * np.sin(angle) * g
            amount.append(along[:, None] * e - f[:, None] * r / R2)
        if order > 1:
            # Hess f = g w'' e e^T - (w' g/R^2)(e r^T + r e^T) - f P/R^2 + f r r^T/R^4.
            bent = -(k * k) / 2 * np.cos(angle) * g
            er = e[None, :, None] * r[:, None, :]
            amount.append(
                bent[:, None, None] * np.outer(e, e)
                - (along / R2)[:, None, None] * (er + np.swapaxes(er, 1, 2))
                - (f / R2)[:, None, None] * P
                + (f / R2**2)[:, None, None] * r[:, :, None] * r[:, None, :]
            )
        return _inward(P, r, amount)


class _Ring(_Part):
    """A contraction at one point c of a path: u = -(A/R) r exp((1 - |r|^2/R^2 - z^2/width^2)/2)."""

    def __init__(self, spec: Contractions, amplitude_mm: float, centre: Array, tangent: Array) -> None:
        self._axis, self._origin = tangent, centre
        self._across = np.eye(3) - np.outer(tangent, tangent)
        self._a = amplitude_mm / spec.radius_mm
        # The exponent is -X^T Q X/2.
        self._Q = self._across / spec.radius_mm**2 + np.outer(tangent, tangent) / spec.width_mm**2
        self._reach = RING_REACH * max(spec.radius_mm, spec.width_mm)

    def near(self, points: Array) -> Mask:
        return np.asarray(np.linalg.norm(points - self._origin, axis=1) < self._reach)

    def displacement(self, points: Array, order: int) -> tuple[Array, ...]:
        gap = points - self._origin
        slope = gap @ self._Q
        f = -self._a * np.exp((1 - np.sum(gap * slope, axis=1)) / 2)
        amount = [f]
        if order:
            amount.append(-f[:, None] * slope)
        if order > 1:
            amount.append(f[:, None, None] * (slope[:, :, None] * slope[:, None, :] - self._Q))
        return _inward(self._across, gap @ self._across, amount)


def _rings(spec: Contractions, time_s: float) -> list[_Part]:
    """Return the rings that stand on the path at a moment, from its begin to its end."""
    nodes = np.array(spec.path_mm)
    at = np.concatenate([[0.0], np.cumsum(spec.chords_mm)])
    slopes = np.gradient(nodes, at, axis=0)
    length, fade = at[-1], min(spec.spacing_mm, at[-1]) / 2
    first = spec.cycles(time_s) % 1 * spec.spacing_mm
    made: list[_Part] = []
    for s in np.arange(first, length, spec.spacing_mm):
        share = math.sin(math.pi / 2 * min(1.0, s / fade, (length - s) / fade)) ** 2
        centre, tangent = _on_curve(at, nodes, slopes, float(s))
        made.append(_Ring(spec, spec.amplitude_mm * share, centre, tangent))
    return made


def _on_curve(at: Array, nodes: Array, slopes: Array, s: float) -> tuple[Array, Array]:
    """Return point and unit tangent of Hermite's cubic through nodes, shape (N, 3), with slopes, at a position s."""
    i = int(np.clip(np.searchsorted(at, s, side="right") - 1, 0, len(at) - 2))
    h = at[i + 1] - at[i]
    t = (s - at[i]) / h
    near, far, m, n = nodes[i], nodes[i + 1], h * slopes[i], h * slopes[i + 1]
    point = (1 + 2 * t) * (1 - t) ** 2 * near + t * (1 - t) ** 2 * m + t * t * (3 - 2 * t) * far + t * t * (t - 1) * n
    change = 6 * t * (1 - t) * (far - near) + (1 - t) * (1 - 3 * t) * m + t * (3 * t - 2) * n
    return point, _unit(change)


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
    >>> from simtest.spec.surfaces import Dent
    >>> dent = Dent(amplitude_mm=2.0, period_s=2.0, direction=(0, 0, 1), radius_mm=5.0)
    >>> pressed = DeformationAt([dent], time_s=1.0)
    >>> pressed.moved(np.zeros((1, 3))).tolist()
    [[0.0, 0.0, 2.0]]
    """

    def __init__(self, parts: Sequence[Deformation], time_s: float) -> None:
        self._parts = [part for spec in parts for part in _parts_of(spec, time_s)]

    def moved(self, points: Array) -> Array:
        """Return where points at rest, shape (N, 3), model frame, mm, are now."""
        for part in self._parts:
            points = _where_near(part, points, part.moved)
        return points

    def at_rest(self, points: Array) -> Array:
        """Return where the points that are now at `points`, shape (N, 3), model frame, mm, are at rest."""
        for part in reversed(self._parts):
            points = _where_near(part, points, part.at_rest)
        return points

    def jets(self, points: Array) -> MapJets:
        """Return the map and its derivatives at points at rest, shape (N, 3), model frame, mm."""
        count = len(points)
        jets = MapJets(points, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 3, 3)))
        for i, part in enumerate(self._parts):
            near = part.near(jets.value)
            if near is None:
                jets = part.jets(jets.value) if i == 0 else _after(part, jets)
            elif near.any():
                whole = MapJets(jets.value.copy(), jets.jacobian.copy(), jets.hessian.copy())
                own = _after(part, MapJets(jets.value[near], jets.jacobian[near], jets.hessian[near]))
                whole.value[near], whole.jacobian[near], whole.hessian[near] = own.value, own.jacobian, own.hessian
                jets = whole
        return jets


def _where_near(part: _Part, points: Array, move: Callable[[Array], Array]) -> Array:
    """Apply a part, forwards or back, to the points that it reaches."""
    near = part.near(points)
    if near is None:
        return move(points)
    moved = points.copy()
    moved[near] = move(points[near])
    return moved


def _after(part: _Part, jets: MapJets) -> MapJets:
    """Return the jets of a part applied to a map: H = J2 H1 + H2[J1, J1]."""
    own, J = part.jets(jets.value), jets.jacobian
    bent = (own.jacobian @ jets.hessian.reshape(-1, 3, 9)).reshape(-1, 3, 3, 3)
    bent += np.swapaxes(J, 1, 2)[:, None] @ own.hessian @ J[:, None]
    return MapJets(own.value, own.jacobian @ J, bent)


def _parts_of(spec: Deformation, time_s: float) -> list[_Part]:
    match spec:
        case Peristalsis():
            return [_Contraction(spec, time_s)]
        case Breathing():
            return [_Breath(spec, time_s)]
        case Dent():
            return [_Press(spec, time_s)]
        case Contractions():
            return _rings(spec, time_s)


def _unit(vector: Sequence[float]) -> Array:
    values = np.array(vector, dtype=float)
    return np.asarray(values / np.linalg.norm(values))


NEWTON_STEPS = 12
CONVERGED = 1e-13
"""A step of less, as a share of the distance, is rounding."""

SETTLED_MM = 1e-9
"""A ray whose last step is longer has no point: it grazes the surface."""

PASSAGE_MM = 0.1
"""Thinner walls may pass unseen."""

REACH = 10.0
"""How far before the hit the tangents start, in distances of the hit: a mesh judges its own hits by a share of it."""


@dataclass(frozen=True)
class DeformedRelief(ReliefField):
    """A relief that rides on deformed tissue: each point of the tissue keeps its height, mm."""

    deformation: DeformationAt | None = None  # The moment's deformation of the model frame

    def tissue_jets(self, points: Array, diffused: bool = False) -> HeightJets:
        """Compute the jets of the tissue below the film at deformed points, shape (N, 3), model frame, mm."""
        assert self.deformation is not None
        rest = self.deformation.at_rest(points)
        own = super().tissue_jets(rest, diffused)
        gradient, hessian = self.deformation.jets(rest).carry(own.gradient, own.hessian)
        return HeightJets(own.height, gradient, hessian)


def stays_in_free_space(rest: SurfaceModel, parts: Sequence[Deformation], time_s: float, point: Array) -> bool:
    """Return whether no wall passes over a point while a deformation grows from none to that of a moment, s.

    All amplitudes and turns grow alike. The point, shape (3,), model frame, mm, is in free space at rest and at the
    moment.
    """

    def at(share: float) -> tuple[float, Array, float]:
        X = DeformationAt([part.scaled(share) for part in parts], time_s).at_rest(point[None])
        return share, X[0], float(rest.clearance(X)[0])

    # The tissue moves from where it surrounds the point at rest to where it does now: along this way none is met.
    pending = [(at(0.0), at(1.0))]
    while pending:
        first, last = pending.pop()
        if min(first[2], last[2]) <= 0:
            return False
        apart = float(np.linalg.norm(first[1] - last[1]))
        if apart > max(PASSAGE_MM, max(first[2], last[2]) / 2):
            middle = at((first[0] + last[0]) / 2)
            pending += [(first, middle), (middle, last)]
    return True


class DeformedSurface(SurfaceModel):
    """A surface, rendered as a mesh, at one moment of its deformation; the camera stays where it is."""

    def __init__(self, rest: SurfaceModel, deformation: DeformationAt) -> None:
        mesh = rest.shape().mesh
        assert mesh is not None
        self.rest, self.deformation = rest, deformation
        self.solid, self.faceted = rest.solid, rest.faceted
        self.model_from_camera = rest.model_from_camera
        self._rest_mesh = mesh
        if rest.relief is not None:
            parts = {name: getattr(rest.relief, name) for name in ("bands", "deviation", "level")}
            # Where tissue is compressed its waves are shorter.
            shortest = float(np.linalg.svd(self.vertex_jets.jacobian, compute_uv=False).min())
            wave = rest.relief.finest_wave * min(1.0, shortest)
            self.relief = DeformedRelief(**parts, finest_wave=wave, deformation=deformation)

    @property
    def at_rest(self) -> SurfaceModel:
        """The surface before its deformation, in its closed form where it has one."""
        return self.rest.at_rest

    @cached_property
    def vertex_jets(self) -> MapJets:
        """The map at the vertices of the mesh at rest."""
        return self.deformation.jets(self._rest_mesh.vertices)

    @cached_property
    def _vertex_forms(self) -> tuple[Array, Array | None]:
        """Normals at the deformed vertices, and shape operators for them."""
        operators = self.rest.vertex_shape_operators()
        forms = np.zeros((len(self._rest_mesh.vertices), 3, 3)) if operators is None else operators
        normal, operators_now = implicit_shape_operator(*self.vertex_jets.carry(self._rest_mesh.normals, forms))
        return normal, None if operators is None else operators_now

    @cached_property
    def _mesh(self) -> TriangleMesh:
        return TriangleMesh(self.vertex_jets.value, self._rest_mesh.faces, self._vertex_forms[0])

    def shape(self) -> Shape:
        """Return the mesh with its vertices moved; shapes of all moments have one key."""
        return Shape("mesh", False, np.eye(4), self._mesh, f"deformed {self.rest.shape().key}")

    def clearance(self, points: Array) -> Array:
        """Return the clearance of the points at rest (see `SurfaceModel.clearance`); the sign is exact."""
        return self.rest.clearance(self.deformation.at_rest(points))

    def vertex_shape_operators(self) -> Array | None:
        """Return S at the deformed vertices (see `SurfaceModel.vertex_shape_operators`)."""
        return self._vertex_forms[1]

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the points where rays meet the deformed surface (see `SurfaceModel.points`)."""
        distance = np.where(np.isfinite(hits.distance) & np.isfinite(directions).all(axis=1), hits.distance, np.nan)
        found = np.flatnonzero(np.isfinite(distance))
        solved = np.full(len(origins), np.nan)
        normal, operator = np.full((len(origins), 3), np.nan), np.full((len(origins), 3, 3), np.nan)
        if len(found):
            own = replace(hits, distance=distance).rows(found)
            solved[found], points, jets = self._solve(origins[found], directions[found], own)
            normal[found], operator[found] = implicit_shape_operator(
                *jets.carry(points.normal_base, shape_operator(points))
            )
        return pack_points(origins, directions, solved, normal, operator)

    def _solve(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, SurfacePoints, MapJets]:
        """Return distances along rays, the points at rest that they meet there, and the map at these."""
        t = hits.distance.copy()
        # The renderer's hit lies on a flat triangle of the deformed mesh.
        for _ in range(NEWTON_STEPS):
            points, step, jets = self._tangent_step(origins + t[:, None] * directions, directions, hits, t)
            t = t + step
            with np.errstate(invalid="ignore"):
                moving = np.abs(step) > CONVERGED * t
            if not moving.any():
                break
        with np.errstate(invalid="ignore"):
            settled = (np.abs(step) < SETTLED_MM) & (t > 0)
        return np.where(settled, t, np.nan), points, jets

    def _tangent_step(
        self, at: Array, directions: Array, hits: RayHits, t: Array
    ) -> tuple[SurfacePoints, Array, MapJets]:
        """Meet the tangents of the rays' curves at rest with the surface; return how far along the rays that is."""
        X = self.deformation.at_rest(at)
        jets = self.deformation.jets(X)
        tangent = np.einsum("nji,nj->ni", jets.inverse_transpose, directions)
        speed = np.linalg.norm(tangent, axis=1)
        tangent /= speed[:, None]
        reach = REACH * t
        start = RayHits(reach, hits.face, hits.barycentric)
        points = self.rest.points(X - reach[:, None] * tangent, tangent, start)
        return points, (points.distance - reach) / speed, jets

    def motion(self, points: SurfacePoints, hits: RayHits) -> tuple[Array, Array]:
        """Return how points and normals move between neighbouring rays (see `SurfaceModel.motion`)."""
        if not self.faceted:
            return super().motion(points, hits)
        # Within a triangle at rest, carried along.
        jets = self.deformation.jets(self.deformation.at_rest(points.position))
        normal = np.einsum("nji,nj->ni", jets.jacobian, points.normal_base)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        plane, derivative = self.rest.motion(replace(points, normal_base=normal), hits)
        K = jets.inverse_transpose
        g, derivative = jets.carry(normal, derivative)
        length = np.linalg.norm(g, axis=1)
        across = np.eye(3) - points.normal_base[:, :, None] * points.normal_base[:, None, :]
        return np.einsum("nij,nj->ni", K, plane), across @ derivative / length[:, None, None]
