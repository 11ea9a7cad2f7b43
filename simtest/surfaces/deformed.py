"""A surface that is deformed: points, normals and curvatures of its image under a smooth map, exact as its own are.

A ray through the deformed surface is a curve through the surface at rest. Newton's method on the curve's tangents, each
met with the surface at rest exactly, finds where it meets it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simtest.runtime.arrays import Array
from simtest.spec.surfaces import Deformation
from simtest.surfaces.deformation import DeformationAt, MapJets
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
    """A relief that rides on deformed tissue: each point of the tissue keeps its height, mm.

    Parameters
    ----------
    deformation : DeformationAt
        The moment's deformation of the model frame.
    """

    deformation: DeformationAt | None = None

    def tissue_jets(self, points: Array, diffused: bool = False) -> HeightJets:
        """Compute the jets of the tissue below the film at deformed points, shape (N, 3), model frame, mm."""
        assert self.deformation is not None
        rest = self.deformation.at_rest(points)
        own = super().tissue_jets(rest, diffused)
        gradient, hessian = self.deformation.jets(rest).carry(own.gradient, own.hessian)
        return HeightJets(own.height, gradient, hessian)


def stays_in_free_space(rest: SurfaceModel, parts: Sequence[Deformation], time_s: float, point: Array) -> bool:
    """Return whether no wall passes over a point while a deformation grows from none to that of a moment.

    Parameters
    ----------
    rest : SurfaceModel
        The surface at rest.
    parts : sequence of Deformation
        The deformation; all amplitudes and turns grow alike.
    time_s : float
        The moment, s.
    point : ndarray, shape (3,)
        Model frame, mm, in free space at rest and at the moment.
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
    """A surface at one moment of its deformation; the camera stays where it is.

    Parameters
    ----------
    rest : SurfaceModel
        The surface at rest; it must be rendered as a mesh (see `graded_mesh` for analytic ones).
    deformation : DeformationAt
        Of the model frame.

    Attributes
    ----------
    rest, deformation
        The given ones.
    """

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
            own = RayHits(distance[found], hits.face[found], hits.barycentric[found])
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
