"""A smooth invertible map of space at one moment, with exact derivatives; and what it does to normals and curvatures.

Each part is a displacement u with a Lipschitz bound below 1, so X -> X + u(X) is invertible (Banach's fixed-point
theorem), and so is the composition. For a level set F = 0 that is carried along, G = F o phi^-1 has the gradient
g = J^-T grad F and the Hessian J^-T (Hess F - sum_i g_i Hess phi_i) J^-1, with J the Jacobian of phi. Normals and shape
operators follow from these.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from simtest.geometry.vectors import projector, rotation, unit
from simtest.runtime.arrays import Array, Mask
from simtest.spec.surfaces import MAX_STRETCH, Breathing, Contractions, Deformation, Dent, Peristalsis
from simtest.surfaces.jets import Jet
from simtest.surfaces.model import (
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    implicit_shape_operator,
    in_rows,
    pack_points,
    shape_operator,
)
from simtest.surfaces.relief_field import BandField, ReliefField

CONVERGED_MM = 1e-12
"""Residual at which the inverse is found; rounding ends the steps earlier for coordinates of 1000 mm and more."""

RING_REACH = 9.0
"""In radii or widths of a ring of contraction; beyond, exp(-9^2/2) = 3e-18 is less than rounding."""

INVERSE_STEPS = 400
"""Enough for the fixed-point iteration alone: 0.9^400 of any start."""


def inverse_transpose(jets: Jet) -> Array:
    """Return J^-T, shape (N, 3, 3), of a map of space."""
    return np.asarray(np.swapaxes(np.linalg.inv(jets.gradient), 1, 2))


def carry(jets: Jet, gradient: Array, hessian: Array) -> tuple[Array, Array]:
    """Return gradient, (N, 3), and Hessian, (N, 3, 3), of F o phi^-1 at the images of a map, from those of F.

    For a derivative of a normal field within a plane in place of a Hessian, the result is that of J^-T N.
    """
    K = inverse_transpose(jets)
    g = np.einsum("nij,nj->ni", K, gradient)
    bent = hessian - (g[:, None] @ jets.hessian.reshape(-1, 3, 9)).reshape(-1, 3, 3)
    return g, np.asarray(K @ bent @ np.swapaxes(K, 1, 2))


@dataclass(frozen=True)
class _Part:
    """A displacement u at one moment, followed by a rigid turn about `centre`."""

    displacement: Callable[[Jet], Jet]
    turn: Array = field(default_factory=lambda: np.eye(3))
    centre: Array = field(default_factory=lambda: np.zeros(3))
    # Which points, shape (N, 3), it moves by more than rounding; None: it may move all
    near: Callable[[Array], Mask] | None = None

    def moved(self, X: Jet) -> Jet:
        """Return where points go."""
        return (X + self.displacement(X)).affine(1.0, -self.centre).linear(self.turn, self.centre)

    def at_rest(self, points: Array) -> Array:
        """Invert: Newton's method, with fixed-point steps where it does not contract as these do."""
        target = (points - self.centre) @ self.turn + self.centre
        X = target.copy()
        # NaN stays NaN.
        open_ = np.flatnonzero(np.isfinite(target).all(axis=1))
        u, J = self.displacement(Jet.variables(X[open_], 1)).parts
        residual = target[open_] - X[open_] - u
        size = np.linalg.norm(residual, axis=1)
        for _ in range(INVERSE_STEPS):
            kept = size > CONVERGED_MM * np.maximum(1.0, np.linalg.norm(target[open_], axis=1) / 100)
            open_, J, residual, size = open_[kept], J[kept], residual[kept], size[kept]
            if not len(open_):
                break
            step = np.linalg.solve(np.eye(3) + J, residual[..., None])[..., 0]
            tried = X[open_] + step
            u, J = self.displacement(Jet.variables(tried, 1)).parts
            left = target[open_] - tried - u
            now = np.linalg.norm(left, axis=1)
            slow = now > MAX_STRETCH * size
            if slow.any():
                # X + residual = target - u(X): the residual shrinks by the Lipschitz bound at least.
                tried[slow] = X[open_][slow] + residual[slow]
                u, J[slow] = self.displacement(Jet.variables(tried[slow], 1)).parts
                left[slow] = target[open_][slow] - tried[slow] - u
                now = np.linalg.norm(left, axis=1)
            X[open_], residual, size = tried, left, now
        return X


