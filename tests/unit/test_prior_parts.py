"""What nobody told: parts of the budget from the priors, against draws from these priors through exact geometry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from simtest.calibration import LIGHT_AT_CAMERA, CameraPrior, LogUniform, Normal, Priors, Uniform, exactly
from simtest.estimators import prior_parts
from simtest.estimators.budget import equivalent_variance, line_covariance
from simtest.estimators.family import fit_isophote_family
from simtest.estimators.names import load_estimators
from simtest.estimators.prior_parts import (
    FADES,
    SPOT_ONSET,
    SPOT_SPREAD,
    STEEPER,
    add_untold_parts,
    falloff_part,
    light_offset_part,
    relief_part,
    to_base,
)
from simtest.estimators.protocol import Estimate
from simtest.geometry import BrownConrady, Camera, KannalaBrandt, Patch, ViewMask, smooth
from simtest.geometry.vectors import basis_across, bisect, tangent_coordinates

LIMIT = chi2.ppf(0.95, 2)
WIDE = Camera.from_fov(120.0, 640, 480)
NOISE = 1e-5 * np.eye(2)
ANGLES_DEG = (0.0, 20.0, 40.0, 55.0)


def sightline_at(angle_deg):
    angle = np.radians(angle_deg)
    return np.array([np.sin(angle) * np.cos(0.7), np.sin(angle) * np.sin(0.7), np.cos(angle)])


def stated(sightline, **given):
    return Estimate(-sightline, -sightline[None], WIDE.project(sightline), **{"budget": {"noise": NOISE}, **given})


def moves_of(sightline, normals):
    """Return the rotations from a reversed sightline to normals, tangent basis, shape (N, 2)."""
    across = normals @ basis_across(-sightline).T
    sine = np.linalg.norm(across, axis=1)
    return across * (np.arctan2(sine, -normals @ sightline) / np.maximum(sine, 1e-15))[:, None]


def true_moves(sightline, offset_mm, distance_mm, rng):
    """Draw azimuths, and return how far the true normal on a plane is from the reversed sightline."""
    azimuth = rng.uniform(0, 2 * np.pi, len(distance_mm))
    lights = offset_mm * np.array([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))])
    return moves_of(sightline, bisect(distance_mm[:, None] * sightline, lights.T))


def held(moves, covariance):
    return np.mean(np.einsum("ni,ni->n", moves, np.linalg.solve(covariance, moves.T).T) <= LIMIT)


# The light ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_a_light_that_nobody_told_is_covered(angle_deg):
    rng, sightline, count = np.random.default_rng(int(angle_deg)), sightline_at(angle_deg), 20000
    covariance = light_offset_part(-sightline, Priors())
    distance = rng.uniform(5, 80, count)
    moves = true_moves(sightline, rng.uniform(0, 6, count), distance, rng)
    assert held(moves, covariance) == pytest.approx(0.95, abs=0.008)
    # The median of what is untold, its largest value, and a light at the camera.
    assert held(true_moves(sightline, 3.0, distance, rng), covariance) >= 0.93
    assert held(true_moves(sightline, 6.0, distance, rng), covariance) >= 0.70
    assert held(true_moves(sightline, 0.0, distance, rng), covariance) == 1
    # Not by being vague.
    rms = np.sqrt(np.mean(np.sum(moves**2, axis=1)) / 2)
    assert np.sqrt(np.linalg.eigvalsh(covariance)[1]) < 1.5 * rms


@pytest.mark.parametrize(
    ("offset", "distance"),
    [(Uniform(2.0, 4.0), Uniform(30.0, 50.0)), (exactly(3.0), Normal(20.0, 4.0)), (exactly(2.0), LogUniform(5, 80))],
)
def test_told_ranges_narrow_the_part(offset, distance):
    rng, sightline, count = np.random.default_rng(1), sightline_at(25.0), 40000
    priors = Priors(light_offset_mm=offset, distance_mm=distance)
    covariance = light_offset_part(-sightline, priors)
    o, d = (prior.quantile(rng.random(count)) for prior in (offset, distance))
    assert 0.93 <= held(true_moves(sightline, o, d, rng), covariance) <= 0.98
    assert np.trace(covariance) < np.trace(light_offset_part(-sightline, Priors()))


def test_the_light_s_part_is_in_the_budget_where_none_is_told_alone():
    sightline = sightline_at(20.0)
    open_light = add_untold_parts(stated(sightline), WIDE, Priors(falloff_power=None))
    assert set(open_light.budget) == {"noise", "light_offset"}
    at_camera = add_untold_parts(stated(sightline), WIDE, LIGHT_AT_CAMERA)
    assert set(at_camera.budget) == {"noise"}
    assert at_camera.flags == ()
    # A known error is no random one, whether the distance is told or not.
    for distance in (None, exactly(20.0)):
        beside = add_untold_parts(stated(sightline), WIDE, Priors(((3.0, 0.0, 0.0),), distance))
        assert (beside.covariance, beside.flags) == (None, ("light_offset",))
    # Far below the stated error it does not matter.
    near = Priors(((0.01, 0.0, 0.0),), exactly(50.0), falloff_power=None)
    assert (add_untold_parts(stated(sightline), WIDE, near).covariance == NOISE).all()
    # An estimate without an uncertainty gets none.
    assert add_untold_parts(stated(sightline, budget=None), WIDE, Priors()).covariance is None


# The camera -----------------------------------------------------------------------------------------------------------


def drawn_sightlines(camera, prior, pixel, rng, count=8000):
    """Return what drawn cameras see at a pixel, those that see something, by bisection of their lens's formula."""
    error = prior.distortion_sd * rng.standard_normal(count)
    at_axis = 1 - error * prior.edge_reach**2
    k1 = (0.0 if camera.distortion is None else camera.distortion.k1) + error / at_axis
    centre = np.array([camera.cx, camera.cy]) + prior.centre_sd_px * rng.standard_normal((count, 2))
    focal = (1 + prior.focal_sd * rng.standard_normal(count)) * at_axis
    m = (pixel - centre) / focal[:, None] / [camera.fx, camera.fy]
    radius, low = np.linalg.norm(m, axis=1), np.zeros(count)
    high = np.where(k1 < 0, 1 / np.sqrt(3 * np.maximum(-k1, 1e-9)), 10.0)
    is_seen = high * (1 + k1 * high**2) > radius
    for _ in range(50):
        middle = (low + high) / 2
        is_low = middle * (1 + k1 * middle**2) < radius
        low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
    angle = low if isinstance(camera.distortion, KannalaBrandt) else np.arctan(low)
    across = m / np.maximum(radius, 1e-15)[:, None] * np.sin(angle)[:, None]
    return np.concatenate([across, np.cos(angle)[:, None]], axis=1)[is_seen]


