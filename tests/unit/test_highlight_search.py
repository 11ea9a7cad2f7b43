"""The search for the points where the normal bisects the directions to light and camera."""

import numpy as np
import pytest

from simtest.geometry import vectors
from simtest.rendering import Session, highlights
from simtest.rendering.misfits import crossed, exact_misfit
from simtest.spec.scene import scene_from_dict

CAMERA = {"width": 200, "height": 160, "fx": 200.0, "fy": 200.0, "cx": 100.0, "cy": 80.0}
RIG = {"lights": [{"position_mm": [3.0, 0.0, 0.0]}, {"position_mm": [-1.0, 4.0, 0.0]}]}
SURFACES = {
    "plane": {"type": "plane", "distance_mm": 20, "tilt_deg": 10},
    "inside": {"type": "cylinder", "distance_mm": 20, "radius_mm": 70, "side": "inside", "spin_deg": 20},
    "sphere": {"type": "sphere", "distance_mm": 20, "radius_mm": 30},
    "bead": {"type": "sphere", "distance_mm": 20, "radius_mm": 1.0},
    "saddle": {"type": "quadric", "distance_mm": 20, "k1_per_mm": 0.03, "k2_per_mm": -0.02, "tilt_deg": 8},
}
WIDE = ("plane", "inside", "sphere", "saddle")
"""Those that fill the frame."""


def scene(surface, **more):
    return scene_from_dict({"surface": SURFACES[surface], "camera": CAMERA, "rig": RIG, **more})


@pytest.fixture(scope="module")
def sessions():
    return {name: Session(scene(name)) for name in WIDE}


def test_a_seed_may_be_the_point_itself(sessions):
    session = sessions["sphere"]
    near = np.array([[104.0, 82.0], [95.0, 77.0]])
    found, owners = highlights.refine(session, near, np.array([0, 0]), False)
    again, _ = highlights.refine(session, found, owners, False)
    np.testing.assert_allclose(again, found, atol=1e-9)
    np.testing.assert_allclose(found[0], found[-1], atol=1e-6)


@pytest.mark.parametrize("surface", WIDE)
def test_jacobian_is_the_misfits_derivative(sessions, surface):
    session, step = sessions[surface], 1e-3
    pixels = np.random.default_rng(5).uniform(40, 120, (20, 2))
    lights = session.scene.rig.true_mm()[np.arange(20) % 2]

    def state(points):
        return exact_misfit(session, points, lights, faceted=True)

    for axis in range(2):
        move = step * np.eye(2)[axis]
        slope = (state(pixels + move).w - state(pixels - move).w) / (2 * step)
        jacobian = state(pixels).jacobian
        # The tangent basis turns with the sightline, which moves w by w itself times the turn.
        bound = 2 * np.abs(state(pixels).w).max() / CAMERA["fx"] + 1e-7
        assert np.abs(slope - jacobian[:, :, axis]).max() < bound


