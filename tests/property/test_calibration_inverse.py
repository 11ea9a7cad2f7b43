"""Properties of responses and of the correction, on random curves and falloffs."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.calibration import Calibration, NoiseModel, Response
from simtest.calibration.photometry import AngularProfile
from simtest.geometry import Camera
from simtest.simulation.sensor import capture, collect
from simtest.spec.sensor import Sensor

CAMERA = Camera(32, 24, 30.0, 30.0, 14.0, 13.0)
STEPS = st.lists(st.floats(0.01, 1.0), min_size=1, max_size=12)


@st.composite
def tables(draw):
    """Return a rising table from (0, 0) to (1, 1)."""
    light = np.cumsum([0.0, *draw(STEPS)])
    value = np.cumsum([0.0, *(draw(st.floats(0.01, 1.0)) for _ in light[1:])])
    ends = [tuple([*(axis / axis[-1])[:-1].tolist(), 1.0]) for axis in (light, value)]
    return {"type": "table", "light": ends[0], "value": ends[1]}


responses = st.one_of(
    st.just({"type": "linear"}),
    st.just({"type": "srgb"}),
    st.builds(lambda gamma: {"type": "gamma", "gamma": gamma}, st.floats(0.3, 4.0)),
    tables(),
)


@settings(deadline=None, derandomize=True)
@given(tables(), st.lists(st.floats(0, 1), min_size=2, max_size=20))
def test_a_table_is_undone_and_keeps_the_order(table, values):
    curve = Response("table", light=table["light"], value=table["value"])
    light = np.sort(values)
    encoded = curve.encode(light)
    assert (np.diff(encoded) >= 0).all()
    np.testing.assert_allclose(curve.decode(encoded), light, atol=1e-9)


@settings(deadline=None, derandomize=True)
@given(responses, st.floats(0, 8), st.integers(8, 16), st.integers(0, 99))
def test_correction_undoes_the_sensor_to_half_a_step(response, power, bits, seed):
    sensor = Sensor.model_validate(
        {"response": response, "bits": bits, "vignetting": {"type": "cosine", "power": power}}
    )
    radiance = np.random.default_rng(seed).random((24, 32), dtype=np.float32)
    light = collect(radiance, sensor, CAMERA)
    frame = capture(light, 1.0, sensor, None)
    curve = sensor.response.model()
    corrected = Calibration(CAMERA, curve, AngularProfile(power)).correct(frame)
    half = 0.5 / (2**bits - 1) + 1e-6
    steps = [curve.decode(np.clip(frame.astype(float) + d, 0, 1)) for d in (half, -half)]
    gain = 1.0 if corrected.gain is None else corrected.gain
    assert (radiance <= steps[0] * gain + 1e-5).all()
    assert (radiance >= steps[1] * gain - 1e-5).all()


@settings(deadline=None, derandomize=True)
@given(st.floats(0, 1), st.floats(10, 1e6), st.floats(0, 100), st.floats(1e-6, 0.1), st.integers(1, 3))
def test_noise_only_grows_with_what_makes_it(level, full_well, read_noise, sigma, channels):
    base, rounding = NoiseModel(sigma, full_well, read_noise).at(level), 1 + 1e-12
    assert NoiseModel(sigma).at(level) == sigma
    assert NoiseModel(sigma, full_well).at(level) * rounding >= sigma
    assert base * rounding >= NoiseModel(sigma, full_well).at(level)
    assert NoiseModel(sigma, full_well, read_noise, 8).at(level) * rounding >= base
    averaged = NoiseModel(sigma, full_well, read_noise).at(level, channels)
    np.testing.assert_allclose(averaged * np.sqrt(channels), base, rtol=1e-12)
    electrons = level * full_well + read_noise**2
    np.testing.assert_allclose(base**2 - sigma**2, electrons / full_well**2, rtol=1e-6, atol=1e-12)