def camera_shares(camera, prior, pixel, rng, noise, count=8000):
    """Return the shares of drawn cameras' sightlines that lie in the stated region, with the camera's part and without.

    What each sees at a pixel is compared with what the told one sees there, beside noise of a deviation, rad.
    """
    sightline = camera.unproject(pixel)
    given = Estimate(-sightline, -sightline[None], np.array(pixel), budget={"noise": noise**2 * np.eye(2)})
    covariance = add_untold_parts(given, camera, replace(LIGHT_AT_CAMERA, camera=prior)).covariance
    true = drawn_sightlines(camera, prior, pixel, rng, count)
    moves = moves_of(sightline, -true) + noise * rng.standard_normal((len(true), 2))
    return held(moves, covariance), held(moves, given.covariance)


@pytest.mark.parametrize(
    "prior", [CameraPrior(focal_sd=0.1), CameraPrior(centre_sd_px=12.8), CameraPrior(0.1, 12.8, 0.02)]
)
@pytest.mark.parametrize("pixel", [(330.0, 250.0), (480.0, 300.0), (600.0, 60.0)])
def test_a_guessed_camera_is_covered(prior, pixel):
    share, _ = camera_shares(WIDE, prior, pixel, np.random.default_rng(3), 0.01, 20000)
    assert 0.93 <= share <= 0.98


FOLDING = Camera(
    1000, 1000, 400.0, 400.0, 500.0, 500.0, distortion=BrownConrady(k1=-0.3), view_mask=ViewMask(500.0, 500.0, 281.0)
)
"""Its lens folds 281.1 px from the centre."""


