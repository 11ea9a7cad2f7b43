"""From the description of a surface to its model."""

from pathlib import Path

from simtest.errors import InputError
from simtest.spec.surface import (
    AnatomySurface,
    CylinderSurface,
    PlaneSurface,
    QuadricSurface,
    SphereSurface,
    Surface,
)
from simtest.surfaces.analytic import Cylinder, Plane, Quadric, Sphere
from simtest.surfaces.mesh_file import MESH_SUFFIXES
from simtest.surfaces.model import SurfaceModel


def make_surface(spec: Surface) -> SurfaceModel:
    """Make the model of a surface.

    Parameters
    ----------
    spec : Surface
        From a scene.

    Returns
    -------
    SurfaceModel

    Raises
    ------
    InputError
        If a recipe or mesh file is missing or malformed.
    """
    match spec:
        case PlaneSurface():
            return Plane(spec)
        case SphereSurface():
            return Sphere(spec)
        case CylinderSurface():
            return Cylinder(spec)
        case QuadricSurface():
            return Quadric(spec)
        case AnatomySurface():
            surface = _make_anatomy(spec)
            if spec.view != "auto":
                # Imported here, as the mesh libraries below.
                from simtest.surfaces.centreline import path_pose

                surface.model_from_camera = path_pose(spec, surface)
            return surface


def forget_meshes() -> None:
    """Let go of the meshes that are kept for further scenes of the last few anatomies."""
    from simtest.surfaces import centreline, colon, liver
    from simtest.surfaces import mesh_surface as mesh

    for kept in (centreline._camera_path, colon.build, liver.build, mesh._prepare):
        kept.cache_clear()


def _make_anatomy(spec: AnatomySurface) -> SurfaceModel:
    # Imported here: the mesh libraries are slow to load and analytic scenes do not need them.
    from simtest.surfaces.colon import Colon
    from simtest.surfaces.liver import Liver
    from simtest.surfaces.mesh_surface import MeshSurface
    from simtest.surfaces.recipe import ColonRecipe, load_recipe

    suffix = Path(spec.path).suffix.lower()
    if suffix in MESH_SUFFIXES:
        if spec.recipe_values:
            raise InputError(f"surface.path = {spec.path!r}: a mesh has no recipe; leave out seed and recipe")
        return MeshSurface(spec)
    if suffix not in ("", ".toml"):
        allowed = ", ".join((".toml", *MESH_SUFFIXES))
        raise InputError(
            f"surface.path = {spec.path!r}: unknown suffix {suffix}; allowed: {allowed}, or a recipe's name"
        )
    recipe = load_recipe(spec.file(), spec.recipe_values)
    return Colon(recipe, spec.viewpoint) if isinstance(recipe, ColonRecipe) else Liver(recipe, spec.viewpoint)
