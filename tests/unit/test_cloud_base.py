"""The diffuse light around a cloud: where the base faces the light, and which clouds have no highlight point."""

import math

import numpy as np
import pytest

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, Priors, Response, exactly
from simtest.errors import Failure
from simtest.estimators import cloud as cloud_module
from simtest.estimators import cloud_light
from simtest.estimators.cloud import DIMMER, BaseEvidence, cloud, spots_covariance
from simtest.estimators.cloud_light import DiffuseLight
from simtest.estimators.cloud_mixture import Cloud
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg, basis_across

CAMERA = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
COVARIANCE = np.eye(2) * math.radians(4.0) ** 2
Y, X = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
SIGHTLINES = CAMERA.unproject(np.stack([X.ravel(), Y.ravel()], axis=1))


def direction(x_deg, y_deg=0.0):
    """A unit sightline."""
    found = np.array([math.tan(math.radians(x_deg)), math.tan(math.radians(y_deg)), 1.0])
    return found / np.linalg.norm(found)


def light_of_sphere(facing, distance=20.0, radius=20.0):
    """Diffuse light of a sphere whose nearest point lies along `facing`, in the picture; 0 beside it."""
    centre = facing * (distance + radius)
    along = SIGHTLINES @ centre
    root = along**2 - centre @ centre + radius**2
    r = along - np.sqrt(np.maximum(root, 0.0))
    normals = (r[:, None] * SIGHTLINES - centre) / radius
    light = -np.einsum("ni,ni->n", normals, SIGHTLINES) * (distance / r) ** 2
    return np.where(root > 0, light, 0.0).reshape(Y.shape)


def light_of_plane(normal, distance, light_mm):
    """Diffuse light of a plane that is lit from beside the camera."""
    r = -distance / (SIGHTLINES @ normal)
    to_light = np.asarray(light_mm) - r[:, None] * SIGHTLINES
    length = np.linalg.norm(to_light, axis=1)
    return ((to_light @ normal) / length**3 * distance**2).reshape(Y.shape)


def points_around(sightline, seed=1, count=24, extent_px=14.0, apart=8.0):
    """Gaussian points about a sightline's pixel that do not touch."""
    rng, middle = np.random.default_rng(seed), CAMERA.project(sightline)
    points: list[np.ndarray] = []
    while len(points) < count:
        point = rng.normal(middle, extent_px)
        if all(np.hypot(*(point - other)) > apart for other in points):
            points.append(point)
    return np.array(points)


def frame_of(light, points_px=(), priors=LIGHT_AT_CAMERA, noise=0.002):
    """A frame of diffuse light, at most 0.4, with a spot at each point."""
    picture = 0.4 * light / light.max() + noise * np.random.default_rng(0).standard_normal(light.shape)
    for u, v in points_px:
        picture += np.exp(-((X - u) ** 2 + (Y - v) ** 2) / (2 * 1.5**2))
    return Frame(picture.astype(np.float32), Calibration(CAMERA, priors=priors), 1.0)


def estimates(frame, priors=LIGHT_AT_CAMERA):
    return cloud.estimate_frame(frame, CAMERA, priors)


def misfit_of(shading):
    """The base's turn from facing the light, by grad ln L = -(2 + J) w."""
    return -np.linalg.solve(2 * np.eye(2) + shading.gains, shading.gradient)


@pytest.mark.parametrize("radius", [10.0, 20.0, 60.0])
def test_light_of_a_sphere_tells_its_gains_and_where_it_faces_the_camera(radius):
    """1 + d k is 1 + d / R in all directions; two degrees beside the highlight point the misfit is so much."""
    gain = 1 + 20.0 / radius
    facing, beside = direction(5.0, 3.0), direction(7.0, 3.0)
    light = DiffuseLight(frame_of(light_of_sphere(facing, radius=radius), noise=0.0005))
    at_point, aside = (light.around(sightline, COVARIANCE) for sightline in (facing, beside))
    assert np.linalg.eigvalsh(at_point.gains) == pytest.approx([gain, gain], rel=0.15)
    expected = gain * basis_across(beside) @ (beside - facing)
    assert misfit_of(aside) == pytest.approx(expected, abs=0.25 * np.linalg.norm(expected))
    assert np.linalg.norm(misfit_of(at_point)) < math.radians(0.3)


