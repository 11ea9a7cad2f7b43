"""The diffuse light around a cloud: where the base faces the light, and which clouds have no highlight point."""

import math

import numpy as np
import pytest

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, Priors, Response, exactly
from simtest.errors import Failure
from simtest.estimators import cloud as cloud_module
from simtest.estimators import cloud_light
from simtest.estimators.cloud import DIMMER, BaseEvidence, cloud, spots_covariance
from simtest.estimators.cloud_light import DiffuseLight, spots_could_be_seen
from simtest.estimators.cloud_mixture import Cloud, fit_mixture, window_of
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
    assert not {"base_unverified"} & set(verified.flags)


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


def test_a_cloud_on_tissue_whose_light_tells_nothing_rests_on_its_spots(monkeypatch):
    """Enough of them are an answer with a flag, few are none."""
    many, few = (
        frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0), count=count, apart=apart))
        for count, apart in ((60, 5.0), (7, 8.0))
    )
    (verified,) = estimates(many)
    assert "base_unverified" not in verified.flags
    monkeypatch.setattr(cloud_module, "evidence_of", lambda *_: BaseEvidence(True))
    (alone,) = estimates(many)
    assert "base_unverified" in alone.flags
    assert np.trace(alone.covariance) > 1.5 * np.trace(verified.covariance)
    refused = estimates(few)
    assert isinstance(refused, Failure)
    assert "7 spots states no normal: its normal would be known to" in refused.detail


def test_a_gradient_that_one_sector_decides_does_not_refuse_a_cloud(monkeypatch):
    """A turn of 60 deg that is known to 40 deg is no evidence against spots that face the light."""
    frame = frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0), count=40, apart=6.0))
    for known, answers in ((40.0, True), (5.0, False)):
        turn, covariance = np.array([math.radians(60.0), 0.0]), math.radians(known) ** 2 * np.eye(2)
        told = BaseEvidence(True, told=True, turn=turn, covariance=covariance)
        monkeypatch.setattr(cloud_module, "evidence_of", lambda *_, told=told: told)
        assert isinstance(estimates(frame), list) == answers


def test_a_spot_counts_by_its_area():
    """Two of nine times the area on one side pull the centre there, and do not make it a cloud of its own."""
    points = points_around(direction(0.0), count=30)
    window = window_of(CAMERA)
    rightmost = np.argsort(points[:, 0])[-2:]
    areas = np.ones(len(points))
    areas[rightmost] = 9.0
    (plain,), (pulled,) = (
        fit_mixture(CAMERA.unproject(points), window, weights=each / each.mean()).clouds
        for each in (np.ones(len(points)), areas)
    )
    expected = areas @ points / areas.sum()
    assert CAMERA.project(pulled.centre) == pytest.approx(expected, abs=1.0)
    assert CAMERA.project(pulled.centre)[0] > CAMERA.project(plain.centre)[0] + 4.0


def test_on_ground_that_is_burnt_out_no_spot_could_be_seen():
    """Where light of the ground and of the faintest spot on it are above the saturation level."""
    ground = np.where(X < 160, 0.3, 0.8)
    picture = np.repeat(ground[..., None], 3, axis=2).astype(np.float32)
    seen, view = Y > 40, Calibration(CAMERA, saturation_level=1.0)
    shown = spots_could_be_seen(Frame(picture, view, 1.0, seen=seen))
    assert shown[120, 40]
    assert not shown[120, 280]
    assert not shown[20, 40]
    assert spots_could_be_seen(Frame(picture, Calibration(CAMERA), 1.0)) is None


