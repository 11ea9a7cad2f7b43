"""Mistakes of a whole table are told: pixels in another frame, axes that point another way."""

import numpy as np
import polars as pl
import pytest

from simtest.dataset.scoring.answers import Answer, reversed_axes, stray_rows, wide_regions
from simtest.dataset.scoring.frames import ExportedFrame, Record
from simtest.errors import Failure, Reason

BOXES = ((100, 40, 20, 20), (10, 60, 30, 25))
NOTHING = Failure(Reason.NO_ESTIMATE, "")


def record():
    frame = ExportedFrame(sha256="", camera="c.toml", peaks=((110, 50), (25, 70)), boxes=BOXES)
    return Record(
        kind="run", version="", fingerprint="", definition="", variant="", experiment={}, uses=(),
        cameras={"c.toml": {}}, frames={"f": frame},
    )  # fmt: skip


def answers(points):
    return {"mine": {"f": [Answer(NOTHING, np.array(point, dtype=float)) for point in points]}}


def results(error_deg, signs=(1, 1, 1), count=40, seed=0):
    """Rows of normals that are off by a Gaussian error, with some axes reversed."""
    rng = np.random.default_rng(seed)
    truths = rng.normal([0, 0, -3], 1.0, (count, 3))
    truths /= np.linalg.norm(truths, axis=1)[:, None]
    normals = truths + rng.normal(0, np.radians(error_deg), truths.shape)
    normals = normals / np.linalg.norm(normals, axis=1)[:, None] * signs
    axes = ("x", "y", "z")
    values = {f"normal_{axis}": normals[:, i] for i, axis in enumerate(axes)}
    values |= {f"truth_{axis}": truths[:, i] for i, axis in enumerate(axes)}
    return pl.DataFrame({"estimator": ["mine"] * count, "status": ["ok"] * count, **values})


def test_pixels_in_another_frame_are_told():
    around = np.array([[110.0, 50.0], [105.0, 45.0], [20.0, 65.0], [30.0, 80.0], [118.0, 58.0], [25.0, 70.0]])
    assert stray_rows(answers(around), record()) is None
    of_regions = around - np.array([[100, 40], [100, 40], [10, 60], [10, 60], [100, 40], [10, 60]])
    assert "6 of 6 rows lie in no detection's region" in stray_rows(answers(of_regions), record())
    swapped = stray_rows(answers(around[:, ::-1]), record())
    assert "6 of 6" in swapped
    assert "\n" not in swapped


def test_a_few_rows_elsewhere_are_no_mistake():
    inside = [[110.0, 50.0]] * 20
    assert stray_rows(answers(inside + [[1.0, 1.0]] * 8), record()) is None
    assert stray_rows(answers([[1.0, 1.0]] * 4), record()) is None


@pytest.mark.parametrize(("signs", "axis"), [((1, -1, 1), "y"), ((-1, 1, 1), "x"), ((-1, -1, 1), "x and y")])
def test_reversed_axes_are_told(signs, axis):
    (said,) = reversed_axes(results(0.5, signs))
    assert said.startswith(f"mine: with {axis} of the normals reversed the median error is 0.")


@pytest.mark.parametrize("error_deg", [0.01, 1.0, 10.0, 60.0])
@pytest.mark.parametrize("seed", range(8))
def test_errors_alone_are_no_reversal(error_deg, seed):
    assert reversed_axes(results(error_deg, seed=seed)) == []
    assert reversed_axes(results(error_deg, signs=(1, -1, 1), count=4, seed=seed)) == []


def stated(error_deg, sd_rad, count=40):
    errors = np.abs(np.random.default_rng(0).normal(0, error_deg, count))
    rows = {"estimator": ["mine"] * count, "status": ["ok"] * count, "error_deg": errors}
    return pl.DataFrame(rows | {name: np.full(count, sd_rad**2) for name in ("cov_11", "cov_22")})


def test_covariances_in_square_degrees_are_told():
    (said,) = wide_regions(stated(1.0, 1.0))
    assert said.startswith("mine: the covariances state a standard deviation of 57.3 deg in the median, and the median")
    assert "must be in rad^2" in said
    assert "\n" not in said


@pytest.mark.parametrize("sd_deg", [0.2, 1.0, 10.0])
def test_wide_covariances_alone_are_no_mistake(sd_deg):
    assert wide_regions(stated(1.0, np.radians(sd_deg))) == []
    # what a method states of frames without noise
    assert wide_regions(stated(0.001, np.radians(0.2))) == []
    assert wide_regions(stated(1.0, 1.0, count=4)) == []


def test_answers_without_covariances_are_no_mistake():
    assert wide_regions(stated(1.0, 1.0).with_columns(cov_11=pl.lit(None, pl.Float64))) == []