def test_vessels_do_not_turn_the_base():
    """Their colour tells them from shading, also where they lie on one side alone."""
    facing = direction(0.0)
    light = 0.5 * light_of_sphere(facing)
    blood = np.where(X > 160, np.exp(-((X - 175) ** 2) / 200), 0.0)
    picture = np.stack([light * np.exp(-absorbed * blood) for absorbed in (0.15, 0.9, 0.8)], axis=2)
    picture += 0.0005 * np.random.default_rng(1).standard_normal(picture.shape)
    calibration = Calibration(CAMERA, response=Response(), priors=LIGHT_AT_CAMERA)
    coloured = Frame(picture.astype(np.float32), calibration, 1.0)
    grey = Frame(picture[..., 0].astype(np.float32), calibration, 1.0)
    with_hue, without = (
        np.linalg.norm(DiffuseLight(frame).around(facing, COVARIANCE).gradient) for frame in (coloured, grey)
    )
    assert without > 0.2
    assert with_hue < 0.1 * without


def test_a_dark_frame_verifies_nothing():
    points = points_around(direction(0.0))
    dark = Frame((frame_of(np.ones(Y.shape), points).encoded - 0.4).astype(np.float32),
                 Calibration(CAMERA, priors=LIGHT_AT_CAMERA), 1.0)  # fmt: skip
    assert not DiffuseLight(dark).shows
    (found,) = estimates(dark)
    assert "base_unverified" in found.flags
    (verified,) = estimates(frame_of(light_of_sphere(direction(0.0)), points))
    assert not {"base_unverified", "base_doubted"} & set(verified.flags)


def test_tissue_full_of_glitter_is_not_dark(monkeypatch):
    """Nothing is left between its spots: a dark base has no light there either, and little elsewhere."""
    monkeypatch.setattr(cloud_light, "bright_parts", lambda frame: np.ones(Y.shape, dtype=bool))
    tissue, dark = (np.where(share * CAMERA.width > X, 0.4, 0.0) for share in (0.4, 0.1))
    shown = [
        DiffuseLight(Frame(picture.astype(np.float32), Calibration(CAMERA), 1.0)).shows for picture in (tissue, dark)
    ]
    assert shown == [True, False]


def test_a_cloud_where_the_base_is_turned_away_gets_no_answer():
    """Spots about a direction 9 deg off the one at which the base faces the camera: 18 deg of misfit."""
    points = points_around(direction(9.0))
    made = estimates(frame_of(light_of_sphere(direction(0.0)), points))
    assert isinstance(made, Failure)
    assert "diffuse light says that the base is turned by" in made.detail


def test_a_cloud_on_tissue_whose_light_tells_nothing_gets_no_answer(monkeypatch):
    frame = frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0), count=20))
    (verified,) = estimates(frame)
    assert "base_unverified" not in verified.flags
    monkeypatch.setattr(cloud_module, "evidence_of", lambda *_: BaseEvidence(True))
    refused = estimates(frame)
    assert isinstance(refused, Failure)
    assert "20 spots states no normal: too little diffuse light" in refused.detail


def test_a_refused_cloud_leaves_a_flag_on_the_others():
    points = np.concatenate(
        [points_around(direction(0.0), extent_px=10.0), points_around(direction(20.0), extent_px=10.0)]
    )
    (found,) = estimates(frame_of(light_of_sphere(direction(0.0)), points))
    assert angle_deg(found.normal, -direction(0.0)) < 3.0
    assert "clouds_refused" in found.flags
    (alone,) = estimates(frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0), extent_px=10.0)))
    assert "clouds_refused" not in alone.flags