@pytest.mark.parametrize("surface", WIDE)
def test_the_maps_misfits_are_the_exact_ones(sessions, surface):
    session = sessions[surface]
    for stride in (1, 2, 7):
        maps = session.misfits(stride)
        height, width = ((size - stride // 2 + stride - 1) // stride + 2 * maps.margin for size in (160, 200))
        assert maps.fine.shape == maps.base.shape == (2, 2, height, width)
        rows, columns = (index[::3, ::3].ravel() for index in np.mgrid[4 : height - 4, 4 : width - 4])
        pixels = maps.pixels(np.stack([columns, rows], axis=1))
        assert np.array_equal(pixels[0], np.full(2, stride // 2 + 0.5 + (4 - maps.margin) * stride))
        for number, light in enumerate(session.scene.rig.true_mm()):
            exact = exact_misfit(session, pixels, light, faceted=True)
            # In the camera's frame here, in the model's there: the length across the sightline is the same.
            length = np.linalg.norm(maps.base[number], axis=0)[rows, columns]
            # The saddle is a mesh.
            np.testing.assert_allclose(length, np.linalg.norm(exact.w, axis=1), rtol=0, atol=3e-5)
        distance = session.exact_points(pixels).distance
        np.testing.assert_allclose(maps.distance[rows, columns], distance, rtol=1e-5)


def test_a_cell_that_the_linear_misfit_crosses_holds_its_zero():
    y, x = np.mgrid[:12, :15].astype(np.float32)
    rng = np.random.default_rng(3)
    for _ in range(50):
        zero, matrix = rng.uniform(1, 10, 2), rng.normal(size=(2, 2))
        w = np.einsum("ij,jhw->ihw", matrix, np.stack([x - zero[0], y - zero[1]]))
        (rows, columns), corners = crossed(w)
        np.testing.assert_array_equal(corners[0], w[:, rows, columns])
        np.testing.assert_array_equal(corners[3], w[:, rows + 1, columns + 1])
        assert (int(zero[1]), int(zero[0])) in set(zip(rows.tolist(), columns.tolist(), strict=True))


def test_the_order_of_lights_and_what_ran_before_change_nothing(sessions):
    session = sessions["saddle"]
    first = [(h.light, *h.bp_px) for h in session.highlights(session.radiance())]
    alone = []
    for number in range(2):
        session.update(scene("saddle", rig={"lights": [RIG["lights"][number]]}))
        alone += [(number, *h.bp_px) for h in session.highlights(session.radiance())]
    session.update(scene("saddle"))
    assert [(h.light, *h.bp_px) for h in session.highlights(session.radiance())] == first
    np.testing.assert_allclose(sorted(alone), sorted(first), atol=1e-9)


def test_seeds_beside_the_surface_find_nothing():
    session = Session(scene("bead", rig={"lights": [{"position_mm": [0, 0, 0]}]}))
    (found,) = session.highlights(session.radiance())
    np.testing.assert_allclose(found.bp_px, [100.0, 80.0], atol=1e-6)
    none, owners = highlights.refine(session, np.array([[5.0, 5.0]]), np.array([0]), False)
    assert none.shape == (0, 2)
    assert owners.shape == (0,)


@pytest.mark.parametrize("radius", [0.15, 0.2, 0.3])
def test_beads_of_three_to_six_pixels_have_both_highlights_wherever_they_stand(radius):
    bead, session = {"type": "sphere", "distance_mm": 20, "radius_mm": radius}, None
    for step in range(6):
        camera = {**CAMERA, "cx": 100.0 + 0.53 * step, "cy": 80.0 + 0.29 * step}
        placed = scene_from_dict({"surface": bead, "camera": camera, "rig": RIG})
        session = session or Session(placed)
        session.update(placed)
        assert sorted(h.light for h in session.highlights()) == [0, 1], step


@pytest.mark.parametrize("kind", ["cylinder", "sphere"])
def test_a_streak_and_a_whole_wall_that_bisects_are_no_points(kind):
    """The camera on a cylinder's axis, or in a sphere's centre, where the misfit is 0 everywhere with its slope."""
    surface = {"type": kind, "distance_mm": 20, "radius_mm": 20, "side": "inside"}
    tables = {"surface": surface, "camera": CAMERA, "rig": {"lights": [{"position_mm": [0, 0, 0]}]}}
    assert Session(scene_from_dict(tables)).highlights() == []


def test_the_earliest_point_of_each_light_is_kept():
    points = np.array([[1.0, 1.0], [1.3, 1.0], [1.0, 1.0], [9.0, 1.0], [9.2, 1.4], [9.2, 1.5]])
    kept = highlights.first_of_light(points, 0.5, np.array([0, 0, 1, 0, 0, 0]))
    assert kept.tolist() == [True, False, True, True, False, True]


@pytest.mark.parametrize("count", [2, 40, 100])
def test_few_points_are_told_apart_as_many_are(count, monkeypatch):
    rng = np.random.default_rng(count)
    # On a grid, so that some lie at the distance itself.
    points, owners = rng.integers(0, 24, (count, 2)) / 4, rng.integers(0, 3, count)
    kept = highlights.first_of_light(points, 0.5, owners)
    monkeypatch.setattr(vectors, "FEW", 0)
    assert np.array_equal(kept, highlights.first_of_light(points, 0.5, owners))
    assert kept.sum() > 1
