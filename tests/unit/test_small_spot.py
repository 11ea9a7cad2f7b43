"""Small and clipped highlights: the centre of a spot, what is stated of it, and what clipping hides."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.calibration import Calibration, Frame
from simtest.calibration.photometry import AngularProfile
from simtest.errors import Failure, Reason
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.budget import clipped_pixels, plateau_area_px
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.family import fit_isophote_family
from simtest.estimators.highlight import fit_highlights
from simtest.estimators.photometric import photometric
from simtest.estimators.small_spots import (
    SpotWindows,
    fit_small_spots,
    fit_spots,
    is_small,
    radius_before_smoothing_px,
)
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import angle_deg

CAMERA = Camera.from_fov(60.0, 96, 80)
BOX, CENTRE = (28, 22, 41, 37), np.array([48.3, 40.6])
ISOVALUES = (0.3, 0.4, 0.5, 0.6, 0.7)


def spot(centre=CENTRE, sigma=(1.2, 1.2), turn=0.0, height=0.8):
    """A Gaussian spot in the frame."""
    x, y = np.meshgrid(np.arange(96) + 0.5 - centre[0], np.arange(80) + 0.5 - centre[1])
    along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    return height * np.exp(-((along / sigma[0]) ** 2 + (across / sigma[1]) ** 2) / 2)


def patch_of(image, noise=0.0, smoothing_px=1.0, level=None, seed=0):
    frame = image + noise * np.random.default_rng(seed).standard_normal(image.shape) + 0.1
    if level is not None:
        frame = np.minimum(frame, level)
    calibration = Calibration(CAMERA, saturation_level=level)
    made = Frame(frame.astype(np.float32), calibration, smoothing_px).patch(BOX)
    assert isinstance(made, Patch)
    return made


sizes = st.floats(0.8, 2.0)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), sizes, sizes, st.floats(0, 3.1), st.sampled_from([0.0, 1.0, 2.0]))
@settings(max_examples=40, deadline=None)
def test_a_gaussian_spot_has_its_centre(dx, dy, along, across, turn, smoothing_px):
    at = np.add(CENTRE, [dx, dy])
    (found,) = fit_small_spots([patch_of(spot(at, (along, across), turn), smoothing_px=smoothing_px)], CAMERA)
    assert np.abs(found.centre_px - at).max() < 5e-3
    # the spot's own second moments, which smoothing does not change
    expected = np.sort([along**2, across**2])
    np.testing.assert_allclose(np.linalg.eigvalsh(found.variance_px2), expected, rtol=0.03)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(1.1, 1.9))
@settings(max_examples=20, deadline=None)
def test_clipping_does_not_move_the_centre(dx, dy, sigma):
    at = np.add(CENTRE, [dx, dy])
    (found,) = fit_small_spots([patch_of(spot(at, (sigma, sigma), height=2.7), level=0.9)], CAMERA)
    assert np.abs(found.centre_px - at).max() < 0.02


@pytest.mark.parametrize("sigma", [1.5, 2.2, 4.0])
@pytest.mark.parametrize("smoothing_px", [0.0, 1.0, 2.0])
def test_the_radius_is_that_before_smoothing(sigma, smoothing_px):
    patch = patch_of(spot(sigma=(sigma, sigma)), smoothing_px=smoothing_px)
    radius = radius_before_smoothing_px(patch)
    assert radius == pytest.approx(sigma * np.sqrt(2 * np.log(2)), abs=0.35)
    assert is_small(patch) == (radius < 3)


def test_the_centre_scatters_as_its_noise_says():
    patches = [patch_of(spot(), noise=0.03, seed=seed) for seed in range(120)]
    found = fit_small_spots(patches, CAMERA)
    scatter = np.cov(np.array([each.centre_px for each in found]).T)
    stated = np.mean([each.by_noise_px2 for each in found], axis=0)
    # 120 pairs know a variance to 13 %, one standard deviation
    assert np.trace(scatter) == pytest.approx(np.trace(stated), rel=0.45)


def test_one_by_one_and_together_are_the_same_bytes():
    patches = [patch_of(spot(sigma=(s, 1.1)), noise=0.01, seed=k) for k, s in enumerate((0.9, 1.4, 1.9))]
    together = fit_small_spots(patches, CAMERA)
    for patch, of_all in zip(patches, together, strict=True):
        (alone,) = fit_small_spots([patch], CAMERA)
        assert (alone.centre_px == of_all.centre_px).all()
        assert (alone.by_shape_px2 == of_all.by_shape_px2).all()


def test_what_estimators_state_of_a_small_highlight():
    patch = patch_of(spot(), noise=0.01)
    true = -CAMERA.unproject(CENTRE)
    for estimator in (cone_axis, curved, photometric, brightest_point):
        made = estimator.estimate(patch, CAMERA)
        assert "unresolved" in made.flags
        assert made.axis_ratio is None
        assert made.curvature is None
        assert made.isophotes == ()
        assert set(made.budget) >= {"noise", "resolution"}
        error = float(angle_deg(made.normal, true))
        assert error < 3 * np.degrees(np.sqrt(np.trace(made.covariance)))
    refused = circle_pose.estimate(patch, CAMERA)
    assert isinstance(refused, Failure)
    assert refused.reason == Reason.UNRESOLVED


def test_a_neighbour_that_is_told_is_left_out():
    image = spot() + spot(np.add(CENTRE, [6.5, 0.0]))
    alone = patch_of(image, noise=0.005)
    peak = np.array([48, 40])
    frame = Frame((image + 0.1).astype(np.float32), Calibration(CAMERA), 1.0)
    told = replace(frame.patch(BOX, tuple(peak)), others_px=((54.8, 40.6),))
    (found,) = fit_small_spots([told], CAMERA)
    assert np.abs(found.centre_px - CENTRE).max() < 0.05
    assert alone.peak_value > 0


def test_a_fit_that_fails_states_the_spot_for_its_error():
    # a cross of clipped pixels says nothing of a Gaussian
    image = np.zeros((80, 96))
    image[38:43, 46:51] = 1.0
    patch = patch_of(image, level=0.9)
    (found,) = fit_small_spots([patch], CAMERA)
    assert np.sqrt(np.trace(found.by_shape_px2)) > 0.3


def test_isophotes_that_hold_another_highlight_are_left_out():
    image = spot(sigma=(4.0, 4.0), height=1.0) + spot(np.add(CENTRE, [12.0, 2.0]), (3.0, 3.0), height=0.55) - 0.1
    patch = patch_of(image)
    family = fit_isophote_family(patch, CAMERA, ISOVALUES)
    assert 2 <= len(family.isophotes) < len(ISOVALUES)
    assert any("holds other highlights" in failure.detail for failure in family.failures)
    assert float(angle_deg(family.axis, CAMERA.unproject(CENTRE))) < 0.2


def test_a_clipped_peak_widens_the_budget():
    whole, clipped = (patch_of(spot(sigma=(5.0, 4.0), height=0.8), 0.003, level=level) for level in (None, 0.5))
    assert plateau_area_px(whole, 0.3) == 0
    assert plateau_area_px(clipped, 0.3) > 20
    families = [fit_isophote_family(patch, CAMERA, ISOVALUES) for patch in (whole, clipped)]
    assert not families[0].clipping.any()
    for budget in (families[1].axis_budget, families[1].peak_budget):
        assert np.linalg.eigvalsh(budget["resolution"])[0] > 0
    # the plateau is as long as the highlight, along the same direction
    values = np.linalg.eigvalsh(families[1].axis_budget["resolution"])
    assert np.sqrt(values[1] / values[0]) == pytest.approx(5 / 4, rel=0.1)


@pytest.mark.parametrize("power", [0.0, 4.0])
def test_what_is_clipped_is_told_where_the_falloff_was_divided_away(power):
    """A highlight near the border is far from clipped, and after the division as bright as one that is."""
    camera = Camera(200, 100, 100.0, 100.0, 50.0, 50.0)
    x, y = np.meshgrid(np.arange(200) + 0.5, np.arange(100) + 0.5)
    falloff = np.hypot(1, np.hypot(x - 50, y - 50) / 100) ** -power
    light = sum(h * np.exp(-((x - u) ** 2 + (y - 50) ** 2) / (2 * s**2)) for u, h, s in ((50, 3, 5), (170, 0.97, 5)))
    frame = np.minimum(light * falloff, 1).astype(np.float32)
    calibration = Calibration(camera, vignetting=AngularProfile(power), saturation_level=1.0)
    for peak, clipped in ((50, frame >= 1), (170, np.zeros(frame.shape, dtype=bool))):
        patch = Frame(frame, calibration, 1.0).patch((0, 0, 200, 100), (peak, 50))
        assert plateau_area_px(patch, 0.5) == pytest.approx(np.count_nonzero(clipped), rel=0.1)


@pytest.mark.parametrize("box", [np.s_[8:29, 9:30], np.s_[0:13, 30:41], np.s_[20:37, 0:5]])
def test_clipped_pixels_of_a_box_are_those_of_the_whole_there(box):
    patch = patch_of(spot(sigma=(3.0, 3.0)) + spot(CENTRE - 14, (2.0, 2.0)), noise=0.05, level=0.6)
    whole = clipped_pixels(patch)
    assert 0 < whole.sum() < whole.size
    assert (whole != patch.saturated).any()
    assert np.array_equal(clipped_pixels(patch, box), whole[box])


def test_what_is_fitted_is_kept_with_the_patch():
    patch = patch_of(spot(sigma=(4.0, 4.0)), noise=0.01)
    (first,), (again,) = (fit_highlights([patch], CAMERA, ISOVALUES) for _ in range(2))
    assert first is again
    (of_copy,) = fit_highlights([replace(patch, others_px=((1.0, 2.0),))], CAMERA, ISOVALUES)
    assert of_copy is not first


def test_the_residual_is_what_stands_off_the_spot():
    """Of noise its standard deviation, each free pixel counted once."""
    sigma, side = 0.02, np.arange(15) - 7.0
    offsets = np.stack([axis.ravel() for axis in np.meshgrid(side, side)])
    lobe = np.exp(-((offsets - 0.3) ** 2).sum(axis=0) / (2 * 2.0**2))
    values = lobe + sigma * np.random.default_rng(5).standard_normal((40, len(lobe)))
    none = np.zeros(values.shape, dtype=bool)
    fits = fit_spots(SpotWindows(values, ~none, none, offsets), np.zeros((40, 2)), np.full(40, 4.0), np.zeros(40))
    assert fits.sound.all()
    # 40 windows of 218 free pixels: the mean of the variances is known to 1.5 %.
    assert np.mean(fits.residual**2) == pytest.approx(sigma**2, rel=0.06)