def test_the_light_moves_a_centre_that_few_spots_tell():
    """Spots 2 deg beside the highlight point: the estimate lies between, and its region is smaller than theirs."""
    facing = direction(0.0)
    points = points_around(direction(2.0), count=12)
    (found,) = estimates(frame_of(light_of_sphere(facing), points))
    plane = Priors(lights_mm=((0.0, 0.0, 0.0),), falloff_power=None, plane=True)
    (spots_alone,) = estimates(frame_of(light_of_sphere(facing), points, plane), plane)
    assert angle_deg(found.normal, -facing) < 0.7 * angle_deg(spots_alone.normal, -facing)
    assert np.trace(found.budget["relief"]) < np.trace(spots_alone.budget["relief"])
    assert found.covariance == pytest.approx(found.covariance.T, rel=1e-9)


def test_a_light_beside_the_camera_is_taken_into_account():
    """A plane lit from 4 mm aside at 25 mm: its cloud lies about the bisector's point, and its light agrees."""
    normal, light_mm = -direction(4.0, 3.0), (4.0, 0.0, 0.0)
    priors = Priors(lights_mm=(light_mm,), distance_mm=exactly(25.0), falloff_power=None)
    positions = -25.0 / (SIGHTLINES @ normal)[:, None] * SIGHTLINES
    to_light = np.array(light_mm) - positions
    half = to_light / np.linalg.norm(to_light, axis=1)[:, None] - SIGHTLINES
    half /= np.linalg.norm(half, axis=1)[:, None]
    point = SIGHTLINES[np.argmax(half @ normal)]
    points = points_around(point, count=40)
    # As drawn the spots' mean is off by chance.
    points += CAMERA.project(point) - points.mean(axis=0)
    (found,) = estimates(frame_of(light_of_plane(normal, 25.0, light_mm), points, priors), priors)
    assert angle_deg(found.normal, normal) < 0.7
    assert "base_doubted" not in found.flags


def test_a_region_holds_the_normal_where_an_estimate_looks():
    """Spots about a direction 5 deg off the highlight point, where the base is turned by 10 deg from the camera."""
    points, radius, distance = points_around(direction(5.0)), 20.0, 20.0
    light = light_of_sphere(direction(0.0), distance, radius)
    (found,) = estimates(frame_of(light, points))
    look = CAMERA.unproject(found.look_px)
    along = look[2] * (distance + radius)
    root = math.sqrt(along**2 - (distance + radius) ** 2 + radius**2)
    normal = ((along - root) * look - np.array([0.0, 0.0, distance + radius])) / radius
    error = math.radians(float(angle_deg(found.normal, normal)))
    assert error**2 < 3 * np.trace(found.covariance)
    # Spots alone say -direction(5), off by 10 deg, with a region of their own of 1.5 deg.
    assert error < math.radians(8.0)
    # Where the light is not given, it does not tell either.
    assert isinstance(estimates(frame_of(light, points, Priors()), Priors()), Failure)


def test_a_normal_that_is_told_too_poorly_is_none(monkeypatch):
    """The light decides what a cloud's centre, with its folds, does not tell."""
    frame = frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0)))
    (found,) = estimates(frame)
    rms = math.degrees(math.sqrt(np.trace(found.budget["relief"] + found.budget["shape"])))
    monkeypatch.setattr(cloud_module, "MOST_RMS", 0.9 * rms)
    # A light that is not given widens a region; what it adds is no reason to refuse.
    for priors in (LIGHT_AT_CAMERA, Priors()):
        refused = estimates(frame, priors)
        assert isinstance(refused, Failure)
        assert "its normal would be known to" in refused.detail
    assert f"known to {rms:.1f} deg" in estimates(frame).detail
    monkeypatch.setattr(cloud_module, "MOST_RMS", 7.5)
    (untold,) = estimates(frame, Priors())
    assert math.degrees(math.sqrt(np.trace(untold.covariance))) > 7.5


