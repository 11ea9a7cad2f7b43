"""What is written as a calibration file reads back as the same calibration, field by field."""

import math
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import simtest
from simtest.calibration import (
    Calibration,
    CameraPrior,
    LogUniform,
    NoiseModel,
    Normal,
    Priors,
    Response,
    Uniform,
    exactly,
)  # fmt: skip
from simtest.calibration.photometry import AngularProfile
from simtest.calibration.priors import UNTOLD_FALLOFF_POWER
from simtest.errors import InputError
from simtest.estimators.process.messages import priors_message
from simtest.geometry import BrownConrady, Camera, KannalaBrandt, ViewMask
from simtest.reconstruction.assumptions import calibration_of_view
from simtest.simulation.frame_files import picture_calibration
from simtest.spec import load_scene, scene_from_dict
from simtest.spec.calibration_spec import degrees_of

SCENES = sorted(
    p.stem for p in (Path(__file__).resolve().parents[2] / "scenes").glob("*.toml") if p.stem != "published"
)


def same(one, other):
    """Compare two calibrations field by field, so that a failure names the field."""
    for item in fields(Calibration):
        if item.name != "priors":
            assert getattr(one, item.name) == getattr(other, item.name), item.name
    for item in fields(Priors):
        assert getattr(one.priors, item.name) == getattr(other.priors, item.name), item.name
    assert one == other


def written(calibration, folder):
    simtest.save_calibration(calibration, folder / "calibration.toml")
    return simtest.load_calibration(folder / "calibration.toml")


@pytest.mark.parametrize("name", SCENES)
def test_what_a_shipped_scene_tells_reads_back(name, tmp_path):
    """Equal to `Scene.calibration` in every field, but for what writing frame.png itself does to a plain frame."""
    scene = load_scene(name)
    told = scene.calibration(37.5)
    of_picture = picture_calibration(told, scene.sensor)
    back = written(of_picture, tmp_path)
    same(back, of_picture)
    if scene.sensor.encodes:
        same(back, told)
    else:
        assert (back.response.kind, back.noise.bits, back.saturation_level) == ("srgb", 8, 1.0)
        assert (back.camera, back.vignetting, back.emission, back.priors) == (
            told.camera, told.vignetting, told.emission, told.priors,
        )  # fmt: skip
    assert len(back.priors.lights_mm) == len(scene.rig.lights)


PROFILES = st.one_of(
    st.just({"type": "cosine", "power": 0.0}),
    st.builds(lambda k: {"type": "cosine", "power": k}, st.floats(0.1, 8)),
    st.lists(st.floats(0.5, 170), min_size=1, max_size=5, unique=True).map(
        lambda a: {"type": "table", "angle_deg": [0.0, *sorted(a)], "value": [1.0, *(0.9**i for i in range(len(a)))]}
    ),
)
RIGS = st.one_of(
    st.builds(lambda profile: {"lights": [{"profile": profile}]}, PROFILES),
    st.builds(
        lambda preset, radius, azimuth: {"preset": preset, "radius_mm": radius, "azimuth_deg": azimuth},
        st.sampled_from(["laparoscope", "colonoscope_2", "colonoscope_3"]), st.floats(0.5, 9), st.floats(-180, 180),
    ),
    st.lists(st.tuples(*[st.floats(-9, 9)] * 3), min_size=1, max_size=4).map(
        lambda places: {"lights": [{"position_mm": list(place)} for place in places]}
    ),
)  # fmt: skip
LENSES = st.one_of(
    st.just({}),
    st.builds(lambda k: {"distortion": {"type": "kannala_brandt", "k1": k}}, st.floats(-0.02, 0.02)),
    st.builds(lambda k, p: {"distortion": {"type": "brown_conrady", "k1": k, "p1": p}}, *[st.floats(-0.01, 0.01)] * 2),
    st.builds(lambda r, c: {"view_mask": {"radius": r, "corner": c}}, st.floats(20, 60), st.floats(0, 15)),
    st.builds(lambda r: {"view_mask": {"radius": r, "cx": 61.5}}, st.floats(20, 60)),
)
RESPONSES = st.one_of(
    st.sampled_from([{"type": "linear"}, {"type": "srgb"}]),
    st.builds(lambda g: {"type": "gamma", "gamma": g}, st.floats(0.5, 4)),
    st.builds(lambda x: {"type": "table", "light": [0, x, 1], "value": [0, 0.5, 1]}, st.floats(0.1, 0.9)),
)
SENSORS = st.fixed_dictionaries(
    {"response": RESPONSES, "vignetting": PROFILES, "response_known": st.booleans(), "vignetting_known": st.booleans()},
    optional={"bits": st.sampled_from([8, 10, 16]), "full_well": st.floats(100, 1e5), "noise_sigma": st.floats(0, 0.1)},
)
KNOWN = st.fixed_dictionaries(
    {"lights": st.booleans(), "lobe": st.booleans()},
    optional={"distance_mm": st.floats(1, 200), "distance_sd": st.floats(0, 1)},
)


@settings(max_examples=40, deadline=None)
@given(RIGS, LENSES, SENSORS, KNOWN, st.floats(1, 1e4), st.booleans())
def test_what_any_scene_tells_reads_back(tmp_path_factory, rig, lens, sensor, known, exponent, emission_known):
    scene = scene_from_dict({
        "surface": {"type": "plane"}, "rig": rig | {"emission_known": emission_known}, "sensor": sensor, "known": known,
        "camera": {"width": 130, "height": 110, "fx": 120.0, "fy": 121.5, **lens},
        "reflectance": {"type": "phong", "exponent": exponent},
    })  # fmt: skip
    told = picture_calibration(scene.calibration(), scene.sensor)
    back = written(told, tmp_path_factory.mktemp("told"))
    same(back, told)
    # What the scene keeps back is not written.
    assert known["lights"] or back.priors.lights_mm == ()
    assert known["lobe"] or back.priors.lobe_curvature is None
    assert sensor["vignetting_known"] or back.vignetting.is_uniform
    assert emission_known or back.emission.is_uniform