def test_what_clipping_leaves_of_a_channel_tells_no_gradient():
    """Red is clipped where it is brightest: what is left of it is flat, and green and blue tell the base's turn."""
    facing, beside = direction(0.0), direction(5.0)
    light = light_of_sphere(facing)
    noise = 0.03 * np.random.default_rng(2).standard_normal((*light.shape, 3))
    picture = light[..., None] * np.array([1.1, 0.7, 0.6]) / light.max() + noise
    turns = []
    for level in (None, 1.0):
        values = picture if level is None else np.minimum(picture, level)
        calibration = Calibration(CAMERA, response=Response(), saturation_level=level, priors=LIGHT_AT_CAMERA)
        turns.append(
            misfit_of(DiffuseLight(Frame(values.astype(np.float32), calibration, 1.0)).around(beside, COVARIANCE))
        )
    assert turns[1] == pytest.approx(turns[0], abs=0.15 * np.linalg.norm(turns[0]))


def test_a_refused_cloud_leaves_a_flag_on_the_others():
    points = np.concatenate(
        [points_around(direction(0.0), extent_px=10.0), points_around(direction(20.0), extent_px=10.0)]
    )
    (found,) = estimates(frame_of(light_of_sphere(direction(0.0)), points))
    assert angle_deg(found.normal, -direction(0.0)) < 3.0
    assert "clouds_refused" in found.flags
    (alone,) = estimates(frame_of(light_of_sphere(direction(0.0)), points_around(direction(0.0), extent_px=10.0)))
    assert "clouds_refused" not in alone.flags


def test_the_light_moves_a_centre_that_few_spots_tell(monkeypatch):
    """Spots 2 deg beside the highlight point: the estimate lies between, known better than without the light."""
    facing = direction(0.0)
    points = points_around(direction(2.0), count=12)
    (found,) = estimates(frame_of(light_of_sphere(facing), points))
    plane = Priors(lights_mm=((0.0, 0.0, 0.0),), falloff_power=None, plane=True)
    (spots_alone,) = estimates(frame_of(light_of_sphere(facing), points, plane), plane)
    assert angle_deg(found.normal, -facing) < 0.7 * angle_deg(spots_alone.normal, -facing)
    monkeypatch.setattr(cloud_module, "evidence_of", lambda *_: BaseEvidence(True))
    monkeypatch.setattr(cloud_module, "MOST_RMS", 20.0)
    (unverified,) = estimates(frame_of(light_of_sphere(facing), points))
    assert angle_deg(unverified.normal, spots_alone.normal) < 1e-3
    assert np.trace(found.covariance) < 0.7 * np.trace(unverified.covariance)
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
    # A light that is not given may turn the diffuse light as well: it tells less, and the region is wider.
    (untold,) = estimates(frame_of(light, points, Priors()), Priors())
    assert 1.2 * np.trace(found.covariance) < np.trace(untold.covariance)
    assert math.radians(float(angle_deg(untold.normal, normal))) ** 2 < 3 * np.trace(untold.covariance)


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
    extent = math.radians(4.0)
    found = Cloud(direction(0.0), extent**2 * np.eye(2), np.zeros((1, 2)), 1.0)
    ratio = 4.0
    dense, faint = (spots_covariance(found, np.zeros((2, 2)), 2 * math.log(each)) for each in (1.0, ratio))
    # The relief's slope is the cloud's extent, halfway to a typical one of 9 deg.
    added = DIMMER**2 * 2 * math.log(ratio) * math.radians(9.0) * extent
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
    monkeypatch.setattr(cloud_module, "OWN_SHARE", 0.0)
    points = points_around(direction(35.0), extent_px=10.0)
    frame, made = frame_of(light_of_sphere(direction(30.0)), points[points[:, 0] < CAMERA.width - 4]), []
    for side in (-1.0, 1.0):
        turn = np.array([side * math.radians(10.0), 0.0])
        told = BaseEvidence(True, told=True, turn=turn, covariance=1e-9 * np.eye(2))
        monkeypatch.setattr(cloud_module, "evidence_of", lambda *_, told=told: told)
        made.append(estimates(frame))
    refused, inwards = sorted(made, key=lambda each: isinstance(each, list))
    assert "its centre lies out of view" in refused.detail
    assert len(inwards) == 1
