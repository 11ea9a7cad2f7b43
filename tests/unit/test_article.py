"""The study of the article's angles: how specularities are drawn, and how their angles are counted."""

import numpy as np
import pytest
import trimesh

from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.validation.references import Model
from studies import article
from studies.registration import Observation

CAMERA = Camera(200, 160, 200.0, 200.0, 100.0, 80.0)


RADIUS_MM, DISTANCE_MM = 40.0, 100.0


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    monkeypatch.setattr(article, "DRAWS", 500)


def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    return Model(np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), np.asarray(mesh.faces))


def view(pixels, turned_deg=0.0):
    """Specularities on the sphere whose candidates are its normals, turned, and a wrong one."""
    pose = np.eye(4)
    pose[2, 3] = DISTANCE_MM
    spots, glints, glints_px = [], {}, {}
    for i, px in enumerate(pixels):
        ray = CAMERA.unproject(np.array(px))
        along = ray[2] * DISTANCE_MM - np.sqrt(RADIUS_MM**2 - DISTANCE_MM**2 * (1 - ray[2] ** 2))
        normal = (along * ray - [0, 0, DISTANCE_MM]) / RADIUS_MM
        side = np.cross(normal, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        turned = np.cos(np.radians(turned_deg)) * normal + np.sin(np.radians(turned_deg)) * side
        pair = np.array([[0.0, 1.0, 0.0], turned])
        spots.append(Observation(np.array(px), {"circle_pose": pair, "cone_axis": turned[None]}, CAMERA, pose, 3))
        glints[i], glints_px[i] = turned, np.array(px)
    nothing = np.empty((0, 2)), np.empty((0, 3))
    return article.View(spots, [0.5 + 0.01 * i for i in range(len(spots))], glints_px, glints, *nothing)


PIXELS = [(100.0, 80.0), (120.5, 70.0), (80.0, 95.0), (130.0, 100.0)]


def test_without_registration_what_is_turned_is_off_by_that_angle():
    made = article.angles(view(PIXELS, 6.0), sphere(), (0.0, 0.0))
    np.testing.assert_allclose(made[article.BASE], 0.0, atol=1e-5)
    # The better candidate counts; the mesh's facets cost less than a tenth of a degree.
    for name in (article.FINE, "circle_pose", "cone_axis"):
        assert made[name].shape == (1, len(PIXELS))
        np.testing.assert_allclose(made[name], 6.0, atol=0.1)


def test_a_registration_alone_turns_the_model_s_normals():
    """A sphere turned about its centre stays the same: only the move counts, about its length over the radius."""
    turned = article.angles(view(PIXELS), sphere(), (0.0, 5.0))[article.BASE]
    assert turned.shape == (article.REGISTRATIONS, len(PIXELS))
    np.testing.assert_allclose(turned, 0.0, atol=0.1)
    moved = article.angles(view(PIXELS), sphere(), (2.0, 0.0))[article.BASE]
    assert 0 < moved.mean() < 1.5 * np.degrees(2.0 / RADIUS_MM)
    again = article.angles(view(PIXELS), sphere(), (2.0, 0.0))[article.BASE]
    np.testing.assert_array_equal(moved, again)


def test_draws_take_five_views_in_equal_parts_and_nothing_that_missed_the_model():
    tables = [np.full((3, 40), float(i)) for i in range(9)]
    taken = article.drawn(tables, np.random.default_rng(0))
    assert len(taken) == article.SPECULARITIES
    counts = np.unique(taken, return_counts=True)[1]
    assert sorted(counts.tolist()) == [5, 5, 5, 5, 6]
    few = [np.array([[1.0, np.nan, 2.0]])] * article.VIEWS
    assert sorted(article.drawn(few, np.random.default_rng(0)).tolist()) == [1.0] * 5 + [2.0] * 5


def test_relief_of_a_known_slope_gives_the_law_s_mean_and_deviation():
    """Theory 7.4: s = 5.7 deg gives 7.1 deg on average, with a standard deviation of 3.7."""
    rng = np.random.default_rng(1)
    tables = [np.hypot(*rng.normal(0, 5.7, (2, 1, 60))) for _ in range(40)]
    made = article.figures(tables, 0)
    np.testing.assert_allclose(made.mean(axis=0), [1.2533 * 5.7, 0.6551 * 5.7], rtol=0.06)
    # A Gaussian relief alone has a narrower spread than the article's: its figures are not both inside.
    assert "**" not in article.cell(made)
    wider = [np.hypot(*rng.normal(0, 5.7, (2, 1, 60))) * rng.uniform(0.5, 1.5, (1, 60)) for _ in range(40)]
    assert article.cell(article.figures(wider, 0)).startswith("**")
    # 26 of them scatter in their mean by the deviation over sqrt(26).
    assert made[:, 0].std() == pytest.approx(0.6551 * 5.7 / np.sqrt(26), rel=0.15)


def test_the_roundest_come_first():
    shown = view(PIXELS)
    ordered = article.rounder(shown, np.arange(len(PIXELS))[None])
    assert ordered.tolist() == [[3, 2, 1, 0]]
    assert angle_deg(shown.glints[0], np.array([0.0, 0.0, -1.0])) < 1