def _contraction(spec: Peristalsis, time_s: float) -> _Part:
    """Return peristalsis: u = -a w(z) r exp((1 - |r|^2/R^2)/2), a = A/R, r the part of X - c across the axis."""
    axis, R2 = unit(spec.axis), spec.radius_mm**2
    across = np.eye(3) - np.outer(axis, axis)

    def displacement(X: Jet) -> Jet:
        from_centre = X.affine(1.0, -np.array(spec.centre_mm))
        r = from_centre.linear(across)
        angle = from_centre.along(axis).affine(2 * math.pi / spec.wavelength_mm, -2 * math.pi * spec.cycles(time_s))
        g = r.squared().affine(-0.5 / R2, 0.5).exp().affine(-spec.amplitude_mm / spec.radius_mm)
        return angle.cos().affine(0.5, 0.5) * g * r

    return _Part(displacement)


def _ring(spec: Contractions, amplitude_mm: float, centre: Array, axis: Array) -> _Part:
    """Return a contraction at a point of a path: u = -(A/R) r exp((1 - |r|^2/R^2 - z^2/width^2)/2)."""
    across = np.eye(3) - np.outer(axis, axis)

    def displacement(X: Jet) -> Jet:
        from_centre = X.affine(1.0, -centre)
        r, z = from_centre.linear(across), from_centre.along(axis)
        exponent = r.squared().affine(-0.5 / spec.radius_mm**2) + (z * z).affine(-0.5 / spec.width_mm**2, 0.5)
        return exponent.exp().affine(-amplitude_mm / spec.radius_mm) * r

    reach = RING_REACH * max(spec.radius_mm, spec.width_mm)
    return _Part(displacement, near=lambda points: np.linalg.norm(points - centre, axis=1) < reach)


def _rings(spec: Contractions, time_s: float) -> Iterator[_Part]:
    """Yield the rings that stand on the path at a moment, from its begin to its end."""
    # Imported here: slow to load, and most deformations need none.
    from scipy.interpolate import CubicHermiteSpline

    nodes = np.array(spec.path_mm)
    at = np.concatenate([[0.0], np.cumsum(spec.chords_mm)])
    path = CubicHermiteSpline(at, nodes, np.gradient(nodes, at, axis=0))
    length, fade = at[-1], min(spec.spacing_mm, at[-1]) / 2
    for s in np.arange(spec.cycles(time_s) % 1 * spec.spacing_mm, length, spec.spacing_mm):
        share = math.sin(math.pi / 2 * min(1.0, s / fade, (length - s) / fade)) ** 2
        yield _ring(spec, spec.amplitude_mm * share, path(s), unit(path(s, 1)))


def _breath(spec: Breathing, time_s: float) -> _Part:
    """Return breathing: u = v A s (1 - warp (1 - cos(k b))/2), then a turn."""
    share, centre, along = spec.share(time_s), np.array(spec.centre_mm), unit(spec.along)
    move = spec.amplitude_mm * share * unit(spec.direction)

    def displacement(X: Jet) -> Jet:
        cosine = X.affine(1.0, -centre).along(along).affine(2 * math.pi / spec.wavelength_mm).cos()
        return cosine.affine(spec.warp / 2, 1 - spec.warp / 2).outer(move)

    return _Part(displacement, rotation(math.radians(spec.turn_deg) * share * unit(spec.axis)), centre)


