"""Lights from highlights on mirrors: the mirror law, the fit, assignment, and what is told of doubtful input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from simtest.calibration.lights.bundle import Highlights, solve
from simtest.calibration.lights.mirrors import Balls, Plates, mirror_points
from simtest.calibration.lights.result import LightCalibration, judge
from simtest.calibration.lights.search import find_lights
from simtest.geometry import Array
from simtest.geometry.camera import Camera
from simtest.geometry.lenses import KannalaBrandt
from simtest.geometry.vectors import bisect

CAMERA = Camera(640, 512, 420.0, 420.0, 322.0, 251.0)
FISHEYE = replace(CAMERA, distortion=KannalaBrandt(k1=-0.02))
LIGHTS = np.array([[4.0, 0.5, 0.3], [-3.0, 2.5, -0.4]])
NOISE_PX = 0.05


def balls(count: int = 8, seed: int = 0, radius: float = 5.0) -> Balls:
    rng = np.random.default_rng(seed)
    pixels = np.stack([rng.uniform(120, 520, count), rng.uniform(110, 400, count)], axis=1)
    centres = CAMERA.unproject(pixels) * rng.uniform(22, 45, count)[:, None]
    factors = np.broadcast_to(np.diag([0.004, 0.004, 0.03]), (count, 3, 3))
    return Balls(centres, factors.copy(), np.full(count, radius))


def seen(
    mirrors: Balls | Plates, lights: Array, seed: int = 1, stray: int = 0, camera: Camera = CAMERA
) -> tuple[Highlights, Array]:
    """Return measured highlights, lights of shape (S, 3) or (V, S, 3), and the planted number of each; -1: stray."""
    rng = np.random.default_rng(seed)
    every = np.broadcast_to(lights, (len(mirrors), *lights.shape[-2:]))
    count = every.shape[1]
    view = np.repeat(np.arange(len(mirrors)), count)
    z = np.repeat(rng.standard_normal((len(mirrors), 3)), count, axis=0)
    pixels = mirrors.predict(camera, view, every.reshape(-1, 3), z)
    extra = np.repeat(np.arange(len(mirrors)), stray)
    about = np.array([pixels[view == i].mean(axis=0) for i in extra]).reshape(-1, 2)
    pixels = np.concatenate([pixels + rng.normal(0, NOISE_PX, pixels.shape), about + rng.uniform(-25, 25, about.shape)])
    covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(pixels), 2, 2)).copy()
    planted = np.concatenate([np.tile(np.arange(count), len(mirrors)), np.full(len(extra), -1)])
    return Highlights(np.concatenate([view, extra]), pixels, covariance), planted


def measured(mirrors: Balls | Plates, highlights: Highlights, camera: Camera = CAMERA) -> LightCalibration:
    found = find_lights(camera, mirrors, highlights)
    assert found is not None
    size = found.bundle.lights.size
    return judge(camera, mirrors, highlights, found, 0.0, np.zeros((size, size)))


def nearest_errors(result: LightCalibration, lights: Array) -> Array:
    """Return the squared error of each planted light in standard deviations of the nearest measured one."""
    squares = []
    for light in lights:
        own = min(result.lights, key=lambda each: float(np.linalg.norm(each.position_mm - light)))
        gap = own.position_mm - light
        squares.append(gap @ np.linalg.solve(own.covariance_mm2, gap))
    return np.array(squares)


def test_mirror_points_obey_the_mirror_law() -> None:
    rng = np.random.default_rng(4)
    centres = rng.normal(0, 8, (200, 3)) + np.array([0.0, 0.0, 40.0])
    radii, lights = rng.uniform(3, 10, 200), rng.uniform(-8, 8, (200, 3))
    points = mirror_points(centres, radii, lights)
    normals = (points - centres) / radii[:, None]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(normals, bisect(points, lights), atol=1e-10)


def test_light_on_the_axis_and_inside_the_ball() -> None:
    centre, radius = np.array([[0.0, 0.0, 30.0]]), np.array([5.0])
    np.testing.assert_allclose(mirror_points(centre, radius, np.zeros((1, 3))), [[0, 0, 25.0]], atol=1e-12)
    assert np.isnan(mirror_points(centre, radius, np.array([[0.0, 0.0, 28.0]]))).all()


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE])
def test_reflected_rays_meet_the_lights(camera: Camera) -> None:
    for mirrors in (balls(), plates()):
        view = np.arange(len(mirrors))
        pixels = mirrors.predict(
            camera, view, np.broadcast_to(LIGHTS[0], (len(mirrors), 3)), np.zeros((len(mirrors), 3))
        )
        points, directions = mirrors.reflect(camera, view, pixels)
        to_light = LIGHTS[0] - points
        np.testing.assert_allclose(directions, to_light / np.linalg.norm(to_light, axis=1)[:, None], atol=1e-8)


def plates(count: int = 8) -> Plates:
    rng = np.random.default_rng(9)
    normals = rng.normal(0, 0.15, (count, 3)) - [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    factors = np.broadcast_to(np.diag([0.002, 0.002, 0.1]), (count, 3, 3)).copy()
    return Plates(normals, -rng.uniform(20, 45, count), factors)


@pytest.mark.parametrize(
    ("kind", "camera"),
    [
        pytest.param("ball", CAMERA, id="ball-camera0"),
        pytest.param("ball", FISHEYE, id="ball-camera1", marks=pytest.mark.ci),
        pytest.param("plate", CAMERA, id="plate-camera0"),
        pytest.param("plate", FISHEYE, id="plate-camera1"),
    ],
)
def test_two_lights_among_stray_highlights(kind: str, camera: Camera) -> None:
    mirrors = balls() if kind == "ball" else plates()
    highlights, planted = seen(mirrors, LIGHTS, stray=1, camera=camera)
    result = measured(mirrors, highlights, camera)
    assert len(result.own) == 2
    assert not result.problems
    assert (result.source[planted < 0] >= 0).mean() < 0.2
    assert (nearest_errors(result, LIGHTS) < 16.3).all()  # chi-squared, 3 degrees of freedom, alpha = 0.001 each


@pytest.mark.slow
def test_covariance_holds_over_draws() -> None:
    # alpha: 60 lights, 3 degrees of freedom each; the mean of chi-squared over 3 has a standard deviation of 0.105.
    squares = []
    for seed in range(30):
        mirrors = balls(seed=100 + seed)
        highlights, planted = seen(mirrors, LIGHTS, seed=200 + seed)
        bundle = solve(CAMERA, mirrors, highlights, planted.astype(np.intp), LIGHTS + 1.0)
        assert bundle is not None
        gaps = bundle.lights - LIGHTS
        squares += [g @ np.linalg.solve(bundle.covariance_of(i), g) for i, g in enumerate(gaps)]
    mean = float(np.mean(squares)) / 3
    assert abs(mean - 1) < 4 * 0.105
    # A covariance of half the size would not pass.
    assert abs(2 * mean - 1) > 4 * 0.105


def test_each_highlight_counts_two_and_each_light_takes_three() -> None:
    """The sum of squares of eight draws lies in the middle 99.8 % of chi-squared of their degrees of freedom."""
    total, freedom = 0.0, 0
    for seed in range(8):
        mirrors = balls(seed=300 + seed)
        highlights, planted = seen(mirrors, LIGHTS, seed=400 + seed)
        bundle = solve(CAMERA, mirrors, highlights, planted.astype(np.intp), LIGHTS + 1.0)
        assert bundle is not None
        assert bundle.freedom == 2 * int((planted >= 0).sum()) - 3 * len(LIGHTS)
        total, freedom = total + bundle.chi2, freedom + bundle.freedom
    assert 0.001 < stats.chi2.cdf(total, freedom) < 0.999


def test_wrong_radius_shows_in_no_residual_and_scales_the_lights() -> None:
    true = balls()
    highlights, _ = seen(true, LIGHTS)
    told = Balls(1.02 * true.centres, 1.02 * true.factors, 1.02 * true.radii)
    right, wrong = measured(true, highlights), measured(told, highlights)
    assert wrong.chi2 == pytest.approx(right.chi2, rel=0.02)
    for one, other in zip(right.lights, wrong.lights, strict=True):
        np.testing.assert_allclose(other.position_mm, 1.02 * one.position_mm, atol=2e-3)


def test_radius_error_is_in_the_interval() -> None:
    mirrors = balls()
    highlights, _ = seen(mirrors, LIGHTS)
    found = find_lights(CAMERA, mirrors, highlights)
    assert found is not None
    exact = judge(CAMERA, mirrors, highlights, found, 0.0, np.zeros((6, 6)))
    loose = judge(CAMERA, mirrors, highlights, found, 0.02, np.zeros((6, 6)))
    for one, other in zip(exact.lights, loose.lights, strict=True):
        added = other.covariance_mm2 - one.covariance_mm2
        np.testing.assert_allclose(added, 0.02**2 * np.outer(one.position_mm, one.position_mm), atol=1e-12)


def test_residuals_that_are_too_large_widen_the_covariance() -> None:
    mirrors = balls()
    highlights, _ = seen(mirrors, LIGHTS)
    told = replace(highlights, covariance=highlights.covariance / 4)
    found = find_lights(CAMERA, mirrors, told)
    assert found is not None
    result = judge(CAMERA, mirrors, told, found, 0.0, np.zeros((6, 6)))
    inflation = result.chi2 / result.freedom
    assert inflation > 1.2
    for i, light in enumerate(found.bundle.lights):
        own = min(result.lights, key=lambda each: float(np.linalg.norm(each.position_mm - light)))
        np.testing.assert_allclose(own.covariance_mm2, inflation * found.bundle.covariance_of(i), rtol=1e-9)


def test_a_standard_deviation_of_a_plates_distance_moves_it_by_its_factor() -> None:
    told = plates()
    moved = replace(told, offsets=told.offsets + told.factors[:, 2, 2])
    view, lights = np.arange(8), np.tile(LIGHTS[0], (8, 1))
    pixels = moved.predict(CAMERA, view, lights, np.zeros((8, 3)))
    deviations = np.tile([0.0, 0.0, 1.0], (8, 1))
    np.testing.assert_allclose(told.predict(CAMERA, view, lights, deviations), pixels, atol=1e-9)


def test_light_that_moves_between_pictures_is_told() -> None:
    mirrors = balls()
    shifts = np.random.default_rng(8).normal(0, 0.4, (len(mirrors), 1, 3))
    still, _ = seen(mirrors, LIGHTS[:1])
    moving, _ = seen(mirrors, LIGHTS[None, :1] + shifts)
    assert not measured(mirrors, still).problems
    found = find_lights(CAMERA, mirrors, moving)
    assert found is not None
    result = judge(CAMERA, mirrors, moving, found, 0.0, np.zeros((3 * len(found.bundle.lights),) * 2))
    assert any("a light that moved" in text for text in (*result.problems, *result.notes))


def test_ball_at_one_place_states_a_wide_interval() -> None:
    single = balls(1)
    mirrors = Balls(np.repeat(single.centres, 4, 0), np.repeat(single.factors, 4, 0), np.repeat(single.radii, 4))
    highlights, _ = seen(mirrors, LIGHTS[:1])
    result = measured(mirrors, highlights)
    assert max(float(light.half_widths_mm.max()) for light in result.lights) > 2.0
    assert any("known to ±" in note for note in result.notes)
    assert (nearest_errors(result, LIGHTS[:1]) < 16.3).all()


def test_lamp_that_stays_with_the_camera_is_no_light_of_the_tip() -> None:
    mirrors = balls()
    lights = np.vstack([LIGHTS[:1], [[180.0, -220.0, -150.0]]])
    highlights, _ = seen(mirrors, lights)
    result = measured(mirrors, highlights)
    assert len(result.own) == 1
    assert nearest_errors(result, LIGHTS[:1])[0] < 16.3
    assert len(result.lights) == 1 or any("lamp" in note for note in result.notes)


def test_two_pictures_of_two_lights_are_not_sure_of_a_ghost() -> None:
    mirrors = balls(2)
    highlights, _ = seen(mirrors, LIGHTS)
    result = measured(mirrors, highlights)
    assert result.problems or (nearest_errors(result, LIGHTS) < 16.3).all()


def test_lights_and_balls_in_one_plane_are_ambiguous() -> None:
    """In one plane all reflected rays meet, so two pictures show two lights or the two points of the other pairing."""
    centres = np.array([[-4.0, 0.0, 30.0], [4.0, 0.0, 30.0]])
    mirrors = Balls(centres, np.broadcast_to(1e-3 * np.eye(3), (2, 3, 3)).copy(), np.full(2, 5.0))
    lights = np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    highlights, _ = seen(mirrors, lights)
    assert any("ambiguous" in problem for problem in measured(mirrors, highlights).problems)
    # From a third place off the plane one pairing is left.
    more = np.concatenate([centres, [[1.0, 7.0, 26.0], [-3.0, -6.0, 35.0]]])
    mirrors = Balls(more, np.broadcast_to(1e-3 * np.eye(3), (4, 3, 3)).copy(), np.full(4, 5.0))
    highlights, _ = seen(mirrors, lights)
    result = measured(mirrors, highlights)
    assert result.problems == ()
    assert (nearest_errors(result, lights) < 16.3).all()


def test_light_that_few_pictures_show_is_a_doubt() -> None:
    mirrors = balls(8)
    highlights, source = seen(mirrors, LIGHTS)
    few = (source != 1) | (highlights.view < 3)
    shown = Highlights(highlights.view[few], highlights.pixels[few], highlights.covariance[few])
    result = measured(mirrors, shown)
    assert any("further light" in problem for problem in result.problems)
    fewer = (source != 1) | (highlights.view < 1)
    shown = Highlights(highlights.view[fewer], highlights.pixels[fewer], highlights.covariance[fewer])
    assert measured(mirrors, shown).problems == ()


def test_nothing_but_stray_highlights_is_no_light() -> None:
    mirrors = balls(10)
    rng = np.random.default_rng(2)
    view = np.arange(10)
    pixels = CAMERA.project(mirrors.centres) + rng.uniform(-30, 30, (10, 2))
    found = find_lights(CAMERA, mirrors, Highlights(view, pixels, np.broadcast_to(1e-3 * np.eye(2), (10, 2, 2)).copy()))
    assert found is None
