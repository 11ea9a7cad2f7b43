"""The law of the smoothing's bias against the pipeline without noise."""

import numpy as np
import pytest

from simtest.errors import Failure
from simtest.geometry.vectors import angle_deg
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper import predictions
from simtest.validation.paper.predictions import smoothing_bias
from simtest.validation.paper.published_pipeline import Pipeline

TOLERANCE = 0.2
"""Share of the measured error."""


def measured(setting):
    result = Pipeline(setting).realise([np.random.default_rng(0)])["circle_pose"][0]
    assert not isinstance(result, Failure), result
    return float(angle_deg(result.candidates, setting.normal).min())


def predicted(setting):
    bias = smoothing_bias(setting)
    assert bias is not None, setting
    return float(np.degrees(bias))


SETTINGS = [
    *[{"isovalue": t, "smoothing_px": float(s)} for t in (0.1, 0.3, 0.5, 0.8) for s in (1, 2, 3, 4)],
    *[{"theta_deg": 30.0, "isovalue": t, "smoothing_px": float(s)} for t in (0.1, 0.5) for s in (1, 2, 4)],
    *[{"theta_deg": 75.0, "isovalue": 0.5, "smoothing_px": float(s)} for s in (1, 2, 3, 4)],
    {"theta_deg": 75.0, "smoothing_px": 1.0},
    {"exponent": 120.0, "theta_deg": 75.0, "smoothing_px": 4.0},
    {"exponent": 30.0, "isovalue": 0.5},
    {"exponent": 120.0, "isovalue": 0.02},
    {"size": 256, "height": 631.0, "isovalue": 0.3},
]


@pytest.mark.parametrize("values", SETTINGS, ids=lambda v: "-".join(f"{k}={x:g}" for k, x in v.items()))
def test_the_law_meets_the_pipeline_without_noise(values):
    setting = PaperSetting(sigma=0.0, **values)
    assert predicted(setting) == pytest.approx(measured(setting), rel=TOLERANCE)


def test_the_interpolation_between_pixels_matters_where_the_smoothing_is_narrow(monkeypatch):
    setting = PaperSetting(sigma=0.0, smoothing_px=0.5)
    assert predicted(setting) == pytest.approx(measured(setting), rel=0.05)
    monkeypatch.setattr(predictions, "LINEAR_INTERPOLATION_PX2", 0.0)
    assert predicted(setting) < 0.7 * measured(setting)


def test_a_circle_stays_a_circle():
    assert predicted(PaperSetting(theta_deg=0.0)) < 1e-6


def test_the_law_does_not_know_the_noise():
    assert smoothing_bias(PaperSetting(sigma=0.1)) == smoothing_bias(PaperSetting(sigma=0.0))


@pytest.mark.parametrize(
    "values",
    [{"eps": 10.0}, {"isovalue": 0.01}, {"exponent": 30.0}, {"theta_deg": 87.0}, {"size": 406, "height": 100.0}],
)
def test_it_says_nothing_with_the_light_off_v_or_the_window_cut(values):
    assert smoothing_bias(PaperSetting(**values)) is None
