"""What generated anatomies and a user's mesh share: a mesh that is built once, and a surface seen from a pose."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simtest.runtime.arrays import Array
from simtest.surfaces.model import RayHits, Shape, SurfaceModel, SurfacePoints, TriangleMesh, pack_points
from simtest.surfaces.poses import MeshProbe


@dataclass(frozen=True)
class BuiltMesh(ABC):
    """A surface's mesh, shared by all its poses.

    Parameters
    ----------
    mesh : TriangleMesh
        mm; normals and winding on the camera's side.
    key : str
        Identity of recipe or file, and settings.
    """

    mesh: TriangleMesh
    key: str

    @cached_property
    def probe(self) -> MeshProbe:
        """Distances and rays for the choice of a pose."""
        return MeshProbe(self.mesh)

    @property
    @abstractmethod
    def shape_operators(self) -> Array:
        """S at the mesh's vertices for its normals, 1/mm, shape (V, 3, 3)."""

    @abstractmethod
    def clearance(self, points: Array) -> Array:
        """Return the signed distance of points, shape (N, 3), to the surface, mm; positive on the camera's side."""

    @abstractmethod
    def at_hits(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, Array, Array]:
        """Return distance, normal and S of the surface on rays that hit the mesh; NaN if there is no solution."""

    def distances(self, origins: Array, directions: Array, hits: RayHits) -> Array:
        """Return the distances of `at_hits` alone."""
        return self.at_hits(origins, directions, hits)[0]


class MeshedSurface(SurfaceModel):
    """A surface that is rendered as a mesh."""

    _build: BuiltMesh

    def shape(self) -> Shape:
        """Return the mesh; winding and normals on the camera's side."""
        return Shape("mesh", False, np.eye(4), self._build.mesh, self._build.key)

    def vertex_shape_operators(self) -> Array:
        """Return S at the mesh's vertices (see `SurfaceModel.vertex_shape_operators`)."""
        return self._build.shape_operators

    def clearance(self, points: Array) -> Array:
        """Return the signed distance to the surface (see `SurfaceModel.clearance`)."""
        return self._build.clearance(points)

    def distances(self, origins: Array, directions: Array, hits: RayHits) -> Array:
        """Return how far along rays the surface lies (see `SurfaceModel.distances`)."""
        hit = np.flatnonzero(np.isfinite(hits.distance))
        found = RayHits(hits.distance[hit], hits.face[hit], hits.barycentric[hit])
        distance = np.full(len(origins), np.nan)
        distance[hit] = self._build.distances(origins[hit], directions[hit], found)
        return distance

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the points where rays meet the surface (see `SurfaceModel.points`)."""
        hit = np.flatnonzero(np.isfinite(hits.distance))
        found = RayHits(hits.distance[hit], hits.face[hit], hits.barycentric[hit])
        at_hits = self._build.at_hits(origins[hit], directions[hit], found)
        whole = [np.full((len(origins), *values.shape[1:]), np.nan) for values in at_hits]
        for values, some in zip(whole, at_hits, strict=True):
            values[hit] = some
        return pack_points(origins, directions, *whole)
