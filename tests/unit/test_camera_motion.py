"""Frames of a camera that moves during the exposure: the mean over it, with the truth of its middle."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import simtest
from simtest.errors import InputError
from simtest.rendering import Session
from simtest.simulation.frame_files import write_frame
from simtest.spec import load_camera, scene_from_dict
from simtest.spec.camera import Motion

pytestmark = pytest.mark.render

CENTRE, RADIUS = np.array([1.5, -1.0, 22.0]), 10.0
CAMERA = {"width": 72, "height": 60, "fx": 90.0, "fy": 90.0}


def on_axis(centre):
    """Return a sphere's tables by its centre, camera frame: the anchor on the optical axis, and how it leans there."""
    depth = centre[2] - np.sqrt(RADIUS**2 - centre[0] ** 2 - centre[1] ** 2)
    normal = (np.array([0.0, 0.0, depth]) - centre) / RADIUS
    tilt, azimuth = np.degrees(np.arccos(-normal[2])), np.degrees(np.arctan2(normal[1], normal[0]))
    return {"type": "sphere", "radius_mm": RADIUS, "distance_mm": depth, "tilt_deg": tilt, "azimuth_deg": azimuth}


def scene(surface=None, motion=None, samples=1, light=None, **tables):
    render = {"samples_per_pixel": samples, **tables.pop("render", {})}
    base = {
        "surface": surface or on_axis(CENTRE),
        "reflectance": {"type": "phong", "exponent": 120.0, "diffuse": 0.3},
        "rig": {"lights": [{"position_mm": [2.0, 1.0, 0.0]} if light is None else light]},
        "camera": {**CAMERA, **({} if motion is None else {"motion": motion})},
        "render": render,
    }
    return scene_from_dict(base | tables)


def radiance(told, variant=None):
    return Session(told, variant).radiance().total.astype(float)


# The mean, against plain references -----------------------------------------------------------------------------------

SCREW = {"velocity_mm_s": [60.0, -30.0, 90.0], "angular_velocity_deg_s": [150.0, 240.0, 400.0], "exposure_s": 0.05,
         "steps": 8}  # fmt: skip


def seen_from(time, screw):
    """Return the sphere's centre in the frame of a camera that has moved for some time, s."""
    turned = Rotation.from_rotvec(np.radians(screw["angular_velocity_deg_s"]) * time).as_matrix()
    return turned.T @ (CENTRE - np.array(screw["velocity_mm_s"]) * time)


def mean_of_stills(screw, samples=1, steps=8):
    """Render the still frames at the middles of equal parts of the exposure, one scene after the other."""
    times = [screw["exposure_s"] * ((step + 0.5) / steps - 0.5) for step in range(steps)]
    return np.mean([radiance(scene(on_axis(seen_from(time, screw)), samples=samples)) for time in times], axis=0)


def test_a_moving_frame_is_the_mean_of_still_ones():
    """The rig moves along, since the still scenes have the same light in the camera's frame."""
    found = radiance(scene(motion=SCREW))
    expected = mean_of_stills(SCREW)
    scale = expected.max()
    edge = 2e-3  # share of pixels at the silhouette that rounding of the pose may move on or off the sphere
    assert (np.abs(found - expected) > 2e-5 * scale).mean() < edge
    # Negative controls: no motion, and the turn the other way round.
    for wrong in (scene(), scene(motion={**SCREW, "angular_velocity_deg_s": [-150.0, -240.0, -400.0]})):
        assert (np.abs(radiance(wrong) - expected) > 2e-3 * scale).mean() > 0.2


def test_the_samples_of_a_pixel_are_shared_out_over_the_steps():
    """16 samples in 8 steps, of which each takes two, err from the mean of still frames of 64 as 16 samples do."""
    expected = mean_of_stills(SCREW, samples=64)
    found = radiance(scene(motion=SCREW, samples=16))
    error = np.sqrt(np.square(found - expected).mean())
    still = {"adaptive": False}
    noise = radiance(scene(samples=16, render=still)) - radiance(scene(samples=512, render=still))
    assert error < 2 * np.sqrt(np.square(noise).mean())
    assert found.mean() == pytest.approx(expected.mean(), rel=2e-3)