def test_parts_keep_their_directions_where_the_light_moves_a_cloud(monkeypatch):
    """The light tells one direction poorly: it is the long one of the region, also where the move turns the basis."""
    for name, value in (("OWN_SHARE", 0.0), ("MOST_RMS", 90.0), ("ASIDE", 1.0)):
        monkeypatch.setattr(cloud_module, name, value)
    facing, turn, along = direction(25.0, -10.0), np.array([0.0, -0.45]), np.array([1.0, 1.0]) / math.sqrt(2)
    told = BaseEvidence(True, told=True, turn=turn, covariance=1e-4 * (np.eye(2) + 9 * np.outer(along, along)))
    monkeypatch.setattr(cloud_module, "evidence_of", lambda *_: told)
    points = points_around(facing, extent_px=8.0)
    (found,) = estimates(frame_of(light_of_sphere(facing), points))
    assert angle_deg(found.normal, -facing) > 15.0
    long = np.linalg.eigh(found.covariance)[1][:, -1] @ basis_across(found.normal)
    # As it lay at the cloud, in the plane across the normal now.
    across = along @ basis_across(CAMERA.unproject(points.mean(axis=0)))
    across -= found.normal * (found.normal @ across)
    assert abs(long @ across) / np.linalg.norm(across) > math.cos(math.radians(1.5))


def test_a_cloud_of_fewer_spots_than_the_densest_is_known_less_well():
    """A base that nowhere faces the lights glitters most where it comes nearest, but less than one that does."""
    extent, gain = math.radians(4.0), 2.0
    found = Cloud(direction(0.0), extent**2 * np.eye(2), np.zeros((1, 2)), 1.0)
    evidence, none = BaseEvidence(True, told=True, gains=gain * np.eye(2)), np.zeros((2, 2))
    ratio = 4.0
    dense, faint = (spots_covariance(found, none, evidence, 2 * math.log(each)) for each in (1.0, ratio))
    # The relief's slope is that of the cloud's extent, gain * extent, halfway to a typical one of 9 deg.
    added = DIMMER**2 * 2 * math.log(ratio) * math.radians(9.0) * gain * extent
    assert faint - dense == pytest.approx(added * np.eye(2), rel=1e-9)


def test_a_wide_cloud_has_a_flag_with_or_without_tissue_below():
    points = points_around(direction(0.0), count=60, extent_px=35.0)
    (lit,) = estimates(frame_of(light_of_sphere(direction(0.0), radius=200.0), points))
    dark = Frame((frame_of(np.ones(Y.shape), points).encoded - 0.4).astype(np.float32),
                 Calibration(CAMERA, priors=LIGHT_AT_CAMERA), 1.0)  # fmt: skip
    (found, *_) = estimates(dark)
    assert "wide" in lit.flags
    assert "wide" in found.flags


def test_bends_are_what_the_spots_show_beyond_chance():
    """Spots that thin out slowly to one side: the centroid is off, and the part `shape` says so."""
    dark = Calibration(CAMERA, priors=LIGHT_AT_CAMERA)
    shapes = []
    for skewed in (False, True):
        points = points_around(direction(0.0), count=40)
        if skewed:
            points[:, 0] += 0.05 * np.maximum(points[:, 0] - 155.0, 0.0) ** 2
        picture = frame_of(np.ones(Y.shape), points).encoded - 0.4
        (found, *_) = estimates(Frame(picture.astype(np.float32), dark, 1.0))
        shapes.append(float(np.trace(found.budget["shape"])))
    assert shapes[0] < 0.2 * shapes[1]
    assert math.degrees(math.sqrt(shapes[1])) > 0.8


def test_a_centre_that_the_light_moves_out_of_view_is_no_answer(monkeypatch):
    far = BaseEvidence(True, told=True, turn=np.array([1.2, 0.0]), covariance=1e-9 * np.eye(2))
    monkeypatch.setattr(cloud_module, "OWN_SHARE", 0.0)
    monkeypatch.setattr(cloud_module, "evidence_of", lambda *_: far)
    made = estimates(frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0))))
    assert isinstance(made, Failure)
    assert "its centre lies out of view" in made.detail
