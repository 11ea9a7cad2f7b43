"""From the description of a surface to its model, and from a recipe to a mesh."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.spec.camera import Moved
from simtest.spec.reflectance import Patches
from simtest.spec.surfaces import (
    AnatomySurface,
    CylinderSurface,
    Deformation,
    PlaneSurface,
    QuadricSurface,
    SphereSurface,
    Surface,
)
from simtest.surfaces.analytic import Cylinder, Plane, Quadric, Sphere
from simtest.surfaces.mesh_file import MESH_SUFFIXES
from simtest.surfaces.model import CACHES, SurfaceModel, TriangleMesh, principal_curvatures
from simtest.surfaces.recipe import ColonRecipe, LiverRecipe, load_recipe

if TYPE_CHECKING:
    from simtest.surfaces.triangles import MeshedSurface

ANALYTIC: dict[type, Any] = {
    PlaneSurface: Plane,
    SphereSurface: Sphere,
    CylinderSurface: Cylinder,
    QuadricSurface: Quadric,
}
"""The models of analytic surfaces by their descriptions."""


def make_surface(
    spec: Surface,
    film_level: float | None = None,
    moved: Moved | None = None,
    deformation: Sequence[Deformation] = (),
    time_s: float = 0.0,
    film_patches: Patches | None = None,
) -> SurfaceModel:
    """Make the model of a scene's surface.

    Parameters
    ----------
    spec : Surface
        Its description.
    film_level : float, optional
        Up to where a liquid film fills the valleys of its relief, in standard deviations of the height.
    moved : Moved, optional
        Where the camera stands, from where the description puts it.
    deformation : sequence of Deformation
        How it deforms; the camera is not moved with it.
    time_s : float
        The moment of the deformation, s.
    film_patches : Patches, optional
        How the film's level varies over the surface.
    """
    surface: SurfaceModel = _make_anatomy(spec) if isinstance(spec, AnatomySurface) else ANALYTIC[type(spec)](spec)
    if isinstance(spec, AnatomySurface) and spec.view != "auto":
        # Imported here, as the mesh libraries below.
        from simtest.surfaces.poses import path_pose

        surface.model_from_camera = path_pose(spec, surface)
    if moved is not None:
        surface.model_from_camera = surface.model_from_camera @ moved.pose()
    if spec.relief is not None:
        # Imported here: its filters are slow to load, and smooth scenes do not need them.
        from simtest.surfaces.relief_field import make_relief

        surface.relief = make_relief(spec.relief, film_level, film_patches)
    if deformation:
        # Imported here, as the relief above.
        from simtest.surfaces.deformation import DeformationAt, DeformedSurface

        if isinstance(surface, Plane | Sphere | Cylinder):
            surface.as_mesh = True
        return DeformedSurface(surface, DeformationAt(deformation, time_s))
    return surface


def forget_meshes() -> None:
    """Free the meshes that are cached for further scenes of the last few anatomies."""
    for cached in CACHES:
        cached.cache_clear()


def _make_anatomy(spec: AnatomySurface) -> SurfaceModel:
    # Imported here: the mesh libraries are slow to load and analytic scenes do not need them.
    from simtest.surfaces.mesh_surface import make_mesh_surface
    from simtest.surfaces.poses import at_viewpoint

    suffix = Path(spec.path).suffix.lower()
    if suffix in MESH_SUFFIXES:
        if spec.recipe_values:
            raise InputError(f"surface.path = {spec.path!r}: a mesh has no recipe; leave out seed and recipe")
        return make_mesh_surface(spec)
    if suffix not in ("", ".toml"):
        allowed = ", ".join((".toml", *MESH_SUFFIXES))
        raise InputError(
            f"surface.path = {spec.path!r}: unknown suffix {suffix}; allowed: {allowed}, or a recipe's name"
        )
    recipe = load_recipe(spec.file(), spec.recipe_values)
    return at_viewpoint(_build(recipe), recipe.type, spec.viewpoint)


def _build(recipe: ColonRecipe | LiverRecipe, edge_mm: float | None = None) -> "MeshedSurface":
    from simtest.surfaces import colon, liver

    build: Any = colon.build if isinstance(recipe, ColonRecipe) else liver.build
    # Not with None, by which the cache would not find it again.
    surface: MeshedSurface = build(recipe) if edge_mm is None else build(recipe, edge_mm)
    return surface


def make_mesh(recipe: ColonRecipe | LiverRecipe, edge_mm: float | None = None) -> tuple[TriangleMesh, Array, Array]:
    """Triangulate the smooth surface of a recipe.

    Parameters
    ----------
    recipe : ColonRecipe or LiverRecipe
    edge_mm : float, optional
        Desired edge length, mm; default that of the scenes.

    Returns
    -------
    mesh : TriangleMesh
        Vertices on the surface, mm, exact normals on the camera's side.
    k_min, k_max : ndarray, shape (V,)
        Exact principal curvatures at the vertices, 1/mm.
    """
    if edge_mm is not None and not 0.01 <= edge_mm <= 20:
        raise InputError(f"edge_mm = {edge_mm:g}: must be 0.01 to 20 mm")
    surface = _build(recipe, edge_mm)
    return surface.mesh, *principal_curvatures(surface.vertex_shape_operators())
