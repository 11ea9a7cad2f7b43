"""What is known beside the picture: its limits, its way to the estimators, and what they make of it."""

from dataclasses import replace

import numpy as np
import pytest

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, CameraPrior, LogUniform, Normal, Priors, Uniform, exactly
from simtest.calibration.priors import NO_FLOORS, OF_PICTURES, Floors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.bisector import bisector
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.budget import dominant
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved, gain_of_stiffness
from simtest.estimators.dispatch import run
from simtest.estimators.family import fit_isophote_family
from simtest.estimators.isophotes import fit_peak_value
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.vectors import angle_deg, bisect, tangent_coordinates
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.spec import load_calibration, scene_from_dict
from simtest.validation import laws
from tests.marked import marked

CAMERA = Camera(200, 160, 200.0, 200.0, 100.0, 80.0)
ISOVALUES = (0.3, 0.4, 0.5, 0.6, 0.7)


def lobe(sigma=0.0, widths=(14.0, 9.0), seed=0, smoothing=2.0):
    x, y = np.meshgrid(np.arange(200) + 0.5, np.arange(160) + 0.5)
    frame = np.exp(-((x - 103.3) ** 2) / 2 / widths[0] ** 2 - (y - 76.8) ** 2 / 2 / widths[1] ** 2)
    frame = frame + sigma * np.random.default_rng(seed).standard_normal(frame.shape)
    smoothed = smooth(frame.astype(np.float32), smoothing).astype(float)
    patch = Patch.cut(smoothed, (30, 20, 150, 120), noise=sigma or None, smoothing_px=smoothing, others_px=())
    assert isinstance(patch, Patch)
    return patch


MALFORMED = [
    (Priors, {"lights_mm": ((0.0, 1.0),)}, "lights_mm"),
    (Priors, {"lights_mm": ((0.0, 1.0, float("nan")),)}, "lights_mm"),
    (Priors, {"distance_mm": exactly(-1.0)}, "distance_mm = -1.0"),
    (Priors, {"distance_mm": Uniform(-1.0, 5.0)}, "distance_mm = -1.0"),
    (Priors, {"distance_mm": 5.0}, r"must be a Uniform, Normal or LogUniform, or exactly\(5.0\)"),
    (Priors, {"lobe_curvature": exactly(0.0)}, "lobe_curvature = 0.0"),
    (Priors, {"light_offset_mm": Uniform(-1.0, 2.0)}, "light_offset_mm = -1.0"),
    (Priors, {"light_offset_mm": None}, "must be a Uniform"),
    (Priors, {"falloff_power": Normal(-1.0, 1.0)}, "falloff_power = -1.0"),
    (Priors, {"relief_slope": 3.0}, "relief_slope = 3.0"),
    (Priors, {"camera": 0.1}, "priors camera is a float"),
    (CameraPrior, {"focal_sd": -1}, "focal_sd = -1"),
    (Normal, {"mean": 5.0, "sd": -1.0}, "Normal sd = -1.0"),
    (Normal, {"mean": float("nan"), "sd": 1.0}, "Normal mean = nan"),
    (Uniform, {"low": 2.0, "high": 2.0}, "low must be less than high"),
    (Uniform, {"low": 0.0, "high": float("inf")}, "Uniform high = inf"),
    (LogUniform, {"low": 0.0, "high": 2.0}, "LogUniform low = 0.0"),
]


def test_what_is_known_is_checked():
    for kind, values, said in MALFORMED:
        with pytest.raises(InputError, match=said):
            kind(**values)


@pytest.mark.parametrize("prior", [Uniform(2.0, 5.0), LogUniform(2.0, 50.0), Normal(3.0, 0.5), exactly(3.0)])
def test_a_distribution_has_the_mean_and_deviation_of_its_draws(prior):
    rng, share = np.random.default_rng(0), (np.arange(200_000) + 0.5) / 200_000
    if isinstance(prior, Normal):
        drawn = prior.mean + prior.sd * rng.standard_normal(200_000)
    else:
        low, high = np.array([prior.low, prior.high])
        drawn = low * (high / low) ** share if isinstance(prior, LogUniform) else low + (high - low) * share
    assert prior.mean == pytest.approx(drawn.mean(), rel=3e-3)
    assert prior.sd == pytest.approx(drawn.std(), rel=1e-2)


