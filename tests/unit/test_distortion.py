"""Lenses with distortion: against their formulas, against OpenCV, and there and back."""

import cv2
import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st

from simtest.errors import InputError
from simtest.geometry import BrownConrady, Camera, KannalaBrandt, Scaramuzza, ViewMask
from simtest.geometry.lenses import undistort_with_errors, with_radial_error
from tests.example_counts import examples

WIDTH, HEIGHT = 640, 480
MASK = ViewMask(325.0, 236.0, 220.0)


def inside(camera, count=20):
    """Return positions all over what the camera sees, its border included."""
    x, y = (np.linspace(0, size, count) for size in (camera.width, camera.height))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return points[camera.contains(points)]


def spread(low, high):
    return st.floats(low, high, allow_subnormal=False)


BROWN = st.builds(
    BrownConrady, k1=spread(-0.5, 0.5), k2=spread(-0.2, 0.2), p1=spread(-0.02, 0.02), p2=spread(-0.02, 0.02),
    k3=spread(-0.05, 0.05), k4=spread(-0.3, 0.3), k5=spread(-0.1, 0.1), k6=spread(-0.05, 0.05),
)  # fmt: skip
FISHEYE = st.builds(KannalaBrandt, *(spread(-width, width) for width in (0.2, 0.05, 0.01, 0.002)))
OMNI = st.builds(
    Scaramuzza, k2=spread(-0.8, 0.3), k3=spread(-0.3, 0.4), k4=spread(-0.6, 0.1), c=spread(0.98, 1.02),
    d=spread(-0.01, 0.01), e=spread(-0.01, 0.01),
)  # fmt: skip


def test_an_error_of_k1_leaves_the_edge_where_it_is():
    """A skew made it move along x."""
    lens, reach = KannalaBrandt(), 0.8
    camera = Camera(640, 480, 300.0, 280.0, 320.0, 240.0, skew=40.0, distortion=lens)
    at_edge = np.array([[np.sin(reach) * np.cos(a), np.sin(reach) * np.sin(a), np.cos(reach)] for a in (0.3, 2.0, 4.5)])
    moved = camera.with_radial_error(0.05, reach)
    np.testing.assert_allclose(moved.project(at_edge), camera.project(at_edge), atol=1e-9)
    # Negative control: other points move.
    assert np.abs(moved.project([0.3, 0.0, 1.0]) - camera.project([0.3, 0.0, 1.0])).max() > 1


@pytest.mark.parametrize(
    ("lens", "most"),
    [
        (BrownConrady(-0.2, 0.03, k3=0.01, k4=0.05), 1e-12),
        (BrownConrady(-0.2, 0.03, 0.001, -0.002), 1e-3),
        (KannalaBrandt(-0.05, 0.01), 1e-12),
        (Scaramuzza(-0.4, 0.02, 0.03, 1.01, 0.01, -0.01), 1e-12),
    ],
)
def test_many_errors_are_undone_as_each_alone_is(lens, most):
    rng, near = np.random.default_rng(1), np.array([0.488, 0.390, 0.781])
    errors, m = 0.03 * rng.standard_normal(40), lens.distort(near) + 0.03 * rng.standard_normal((40, 2))
    rays = undistort_with_errors(lens, m, errors, 0.7, near)
    for ray, point, error in zip(rays, m, errors.tolist(), strict=True):
        other, at_axis = with_radial_error(lens, error, 0.7)
        np.testing.assert_allclose(ray, other.undistort(point / at_axis), rtol=0, atol=most)


def test_past_its_fold_a_lens_with_an_error_sees_nothing():
    near = np.array([np.sin(1.0), 0.0, np.cos(1.0)])
    m = np.tile(KannalaBrandt().distort(near), (3, 1))
    seen = undistort_with_errors(KannalaBrandt(), m, np.array([0.0, -0.14, -0.16]), 0.0, near)
    # theta - 0.16 theta^3 is 0.962 at most
    np.testing.assert_array_equal(np.isfinite(seen).all(axis=1), [True, True, False])
    np.testing.assert_allclose(seen[0], near, atol=1e-12)


def test_newtons_steps_do_not_go_to_and_fro():
    """Between 91 and 92 deg they did, and gave directions 66 deg off."""
    lens = Scaramuzza(k2=-0.457423002005407, k3=0.0031308, k4=-0.5850735815836711)
    angle = np.radians(np.linspace(1, 150, 2000))
    rays = np.stack([np.sin(angle), np.zeros(2000), np.cos(angle)], axis=-1)
    np.testing.assert_allclose(lens.undistort(lens.distort(rays)), rays, atol=1e-10)


@settings(max_examples=examples(80), deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(st.one_of(BROWN, FISHEYE, OMNI), st.sampled_from([None, MASK]), spread(150, 900))
def test_pixels_round_trip(lens, mask, focal):
    try:
        camera = Camera(WIDTH, HEIGHT, focal, 0.9 * focal, 331.2, 225.7, 3.0, lens, mask)
    except InputError:
        assume(False)
    pixels = inside(camera)
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-14)
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-8)
    np.testing.assert_allclose(camera.project(0.3 * rays), pixels, atol=1e-8)


