"""The sensor: its stages one by one, its curves and profiles, and its presets."""

import numpy as np
import pytest

from simtest.api import _scene
from simtest.calibration import Response, srgb_decode, srgb_encode
from simtest.calibration.photometry import AngularProfile
from simtest.geometry import Camera, smooth
from simtest.runtime.files import write_json
from simtest.runtime.seeds import from_integer
from simtest.simulation.sensor import capture, collect, expose
from simtest.spec import load_scene
from simtest.spec.lights import CosineProfile, TableProfile
from simtest.spec.sensor import PRESETS, Sensor
from tests.refusals import refused

CAMERA = Camera(60, 40, 50.0, 50.0, 30.0, 20.0)
TABLE = {"type": "table", "light": [0.0, 0.1, 0.5, 1.0], "value": [0.0, 0.3, 0.8, 1.0]}
RESPONSES = [{"type": "linear"}, {"type": "gamma", "gamma": 2.2}, {"type": "srgb"}, TABLE]


def image(shape=(40, 60), seed=0):
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def sensor(**keys):
    return Sensor.model_validate(keys)


# Stages ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "sigma"), [((40, 60), 0.05), ((40, 60, 3), 0.0), ((40, 60, 3), 0.05)])
def test_a_sensor_without_further_keys_is_exposure_and_white_noise(shape, sigma):
    radiance = 3 * image(shape)
    plain = sensor(noise_sigma=sigma)
    light = collect(radiance, plain, CAMERA)
    frame = capture(light, 2.0, plain, from_integer(5))
    np.testing.assert_array_equal(frame, expose(radiance, 2.0, sigma, from_integer(5)))
    assert frame.max() > 1.0


def test_vignetting_is_the_profile_of_the_sightlines_angle():
    radiance = np.ones((40, 60, 3), np.float32)
    light = collect(radiance, sensor(vignetting={"type": "cosine", "power": 4.0}), CAMERA)
    x, y = CAMERA.pixel_centres()[..., 0] - 30, CAMERA.pixel_centres()[..., 1] - 20
    cosine = 50 / np.sqrt(x**2 + y**2 + 50**2)
    np.testing.assert_allclose(light, np.repeat(cosine[..., None] ** 4, 3, axis=2), rtol=1e-6)
    table = {"type": "table", "angle_deg": [0.0, 90.0], "value": [1.0, 0.0]}
    by_table = collect(radiance, sensor(vignetting=table), CAMERA)
    np.testing.assert_allclose(by_table[..., 0], 1 - np.degrees(np.arccos(cosine)) / 90, rtol=1e-6)


def test_point_spread_comes_before_vignetting_and_noise():
    radiance = np.zeros((40, 60), np.float32)
    radiance[20, 50] = 1.0
    keys = {"point_spread_px": 1.5, "vignetting": {"type": "cosine", "power": 8.0}}
    both = collect(radiance, sensor(**keys), CAMERA)
    falloff = collect(np.ones_like(radiance), sensor(**keys), CAMERA)
    np.testing.assert_allclose(both, smooth(radiance, 1.5) * falloff, rtol=1e-5, atol=1e-9)
    assert collect(radiance, sensor(point_spread_px=1.5), CAMERA).sum() == pytest.approx(1.0, rel=1e-4)
    noisy = sensor(point_spread_px=3.0, noise_sigma=0.1)
    noise = capture(np.zeros((200, 200), np.float32), 1.0, noisy, from_integer(0))
    assert abs(np.mean(noise[1:] * noise[:-1])) < 1e-3 * 0.1


def test_saturation_clips_at_full_scale_after_the_noise():
    light = np.linspace(0, 3, 2400, dtype=np.float32).reshape(40, 60)
    keys = {"noise_sigma": 0.2}
    open_ended = capture(light, 1.0, sensor(**keys), from_integer(1))
    clipped = capture(light, 1.0, sensor(saturation=True, **keys), from_integer(1))
    np.testing.assert_array_equal(clipped, np.clip(open_ended, 0, 1))


def test_noise_without_a_generator_is_refused():
    with pytest.raises(ValueError, match="generator"):
        capture(image(), 1.0, sensor(full_well=100), None)


def test_a_full_scale_below_single_precision_divides_all_the_same():
    frame = expose(np.array([[0.0, 1e-38]], np.float32), 1e-46, 0.0, None)
    np.testing.assert_allclose(frame, [[0.0, 1e8]], rtol=1e-6)


