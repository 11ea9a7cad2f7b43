"""Estimator `cloud`: spots, mixtures of clouds, shape and slope, and its way to results and files."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, Priors, Response, Uniform, exactly
from simtest.errors import Failure, Reason
from simtest.estimators import cloud_light
from simtest.estimators.cloud import CloudCentre, cloud, small_sample
from simtest.estimators.cloud_light import find_spots
from simtest.estimators.cloud_mixture import fit_mixture, sampling_covariance, window_of
from simtest.estimators.cloud_shape import CloudShape, slope_of
from simtest.estimators.dispatch import run_in_frame
from simtest.estimators.protocol import CloudEstimator
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg, basis_across, tangent_coordinates
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime import chi_squared

CAMERA = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
FORWARD = np.array([0.0, 0.0, 1.0])


def directions(rng, count, centre=FORWARD, extent=0.07, long=1.0):
    """Sightlines of a gaussian cloud, `long` times as wide along its first direction."""
    centre = np.asarray(centre) / np.linalg.norm(centre)
    across = rng.standard_normal((count, 2)) * [extent * long, extent]
    found = centre + across @ basis_across(centre)
    return found / np.linalg.norm(found, axis=1)[:, None]


def picture_of(points_px, radius_px=1.5, background=0.0, noise=0.004, seed=0):
    """A frame with a gaussian spot at each point."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    picture = np.full((CAMERA.height, CAMERA.width), background)
    for u, v in points_px:
        picture += np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * radius_px**2))
    return (picture + noise * rng.standard_normal(picture.shape)).astype(np.float32)


def frame_of(picture, priors=LIGHT_AT_CAMERA):
    return Frame(picture, Calibration(CAMERA, priors=priors), 1.0)


def spread_points(rng, count, centre=(160.0, 120.0), extent=16.0, apart=9.0):
    """Points of a gaussian cloud that are no nearer than `apart`."""
    points: list[np.ndarray] = []
    while len(points) < count:
        point = rng.normal(centre, extent)
        if all(np.hypot(*(point - other)) > apart for other in points):
            points.append(point)
    return np.array(points)


# Spots ---------------------------------------------------------------------------------------------------------------


def test_spots_lie_where_they_are():
    points = spread_points(np.random.default_rng(1), 20, extent=40.0)
    found = find_spots(frame_of(picture_of(points)))
    assert len(found.points_px) == 20
    gaps = np.linalg.norm(found.points_px[:, None] - points, axis=2)
    assert gaps.min(axis=1).max() < 0.3
    assert len(set(gaps.argmin(axis=1).tolist())) == 20


def test_a_saddle_parts_two_spots_and_a_shoulder_does_not():
    for apart, count in ((8.0, 2), (3.0, 1)):
        found = find_spots(frame_of(picture_of([(100.3, 80.0), (100.3 + apart, 80.0)])))
        assert len(found.points_px) == count


def labelled_maxima(above, around, brightest, least):
    """Peak, area and centroid of each spot, slowly: the parts above each threshold are labelled anew."""
    spots, level = [], brightest * cloud_light.STEP
    while level >= least:
        _, labels, stats, centroids = cv2.connectedComponentsWithStats((above >= level).astype(np.uint8))
        for label in range(1, len(stats)):
            own = [spot for spot in spots if labels[spot["pixel"]] == label]
            if not own:
                pixel = np.unravel_index(np.where(labels == label, above, -1).argmax(), above.shape)
                own = [{"pixel": pixel, "peak": float(above[pixel]), "area": 0, "merged": False}]
                spots += own
            for spot in own[1:]:
                if cloud_light.SADDLE * spot["peak"] < level:
                    own = [other for other in own if other is not spot]
                    spots = [other for other in spots if other is not spot]
            for spot in own:
                spot["merged"] |= len(own) > 1
            if not own[0]["merged"] and (not own[0]["area"] or level >= own[0]["peak"] / 2):
                own[0] |= {"area": int(stats[label, cv2.CC_STAT_AREA]), "point": centroids[label] + 0.5}
        level *= cloud_light.STEP
    faintest = cloud_light.LEAST_CONTRAST * around
    kept = [spot for spot in spots if spot["area"] >= 3 and spot["peak"] >= faintest[spot["pixel"]]]
    kept.sort(key=lambda spot: -spot["peak"])
    return [(spot["peak"], spot["area"], *spot["point"]) for spot in kept]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_spots_are_the_maxima_that_labels_at_each_threshold_find(seed, steps):
    rng = np.random.default_rng(seed)
    above = cv2.GaussianBlur(rng.random((60, 80)).astype(np.float32), (0, 0), 1.5)
    above = (above - above.min()) / (above.max() - above.min()) * (rng.random(above.shape) > 0.05).astype(np.float32)
    above = np.round(above * 12) / np.float32(12) if steps else above
    around = np.full(above.shape, np.float32(1.2))
    spots = cloud_light._maxima(above, around, float(above.max()), 0.2)
    found = zip(spots.peaks.tolist(), spots.areas_px.tolist(), *spots.points_px.T.tolist(), strict=True)
    assert list(found) == labelled_maxima(above, around, float(above.max()), 0.2)
    assert len(spots.peaks) > 10


