"""Surfaces with exact position, normal and curvature.

`model` is what every surface offers, `factory` makes one from its description. `analytic` holds plane, sphere, cylinder
and quadric; `colon` (with `tube`) and `liver` are generated from a `recipe`; `mesh_surface` is a user's mesh,
read and repaired by `mesh_file`, judged by `mesh_check`. `poses` places cameras. `relief_field`, `tissue_pattern` (with
`vessels`) and `deformation` act on any surface, and `instrument` is what stands before it.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.surfaces.factory import forget_meshes, make_surface
    from simtest.surfaces.model import RayHits, Shape, SurfaceModel, SurfacePoints, TriangleMesh

__getattr__, __dir__, __all__ = lazy_names(__name__)
