"""From a recipe to a mesh with exact normals and curvatures at its vertices."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.surfaces.model import Array, TriangleMesh, principal_curvatures
from simtest.surfaces.recipe import ColonRecipe, LiverRecipe, load_recipe


def load_anatomy(
    kind: str, recipe: str | Path | None = None, seed: int | None = None, settings: Mapping[str, Any] | None = None
) -> ColonRecipe | LiverRecipe:
    """Read a recipe of one kind.

    Parameters
    ----------
    kind : {"colon", "liver"}
        What the recipe must be of.
    recipe : str or Path, optional
        A recipe file; default the shipped one.
    seed : int, optional
        In place of the recipe's.
    settings : mapping, optional
        Values that replace those of the file, by key path.

    Returns
    -------
    ColonRecipe or LiverRecipe

    Raises
    ------
    InputError
        If the file is missing, malformed, or of the other kind.
    """
    path = find(recipe if recipe is not None else kind, "meshes")
    values = {**(settings or {}), **({} if seed is None else {"seed": seed})}
    described = load_recipe(path, values)
    if described.type != kind:
        raise InputError(f"{path}: type = {described.type!r}; simtest mesh {kind} needs {kind!r}")
    return described


def make_mesh(recipe: ColonRecipe | LiverRecipe, edge_mm: float | None = None) -> tuple[TriangleMesh, Array, Array]:
    """Triangulate the smooth surface of a recipe.

    Parameters
    ----------
    recipe : ColonRecipe or LiverRecipe
    edge_mm : float, optional
        Edge length wanted, mm; default that of the scenes.

    Returns
    -------
    mesh : TriangleMesh
        Vertices on the surface, mm, exact normals on the camera's side.
    k_min, k_max : ndarray, shape (V,)
        Exact principal curvatures at the vertices, 1/mm.

    Raises
    ------
    InputError
        If the recipe gives no usable surface, or too many triangles.
    """
    from simtest.surfaces import colon, liver

    if edge_mm is not None and not 0.01 <= edge_mm <= 20:
        raise InputError(f"edge_mm = {edge_mm:g}: must be 0.01 to 20 mm")
    if isinstance(recipe, ColonRecipe):
        tube = colon.build(recipe, edge_mm)
        return tube.mesh, *principal_curvatures(tube.shape_operators())
    body = liver.build(recipe, edge_mm)
    return body.mesh, *principal_curvatures(body.shape_operators())