def test_estimators_are_told_what_is_known():
    told = []

    class Listens:
        def estimate(self, patch, camera, priors):
            told.append(priors)
            return Failure(Reason.NO_PEAK)

    priors = Priors(distance_mm=exactly(7.0))
    run(Listens(), lobe(), CAMERA, priors)
    # A patch that is a Failure is not shown to it.
    reconstruct(np.zeros((160, 200), np.float32), CAMERA, {"listens": Listens()}, roi=(0, 0, 50, 50))
    reconstruct(_frame(), Calibration(CAMERA, priors=priors), {"listens": Listens()}, roi=(60, 40, 80, 80))
    reconstruct(_frame(), Calibration(CAMERA, priors=priors), {"listens": Listens()})
    assert told == [priors] * 3


def _frame():
    x, y = np.meshgrid(np.arange(200), np.arange(160))
    return np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / 200).astype(np.float32)


def test_a_calibration_file_says_it(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(
        "width = 200\nheight = 160\nfx = 200.0\nfy = 200.0\n"
        "[rig]\nlights_mm = [[4.0, 0.0, 0.0], [-4.0, 0.0, 1.0]]\ndistance_mm = 40.0\ndistance_sd_mm = 8.0\n"
        "[surface]\nphong_exponent = 50.0\n"
    )
    told = Priors(((4.0, 0.0, 0.0), (-4.0, 0.0, 1.0)), Normal(40.0, 8.0), exactly(200.0))
    assert load_calibration(path).priors == told
    # One part of the falloff leaves the other open; both, even as none, leave no prior.
    emission, vignetting = (f'[{name}]\ntype = "cosine"\npower = 0.0\n' for name in ("emission", "vignetting"))
    for stated, prior in (
        (emission, told),
        (vignetting, told),
        (emission + vignetting, replace(told, falloff_power=None)),
    ):
        path.write_text(path.read_text().partition("[emission]")[0].partition("[vignetting]")[0] + stated)
        assert load_calibration(path).priors == prior
    # An emission is undone for a light at the camera alone.
    path.write_text(
        path.read_text().replace('[emission]\ntype = "cosine"\npower = 0.0', '[emission]\ntype = "cosine"\npower = 2.0')
    )
    read = load_calibration(path)
    assert (read.priors, read.falloff) == (told, None)
    path.write_text(path.read_text().replace("distance_mm = 40.0", ""))
    with pytest.raises(InputError, match="distance_sd_mm"):
        load_calibration(path)


def test_a_scene_says_it():
    surface = {"type": "plane"}
    scene = scene_from_dict({"surface": surface, "known": {"distance_error": -0.2, "distance_sd": 0.1}})
    priors = scene.calibration(10.0).priors
    assert (priors.distance_mm.mean, priors.distance_mm.sd) == (pytest.approx(8.0), pytest.approx(0.8))
    assert (priors.lights_mm, priors.lobe_curvature) == (((0.0, 0.0, 0.0),), exactly(200.0))
    silent = scene_from_dict({"surface": surface, "known": {"lights": False, "lobe": False}})
    assert silent.calibration(10.0).priors == Priors(falloff_power=None, floors=NO_FLOORS)
    # Few highlights of a steep relief may be near misses as in a picture; a gentle one shows none.
    for slope, floors in ((2.0, NO_FLOORS), (4.0, Floors(near_miss_sd=OF_PICTURES.near_miss_sd))):
        relief = {"bands": [{"slope_deg": slope, "wavelength_mm": 1.0}]}
        rough = scene_from_dict({"surface": {**surface, "relief": relief}})
        assert rough.calibration().priors.floors == floors
    unknown = scene_from_dict({"surface": surface, "sensor": {"vignetting_known": False}})
    assert unknown.calibration().priors.falloff_power == Priors().falloff_power
    with pytest.raises(InputError, match="exclude each other"):
        scene_from_dict({"surface": surface, "known": {"distance_mm": 5.0, "distance_error": 0.0}})


def test_without_a_rig_the_bisector_says_so():
    for priors in (Priors(), Priors(distance_mm=exactly(5.0))):
        result = bisector.estimate(lobe(), CAMERA, priors)
        assert isinstance(result, Failure)
        assert result.reason == Reason.NOT_KNOWN
    axis = fit_isophote_family(lobe(), CAMERA, ISOVALUES).peak_axis
    for priors in (Priors(((0.0, 0.0, 0.0),), exactly(10.0)), LIGHT_AT_CAMERA):
        light_at_camera = bisector.estimate(lobe(), CAMERA, priors)
        np.testing.assert_allclose(light_at_camera.normal, -axis, atol=1e-12)


def test_the_bisector_halves_the_angle():
    light, P = np.array([3.0, -2.0, 1.0]), np.array([1.0, 2.0, 20.0])
    N = bisect(P, light)
    to_light, to_camera = light - P, -P
    assert N @ to_light / np.linalg.norm(to_light) == pytest.approx(N @ to_camera / np.linalg.norm(to_camera))
    assert angle_deg(N, -P / np.linalg.norm(P)) == pytest.approx(np.degrees(laws.bisector_angle(P, light)))


# The family -----------------------------------------------------------------------------------------------------------


def test_moments_of_a_gaussian_are_those_before_smoothing():
    family = fit_isophote_family(lobe(), CAMERA, ISOVALUES)
    raw = np.sqrt(np.linalg.eigvalsh(family.moments)) * 200
    # Tangents about an axis that lies 1 deg off the optical one.
    np.testing.assert_allclose(raw, [9.0, 14.0], rtol=2e-3)
    unsmoothed = fit_isophote_family(replace(lobe(), smoothing_px=0.0), CAMERA, ISOVALUES)
    assert np.sqrt(np.linalg.eigvalsh(unsmoothed.moments)[0]) * 200 > 9.0 * 1.02


def test_crossings_move_as_their_derivatives_say():
    patch, t, change = lobe(), 0.5, 1e-8
    moved = patch.traced([t], [False])
    before, bump = patch.crossings(t), change * np.random.default_rng(1).standard_normal(patch.values.shape)
    column, row = patch.peak_pixel
    value = float(patch.values[row, column] + bump[row, column])
    after = replace(patch, values=patch.values + bump, peak_value=value).crossings(t)
    across = np.where(moved.vertical, 1, 0)
    shift = (after - before)[np.arange(len(before)), across]
    by_pixels = np.sum(moved.by_pixels * bump[moved.pixels[..., 1], moved.pixels[..., 0]], axis=1)
    np.testing.assert_allclose(shift, by_pixels + moved.by_level * t * bump[row, column], atol=3e-11)


def test_the_covariance_is_that_of_realisations():
    """Mean axis, drift and moments over 200 frames against their stated covariance; chi-square of each variance."""
    count, sigma = 200, 0.02
    made, basis = [], fit_isophote_family(lobe(), CAMERA, ISOVALUES)
    for seed in range(count):
        family = fit_isophote_family(lobe(sigma, seed=seed), CAMERA, ISOVALUES)
        m = family.moments
        drift = basis.basis @ (family.drift @ family.basis)
        made.append([*(basis.basis @ family.axis), *drift, m[0, 0], m[0, 1], m[1, 1]])
    one = fit_isophote_family(lobe(sigma, seed=1), CAMERA, ISOVALUES)
    stated = np.concatenate([np.diag(one.axes_covariance), np.diag(one.moments_covariance)])
    # Variances of 200 draws lie within 30 % with more than 99.7 % each; top and peak pixel are not quite linear.
    np.testing.assert_allclose(np.var(made, axis=0, ddof=1), stated, rtol=0.3)


def test_the_top_is_not_the_highest_pixel():
    tops, peaks = [], []
    for seed in range(20):
        patch = lobe(0.05, widths=(40.0, 30.0), seed=seed)
        tops.append(fit_peak_value(patch).value)
        peaks.append(patch.peak_value)
    true = float(lobe(widths=(40.0, 30.0)).peak_value)
    assert abs(np.mean(tops) - true) < 0.25 * (np.mean(peaks) - true)


def test_a_clipped_top_is_found_from_the_ring_around_it():
    whole = lobe(widths=(24.0, 18.0))
    values = np.minimum(whole.values, 0.7 * whole.peak_value)
    clipped = replace(whole, values=values, saturated=values == values.max(), peak_value=float(values.max()))
    assert fit_peak_value(clipped).value == pytest.approx(whole.peak_value, rel=0.01)
    # Negative control: taken as it is, the top is 30 % too low.
    assert fit_peak_value(replace(clipped, saturated=None)).value < 0.8 * whole.peak_value


@pytest.mark.parametrize("m", [0.2, 1.0, 4.0])
def test_gains_invert_the_stiffness(m):
    c = 200.0
    assert gain_of_stiffness(np.array([c * m * m + 2 * m]), c) == pytest.approx(m)
    other = -2 / c - m
    assert c * other**2 + 2 * other == pytest.approx(c * m * m + 2 * m)


def test_curvature_with_and_without_a_known_lobe():
    without = curved.estimate(lobe(), CAMERA)
    with_lobe = curved.estimate(lobe(), CAMERA, Priors(lobe_curvature=exactly(200.0)))
    assert isinstance(without, Estimate)
    assert isinstance(with_lobe, Estimate)
    assert without.curvature.hypotheses is None
    assert without.axis_ratio == pytest.approx(9 / 14, rel=3e-3)
    hypotheses = with_lobe.curvature.hypotheses
    assert (hypotheses[0] > 0).all()
    assert (np.diff(np.sum((hypotheses - 1) ** 2, axis=1)) >= 0).all()
    # The long axis of the family is the direction of the smaller gain.
    assert abs(with_lobe.curvature.directions[0] @ [1.0, 0.0, 0.0]) > 0.999
    assert abs(with_lobe.curvature.gains[0]) < abs(with_lobe.curvature.gains[1])


def test_a_streak_is_refused():
    narrow = lobe(widths=(30.0, 2.0), smoothing=0.5)
    result = curved.estimate(narrow, CAMERA)
    assert isinstance(result, Failure)
    assert result.reason == Reason.STREAK
    assert isinstance(curved.estimate(lobe(widths=(30.0, 6.0)), CAMERA), Estimate)


def test_a_highlight_cut_by_the_border_is_flagged():
    patch = lobe()
    # The box begins at column 30: the peak is at 73 of the patch, the isophote at t = 0.3 reaches 22 px from it.
    part = Patch.cut(np.asarray(patch.values), (45, 0, 105, 120))
    assert "partial_arc" not in cone_axis.estimate(part, CAMERA).flags
    cut = Patch.cut(np.asarray(patch.values), (55, 0, 95, 120))
    assert {"missing_isovalues", "partial_arc"} <= set(cone_axis.estimate(cut, CAMERA).flags)


@pytest.mark.parametrize(
    ("first_column", "reason"),
    [
        (45, None),  # whole
        (90, None),  # the isophote at 0.5 is cut, that at 0.9 is not
        (100, Reason.NO_CLOSED_ISOPHOTE),  # arcs can be fitted, but the way up to the peak is cut
        (106, Reason.NO_CLOSED_ISOPHOTE),  # the peak is outside
        (125, Reason.NO_CLOSED_ISOPHOTE),  # a flank alone: nothing can be fitted
    ],
)
def test_brightest_point_refuses_a_peak_that_the_border_may_cut_off(first_column, reason):
    """The lobe's peak is at column 103.3, its isophotes at 0.5 and 0.9 reach 16.5 and 6.4 px from there."""
    smoothed = np.zeros((160, 200))
    whole = lobe()
    smoothed[20:140, 30:180] = whole.values
    patch = Patch.cut(smoothed, (first_column, 20, 180 - first_column, 120), smoothing_px=2.0)
    result = brightest_point.estimate(patch, CAMERA)
    if reason is None:
        assert angle_deg(result.normal, -CAMERA.unproject((103.3, 76.8))) < 0.1
        assert ("partial_arc" in result.flags) == (first_column > 80)
    else:
        assert (type(result), result.reason) == (Failure, reason)


def test_a_choice_without_known_noise_has_no_margin():
    estimate = circle_pose.estimate(lobe(), CAMERA)
    assert isinstance(estimate, Estimate)
    assert estimate.choice_margin is None
    assert "near_degenerate" in estimate.flags


# Several lights -----------------------------------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.parametrize(
    ("preset", "exponent", "surface"),
    [
        ("colonoscope_3", 400.0, {"type": "plane"}),
        ("colonoscope_2", 400.0, {"type": "cylinder", "radius_mm": 60.0}),
        ("laparoscope", 50.0, {"type": "plane"}),
    ],
)
def test_each_highlight_gets_its_light(preset, exponent, surface):
    placed = {"distance_mm": 30.0, "tilt_deg": 3.0, "azimuth_deg": 20.0, **surface}
    phong = {"type": "phong", "exponent": exponent}
    scene = scene_from_dict(
        {"surface": placed, "reflectance": phong, "rig": {"preset": preset}, "known": {"distance_mm": 30.0}}
    )
    session = Session(scene)
    radiance = session.radiance()
    true = session.highlights(radiance)
    noise = 0.02 * np.random.default_rng(0).standard_normal(radiance.total.shape)
    frame = (radiance.total / radiance.total.max() + noise).astype(np.float32)
    # Wide lobes of a ring melt into one, about the lights' mean place: not the shape of one highlight.
    merged = preset == "laparoscope"
    if merged:
        assert not reconstruct(frame, scene.calibration(), {"bisector": bisector})
    found = reconstruct(frame, scene.calibration(), {"bisector": bisector}, isolated=not merged)
    assert len(found) == (1 if merged else len(true))
    for specularity in found:
        estimate = specularity.estimates["bisector"]
        nearest = min(true, key=lambda h: np.linalg.norm(h.bp_px - specularity.patch.peak_px))
        assert ("ambiguous_light" in estimate.flags) == merged
        assert len(estimate.candidates) == (len(true) + 1 if merged else 1)
        if not merged:
            assert angle_deg(estimate.normal, nearest.normal) < 0.1
    if not merged:
        # Cut out alone, it is still told by the arrangement of the frame's others.
        (cut,) = reconstruct(frame, scene.calibration(), {"bisector": bisector}, roi=found[0].region.box)
        assert "ambiguous_light" not in cut.estimates["bisector"].flags
        # Negative control: without others, a highlight cannot be told from theirs.
        known = scene.calibration()
        alone = bisector.estimate(replace(found[0].patch, others_px=()), known.camera, known.priors)
        assert "ambiguous_light" in alone.flags


