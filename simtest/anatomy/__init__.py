"""Surfaces with exact position, normal and curvature."""

from simtest.anatomy.base import RayHits, Shape, SurfaceModel, SurfacePoints, TriangleMesh
from simtest.anatomy.factory import forget_meshes, make_surface

__all__ = ["RayHits", "Shape", "SurfaceModel", "SurfacePoints", "TriangleMesh", "forget_meshes", "make_surface"]