def test_electrons_beyond_all_counting_stay_finite():
    frame = capture(np.full((4, 4), 1e12, np.float32), 1e-6, sensor(full_well=1e9), from_integer(0))
    np.testing.assert_allclose(frame, 1e18, rtol=1e-6)


# Curves and profiles ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("response", "bits"), [(RESPONSES[0], 8), (RESPONSES[0], 16), *((each, 10) for each in RESPONSES[1:])]
)
def test_quantisation_rounds_to_the_nearest_of_all_codes(response, bits):
    largest = 2**bits - 1
    light = np.linspace(0, 1, 2**18, dtype=np.float32).reshape(512, 512)
    frame = capture(light, 1.0, sensor(bits=bits, response=response), None).astype(float)
    codes = frame * largest
    assert np.abs(codes - np.rint(codes)).max() < 1e-2
    assert frame.min() == 0
    assert frame.max() == 1
    exact = sensor(response=response).response.model().encode(light)
    assert np.abs(frame - exact).max() <= 0.5 / largest + 1e-7
    if response["type"] == "linear":
        assert len(np.unique(np.rint(codes))) == 2**bits


@pytest.mark.parametrize("response", RESPONSES, ids=lambda r: r["type"])
def test_decoding_undoes_encoding(response):
    curve = sensor(response=response).response.model()
    light = np.linspace(0, 1, 1001)
    values = curve.encode(light)
    assert (np.diff(values) > 0).all()
    assert (values[0], values[-1]) == (0, pytest.approx(1, abs=1e-12))
    # The published sRGB constants leave a step of 2e-8 where its two parts meet.
    np.testing.assert_allclose(curve.decode(values), light, atol=1e-7 if response["type"] == "srgb" else 1e-12)


def test_curves_have_their_published_values():
    assert Response("gamma", 2.0).encode(0.25) == 0.5
    assert Response("table", light=(0, 0.5, 1), value=(0, 0.9, 1)).encode(0.25) == pytest.approx(0.45)
    # IEC 61966-2-1: 18 % grey is 0.46135 and the linear part's slope is 12.92.
    assert srgb_encode(np.array(0.18)) == pytest.approx(0.46135, abs=1e-5)
    assert srgb_encode(np.array(0.002)) == pytest.approx(0.02584, abs=1e-9)
    assert srgb_decode(np.array(0.5)) == pytest.approx(0.214041, abs=1e-6)


def test_a_cosine_profile_is_the_cosines_power():
    angles = np.radians([0, 30, 60, 89, 91, 180])
    expected = [1, np.cos(np.pi / 6) ** 4, 0.5**4, np.cos(np.radians(89)) ** 4, 0, 0]
    np.testing.assert_allclose(CosineProfile(power=4.0).model().at(np.cos(angles)), expected, atol=1e-15)
    assert AngularProfile().is_uniform
    np.testing.assert_array_equal(AngularProfile().at([-1.0, 0.0, 1.0]), 1.0)


def test_a_table_is_linear_in_the_angle_and_holds_its_last_value():
    profile = TableProfile(angle_deg=(0.0, 20.0, 40.0), value=(2.0, 1.0, 0.5)).model()
    np.testing.assert_allclose(profile.at(np.cos(np.radians([0, 10, 30, 40, 170]))), [2, 1.5, 0.75, 0.5, 0.5])


def test_a_table_keeps_its_digits_next_to_the_axis():
    profile, angle = AngularProfile(angles=(0.0, 1e-6), values=(1.0, 0.5)), np.array([1e-9, 1e-8, 5e-7])
    expected = 1 - 0.5e6 * angle
    np.testing.assert_allclose(profile.at(np.cos(angle), np.sin(angle)), expected, rtol=1e-12)
    # The cosine alone has lost them.
    assert np.abs(profile.at(np.cos(angle)) - expected).max() > 1e-3


# Presets ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_gives_what_its_table_says(name):
    made = sensor(preset=name)
    assert made.full_well == PRESETS[name]["full_well"]
    assert made.coding.quality == PRESETS[name]["coding"]["quality"]
    assert made.sharpening.amount == PRESETS[name]["sharpening"]["amount"]
    assert Sensor.model_validate(made.model_dump(mode="json")) == made
    assert Sensor.model_validate(made.model_dump(exclude_unset=True)) == made