# Laws ---------------------------------------------------------------------------------------------------------------


def test_the_bisector_s_residual():
    P, light = np.array([0.0, 0.0, 10.0]), np.array([1.0, 0.0, 0.0])
    low, high = np.degrees(laws.bisector_residual(P, light, np.array([-0.2, 0.2])))
    assert low == pytest.approx(0.71, abs=0.005)
    assert high == pytest.approx(0.47, abs=0.005)
    over = np.degrees(laws.bisector_residual(P, light, np.linspace(-0.2, 0.2, 2001)))
    assert over.mean() == pytest.approx(0.29, abs=0.005)


def test_branch_point_and_look():
    assert np.degrees(laws.branch_point_error(0.01)) == pytest.approx(8.1, abs=0.05)
    # The exact law of a cone of small half-angle, theory.md section 4, goes over into it.
    assert laws.branch_point_error(1e-4) == pytest.approx(laws.circle_pose_error(1e-3, 1e-3 * (1 - 1e-4)), rel=1e-3)
    assert laws.look_error([0.01, 0.0], 1.0, 3.0) == pytest.approx(0.02)
    assert laws.look_error([0.0, 0.01], 1.0, 3.0) == pytest.approx(0.04)


# What the bisector makes of a distance that is not known exactly -----------------------------------------------------


