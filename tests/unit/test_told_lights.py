"""Lights whose positions are told with a covariance: files, messages to cores, and the budget's part light_offset."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import simtest
from simtest.calibration import Normal, Priors, exactly
from simtest.calibration.priors import OF_PICTURES, Floors
from simtest.estimators.prior_parts import mean_light_part, told_light_part
from simtest.estimators.process.messages import priors_message
from simtest.geometry import Array
from simtest.geometry.vectors import basis_across, bisect
from simtest.spec.calibration_file import load_calibration, save_calibration
from tests.refusals import refused

COVARIANCE = ((0.04, 0.01, 0.0), (0.01, 0.09, -0.02), (0.0, -0.02, 0.25))


def _moves(count: int, light: Array, sightline: Array, distance: float, scale: float = 1.0) -> Array:
    """Return normals of lights that are drawn about `light`, in the tangent basis of the nominal normal."""
    drawn = np.random.default_rng(3).multivariate_normal(light, scale * np.array(COVARIANCE), count)
    position = distance * sightline
    normal = bisect(position, light)
    return bisect(np.broadcast_to(position, drawn.shape), drawn) @ basis_across(normal).T


def test_part_is_the_covariance_of_normals_whose_light_is_drawn() -> None:
    light, sightline = np.array([4.0, -1.0, 0.5]), np.array([0.2, -0.1, 0.97])
    sightline /= np.linalg.norm(sightline)
    normal = bisect(30.0 * sightline, light)
    part = told_light_part(sightline, normal, light, np.array(COVARIANCE), np.array([30.0]))
    moves = _moves(40_000, light, sightline, 30.0)
    np.testing.assert_allclose(part, np.cov(moves.T), rtol=0.04, atol=0.01 * np.trace(part))
    # A light that is nine times as uncertain moves it by nine times the variance: the comparison would tell.
    wide = np.cov(_moves(40_000, light, sightline, 30.0, 9.0).T)
    assert np.trace(wide) > 8 * np.trace(part)


def test_exact_positions_have_no_part() -> None:
    assert mean_light_part(np.array([0.0, 0.0, -1.0]), Priors(lights_mm=((1.0, 0.0, 0.0),))) is None
    zero = Priors(lights_mm=((1.0, 0.0, 0.0),), lights_covariance_mm2=(((0.0, 0.0, 0.0),) * 3,))
    assert mean_light_part(np.array([0.0, 0.0, -1.0]), zero) is None


def test_file_reads_back(tmp_path: Path) -> None:
    priors = Priors(((4.0, 0.0, 0.0),), exactly(30.0), lights_covariance_mm2=(COVARIANCE,))
    calibration = simtest.Calibration(simtest.Camera.from_fov(70.0, 64, 48), priors=priors)
    path = tmp_path / "scope.toml"
    save_calibration(calibration, path)
    assert load_calibration(path).priors == priors


def test_a_light_without_a_covariance_has_that_of_the_floors() -> None:
    far = Priors(lights_mm=((300.0, 0.0, 0.0),), floors=Floors(light_sd_mm=3.0, light_sd=0.04 / 3))
    assert far.lights_covariance is not None
    np.testing.assert_allclose(far.lights_covariance, 25.0 * np.eye(3)[None])
    assert priors_message(far)["lights_covariance_mm2"] == far.lights_covariance.tolist()
    given = replace(far, lights_covariance_mm2=(COVARIANCE,))
    np.testing.assert_array_equal(given.lights_covariance, [COVARIANCE])
    exact = replace(far, lights_covariance_mm2=(((0.0, 0.0, 0.0),) * 3,))
    assert exact.lights_covariance is None


def test_a_distance_is_no_surer_than_its_floor() -> None:
    floors = Floors(distance_sd=0.03)
    assert Priors(distance_mm=exactly(50.0), floors=floors).distance == Normal(50.0, 1.5)
    assert Priors(distance_mm=Normal(50.0, 2.0), floors=floors).distance == Normal(50.0, 2.0)


def test_floors_of_a_file_read_back(tmp_path: Path) -> None:
    path = tmp_path / "scope.toml"
    path.write_text(f"{CAMERA}lights_mm = [[1, 0, 0]]\n[uncertainty]\nfeature_floor_deg = 0.0\noff_peak = 0.2\n")
    priors = load_calibration(path).priors
    assert priors.floors == replace(OF_PICTURES, feature_sd=0.0, off_peak=0.2)
    save_calibration(load_calibration(path), path)
    assert load_calibration(path).priors == priors


def test_cores_are_told_only_what_is_stated() -> None:
    exact = Priors(lights_mm=((4.0, 0.0, 0.0),))
    assert "lights_covariance_mm2" not in priors_message(exact)
    told = Priors(lights_mm=((4.0, 0.0, 0.0),), lights_covariance_mm2=(COVARIANCE,))
    assert priors_message(told)["lights_covariance_mm2"] == [[list(row) for row in COVARIANCE]]


MALFORMED = {
    "one of two": ("[[[1, 0, 0], [0, 1, 0], [0, 0, 1]]]", "1 matrices; must be one for each of the 2"),
    "not symmetric": ("[[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 2, 0], [0, 1, 0], [0, 0, 1]]]", "is no covariance"),
    "not positive": ("[[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 2, 0], [2, 1, 0], [0, 0, 1]]]", "is no covariance"),
    "not square": ("[[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 0], [0, 1], [0, 0]]]", "lights_covariance_mm2"),
}
CAMERA = "[camera]\nwidth = 64\nheight = 48\nfx = 50.0\nfy = 50.0\n[rig]\n"


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_covariances(tmp_path: Path, case: str) -> None:
    value, words = MALFORMED[case]
    path = tmp_path / "scope.toml"
    path.write_text(f"{CAMERA}lights_mm = [[1, 0, 0], [0, 1, 0]]\nlights_covariance_mm2 = {value}\n")
    refused(lambda: load_calibration(path), words)


def test_no_lights_have_no_covariance(tmp_path: Path) -> None:
    path = tmp_path / "scope.toml"
    path.write_text(f"{CAMERA}lights_mm = []\nlights_covariance_mm2 = []\n")
    assert load_calibration(path).priors.lights_covariance is None