@settings(max_examples=examples(120), deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(st.one_of(BROWN, FISHEYE, OMNI), st.integers(0, 2**32 - 1))
def test_directions_round_trip(lens, seed):
    """On the first branch, undistort takes back what distort did, to the digits that the branch's slope leaves."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, min(0.9 * lens.limit_angle, 1.2), 200)
    around = rng.uniform(0, 2 * np.pi, 200)
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=-1)
    there = lens.distort(rays)
    seen = np.isfinite(there).all(axis=-1)  # tangential terms may fold a little earlier
    back = lens.undistort(there[seen])
    np.testing.assert_allclose(lens.distort(back), there[seen], atol=2e-13)
    if not isinstance(lens, BrownConrady) or lens.p1 == lens.p2 == 0:
        assert seen.all()
        np.testing.assert_allclose(back, rays, atol=1e-10)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_brown_conrady_is_opencvs(count):
    coefficients = np.array([-0.31, 0.12, 0.0013, -0.0021, -0.02, 0.03, -0.01, 0.004])[:count]
    camera = Camera(WIDTH, HEIGHT, 500.0, 430.0, 331.2, 225.7, 0.0, BrownConrady(*coefficients))
    points = np.random.default_rng(1).uniform([-4, -4, 8], [4, 4, 10], (500, 3))
    exported = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), exported, coefficients)
    np.testing.assert_allclose(camera.project(points), seen[:, 0] + 0.5, atol=1e-6)
    # Negative control: the half pixel counts.
    assert np.abs(camera.project(points) - seen[:, 0]).min() > 0.49


def test_kannala_brandt_is_opencvs():
    coefficients = np.array([0.05, -0.02, 0.004, -0.0007])
    camera = Camera(WIDTH, HEIGHT, 240.0, 235.0, 331.2, 225.7, 0.0, KannalaBrandt(*coefficients))
    points = np.random.default_rng(1).uniform([-9, -9, 2], [9, 9, 10], (500, 1, 3))
    exported = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    seen, _ = cv2.fisheye.projectPoints(points, np.zeros((3, 1)), np.zeros((3, 1)), exported, coefficients)
    np.testing.assert_allclose(camera.project(points[:, 0]), seen[:, 0] + 0.5, atol=1e-6)
    flat = np.ascontiguousarray(points[:, :, :2] / points[:, :, 2:])
    again = cv2.fisheye.distortPoints(flat, exported, coefficients)
    np.testing.assert_allclose(camera.project(points[:, 0]), again[:, 0] + 0.5, atol=1e-6)


def test_an_omnidirectional_lens_sees_sideways_and_backwards():
    """Its definition in numbers: r = 2 sees the direction (2, 0, 1 - 0.5 * 4), which is behind the camera."""
    lens = Scaramuzza(k2=-0.5)
    np.testing.assert_allclose(lens.undistort([2.0, 0.0]), np.array([2, 0, -1]) / np.sqrt(5), atol=1e-15)
    np.testing.assert_allclose(lens.distort([4.0, 0.0, -2.0]), [2, 0], atol=1e-14)
    np.testing.assert_allclose(lens.distort([0.0, 3.0, 0.0]), [0, np.sqrt(2)], atol=1e-14)
    assert np.isnan(lens.distort([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])).any(axis=1).all()
    # The stretch, after the radius: (c x + d y, e x + y).
    sheared = Scaramuzza(k2=-0.5, c=1.1, d=0.2, e=-0.1)
    np.testing.assert_allclose(sheared.distort([2.0, 2.0, 1.0]), lens.distort([2.0, 2.0, 1.0]) * [1.3, 0.9], atol=1e-14)
    np.testing.assert_allclose(sheared.undistort(sheared.distort([2.0, -1.0, 0.5])), np.array([4, -2, 1]) / np.sqrt(21))
    for c, d, e in ((1.0, 2.0, 0.5), (-1.0, 0.0, 0.0), (0.0, 0.0, 0.0)):
        with pytest.raises(InputError, match=r"distortion\.c = .* c - d e must be > 0"):
            Scaramuzza(-0.1, 0.0, 0.0, c, d, e)


def test_a_fisheye_sees_sideways_and_backwards():
    camera = Camera(800, 800, 180.0, 180.0, 400.0, 400.0, 0.0, KannalaBrandt(0.01), ViewMask(400, 400, 350))
    right, edge = camera.unproject([[400 + 180 * np.pi / 2 * (1 + 0.01 * (np.pi / 2) ** 2), 400], [749.9, 400.0]])
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)
    assert edge[2] < -0.1
    np.testing.assert_allclose(camera.project(5 * edge), [749.9, 400.0], atol=1e-8)
    assert np.isnan(camera.project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])).all()
    # A perspective lens does not.
    perspective = Camera(800, 800, 500.0, 500.0, 400.0, 400.0, 0.0, BrownConrady(0.1))
    assert np.isnan(perspective.project([[1.0, 0, 0], [1.0, 0, -0.5]])).all()


def test_beyond_the_fold_nothing_is_seen():
    lens = BrownConrady(k1=-0.4)
    assert lens.limit == pytest.approx(np.sqrt(1 / 1.2))
    assert KannalaBrandt(k1=-0.2).limit_angle == pytest.approx(np.sqrt(1 / 0.6))
    assert BrownConrady(k1=0.1).limit == 1e6
    # f - r f' = 1 - k2 r^2 vanishes where the direction (r, f) is farthest from the axis.
    assert Scaramuzza(k2=0.25).limit == pytest.approx(2)
    assert Scaramuzza(k2=0.25).limit_angle == pytest.approx(np.arctan2(2, 2))
    assert np.isnan(Scaramuzza(k2=0.25).undistort([2.001, 0])).all()
    assert np.isfinite(Scaramuzza(k2=0.25).undistort([1.999, 0])).all()
    assert (Scaramuzza(k4=-0.1).limit_angle, Scaramuzza().limit_angle) == pytest.approx((np.pi, np.pi / 2), abs=2e-6)
    assert BrownConrady(k4=-0.25).limit == pytest.approx(2)  # the pole
    before, after = lens.limit - 1e-3, lens.limit + 1e-3
    assert np.isfinite(lens.distort([before, 0, 1])).all()
    assert np.isnan(lens.distort([after, 0, 1])).all()
    # The radius at the fold, r (1 - 0.4 r^2), is the largest that has a direction.
    most = lens.limit * (1 - 0.4 * lens.limit**2)
    assert np.isfinite(lens.undistort([most - 1e-9, 0])).all()
    assert np.isnan(lens.undistort([most + 1e-9, 0])).all()


def test_tangential_terms_next_to_a_pole():
    """Newton's steps went across the pole: 2 % of these directions were imaged and not found again."""
    lens = BrownConrady(-0.359, -0.031, 0.02, 0.016, -0.015, -0.164, -0.114, -0.022)
    rng = np.random.default_rng(0)
    theta, phi = lens.limit_angle * rng.uniform(0.8, 0.999, 4000), rng.uniform(0, 2 * np.pi, 4000)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    np.testing.assert_allclose(lens.undistort(lens.distort(rays)), rays, atol=1e-9)


def test_tangential_terms_fold_too():
    lens = BrownConrady(p2=0.3)
    # Along x: m = x + 3 p2 x^2, whose slope vanishes at x = -1/(6 p2).
    assert np.isfinite(lens.distort([-0.55, 0, 1])).all()
    assert np.isnan(lens.distort([-0.56, 0, 1])).all()
    with pytest.raises(InputError, match="folds over"):
        Camera(600, 600, 600.0, 600.0, 300.0, 300.0, 0.0, lens)
    Camera(600, 600, 1500.0, 1500.0, 300.0, 300.0, 0.0, lens)


@pytest.mark.parametrize("lens", [BrownConrady(k1=-0.4), KannalaBrandt(k1=-0.4, k2=-0.05), Scaramuzza(k2=0.3)])
def test_a_lens_that_folds_over_in_view_is_refused(lens):
    near = 0.9999 * lens.limit_angle
    # An omnidirectional lens has its fold in the angle, not in the radius.
    fold = lens.limit if isinstance(lens, Scaramuzza) else float(lens.distort([np.sin(near), 0, np.cos(near)])[0])
    size, focal = 600, 300 / fold
    with pytest.raises(InputError, match=rf"folds over at {np.degrees(lens.limit_angle):.4g} deg .* over the image"):
        Camera(size, size, focal, focal, 300.0, 300.0, 0.0, lens)
    with pytest.raises(InputError, match="over the view mask"):
        Camera(size, size, focal, focal, 300.0, 300.0, 0.0, lens, ViewMask(300.0, 300.0, 301.0))
    camera = Camera(size, size, focal, focal, 300.0, 300.0, 0.0, lens, ViewMask(300.0, 300.0, 299.0))
    assert np.isfinite(camera.unproject(camera.pixel_centres()[camera.seen])).all()
    Camera(size, size, 1.5 * focal, 1.5 * focal, 300.0, 300.0, 0.0, lens)


@pytest.mark.parametrize(("lens", "bad"), [(BrownConrady, float("inf")), (KannalaBrandt, "0.1"), (Scaramuzza, True)])
def test_coefficients_that_are_none(lens, bad):
    with pytest.raises(InputError, match=r"distortion\.k[23] = .*: must be a finite number"):
        lens(0.1, bad)


def test_shapes_and_the_axis():
    """At the axis no formula may divide by the radius."""
    for lens in (BrownConrady(-0.3), KannalaBrandt(0.1), Scaramuzza(-0.6)):
        np.testing.assert_array_equal(lens.undistort([[0.0, 0.0]]), [[0, 0, 1]])
        np.testing.assert_array_equal(lens.distort([[0.0, 0.0, 2.0]]), [[0, 0]])
        assert lens.distort(np.ones((3, 4, 3))).shape == (3, 4, 2)
        assert lens.undistort(np.zeros((3, 4, 2))).shape == (3, 4, 3)