def test_texture_of_tissue_is_no_spot():
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    texture = 0.5 + 0.1 * np.sin(x / 3.0) * np.sin(y / 4.0)
    # An edge beyond which all is dark: beside it the median is dark.
    texture[:, 220:] = 0.0
    assert not len(find_spots(frame_of(picture_of([], noise=0.002) + texture.astype(np.float32))).peaks)
    shining = picture_of([(60.0, 60.0)]) + texture.astype(np.float32)
    assert len(find_spots(frame_of(shining)).peaks) == 1


@pytest.mark.parametrize("coloured", [True, False])
def test_what_a_split_of_the_light_leaves_of_the_tissue_is_no_spot(coloured):
    """Specular light with residues of a fifth of the tissue's light: spots where the tissue is dark, else none."""
    rng = np.random.default_rng(4)
    points = spread_points(rng, 12)
    residues = np.stack(np.meshgrid(np.arange(20, 310, 24), np.arange(15, 230, 24)), axis=-1).reshape(-1, 2) + 0.5
    split = picture_of(points) + 0.1 * picture_of(residues, noise=0.0)
    found = {}
    for tissue in (0.0, 0.5):
        picture = picture_of(points, background=tissue, seed=1)
        picture = np.repeat(picture[..., None], 3, axis=2) if coloured else picture
        calibration = Calibration(CAMERA, response=Response(), priors=LIGHT_AT_CAMERA)
        found[tissue] = find_spots(Frame(picture, calibration, 1.0, light=split))
    assert len(found[0.0].peaks) > 60
    gaps = np.linalg.norm(found[0.5].points_px[:, None] - points, axis=2)
    assert len(gaps) == 12
    assert gaps.min(axis=1).max() < 0.5


def test_the_dark_beside_an_organ_has_no_spots():
    """A split leaves less than no light around a limb: gaps in it, at no light or a little less, are no spots."""
    rng = np.random.default_rng(4)
    points = spread_points(rng, 8, extent=10.0)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    organ = np.hypot(x - 160, y - 120) < 60
    phase = np.arange(24) * np.pi / 12
    gaps = np.stack([160 + 75 * np.cos(phase), 120 + 75 * np.sin(phase)], axis=1)
    below = np.where(organ, 0.0, 0.5) * (1 - 0.95 * np.minimum(picture_of(gaps, noise=0.0), 1.0))
    split = picture_of(points) - below.astype(np.float32)
    picture = picture_of(points, noise=0.001, seed=1) + 0.3 * organ
    calibration = Calibration(CAMERA, response=Response(), priors=LIGHT_AT_CAMERA)
    frame = Frame(np.repeat(picture[..., None], 3, axis=2).astype(np.float32), calibration, 1.0, light=split)
    found = find_spots(frame)
    assert len(found.peaks) == 8
    assert np.linalg.norm(found.points_px[:, None] - points, axis=2).min(axis=1).max() < 0.5
    assert organ[tuple(found.points_px[:, ::-1].astype(int).T)].all()


