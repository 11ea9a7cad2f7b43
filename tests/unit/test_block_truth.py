"""The exact points of many rays: in blocks as in one piece; the colon's quick formulas against plain ones."""

from dataclasses import fields

import numpy as np
import pytest

from simtest.rendering import backend, truth, tube_kernel
from simtest.spec.surfaces import AnatomySurface, Relief, ReliefBand, SphereSurface
from simtest.surfaces import RayHits, SurfacePoints, make_surface
from simtest.surfaces.colon import Colon
from simtest.surfaces.recipe import ColonRecipe, Polyp
from simtest.surfaces.tube import Tube

RECIPES = [
    ColonRecipe(),
    ColonRecipe(relief_mm=0.1, seed=7),
    ColonRecipe(length_mm=60, radius_mm=6, bend_deg=170, sway_deg=20, sway_length_mm=60, fold_depth_mm=2.5,
                taenia_mm=0.3),
]  # fmt: skip


def rays(surface, count):
    rng = np.random.default_rng(1)
    directions = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pose = surface.model_from_camera
    return np.tile(pose[:3, 3], (count, 1)), directions @ pose[:3, :3].T


def hits_of(surface, origins, directions):
    if surface.shape().mesh is None:
        missed = np.arange(len(origins)) % 7 == 0
        return RayHits(np.where(missed, np.inf, 1.0), np.zeros(len(origins), dtype=int), np.zeros((len(origins), 2)))
    probe = surface.probe
    face, distance, barycentric = probe._tree.intersect_ray_first(
        probe._vertices, probe._faces, np.ascontiguousarray(origins), np.ascontiguousarray(directions)
    )
    return RayHits(np.where(face >= 0, distance, np.inf), np.maximum(face, 0), np.asarray(barycentric)[:, :2])


RELIEF = Relief(bands=(ReliefBand(wavelength_mm=1.0, slope_deg=4.0),))


@pytest.mark.parametrize("count", [0, 1, 150, 1000])
@pytest.mark.parametrize(
    "spec",
    [SphereSurface(), AnatomySurface(path="colon"), AnatomySurface(path="colon", relief=RELIEF)],
    ids=["sphere", "colon", "rough colon"],
)
def test_blocks_give_what_one_piece_gives(spec, count, monkeypatch):
    monkeypatch.setattr(truth, "BLOCK", 64)
    monkeypatch.setattr(tube_kernel, "BLOCK", 256)
    surface = make_surface(spec)
    origins, directions = rays(surface, count)
    hits = hits_of(surface, origins, directions) if count else RayHits(np.empty(0), np.empty(0, int), np.empty((0, 2)))
    whole = truth.solve(surface, origins, directions, hits)
    backend.load()
    blocks = truth.solve_frame(surface, origins, directions, hits)
    assert count < 2 or whole.valid.sum() > 0
    for field in fields(SurfacePoints):
        one, other = getattr(whole, field.name), getattr(blocks, field.name)
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        # Products of matrices may round by their size, and the kernel adds in another order.
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-11)


def test_pedunculated_polyps_have_no_chart():
    polyp = Polyp(along_mm=60, around_deg=90, height_mm=7, width_mm=7, neck_mm=4)
    for polyps in ((), (polyp,)):
        tube = Tube(ColonRecipe(polyps=polyps))
        surface = Colon(None, "", tube, np.zeros((1, 3, 2)))
        assert (surface.chart is None) == tube.has_stalks == bool(polyps)


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_centreline_is_its_quadrature(recipe):
    tube = Tube(recipe)
    u = np.linspace(-30, recipe.length_mm + 30, 4001)
    spacing = tube._knots[1]
    knot = np.clip(np.rint(u / spacing), 0, len(tube._knots) - 1).astype(int)
    expected = tube._knot_points[knot] + tube._integrate(tube._knots[knot], u)
    np.testing.assert_allclose(tube.centreline(u), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_shape_operator_is_that_of_the_fundamental_forms(recipe):
    tube, rng = Tube(recipe), np.random.default_rng(2)
    u, v = rng.uniform(0, recipe.length_mm, 500), rng.uniform(-1, 8, 500)
    normal, S = tube.normal_and_shape_operator(u, v)
    p = tube.jet(u, v)
    J, second = p.gradient, -np.einsum("ni,nijk->njk", normal, p.hessian)
    dual = J @ np.linalg.inv(J.transpose(0, 2, 1) @ J)
    np.testing.assert_allclose(S, dual @ second @ dual.transpose(0, 2, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(S @ normal[:, :, None], 0, atol=1e-12)


@pytest.mark.parametrize("recipe", RECIPES)
def test_first_derivatives_alone_are_the_same(recipe):
    tube, rng = Tube(recipe), np.random.default_rng(3)
    u, v = rng.uniform(0, recipe.length_mm, 500), rng.uniform(0, 7, 500)
    whole, first = tube.radius(u, v), tube.radius(u, v, second=False)
    np.testing.assert_array_equal(whole.value, first.value)
    np.testing.assert_array_equal(whole.gradient, first.gradient)
    assert len(first.parts) == 2