def _press(spec: Dent, time_s: float) -> _Part:
    """Return a dent: u = v A s exp(-|X - c|^2/(2 w^2))."""
    move = spec.amplitude_mm * spec.share(time_s) * unit(spec.direction)

    def displacement(X: Jet) -> Jet:
        from_centre = X.affine(1.0, -np.array(spec.centre_mm))
        return from_centre.squared().affine(-0.5 / spec.radius_mm**2).exp().outer(move)

    return _Part(displacement)


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
        return self._applied(Jet(points)).value

    def at_rest(self, points: Array) -> Array:
        """Return where the points that are now at `points`, shape (N, 3), model frame, mm, are at rest."""
        for part in reversed(self._parts):
            near = part.near and part.near(points)
            if near is None:
                points = part.at_rest(points)
            elif near.any():
                points = points.copy()
                points[near] = part.at_rest(points[near])
        return points

    def jets(self, points: Array) -> Jet:
        """Return the map and its derivatives at points at rest, shape (N, 3), model frame, mm."""
        return self._applied(Jet.variables(points))

    def _applied(self, X: Jet) -> Jet:
        for part in self._parts:
            near = part.near and part.near(X.value)
            if near is None:
                X = part.moved(X)
            elif near.any():
                X = X.with_rows(near, part.moved(X.rows(near)))
        return X


def _parts_of(spec: Deformation, time_s: float) -> list[_Part]:
    match spec:
        case Peristalsis():
            return [_contraction(spec, time_s)]
        case Breathing():
            return [_breath(spec, time_s)]
        case Dent():
            return [_press(spec, time_s)]
        case Contractions():
            return list(_rings(spec, time_s))


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

    def _summed(self, bands: tuple[BandField, ...], points: Array, diffused: bool = False) -> Jet:
        """Compute the jets of the sum of bands at deformed points, shape (N, 3), model frame, mm."""
        assert self.deformation is not None
        rest = self.deformation.at_rest(points)
        at_rest = super()._summed(bands, rest, diffused)
        return Jet(at_rest.value, *carry(self.deformation.jets(rest), at_rest.gradient, at_rest.hessian))


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
            names = ("bands", "deviation", "level", "patches", "dry_level")
            parts = {name: getattr(rest.relief, name) for name in names}
            # Where tissue is compressed its waves are shorter.
            shortest = float(np.linalg.svd(self.vertex_jets.gradient, compute_uv=False).min())
            wave = rest.relief.finest_wave * min(1.0, shortest)
            self.relief = DeformedRelief(**parts, finest_wave=wave, deformation=deformation)

    @property
    def at_rest(self) -> SurfaceModel:
        """The surface before its deformation."""
        return self.rest

    @cached_property
    def vertex_jets(self) -> Jet:
        """The map at the vertices of the mesh at rest."""
        return self.deformation.jets(self._rest_mesh.vertices)

    @cached_property
    def _vertex_forms(self) -> tuple[Array, Array | None]:
        """Normals at the deformed vertices, and shape operators for them."""
        operators = self.rest.vertex_shape_operators()
        forms = np.zeros((len(self._rest_mesh.vertices), 3, 3)) if operators is None else operators
        normal, operators_now = implicit_shape_operator(*carry(self.vertex_jets, self._rest_mesh.normals, forms))
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
        hit = np.flatnonzero(np.isfinite(distance))
        solved, points, jets = self._solve(origins[hit], directions[hit], replace(hits, distance=distance).rows(hit))
        forms = implicit_shape_operator(*carry(jets, points.normal_base, shape_operator(points)))
        return pack_points(origins, directions, *in_rows(len(origins), hit, solved, *forms))

    def _solve(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, SurfacePoints, Jet]:
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

    def _tangent_step(self, at: Array, directions: Array, hits: RayHits, t: Array) -> tuple[SurfacePoints, Array, Jet]:
        """Meet the tangents of the rays' curves at rest with the surface; return how far along the rays that is."""
        X = self.deformation.at_rest(at)
        jets = self.deformation.jets(X)
        tangent = np.einsum("nji,nj->ni", inverse_transpose(jets), directions)
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
        normal = unit(np.einsum("nji,nj->ni", jets.gradient, points.normal_base))
        plane, derivative = self.rest.motion(replace(points, normal_base=normal), hits)
        g, derivative = carry(jets, normal, derivative)
        length = np.linalg.norm(g, axis=1)
        across = projector(points.normal_base)
        return np.einsum("nij,nj->ni", inverse_transpose(jets), plane), across @ derivative / length[:, None, None]