@pytest.mark.ci
def test_a_camera_is_covered_up_to_the_rim_of_a_lens_that_folds():
    """8000 cameras at each pixel, those with a sightline there; the last one is 0.1 px from where the lens ends."""
    rng, prior = np.random.default_rng(51), CameraPrior(0.005, 2.0, 0.02)
    shares = [camera_shares(FOLDING, prior, (x, 500.0), rng, 0.01) for x in (700.0, 770.0, 778.0, 780.5, 781.0)]
    held_share, without = zip(*shares, strict=True)
    assert 0.92 <= np.mean(held_share) <= 0.98, held_share
    assert min(held_share) >= 0.92, held_share
    # Negative control: without the part.
    assert max(without[1:]) < 0.8, without


BARREL = Camera(
    640, 480, 420.0, 380.0, 310.0, 250.0, distortion=BrownConrady(k1=-0.2), view_mask=ViewMask(310.0, 250.0, 330.0)
)
FISHEYE = Camera(
    640, 480, 300.0, 300.0, 320.0, 240.0, distortion=KannalaBrandt(k1=-0.1), view_mask=ViewMask(320.0, 240.0, 350.0)
)


@pytest.mark.parametrize("camera", [BARREL, FISHEYE])
@pytest.mark.parametrize(
    "prior", [CameraPrior(distortion_sd=0.05), CameraPrior(distortion_sd=0.05, edge_reach=0.8),
              CameraPrior(0.02, 3.0, 0.02, 0.8), CameraPrior(0.05, 10.0)],
)  # fmt: skip
def test_lenses_with_a_radial_error_are_covered(camera, prior):
    """Of a fisheye the error was taken at the image's radius, not the angle, and all were linear: down to 69 %."""
    rng = np.random.default_rng(8)
    for radius in (0.0, 100.0, 200.0, 300.0):
        pixel = np.array([camera.cx, camera.cy]) + radius * np.array([0.8, 0.6])
        assert 0.92 <= camera_shares(camera, prior, pixel, rng, 1e-3)[0] <= 0.98, radius


def test_no_uncertainty_is_reported_where_the_lens_sees_nothing():
    sightline = FOLDING.unproject((781.0, 500.0))
    beyond = Estimate(-sightline, -sightline[None], np.array([782.0, 500.0]), budget={"noise": NOISE})
    assert add_untold_parts(beyond, FOLDING, Priors(camera=CameraPrior(0.01))).covariance is None


# One number -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("draw", [Uniform(0.0, 4.0), Normal(0.0, 2.0), LogUniform(0.1, 10.0), Uniform(-1.0, 1.0)])
def test_an_error_along_a_line_is_covered_beside_a_normal_one(draw):
    rng, count = np.random.default_rng(5), 100_000
    x = draw.quantile(rng.random(count)) if not isinstance(draw, Normal) else draw.sd * rng.standard_normal(count)
    shares = (np.arange(200) + 0.5) / 200
    samples = draw.quantile(shares)
    v = equivalent_variance(samples)
    assert np.mean(x**2 / v + rng.standard_normal(count) ** 2 <= LIMIT) == pytest.approx(0.95, abs=0.005)
    if isinstance(draw, Normal):
        assert v == pytest.approx(draw.sd**2, rel=0.02)
    # Turned into any direction.
    turned = line_covariance(samples[:, None] * np.array([0.6, 0.8]))
    np.testing.assert_allclose(turned, v * np.outer([0.6, 0.8], [0.6, 0.8]), atol=1e-9 * v)