def test_given_keys_replace_the_presets():
    preset = PRESETS["colonoscope_hd"]
    made = sensor(preset="colonoscope_hd", sharpening={"amount": 0.2}, mosaic=None, exposure={"percentile": 99.0})
    assert (made.sharpening.amount, made.sharpening.radius_px) == (0.2, preset["sharpening"]["radius_px"])
    assert made.mosaic is None
    assert (made.exposure.percentile, made.exposure.average) == (99.0, None)
    # Of another type: nothing of the preset's table stays.
    assert sensor(preset="colonoscope_hd", coding={"type": "h264", "crf": 30}).coding.crf == 30
    gain = sensor(preset="colonoscope_hd", exposure={"gain": 2.0})
    assert (gain.exposure.gain, gain.exposure.average) == (2.0, preset["exposure"]["average"])


@pytest.mark.parametrize(("new", "kept"), [(name, name == "old_sd") for name in PRESETS])
def test_another_preset_replaces_the_numbers_of_the_former(new, kept, tmp_path):
    own = {"sensor.full_well": 9000.0, "sensor.sharpening.amount": 0.3} if kept else {}
    expected = load_scene("cylinder", {**own, "sensor.preset": new}).sensor
    scene = load_scene("cylinder", {**own, "sensor.preset": "colonoscope_hd"})
    assert _scene(scene, {"sensor.preset": new}, {}).sensor == expected
    write_json(tmp_path / "frame.json", {"scene": scene.model_dump(mode="json")})
    assert load_scene(tmp_path / "frame.json", {"sensor.preset": new}).sensor == expected


def test_another_tissue_replaces_the_colour_of_the_former(tmp_path):
    preset = {"reflectance.albedo.preset": "liver_capsule"}
    expected = load_scene("tissue_colon", preset).reflectance.albedo
    assert expected.base == (0.2, 0.04, 0.033)
    write_json(tmp_path / "frame.json", {"scene": load_scene("tissue_colon").model_dump(mode="json")})
    for made in (_scene(load_scene("tissue_colon"), preset, {}), load_scene(tmp_path / "frame.json", preset)):
        assert made.reflectance.albedo == expected
    # Negative control: without a new preset a part of the former one can be set.
    assert _scene(load_scene("tissue_colon"), {"reflectance.albedo.base.1": 0.5}, {}).albedo.base == (0.66, 0.5, 0.19)


def test_what_a_preset_gives_can_be_switched_off():
    """TOML has no null."""
    stages = ("mosaic", "colour", "sharpening", "scaling", "overlay", "coding", "full_well", "bits")
    off = {f"sensor.{name}": False for name in stages} | {"sensor.read_noise": 0.0}
    made = load_scene("plane", {"sensor.preset": "old_sd", **off}).sensor
    assert [getattr(made, name) for name in stages] == [None] * len(stages)
    assert made.response.type == "srgb"
    refused(lambda: load_scene("plane", {"sensor.coding": True}), "sensor.coding = True: must be a table")
    refused(lambda: load_scene("plane", {"sensor.read_noise": False}), "sensor.read_noise = False: must be a number")


def test_presets_differ_in_what_they_do_to_an_edge():
    """The old processor blurs the edge most; all draw halos; without a preset there is none."""
    light = np.repeat(np.where(np.arange(64) < 32, 0.2, 0.6).astype(np.float32)[None, :, None], 48, axis=0)
    light = np.repeat(light, 3, axis=2)
    widths, depths = {}, {}
    for name in (*PRESETS, None):
        keys = {"preset": name} if name else {"response": {"type": "srgb"}}
        noiseless = {"full_well": None, "read_noise": 0.0, "exposure": {"full_scale": 1.0}}
        frame = capture(light, 1.0, sensor(**keys, **noiseless), None)[8:-8].mean(axis=(0, 2))
        low, high = frame[4:20].mean(), frame[44:60].mean()
        widths[name] = int(((frame > low + 0.1 * (high - low)) & (frame < high - 0.1 * (high - low))).sum())
        depths[name] = low - frame[20:32].min()
    assert widths["old_sd"] == max(widths.values()) > widths[None]
    assert all(depths[name] > 0.02 for name in PRESETS)
    assert depths[None] < 1e-6