INTERVALS = st.tuples(st.floats(0.1, 50), st.floats(0, 50)).map(lambda x: Uniform(x[0], x[0] + x[1] + 0.01))
CALIBRATIONS = st.builds(
    lambda distance, offset, slope, power, camera, sigma: Calibration(
        Camera(64, 48, 70.0, 71.0, 30.25, 25.0, 0.1, BrownConrady(k1=-0.01), ViewMask(32.0, 24.0, 22.0)),
        noise=NoiseModel(sigma, 4000.0, 2.5, 12), saturation_level=0.98,
        priors=Priors((), distance, light_offset_mm=offset, camera=camera, falloff_power=power, relief_slope=slope),
    ),
    st.one_of(st.none(), INTERVALS, st.builds(Normal, st.floats(1, 90), st.floats(0, 9))),
    st.one_of(INTERVALS, st.floats(0, 9).map(exactly)),
    st.one_of(st.floats(0, 45), st.integers(0, 45)).map(lambda d: exactly(math.radians(d))),
    st.one_of(st.none(), st.just(UNTOLD_FALLOFF_POWER), INTERVALS),
    st.builds(CameraPrior, st.floats(0, 0.5), st.floats(0, 20), st.floats(0, 0.3)),
    st.floats(0, 0.2),
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(CALIBRATIONS)
def test_priors_read_back(tmp_path_factory, calibration):
    same(written(calibration, tmp_path_factory.mktemp("told")), calibration)


@given(st.floats(0, 180))
def test_angles_in_degrees_read_back_as_the_same_radians(degrees):
    assert math.radians(degrees_of(math.radians(degrees))) == math.radians(degrees)
    assert np.radians(degrees_of(float(np.radians(degrees)))) == np.radians(degrees)


def test_whole_degrees_are_written_as_such():
    assert [degrees_of(math.radians(d)) for d in range(181)] == list(range(181))


CAMERA = Camera(64, 48, 70.0, 70.0, 32.0, 24.0)


@pytest.mark.parametrize(
    ("calibration", "field"),
    [
        (Calibration(CAMERA, priors=Priors(distance_mm=LogUniform(5.0, 80.0))), "distance_mm"),
        (Calibration(CAMERA, priors=Priors(lobe_curvature=Uniform(20.0, 80.0))), "lobe_curvature"),
        (Calibration(CAMERA, priors=Priors(plane=True)), "plane"),
        (Calibration(CAMERA, priors=Priors(relief_slope=Normal(0.05, 0.01))), "relief_slope"),
        (Calibration(CAMERA, Response("srgb"), noise=NoiseModel(bits=8)), "noise"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_no_file_states_is_refused_and_not_dropped(calibration, field, tmp_path):
    with pytest.raises(InputError, match=f"calibration {field} = .*: a calibration file cannot state it"):
        written(calibration, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("calibration", "name", "said"),
    [
        (CAMERA, "calibration.toml", "calibration is a Camera: must be a simtest.Calibration"),
        (Calibration(CAMERA), "calibration.yaml", "a calibration is TOML"),
        (Calibration(CAMERA), "none/calibration.toml", "No such file or directory"),
    ],
)
def test_refusals_of_writing(calibration, name, said, tmp_path):
    with pytest.raises(InputError, match=said):
        simtest.save_calibration(calibration, tmp_path / name)


def test_a_table_profile_is_the_same_to_the_rounding_of_degrees(tmp_path):
    profile = AngularProfile(angles=(0.0, 0.1, 0.7300000000000001), values=(1.0, 0.8, 0.3))
    back = written(Calibration(CAMERA, vignetting=profile), tmp_path).vignetting
    assert back.values == profile.values
    np.testing.assert_allclose(back.angles, profile.angles, rtol=1e-15)


def test_a_fisheye_reads_back(tmp_path):
    camera = Camera(64, 48, 20.0, 20.0, 32.0, 24.0, distortion=KannalaBrandt(k1=-0.01, k4=1e-5))
    assert written(Calibration(camera), tmp_path).camera == camera


def test_the_example_of_the_manual_reads_back(tmp_path):
    manual = (Path(__file__).resolve().parents[2] / "docs/howto/cameras.md").read_text(encoding="utf-8")
    (example,) = [block for block in re.findall(r"```toml\n(.*?)```", manual, flags=re.S) if "[rig]" in block]
    (tmp_path / "example.toml").write_text(example)
    stated = simtest.load_calibration(tmp_path / "example.toml")
    same(written(stated, tmp_path), stated)
    # Each key of the example is one that counts.
    assert len(stated.priors.lights_mm) == 2
    assert stated.priors.camera == CameraPrior(0.01, 5.0, 0.02)


def test_a_guessed_camera_is_written_with_its_deviations_alone(tmp_path):
    names = {"focal_sd", "centre_sd_px", "distortion_sd"}
    for fov_deg, more in ((70.0, set()), (140.0, {"edge_reach"})):
        stated = calibration_of_view(fov_deg, 200, 160)
        again = written(stated, tmp_path)
        same(again, stated)
        assert (stated.priors.camera.guessed, again.priors.camera.guessed) == (True, False)
        assert set(priors_message(stated.priors)["camera"]) == names | more