def test_faint_spots_do_not_count():
    bright = [(40.0 + 30 * i, 60.0) for i in range(6)]
    picture = picture_of(bright) + 0.15 * picture_of([(100.0, 160.0)], noise=0.0)
    assert len(find_spots(frame_of(picture)).peaks) == 6


def test_a_dark_frame_has_no_spots():
    assert not len(find_spots(frame_of(np.zeros((240, 320), dtype=np.float32))).peaks)


# Mixture -------------------------------------------------------------------------------------------------------------


def test_one_cloud_is_one_and_its_extent_is_the_sample_s():
    rng = np.random.default_rng(2)
    sightlines = directions(rng, 80, centre=(0.1, -0.1, 1.0), extent=0.06, long=2.0)
    mixture = fit_mixture(sightlines, window_of(CAMERA))
    (only,) = mixture.clouds
    assert angle_deg(only.centre, np.array([0.1, -0.1, 1.0]) / math.sqrt(1.02)) < 3 * math.degrees(0.12 / math.sqrt(80))
    small, large = np.sqrt(np.linalg.eigvalsh(only.covariance))
    assert small == pytest.approx(0.06, rel=0.2)
    assert large == pytest.approx(0.12, rel=0.2)


def test_a_fit_that_is_ended_early_is_whole(monkeypatch):
    """The share of a cloud that is in view, and whose the spots are, are those of the clouds that are returned."""
    monkeypatch.setattr("simtest.estimators.cloud_mixture.STEPS", 1)
    sightlines, window = directions(np.random.default_rng(5), 60, (0.5, 0.1, 1.0)), window_of(CAMERA)
    mixture = fit_mixture(sightlines, window)
    inside = [float((cloud.densities(window.sightlines) * window.solid[:, None]).sum()) for cloud in mixture.clouds]
    assert [cloud.seen for cloud in mixture.clouds] == pytest.approx(np.clip(inside, 0.05, 1.0), rel=1e-12)


def test_two_patches_are_two_clouds():
    rng = np.random.default_rng(3)
    centres = np.array([[-0.4, 0.0, 1.0], [0.4, 0.1, 1.0]])
    sightlines = np.concatenate([directions(rng, 30, centre, extent=0.05) for centre in centres])
    mixture = fit_mixture(sightlines, window_of(CAMERA))
    assert len(mixture.clouds) == 2
    for centre in centres / np.linalg.norm(centres, axis=1)[:, None]:
        assert min(float(angle_deg(c.centre, centre)) for c in mixture.clouds) < 2.5


def test_a_cloud_that_the_border_cuts_is_not_drawn_inwards():
    """The mean of what is seen is off by most of an extent; the truncated gaussian is not."""
    truth = CAMERA.unproject(np.array([310.0, 120.0]))
    offs, plain = [], []
    for seed in range(6):
        sightlines = directions(np.random.default_rng(seed), 120, truth, extent=0.1)
        seen = sightlines[CAMERA.contains(CAMERA.project(sightlines))]
        (only, *_) = sorted(fit_mixture(seen, window_of(CAMERA)).clouds, key=lambda c: -c.share)
        offs.append(tangent_coordinates(truth, only.centre) @ basis_across(truth))
        mean = seen.mean(axis=0)
        plain.append(tangent_coordinates(truth, mean / np.linalg.norm(mean)) @ basis_across(truth))
    bias, naive = (float(np.linalg.norm(np.mean(values, axis=0))) for values in (offs, plain))
    assert naive > 0.05
    assert bias < 0.4 * naive


def test_told_lights_are_parts_of_one_cloud():
    """Two lights far apart make two groups of spots: with their offsets told, one cloud, whose centre is between."""
    rng = np.random.default_rng(4)
    sightlines = np.concatenate([directions(rng, 25, (side * 0.2, 0.0, 1.0), extent=0.04) for side in (-1, 1)])
    untold = fit_mixture(sightlines, window_of(CAMERA))
    assert len(untold.clouds) == 2
    lights = np.array([[-8.0, 0.0, 0.0], [8.0, 0.0, 0.0]])
    told = fit_mixture(sightlines, window_of(CAMERA), lambda c: lights @ basis_across(c).T / 40)
    (only,) = told.clouds
    assert angle_deg(only.centre, FORWARD) < 1.0
    assert np.sqrt(np.linalg.eigvalsh(only.covariance)).max() < 0.06


