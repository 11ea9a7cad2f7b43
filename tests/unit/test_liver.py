"""The generated liver: derivatives against finite differences, a closed even mesh; its points: test_surfaces."""

from pathlib import Path

import numpy as np
import pytest
from surface_helpers import gradient, hits_on, interpolated_normals

from simtest.errors import InputError
from simtest.surfaces.liver import _project, build
from simtest.surfaces.poses import at_viewpoint
from simtest.surfaces.recipe import LiverRecipe, load_recipe

ROOT = Path(__file__).resolve().parents[2]
STEP = 0.02


def make_liver(recipe, viewpoint):
    return at_viewpoint(build(recipe), recipe.type, viewpoint)


@pytest.fixture(scope="module")
def recipe() -> LiverRecipe:
    recipe = load_recipe(ROOT / "meshes" / "liver.toml")
    assert isinstance(recipe, LiverRecipe)
    return recipe


def test_gradient_and_hessian_match_finite_differences(recipe):
    body = build(recipe).body
    points = build(recipe).mesh.vertices[::37] + np.random.default_rng(0).normal(size=3)
    at = body.evaluate(points)
    np.testing.assert_allclose(at.value, body.values(points), atol=1e-12)
    np.testing.assert_allclose(at.gradient, gradient(body.values, points, STEP), atol=2e-7)
    np.testing.assert_allclose(at.hessian, gradient(lambda p: body.evaluate(p).gradient, points, STEP), atol=2e-7)
    np.testing.assert_allclose(at.hessian, at.hessian.transpose(0, 2, 1), atol=1e-14)


def test_mesh_is_closed_even_and_on_the_surface(recipe):
    import trimesh

    shape = make_liver(recipe, 0).shape()
    mesh = trimesh.Trimesh(shape.mesh.vertices, shape.mesh.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert 80_000 < len(mesh.faces) < 200_000
    assert 0.9e6 < mesh.volume < 1.9e6
    np.testing.assert_allclose(mesh.extents, [200, 150, 110], rtol=0.1)
    edges = np.linalg.norm(np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1), axis=2)
    quality = 4 * np.sqrt(3) * mesh.area_faces / (edges**2).sum(axis=1)  # 1: equilateral
    assert quality.min() > 0.05
    assert np.median(quality) > 0.8
    assert np.abs(build(recipe).body.values(mesh.vertices)).max() < 1e-10
    agreement = np.einsum("ni,ni->n", mesh.vertex_normals, shape.mesh.normals)
    # The mean of the faces is off where triangles of unequal size meet, at the border of a finer region.
    assert agreement.min() > 0.9
    assert (agreement > 0.99).mean() > 0.999


def test_outside_is_convex_and_the_inferior_edge_sharp(recipe):
    origins, directions, hits, _ = hits_on(build(recipe).mesh, 4000, 60.0, 15.0)
    points = make_liver(recipe, 0).points(origins, directions, hits)
    assert points.valid.mean() > 0.998
    assert np.nanmax(np.abs(points.distance - hits.distance)) < 0.5
    assert np.nanmedian(points.k_max) > 1 / 100
    assert 0.1 < np.nanmax(points.k_max) < 0.6
    assert np.nanmin(points.k_min) < 0  # the hollow of the visceral face


def test_key_and_mesh_follow_the_recipe_alone(recipe):
    a, b = make_liver(recipe, 0).shape(), make_liver(recipe, 5).shape()
    assert a.key == b.key
    assert a.mesh is b.mesh


def test_impossible_bodies_are_refused(recipe):
    with pytest.raises(InputError, match="visceral"):
        make_liver(recipe.model_copy(update={"visceral_offset_mm": -100.0, "visceral_radius_mm": 1e4}), 0)
    lobe = recipe.lobes[0].model_copy(update={"semi_axes_mm": (200.0, 200.0, 200.0)})
    with pytest.raises(InputError, match="cells"):
        make_liver(recipe.model_copy(update={"lobes": (lobe,)}), 0)


def test_interpolated_normals_are_those_of_the_surface(recipe):
    body, mesh = build(recipe).body, build(recipe).mesh
    face, weights, shown = interpolated_normals(mesh)
    corners = mesh.vertices[mesh.faces]
    exact = body.normals(_project(body, np.einsum("nc,nci->ni", weights, corners[face]), 4))
    error = np.degrees(np.arcsin(np.linalg.norm(np.cross(shown, exact), axis=1).clip(max=1)))
    assert error.mean() < 0.05
    assert np.quantile(error, 0.999) < 0.3


@pytest.mark.slow
def test_the_fossa_is_a_hollow_and_the_size_is_that_of_a_liver(recipe):
    mesh = build(recipe).mesh
    assert (np.ptp(mesh.vertices, axis=0) <= [220, 210, 190]).all()
    without = build(recipe.model_copy(update={"fossa": None})).body
    deep = without.values(mesh.vertices).min()
    assert -20 < deep < -5  # mm into the liver that has none
    centre = np.array(recipe.fossa.centre_mm)
    hollow = mesh.vertices[without.values(mesh.vertices) < -2]
    assert np.linalg.norm(hollow - centre, axis=1).max() < 40


def test_long_thin_lobes_that_melt_into_each_other_stay_whole():
    """Far out on its long axis a level set leaves the ellipsoid by much more than the depth of the blend."""
    import trimesh

    lobes = [
        {"centre_mm": (0, 0, 0), "semi_axes_mm": (150, 12, 12)},
        {"centre_mm": (-20, 5, 0), "semi_axes_mm": (150, 14, 12)},
    ]
    recipe = LiverRecipe.model_validate({"lobes": lobes, "blend_mm": 20.0, "relief_mm": 1.0})
    mesh = build(recipe, 3.0).mesh
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
