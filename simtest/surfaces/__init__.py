"""Surfaces with exact position, normal and curvature."""

from simtest.surfaces.factory import forget_meshes, make_surface
from simtest.surfaces.model import RayHits, Shape, SurfaceModel, SurfacePoints, TriangleMesh

__all__ = ["RayHits", "Shape", "SurfaceModel", "SurfacePoints", "TriangleMesh", "forget_meshes", "make_surface"]
