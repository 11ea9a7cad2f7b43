"""The generated liver: derivatives against finite differences, Newton points, a closed even mesh."""

from pathlib import Path

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.surfaces.liver import _project, build
from simtest.surfaces.model import RayHits
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


def chosen_hits(recipe, count=4000, seed=0):
    mesh = build(recipe).mesh
    rng = np.random.default_rng(seed)
    face, (b, c) = rng.integers(len(mesh.faces), size=count), np.sort(rng.random((2, count)), axis=0)
    b, c = b, c - b
    points = np.einsum("cn,nci->ni", np.stack([1 - b - c, b, c]), mesh.vertices[mesh.faces[face]])
    facing = mesh.normals[mesh.faces[face, 0]]
    origins = points + 60.0 * facing + rng.normal(size=(count, 3)) * 15
    directions = points - origins
    distance = np.linalg.norm(directions, axis=1)
    return origins, directions / distance[:, None], RayHits(distance, face, np.stack([b, c], axis=1)), facing


def gradient(f, points, h=STEP):
    """4th-order finite differences of a function of points, shape (N, 3), on the last axis of the result."""
    parts = []
    for axis in np.eye(3):
        m2, m1, p1, p2 = (f(points + k * h * axis) for k in (-2, -1, 1, 2))
        parts.append((m2 - 8 * m1 + 8 * p1 - p2) / (12 * h))
    return np.stack(parts, axis=-1)


def test_gradient_and_hessian_match_finite_differences(recipe):
    body = build(recipe).body
    points = build(recipe).mesh.vertices[::37] + np.random.default_rng(0).normal(size=3)
    at = body.evaluate(points)
    np.testing.assert_allclose(at.value, body.values(points), atol=1e-12)
    np.testing.assert_allclose(at.gradient, gradient(body.values, points), atol=2e-7)
    np.testing.assert_allclose(at.hessian, gradient(lambda p: body.evaluate(p).gradient, points), atol=2e-7)
    np.testing.assert_allclose(at.hessian, at.hessian.transpose(0, 2, 1), atol=1e-14)


def test_normals_and_curvatures_match_finite_differences_of_the_surface(recipe):
    """The surface as a height over its tangent plane: heights by bisection of F, differenced for normal and S."""
    body = build(recipe).body
    origins, directions, hits, _ = chosen_hits(recipe, 300)
    points = make_liver(recipe, 0).points(origins, directions, hits)
    ok = points.valid
    p, n = points.position[ok], points.normal[ok]
    first, second = points.direction_min[ok], points.direction_max[ok]

    def height(x, y):
        foot = p + x * first + y * second
        low, high = np.full(len(p), -0.5), np.full(len(p), 0.5)
        for _ in range(52):
            middle = (low + high) / 2
            outside = body.values(foot + middle[:, None] * n) > 0
            low, high = np.where(outside, low, middle), np.where(outside, middle, high)
        return (low + high) / 2

    h = 0.05
    for k, (x, y) in ((points.k_min[ok], (1, 0)), (points.k_max[ok], (0, 1))):
        m2, m1, z, p1, p2 = (height(s * h * x, s * h * y) for s in (-2, -1, 0, 1, 2))
        slope = (m2 - 8 * m1 + 8 * p1 - p2) / (12 * h)
        bend = -(-m2 + 16 * m1 - 30 * z + 16 * p1 - p2) / (12 * h * h)
        assert np.abs(slope).max() < 1e-6
        assert (np.abs(bend - k) <= 1e-4 * np.maximum(np.abs(k), 1 / 30)).all()
    twist = (height(h, h) - height(h, -h) - height(-h, h) + height(-h, -h)) / (4 * h * h)
    assert np.abs(twist).max() < 2e-4  # of second order only


def test_newton_points_lie_on_ray_and_surface(recipe):
    origins, directions, hits, _ = chosen_hits(recipe)
    hits.distance[0] = np.inf
    points = make_liver(recipe, 0).points(origins, directions, hits)
    assert not points.valid[0]
    assert np.isnan(points.normal[0]).all()
    assert points.valid.mean() > 0.998
    ok = points.valid
    assert np.abs(build(recipe).body.values(points.position[ok])).max() < 1e-10
    np.testing.assert_allclose(
        points.position[ok], origins[ok] + points.distance[ok, None] * directions[ok], atol=1e-12
    )
    assert np.abs(points.distance - hits.distance)[ok].max() < 0.5
    assert (np.einsum("ni,ni->n", points.normal, directions)[ok] < 0).all()


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
    origins, directions, hits, _ = chosen_hits(recipe)
    points = make_liver(recipe, 0).points(origins, directions, hits)
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
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face, weights = rng.choice(len(area), 100_000, p=area / area.sum()), rng.dirichlet([1, 1, 1], 100_000)
    shown = np.einsum("nc,nci->ni", weights, mesh.normals[mesh.faces[face]])
    shown /= np.linalg.norm(shown, axis=1, keepdims=True)
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