@pytest.mark.slow
def test_regions_of_independent_spots_hold_95_percent():
    """Hotelling's factor: 12 and 40 spots, extent from the same spots."""
    window = window_of(CAMERA)
    for count in (12, 30):
        held = []
        for seed in range(60):
            (only, *_) = fit_mixture(directions(np.random.default_rng([count, seed]), count), window).clouds
            covariance = sampling_covariance(only, window, count) * small_sample(count)
            miss = tangent_coordinates(only.centre, FORWARD)
            held.append(miss @ np.linalg.solve(covariance, miss) <= chi_squared.quantile(0.95, 2))
        assert np.mean(held) >= 0.88


# Shape ---------------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.floats(2.0, 8.0), st.floats(0.3, 3.0), st.floats(0.3, 3.0), st.floats(0.0, 3.1))
def test_slope_with_told_gains(slope_deg, first, second, angle):
    """C = M^-1 s^2 M^-T: with the gains told it gives s back, whatever they are and however they lie."""
    slope = math.radians(slope_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    C = turn @ np.diag([(slope / first) ** 2, (slope / second) ** 2]) @ turn.T
    found = slope_of(C, 400.0, exactly(1e-9), (first, second))
    assert found.value == pytest.approx(slope, rel=0.01)
    assert found.low < slope < found.high
    assert found.told


def test_slope_without_told_gains_has_an_interval_of_their_prior():
    C = np.eye(2) * math.radians(4.0) ** 2
    told, untold = slope_of(C, 40.0, exactly(1e-9), (1.0, 1.0)), slope_of(C, 40.0, exactly(1e-9))
    assert not untold.told
    assert untold.high - untold.low > 2 * (told.high - told.low)
    assert untold.low < math.radians(4.0) < untold.high


def test_a_lobe_widens_a_cloud():
    C = np.eye(2) * math.radians(3.0) ** 2
    assert slope_of(C, 40.0, exactly(1 / 1600), (1, 1)).value < 0.95 * slope_of(C, 40.0, exactly(1e-9), (1, 1)).value


# Estimator -----------------------------------------------------------------------------------------------------------


def test_estimate_of_a_cloud():
    points = spread_points(np.random.default_rng(5), 24, centre=(150.0, 110.0))
    (found,) = cloud.estimate_frame(frame_of(picture_of(points)), CAMERA, LIGHT_AT_CAMERA)
    assert found.target == "base"
    assert found.cloud is not None
    assert len(found.cloud.points_px) == 24
    assert angle_deg(found.normal, -CAMERA.unproject(points.mean(axis=0))) < 0.5
    # s / sqrt(N) of an extent of 16 px at 200 px, over 24 spots
    stated = math.degrees(math.sqrt(np.trace(found.budget["relief"])))
    assert 0.8 < stated / math.degrees(math.sqrt(2) * 16 / 200 / math.sqrt(24)) < 1.8
    assert set(found.budget) == {"relief", "shape"}


def test_a_plane_that_is_told_does_not_bend():
    points = spread_points(np.random.default_rng(5), 24)
    plane = Priors(lights_mm=((0.0, 0.0, 0.0),), falloff_power=None, plane=True)
    # Towards +x the spots thin out slowly: the gains fall there.
    points[:, 0] += 0.6 * np.maximum(points[:, 0] - 160.0, 0.0) ** 1.5
    (flat,) = cloud.estimate_frame(frame_of(picture_of(points), plane), CAMERA, plane)
    (bent,) = cloud.estimate_frame(frame_of(picture_of(points)), CAMERA, LIGHT_AT_CAMERA)
    assert not flat.budget["shape"].any()
    assert np.trace(bent.covariance) > np.trace(flat.covariance)
    assert np.array_equal(flat.normal, bent.normal)


def test_what_nobody_told_of_the_light_is_in_the_budget():
    points = spread_points(np.random.default_rng(5), 24)
    frame = frame_of(picture_of(points), Priors())
    (untold,) = cloud.estimate_frame(frame, CAMERA, Priors())
    assert np.trace(untold.budget["light_offset"]) > 0
    # A light told far aside, at a distance that is told badly.
    aside = Priors(lights_mm=((6.0, 0.0, 0.0),), distance_mm=Uniform(20.0, 40.0))
    (told,) = cloud.estimate_frame(frame_of(picture_of(points), aside), CAMERA, aside)
    assert np.trace(told.budget["distance"]) > 0
    moved = angle_deg(told.normal, untold.normal)
    assert moved == pytest.approx(math.degrees(math.atan(6 / 60)), rel=0.1)


def test_too_few_spots_are_no_cloud_and_it_says_why():
    made = cloud.estimate_frame(frame_of(picture_of([(160.0, 120.0)])), CAMERA, LIGHT_AT_CAMERA)
    assert isinstance(made, Failure)
    assert made.reason == Reason.NO_ESTIMATE
    assert "1 bright spot" in made.detail


def test_a_cloud_that_is_mostly_out_of_view_gets_no_answer():
    rng = np.random.default_rng(6)
    points = spread_points(rng, 60, centre=(315.0, 120.0), extent=40.0, apart=7.0)
    made = cloud.estimate_frame(frame_of(picture_of(points[points[:, 0] < 317])), CAMERA, LIGHT_AT_CAMERA)
    assert isinstance(made, Failure)
    assert "in view" in made.detail


def test_a_long_cloud_is_flagged():
    rng = np.random.default_rng(7)
    points = rng.normal((160.0, 120.0), (45.0, 8.0), size=(50, 2))
    (found, *_) = cloud.estimate_frame(frame_of(picture_of(points)), CAMERA, LIGHT_AT_CAMERA)
    assert "anisotropic_or_curved" in found.flags
    assert found.axis_ratio < 0.5
    # The cloud is longest along x, where the gain is smallest.
    assert abs(found.curvature.directions[0][0]) > 0.95


def test_no_patch_takes_a_cloud():
    points = spread_points(np.random.default_rng(5), 24)
    frame = frame_of(picture_of(points))
    patches = [frame.patch((140, 100, 40, 40))]
    made = run_in_frame(cloud, frame, patches, LIGHT_AT_CAMERA)
    assert list(made.of_patches) == [None]
    assert len(made.elsewhere) == 1
    refused = run_in_frame(CloudCentre(least_spots=100), frame, patches, LIGHT_AT_CAMERA)
    (only,) = refused.of_patches
    assert isinstance(only, Failure)
    assert isinstance(cloud, CloudEstimator)


def test_clouds_reach_normals_json_and_the_drawings():
    points = spread_points(np.random.default_rng(5), 24)
    calibration = Calibration(CAMERA, priors=LIGHT_AT_CAMERA)
    made = reconstruct(picture_of(points), calibration, {"cloud": cloud}, smoothing_px=1.0, detector="peaks")
    last = made[-1]
    width = last.region.box[2]
    assert width > 40
    assert all("cloud" not in other.estimates for other in made[:-1])
    (record,) = [spot for spot in made if spot.best == "cloud"]
    assert record.score is None
    (outline,) = record.drawings["cloud"].curves
    area = cv2.contourArea(np.array(outline, dtype=np.float32))
    values = np.linalg.eigvalsh(last.estimates["cloud"].cloud.covariance)
    assert area == pytest.approx(math.pi * 4 * math.sqrt(values.prod()) * 200**2, rel=0.05)


def test_same_frame_same_answer():
    points = spread_points(np.random.default_rng(5), 24)
    first, second = (reconstruct(picture_of(points), CAMERA, {"cloud": cloud})[-1] for _ in range(2))
    assert np.array_equal(first.estimates["cloud"].normal, second.estimates["cloud"].normal)


def test_the_axis_ratio_is_that_of_the_extents():
    R = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = R @ np.diag([0.02**2, 0.05**2]) @ R.T
    shape = CloudShape(np.zeros((9, 2)), covariance, 9.0, 1.0, exactly(1e-9), slope_of(covariance, 9.0, exactly(1e-9)))
    assert shape.axis_ratio == pytest.approx(0.4, rel=1e-9)