PAIR = ((4.0, 0.0, 0.0), (-4.0, 0.0, 0.0))


def bisected(sigma, lights, distance=None):
    told = exactly(distance) if isinstance(distance, float) else distance
    return bisector.estimate(lobe(sigma), CAMERA, Priors(lights, told, falloff_power=None))


def share_held(stated, sigma, lights, distances):
    """Return the share of distances and lights whose normals lie in a stated region."""
    made = [bisected(sigma, (light,), d) for d in distances.tolist() for light in lights]
    moves = np.array([tangent_coordinates(stated.normal, each.normal) for each in made])
    return np.mean(np.einsum("ni,ni->n", moves, np.linalg.solve(stated.covariance, moves.T).T) <= 5.991)


def test_an_untold_distance_is_the_working_range():
    light = (3.0, -1.0, 0.0)
    told, vague = [bisected(0.01, (light,), d) for d in (5.0, 80.0)], bisected(0.01, (light,))
    # Between the two ends, whose normals lie within twice its region.
    ends = [tangent_coordinates(vague.normal, each.normal) for each in told]
    assert ends[0] @ ends[1] < 0
    assert dominant(vague.budget) == "distance"
    # The noise may look like a drift, which is shape.
    assert set(told[0].budget) - {"shape"} == {"noise", "resolution", "distance"}
    assert np.trace(told[0].budget["distance"]) == 0
    # The share of the working range whose normals lie in the region.
    assert 0.9 <= share_held(vague, 0.01, [light], np.linspace(5.0, 80.0, 31)) < 1


