"""The sensor's noise against its model: mean and variance by level, Poisson numbers; levels are stated."""

import numpy as np
import pytest
from scipy import stats

from simtest.calibration import NoiseModel
from simtest.runtime.seeds import Stage, generator
from simtest.simulation.sensor import capture
from simtest.spec.sensor import Sensor

ALPHA = 0.01
"""Level of each family of tests: with the seeds fixed, how surprising a pass or a rejection has to be."""

LEVELS = np.linspace(0.01, 1.0, 24)
PIXELS = (400, 400)
FULL_WELL, READ_NOISE, SIGMA = 1000.0, 8.0, 0.01

SENSORS = {
    "white": {"noise_sigma": SIGMA},
    "shot": {"full_well": FULL_WELL},
    "all": {"full_well": FULL_WELL, "read_noise": READ_NOISE, "noise_sigma": SIGMA},
}
# Pictures that are processed have Poisson numbers of another kind; a sharpening of 0 changes nothing else.
SENSORS |= {f"{name}, processed": {**SENSORS[name], "sharpening": {"amount": 0.0}} for name in ("shot", "all")}


def levels(name):
    """Return a frame for each level, full scale 3."""
    sensor = Sensor.model_validate(SENSORS[name])
    for i, level in enumerate(LEVELS):
        light = np.full(PIXELS, 3 * level, np.float32)
        yield level, capture(light, 3.0, sensor, generator(0, "levels", name, i, Stage.SENSOR)).astype(float)


def scores(name, model):
    """Return the z score of the mean and of the variance at each level."""
    shot = 0 if model.full_well is None else 1
    means, variances = [], []
    for level, frame in levels(name):
        variance = float(model.at(level)) ** 2
        # Fourth cumulant: Poisson numbers have that of their mean, the rest is normal.
        fourth = shot * level * (model.full_well or 1.0) ** -3
        means.append((frame.mean() - level) / np.sqrt(variance / frame.size))
        spread = np.sqrt((fourth + 2 * variance**2) / frame.size)
        variances.append((frame.var(ddof=1) - variance) / spread)
    return np.array(means), np.array(variances)


def accepts(name, model):
    """Bonferroni over the levels' means and variances, and chi-square of all of them, each at level ALPHA / 2."""
    z = np.concatenate(scores(name, model))
    single = np.abs(z).max() < stats.norm.ppf(1 - ALPHA / 4 / len(z))
    return bool(single and np.sum(z**2) < stats.chi2.ppf(1 - ALPHA / 2, len(z)))


def model(name, **wrong):
    keys = {"sigma" if k == "noise_sigma" else k: v for k, v in SENSORS[name].items() if k != "sharpening"}
    return NoiseModel(**{**keys, **wrong})


@pytest.mark.parametrize("name", SENSORS)
def test_mean_and_variance_of_each_level_are_the_models(name):
    assert accepts(name, model(name))
    assert model(name) == Sensor.model_validate(SENSORS[name]).noise_model()


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("shot", {"full_well": 1.02 * FULL_WELL}),
        ("shot", {"full_well": FULL_WELL / 1.02}),
        ("shot, processed", {"full_well": 1.02 * FULL_WELL}),
        ("all, processed", {"read_noise": 1.1 * READ_NOISE}),
        ("all", {"full_well": 1.02 * FULL_WELL}),
        ("white", {"sigma": 1.02 * SIGMA}),
        ("all", {"read_noise": 0.0}),
    ],
)
def test_a_wrong_gain_is_noticed(name, wrong):
    """Negative control: 2 % in the gain."""
    assert not accepts(name, model(name, **wrong))


@pytest.mark.parametrize("name", ["shot", "shot, processed"])
@pytest.mark.parametrize("electrons", [3.0, 40.0, 700.0])
def test_electrons_are_poisson_numbers(electrons, name):
    frame = capture(
        np.full(PIXELS, electrons / FULL_WELL, np.float32), 1.0, Sensor.model_validate(SENSORS[name]),
        generator(1, "poisson", str(electrons), 0, Stage.SENSOR),
    )  # fmt: skip
    counts = frame.astype(float) * FULL_WELL
    assert np.abs(counts - np.rint(counts)).max() < 1e-3

    def p_value(mean):
        low, high = (int(v) for v in stats.poisson.ppf([1e-3, 1 - 1e-3], electrons))
        numbers = np.arange(low, high + 1)
        inside = [np.count_nonzero(np.rint(counts) == k) for k in numbers]
        observed = [*inside, counts.size - sum(inside)]
        expected = stats.poisson.pmf(numbers, mean)
        return stats.chisquare(observed, counts.size * np.append(expected, 1 - expected.sum())).pvalue

    # Three levels, two chains: Bonferroni at level ALPHA.
    assert p_value(electrons) > ALPHA / 6
    assert p_value(1.02 * electrons) < ALPHA / 6


def test_noise_of_averaged_channels_falls_by_the_root_of_their_number():
    sensor = Sensor(full_well=FULL_WELL, noise_sigma=SIGMA)
    light = np.broadcast_to(np.array([0.2, 0.5, 0.8], np.float32), (*PIXELS, 3))
    frame = capture(light, 1.0, sensor, generator(2, "colour", "", 0, Stage.SENSOR)).mean(axis=2, dtype=float)
    expected = float(sensor.noise_model().at(0.5, channels=3)) ** 2
    low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], frame.size - 1) / (frame.size - 1)
    assert low < frame.var(ddof=1) / expected < high


@pytest.mark.parametrize("response", [{"type": "linear"}, {"type": "gamma", "gamma": 2.2}])
def test_quantisation_adds_a_twelfth_of_the_step_squared(response):
    """Where other noise blurs the steps, what is left of the decoded frame's variance is the step's."""
    sensor = Sensor.model_validate({"noise_sigma": 0.004, "bits": 8, "response": response})
    for i, level in enumerate((0.2, 0.5, 0.8)):
        rng = generator(3, "bits", response["type"], i, Stage.SENSOR)
        frame = capture(np.full(PIXELS, level, np.float32), 1.0, sensor, rng)
        linear = sensor.response.model().decode(frame)
        assert linear.std() == pytest.approx(float(sensor.noise_model().at(level)), rel=0.02)
        assert linear.std() > 1.01 * 0.004