@pytest.mark.parametrize("plane", [True, False])
def test_relief_is_covered_at_the_base(plane):
    rng, count = np.random.default_rng(6), 40000
    slope = np.radians(rng.uniform(3, 20, count))
    # highlights lie wider than the slope by the width of their lobe, in squares, and on organs where it is steep, as
    # far as steep facets are in view
    steeper = 1.0 if plane else STEEPER / np.hypot(1, slope / FADES)
    spread = np.hypot(steeper * slope, SPOT_SPREAD * np.sqrt(1 - np.exp(-((slope / SPOT_ONSET) ** 2))))
    moves = spread[:, None] * rng.standard_normal((count, 2))
    assert held(moves, relief_part(Priors(plane=plane))) == pytest.approx(0.95, abs=0.006)
    told = relief_part(Priors(relief_slope=exactly(np.radians(5.0)), plane=plane))
    steeper = 1.0 if plane else STEEPER / np.hypot(1, np.radians(5.0) / FADES)
    np.testing.assert_allclose(told, ((steeper * np.radians(5.0)) ** 2 + SPOT_SPREAD**2) * np.eye(2), rtol=1e-5)
    if not plane:
        # Negative control: what holds a plane's relief does not hold an organ's.
        moves = np.sqrt(told[0, 0]) * rng.standard_normal((count, 2))
        assert held(moves, relief_part(Priors(relief_slope=exactly(np.radians(5.0)), plane=True))) < 0.9
    # A smooth surface has one highlight, at the base's own brightest point.
    np.testing.assert_array_equal(relief_part(Priors(relief_slope=exactly(0.0), plane=plane)), np.zeros((2, 2)))


def test_a_single_highlight_states_the_base_with_the_relief_in_its_budget():
    fine = stated(sightline_at(10.0))
    relief = relief_part(Priors())
    base = to_base(fine, relief)
    assert (base.target, set(base.budget)) == ("base", {"noise", "relief"})
    np.testing.assert_array_equal(base.normal, fine.normal)
    assert to_base(base, relief) is base
    assert to_base(fine.without_uncertainty(), relief).covariance is None


# The falloff ----------------------------------------------------------------------------------------------------------


def falloff_frame(power, camera, widths=(7.0, 10.0)):
    """Return a Gaussian lobe off the optical axis under a falloff cos^k."""
    x, y = np.moveaxis(camera.pixel_centres(), -1, 0)
    lobe = np.exp(-((x - 222.3) ** 2) / 2 / widths[0] ** 2 - (y - 70.8) ** 2 / 2 / widths[1] ** 2)
    return (lobe * camera.unproject(camera.pixel_centres())[..., 2] ** power).astype(np.float32)


@pytest.mark.parametrize("name", ["cone_axis", "brightest_point", "curved"])
def test_a_falloff_that_nobody_told_is_covered(name, monkeypatch):
    camera = Camera.from_fov(80.0, 320, 240)
    powers = (np.arange(20) + 0.5) / 5  # evenly over the prior, 0 to 4
    estimator = load_estimators([name])[name]

    def estimated(power, priors):
        values = smooth(falloff_frame(power, camera), 1.0)
        patch = Patch.cut(values, (180, 30, 90, 90), noise=1e-4, smoothing_px=1.0)
        return estimator.estimate(patch, camera, priors)

    right = estimated(0.0, LIGHT_AT_CAMERA)
    told = replace(LIGHT_AT_CAMERA, falloff_power=Priors().falloff_power)
    moves = np.array([tangent_coordinates(right.normal, estimated(k, LIGHT_AT_CAMERA).normal) for k in powers])
    family = fit_isophote_family(
        Patch.cut(smooth(falloff_frame(0.0, camera), 1.0), (180, 30, 90, 90), noise=1e-4, smoothing_px=1.0),
        camera, (0.5,),
    )  # fmt: skip
    part = falloff_part(right.normal, family, told.falloff_power, told)
    along = np.linalg.eigh(part)[1][:, 1]
    # The law about the optical axis: k tan(phi) times the lobe's moments.
    monkeypatch.setattr(prior_parts, "TILT", 0.0)
    exact = falloff_part(right.normal, family, exactly(4.0), told) * LIMIT
    largest = float(np.abs(tangent_coordinates(right.normal, estimated(4.0, LIGHT_AT_CAMERA).normal) @ along))
    limit = {"cone_axis": 0.05, "curved": 0.05, "brightest_point": 0.3}[name]
    assert np.sqrt(exact[0, 0] + exact[1, 1]) == pytest.approx(largest, rel=limit)
    if name != "brightest_point":
        # All but the strongest falloffs lie in the region, and these do not by much.
        inside = np.mean((moves @ along) ** 2 <= LIMIT * np.trace(part))
        assert 0.9 <= inside <= 1
        assert set(estimated(2.0, told).budget) - set(estimated(2.0, LIGHT_AT_CAMERA).budget) == {"response"}