def blob(image):
    """Return the centroid, px, and the 2 x 2 covariance, px^2, of an image's light."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    points, weights = np.stack([x, y], axis=-1).reshape(-1, 2), image.ravel()
    return np.average(points, axis=0, weights=weights), np.cov(points.T, aweights=weights, ddof=0)


def test_a_turn_about_the_optical_axis_draws_arcs():
    """A highlight at r px from the centre is spread along the arc r omega T; second moments have closed forms."""
    turn, steps = np.radians(20.0), 24
    turning = {"angular_velocity_deg_s": [0.0, 0.0, 200.0], "exposure_s": 0.1, "steps": steps}
    aslant = {"type": "plane", "distance_mm": 15.0, "tilt_deg": 12.0, "azimuth_deg": 30.0}
    own = {"light": {}, "reflectance": {"type": "phong", "exponent": 2000.0, "diffuse": 0.3}}
    still, moved = (Session(scene(aslant, motion, 16, **own)).radiance().specular for motion in (None, turning))
    at, before = blob(still)
    ray = at - np.array([CAMERA["width"], CAMERA["height"]]) / 2
    radius = np.linalg.norm(ray)
    along, across = ray / radius, np.array([-ray[1], ray[0]]) / radius
    _, after = blob(moved)
    gained = after - before
    # Mean of the squared sine over the turns, and the variance of the cosine.
    turns = turn * ((np.arange(steps) + 0.5) / steps - 0.5)
    assert radius > 15
    assert across @ gained @ across == pytest.approx(radius**2 * (1 - np.sinc(turn / np.pi)) / 2, rel=0.03)
    assert abs(along @ gained @ along) < 2 * radius**2 * np.cos(turns).var() + 0.05
    assert moved.sum() == pytest.approx(still.sum(), rel=2e-2)


def test_a_plane_that_passes_by_is_box_filtered():
    """Sideways by v T f / d px: the tissue's pattern passes through the light's, which moves with the camera."""
    width, depth, focal, shift = 9, 20.0, 90.0, 9
    pattern = {"surface": {"type": "plane", "distance_mm": depth}, "light": {}}
    albedo = {"type": "phong", "exponent": 50.0, "specular": 0.0, "albedo": {"preset": "colon_mucosa"}}
    passing = {"velocity_mm_s": [shift * depth / focal / 0.02, 0.0, 0.0], "exposure_s": 0.02, "steps": width}
    still, moved = (radiance(scene(motion=motion, reflectance=albedo, **pattern)) for motion in (None, passing))
    # Light of a lamp at the camera on a Lambertian plane: cos^4 over the square of its distance.
    y, x = np.mgrid[: CAMERA["height"], : CAMERA["width"]] + 0.5
    cosine = 1 / np.sqrt(1 + ((x - CAMERA["width"] / 2) / focal) ** 2 + ((y - CAMERA["height"] / 2) / focal) ** 2)
    light = (cosine**3)[..., None]
    colours = still / light
    half = width // 2
    boxed = np.mean([colours[:, i : colours.shape[1] - 2 * half + i] for i in range(width)], axis=0)
    np.testing.assert_allclose((moved / light)[:, half:-half], boxed, rtol=2e-3)
    # Negative control: the pattern has detail that the motion takes away.
    assert np.abs(colours[:, half:-half] / boxed - 1).max() > 0.05


def test_light_spreads_below_the_tissue_as_in_the_middle_of_the_exposure():
    """The mean light is spread once, over the surface of the middle: near the mean of still frames that were spread."""
    tissue = {"type": "tissue", "film": {"index": 1.36}, "colour": [0.85, 0.45, 0.4], "translucency": {}}
    slow = {**SCREW, "velocity_mm_s": [20.0, -10.0, 30.0], "angular_velocity_deg_s": [10.0, 20.0, 40.0], "steps": 3}
    times = slow["exposure_s"] * np.array([-1, 0, 1]) / 3

    def grey(told):
        return radiance(told, "llvm_ad_mono")

    expected = np.mean([grey(scene(on_axis(seen_from(time, slow)), reflectance=tissue)) for time in times], axis=0)
    tissue_seen = expected > 0.02 * expected.max()

    def errors(motion):
        gap = np.abs(grey(scene(motion=motion, reflectance=tissue)) - expected)
        return np.percentile(gap[tissue_seen] / expected[tissue_seen], [50, 95])

    moved, still = errors(slow), errors(None)
    assert moved[0] < 5e-4 < 2e-3 < still[0]
    assert moved[1] < 6e-3 < still[1]


# What stays -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 16])
def test_a_motion_of_no_velocity_changes_no_byte(samples):
    at_rest = scene(motion={"exposure_s": 0.1, "steps": 4}, samples=samples)
    np.testing.assert_array_equal(radiance(at_rest), radiance(scene(samples=samples)))


def test_truth_is_that_of_the_middle():
    session = Session(scene())
    still = session.frame()
    before = session.truth(), session.highlights()
    session.update(scene(motion=SCREW))
    moved = session.frame()
    assert not np.array_equal(moved.radiance.total, still.radiance.total)
    for name, values in vars(still.labels).items():
        np.testing.assert_array_equal(getattr(moved.labels, name), values, err_msg=name)
    # Neither is searched for again, and a fresh session finds the same.
    assert session.truth() is before[0]
    fresh = Session(scene(motion=SCREW))
    for name, values in vars(before[0]).items():
        np.testing.assert_array_equal(getattr(fresh.truth(), name), values, err_msg=name)
    assert [h.bp_px.tolist() for h in fresh.highlights()] == [h.bp_px.tolist() for h in before[1]]
    # The lights stand where they stood: the next still frame has the same bytes.
    session.update(scene())
    np.testing.assert_array_equal(session.radiance().total, still.radiance.total)


@pytest.mark.parametrize("effort", [{}, {"path_depth": 3}])
def test_the_same_seed_gives_the_same_bytes(effort):
    inside = {"type": "sphere", "radius_mm": 12.0, "distance_mm": 14.0, "side": "inside"}
    told = scene(inside, {**SCREW, "steps": 3}, 2, render=effort)
    first, second = radiance(told), radiance(told)
    np.testing.assert_array_equal(first, second)
    assert np.isfinite(first).all()
    other = scene(inside, {**SCREW, "steps": 3}, 2, render={**effort, "seed": 1})
    assert not np.array_equal(radiance(other), first)


def test_work_is_told_and_can_be_stopped():
    done = []
    session = Session(scene(motion=SCREW, samples=16))
    session.radiance(lambda now, total, what: done.append(now / total))
    assert done == sorted(done)
    assert done[-1] == 1.0
    assert len(done) == SCREW["steps"]

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.radiance(stop)
    session.update(scene())
    np.testing.assert_array_equal(session.radiance().total, radiance(scene()))


# Commands -------------------------------------------------------------------------------------------------------------


def test_a_frames_files_say_what_moved(tmp_path):
    sensor = {"preset": "colonoscope_hd"}
    frame = simtest.render(scene(motion=SCREW, sensor=sensor))
    write_frame(frame, tmp_path)
    told = json.loads((tmp_path / "frame.json").read_text())
    assert told["scene"]["camera"]["motion"]["velocity_mm_s"] == SCREW["velocity_mm_s"]
    assert "middle" in told["fields"]["motion"]
    # A camera file says how pictures are formed, not how one of them was made.
    for name in ("camera.toml", "calibration.toml"):
        assert "motion" not in (tmp_path / name).read_text()
        assert load_camera(tmp_path / name).width == CAMERA["width"]


def test_a_camera_that_enters_the_wall_is_refused_and_the_session_stays():
    session = Session(scene())
    still = session.radiance().total
    into = {"velocity_mm_s": [0.0, 0.0, 500.0], "exposure_s": 0.06}
    with pytest.raises(InputError, match=r"camera.motion: 0\.0\d+ s from the middle .* the camera lies .* mm inside"):
        session.update(scene(motion=into))
    np.testing.assert_array_equal(session.radiance().total, still)
    with pytest.raises(InputError, match=r"rig.lights.0 lies"):
        Session(scene(motion={**into, "exposure_s": 0.045}, light={"position_mm": [0.0, 0.0, 3.0]}))


def test_poses_are_those_of_an_independent_rotation():
    motion = Motion(**SCREW)
    for time, pose in zip(motion.times_s, motion.poses(), strict=True):
        turned = Rotation.from_rotvec(np.radians(SCREW["angular_velocity_deg_s"]) * time).as_matrix()
        np.testing.assert_allclose(pose[:3, :3], turned, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], np.array(SCREW["velocity_mm_s"]) * time, atol=1e-12)
    assert motion.times_s.mean() == pytest.approx(0, abs=1e-15)
    assert np.diff(motion.times_s) == pytest.approx([0.05 / 8] * 7)