@pytest.mark.parametrize("sd", [2.0, 8.0, 12.0])
def test_regions_hold_over_a_normal_prior_on_the_distance(sd):
    # The light's angle goes with 1/d, which is no line over a wide prior: linear propagation would cover 18 of 20.
    prior = Normal(40.0, sd)
    stated = bisected(0.001, PAIR[:1], prior)
    assert share_held(stated, 0.001, PAIR[:1], prior.quantile((np.arange(20) + 0.5) / 20)) >= 0.95


def test_lights_that_are_not_told_apart_are_in_the_budget():
    found = bisected(0.01, PAIR, 20.0)
    assert "ambiguous_light" in found.flags
    half = np.arctan(4.0 / 20.0) / 2
    assert np.trace(found.budget["light_offset"]) == pytest.approx(half**2, rel=0.05)


@pytest.mark.parametrize(
    "prior", marked([None, Uniform(8.0, 60.0), Normal(30.0, 9.0)], ci=[Uniform(8.0, 60.0), Normal(30.0, 9.0)])
)
def test_regions_hold_over_the_distance_where_lights_are_not_told_apart(prior):
    # Lights on both sides: their mean lies at the camera, so that the distance moves nothing of what it gives.
    stated = bisected(0.001, PAIR, prior)
    assert "ambiguous_light" in stated.flags
    distances = Priors(PAIR, prior).distance.quantile((np.arange(40) + 0.5) / 40)
    # The spread of the lights at the median distance alone would hold 85 and 90 % over the first two priors.
    assert 0.92 <= share_held(stated, 0.001, PAIR, distances) < 1
