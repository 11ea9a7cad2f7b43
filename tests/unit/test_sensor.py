"""The sensor's stages one by one, and what they leave alone."""

import numpy as np
import pytest

from simtest.calibration import Response, srgb_decode, srgb_encode
from simtest.errors import InputError
from simtest.geometry import Camera, smooth
from simtest.runtime.seeds import from_integer
from simtest.simulation.sensor import capture, collect, expose
from simtest.spec import scene_from_dict
from simtest.spec.sensor import Sensor

CAMERA = Camera(60, 40, 50.0, 50.0, 30.0, 20.0)
TABLE = {"type": "table", "light": [0.0, 0.1, 0.5, 1.0], "value": [0.0, 0.3, 0.8, 1.0]}
RESPONSES = [{"type": "linear"}, {"type": "gamma", "gamma": 2.2}, {"type": "srgb"}, TABLE]


def image(shape=(40, 60), seed=0):
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def sensor(**keys):
    return Sensor.model_validate(keys)


@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3)])
@pytest.mark.parametrize("sigma", [0.0, 0.05])
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
    noise = capture(
        np.zeros((200, 200), np.float32), 1.0, sensor(point_spread_px=3.0, noise_sigma=0.1), from_integer(0)
    )
    assert abs(np.mean(noise[1:] * noise[:-1])) < 1e-3 * 0.1


def test_saturation_clips_at_full_scale_after_the_noise():
    light = np.linspace(0, 3, 2400, dtype=np.float32).reshape(40, 60)
    keys = {"noise_sigma": 0.2}
    open_ended = capture(light, 1.0, sensor(**keys), from_integer(1))
    clipped = capture(light, 1.0, sensor(saturation=True, **keys), from_integer(1))
    np.testing.assert_array_equal(clipped, np.clip(open_ended, 0, 1))


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("response", RESPONSES, ids=lambda r: r["type"])
def test_quantisation_rounds_to_the_nearest_of_all_codes(bits, response):
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


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"sensor": {"response": {**TABLE, "value": [0.0, 0.8, 0.3, 1.0]}}}, "sensor.response.*value"),
        ({"sensor": {"response": {**TABLE, "value": [0.0, 0.3, 0.3, 1.0]}}}, "sensor.response.*value"),
        ({"sensor": {"response": {**TABLE, "value": [0.1, 0.3, 0.8, 1.0]}}}, "sensor.response.*rise from 0 to 1"),
        ({"sensor": {"response": {**TABLE, "light": [0.0, 0.1, 0.5, 0.9]}}}, "sensor.response.*light"),
        ({"sensor": {"response": {**TABLE, "light": [0.0, 1.0]}}}, "sensor.response.*as many"),
        ({"sensor": {"response": {**TABLE, "value": [0.0, -0.3, 0.8, 1.0]}}}, r"sensor.response.value.1 = -0.3"),
        ({"sensor": {"response": {"type": "gamma", "gamma": -1.0}}}, "sensor.response.gamma = -1.0"),
        ({"sensor": {"response": {"type": "film"}}}, "sensor.response.type = 'film': unknown; allowed: gamma, linear"),
        ({"sensor": {"bits": 7}}, "sensor.bits = 7"),
        ({"sensor": {"bits": 17}}, "sensor.bits = 17"),
        ({"sensor": {"bits": 8.5}}, "sensor.bits = 8.5"),
        ({"sensor": {"exposure": {"full_scale": 0.0}}}, "sensor.exposure.full_scale = 0.0"),
        ({"sensor": {"exposure": {"full_scale": 1e-46}}}, "sensor.exposure.full_scale = 1e-46"),
        ({"sensor": {"exposure": {"gain": 1e-300}}}, "sensor.exposure.gain = 1e-300"),
        ({"sensor": {"exposure": {"percentile": 0}}}, "sensor.exposure.percentile = 0"),
        ({"sensor": {"exposure": {"percentile": 100.1}}}, "sensor.exposure.percentile = 100.1"),
        ({"sensor": {"exposure": {"percentile": 99, "full_scale": 1.0}}}, "sensor.exposure: .*exclude each other"),
        ({"sensor": {"exposure": {"gain": 0}}}, "sensor.exposure.gain = 0"),
        ({"sensor": {"full_well": -5}}, "sensor.full_well = -5"),
        ({"sensor": {"full_well": 100, "read_noise": -1}}, "sensor.read_noise = -1"),
        ({"sensor": {"read_noise": 3}}, "sensor: read_noise = 3 electrons: needs full_well"),
        ({"sensor": {"point_spread_px": -1}}, "sensor.point_spread_px = -1"),
        ({"sensor": {"vignetting": {"type": "cosine", "power": -4}}}, "sensor.vignetting.power = -4"),
        ({"sensor": {"saturation": 1}}, "sensor.saturation = 1: must be true or false"),
    ],
)
def test_malformed_sensors_name_the_key(table, key):
    with pytest.raises(InputError, match=key):
        scene_from_dict({"surface": {"type": "plane"}, **table})


def test_noise_without_a_generator_is_refused():
    with pytest.raises(ValueError, match="generator"):
        capture(image(), 1.0, sensor(full_well=100), None)


def test_a_full_scale_below_single_precision_divides_all_the_same():
    frame = expose(np.array([[0.0, 1e-38]], np.float32), 1e-46, 0.0, None)
    np.testing.assert_allclose(frame, [[0.0, 1e8]], rtol=1e-6)


def test_electrons_beyond_all_counting_stay_finite():
    frame = capture(np.full((4, 4), 1e12, np.float32), 1e-6, sensor(full_well=1e9), from_integer(0))
    np.testing.assert_allclose(frame, 1e18, rtol=1e-6)
