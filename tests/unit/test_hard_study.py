"""The corpus `hard`: drawn from seeds, kept in files, and its table's figures."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from simtest.errors import Failure, Reason
from simtest.estimators.protocol import Estimate
from simtest.geometry import Patch
from simtest.geometry.vectors import deviation_deg
from studies.hard.cases import Case, calibration_of, scene_of
from studies.hard.measure import record, semi_axis_deg
from studies.hard.rows import GROUPS, ROWS
from studies.hard.scenes import KINDS, SPLITS, base_scene
from studies.hard.table import CHI2_95, lines, text


def a_case(**changes):
    values = np.random.default_rng(0).random((12, 15)).astype(np.float32)
    values[6, 7] = 3.0
    patch = Patch.cut(values, (0, 0, 15, 12), raw=values / 2, noise=0.01, smoothing_px=1.0, saturated=values > 2)
    normal = np.array([0.0, 0.6, -0.8])
    return replace(Case("JPEG 80", patch, normal, normal[[1, 0, 2]], 1, 3.5, (10.0, 20.0)), **changes)


def test_scenes_follow_their_number_and_the_splits_share_none():
    assert base_scene(3) == base_scene(3)
    surfaces = {split: [repr(base_scene(first + i)["surface"]) for i in range(12)] for split, first in SPLITS.items()}
    assert not set(surfaces["train"]) & set(surfaces["test"])


@pytest.mark.parametrize("number", range(len(KINDS)))
def test_every_row_of_every_kind_is_a_scene(number):
    for row in ROWS:
        _, scene = scene_of(number, row)
        assert scene.sensor.vignetting_known == row.told.vignetting
        priors = calibration_of(number, row, (10.0, 20.0)).priors
        assert bool(priors.lights_mm) == row.told.light
        assert priors.camera.is_exact == row.told.focal


def test_a_reported_deviation_is_the_rms_of_the_angle_and_a_semi_axis_that_along_one_axis():
    covariance = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])
    off = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 20_000)
    angles = np.degrees(np.hypot(*off.T))
    assert deviation_deg(covariance) == pytest.approx(np.sqrt(np.mean(angles**2)), rel=0.02)
    assert semi_axis_deg(covariance) == pytest.approx(np.sqrt(np.mean(angles**2) / 2), rel=0.02)
    ahead = np.array([[0.0, 0.0, -1.0]])
    estimate = Estimate(ahead[0], ahead, np.zeros(2), covariance=covariance)
    assert estimate.deviation_deg == deviation_deg(covariance)


def test_the_interval_of_a_share_counts_scenes():
    # Two scenes whose highlights are all alike say less than twenty scenes of one each.
    row = {"row": "JPEG 80", "estimator": "e", "holds": 1, "status": "ok", "states": True, "matched": True}
    row |= {"error_deg": 1.0, "semi_deg": 1.0, "flags": ""}

    def line(scenes):
        made = [row | {"scene": number, "mahalanobis2": 1.0 if number % 2 else 100.0} for number in scenes]
        return lines(pl.DataFrame(made), ["JPEG 80"])[0]

    few, many = line([0] * 10 + [1] * 10), line(range(20))
    assert few.covered == many.covered == 50.0
    assert few.high - few.low > 1.5 * (many.high - many.low)


def test_the_table_counts_what_is_covered_silent_and_failed():
    case, normal = a_case(), a_case().normal
    made = [record(0, "plane", case, "e", Failure(Reason.NO_CLOSED_ISOPHOTE, ""))]
    for sd in (0.1, 0.1, 0.1, 1e-4):
        turned = normal + np.array([1e-3, 0, 0])
        turned /= np.linalg.norm(turned)
        flags = () if sd < 0.01 else ("saturated",)
        estimate = Estimate(turned, turned[None], np.zeros(2), covariance=sd**2 * np.eye(2), flags=flags)
        made.append(record(0, "plane", case, "e", estimate))
    line = lines(pl.DataFrame(made, infer_schema_length=None), ["JPEG 80"])[0]
    assert (line.answers, line.stated, line.failures, line.covered) == (4, 4, 1, 75.0)
    assert line.silent == 0  # the case's pixels are clipped, and that is said
    assert "JPEG 80" in text([line])
    # Groups count their rows together, and each row belongs to one of them or stands alone.
    table = pl.DataFrame(made, infer_schema_length=None)
    alone, together = lines(table, [], {"told": ["JPEG 80", "mosaic"], "none": ["mosaic"]})[0], line
    assert replace(alone, row="JPEG 80") == together
    assert set(GROUPS["all rows"]) == {row.name for row in ROWS}
    assert not set(GROUPS["light told"]) & set(GROUPS["light untold"])
    assert pytest.approx(5.991, abs=1e-3) == CHI2_95
