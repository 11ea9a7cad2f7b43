"""The grid of a level set: exact wherever its zero passes, the right sign elsewhere, and far fewer evaluations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.runtime.resources import find
from simtest.surfaces.liver import Body, in_blocks, level_grid
from simtest.surfaces.recipe import LiverRecipe, load_recipe


def axes_of(*sizes, spacing=0.5, low=-7.0):
    return [low + spacing * np.arange(size) for size in sizes]


def nodes_of(axes):
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def at_crossings(exact):
    """Return the nodes of cells whose corners differ in sign, by plain loops over the corners."""
    signs, corners = exact < 0, np.zeros(exact.shape, dtype=bool)
    cells = [slice(None, -1), slice(1, None)]
    views = [np.index_exp[cells[i], cells[j], cells[k]] for i in range(2) for j in range(2) for k in range(2)]
    crossed = np.logical_or.reduce([signs[v] for v in views]) & ~np.logical_and.reduce([signs[v] for v in views])
    for view in views:
        corners[view] |= crossed
    return corners


@settings(max_examples=25, deadline=None)
@given(
    sizes=st.tuples(*[st.integers(2, 40)] * 3),
    radius=st.floats(0.3, 9.0),
    centre=st.tuples(*[st.floats(-8, 10)] * 3),
    stretch=st.floats(0.5, 3.0),
)
def test_the_grid_is_exact_where_the_zero_passes(sizes, radius, centre, stretch):
    axes = axes_of(*sizes)

    def values(points):
        return stretch * (np.linalg.norm(points - centre, axis=1) - radius)

    grid = level_grid(values, lambda points, radius: np.full(len(points), stretch), axes)
    exact = values(nodes_of(axes)).reshape(sizes)
    assert grid.shape == sizes
    np.testing.assert_array_equal(np.sign(grid), np.sign(exact))
    chosen = at_crossings(exact)
    np.testing.assert_allclose(grid[chosen], exact[chosen], rtol=0, atol=1e-12)


def test_few_nodes_are_evaluated():
    axes, counted = axes_of(120, 120, 120, spacing=0.2, low=-12.0), []

    def values(points):
        counted.append(len(points))
        return np.linalg.norm(points, axis=1) - 8

    level_grid(values, lambda points, radius: np.ones(len(points)), axes)
    assert sum(counted) < 0.35 * 120**3


def test_a_slope_that_is_too_small_misses_the_surface():
    """Negative control: the bound is what keeps the surface."""
    axes = axes_of(40, 40, 40)
    steep = lambda points: 10 * (np.linalg.norm(points - 0.3, axis=1) - 2)  # noqa: E731
    exact = steep(nodes_of(axes)).reshape(40, 40, 40)
    wrong = level_grid(steep, lambda points, radius: np.full(len(points), 0.5), axes)
    assert (np.sign(wrong) != np.sign(exact)).any()


@pytest.mark.parametrize("seed", [0, 3])
def test_the_slopes_of_a_liver_bound_its_gradient(seed):
    recipe = load_recipe(find("liver", "meshes"), {"seed": seed})
    assert isinstance(recipe, LiverRecipe)
    body, rng = Body(recipe), np.random.default_rng(seed)
    low, high = body.box()
    centres = rng.uniform(low, high, (400, 3))
    for radius in (0.1, 3.0, 20.0):
        bound = body.slopes(centres, radius)
        step = rng.standard_normal((50, 400, 3))
        step *= radius * rng.random((50, 400, 1)) / np.linalg.norm(step, axis=2, keepdims=True)
        gradient = body.evaluate((centres + step).reshape(-1, 3), second=False).gradient
        steepest = np.linalg.norm(gradient, axis=1).reshape(50, 400).max(axis=0)
        assert (steepest <= bound).all()


def test_blocks_give_what_one_piece_gives():
    for count in (0, 1, 8192, 20_001):
        points = np.random.default_rng(1).normal(size=(count, 3))
        np.testing.assert_array_equal(in_blocks(lambda some: some[:, 0] * 2, points), points[:, 0] * 2)
