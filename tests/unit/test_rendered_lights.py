"""Lights measured on balls that Mitsuba renders, and what they are worth on frames of the same scope."""

from pathlib import Path

import numpy as np
import pytest
from rendered_balls import Floats, Rendering, nearest_errors, places, plain_calibration

from simtest.calibration import Priors
from simtest.cli.pictures import calibrate
from simtest.runtime import chi_squared
from simtest.spec.calibration_file import load_calibration, save_calibration

pytestmark = [pytest.mark.slow, pytest.mark.render]

RADIUS = 5.0
RIGS = {
    1: np.array([[3.5, -0.8, 0.4]]),
    2: np.array([[4.0, 0.5, 0.3], [-3.5, 1.5, -0.4]]),
    3: np.array([[3.2, 2.1, 0.5], [-3.6, 1.2, -0.3], [0.4, -4.1, 0.2]]),
}


def measured(folder: Path, made: Rendering, told_radius: float = RADIUS) -> Priors:
    """Run the command on the pictures, and return what its calibration file says."""
    pictures = folder / "ball"
    pictures.mkdir()
    made.write(pictures)
    save_calibration(plain_calibration(), folder / "scope.toml")
    call = [str(pictures), "--camera", str(folder / "scope.toml"), "--ball-radius", str(told_radius)]
    out = folder / "out"
    told = calibrate(
        ["light", *call, "--out", str(out)], exit_on_error=False, print_error=False, result_action="return_value"
    )
    assert told == 0
    return load_calibration(out / "calibration.toml").priors


def distances(priors: Priors, lights: Floats) -> tuple[list[float], list[float]]:
    """Return the errors, mm, and their squared Mahalanobis distances."""
    assert priors.lights_covariance is not None
    gaps = nearest_errors(priors.lights, lights)
    squares = [float(g @ np.linalg.solve(c, g)) for g, c in zip(gaps, priors.lights_covariance, strict=True)]
    return [float(np.linalg.norm(gap)) for gap in gaps], squares


@pytest.mark.parametrize("count", [1, 3])
def test_lights_of_rendered_balls(tmp_path: Path, count: int) -> None:
    lights = RIGS[count]
    priors = measured(tmp_path, Rendering(lights, places(8, RADIUS, count), RADIUS))
    assert len(priors.lights) == count
    errors, squares = distances(priors, lights)
    assert max(errors) < 0.2
    # alpha = 0.001 of all lights together
    assert max(squares) < chi_squared.quantile(1 - 0.001 / count, 3)


def test_wrong_radius_moves_the_lights_out_of_their_regions(tmp_path: Path) -> None:
    """The negative control: the test above can fail."""
    lights = RIGS[3]
    errors, squares = distances(
        measured(tmp_path, Rendering(lights, places(8, RADIUS, 3), RADIUS), 1.08 * RADIUS), lights
    )
    assert min(errors) > 0.2
    assert max(squares) > chi_squared.quantile(1 - 0.001 / 3, 3)


@pytest.mark.parametrize("count", [1, 2])
def test_dark_background_widens_the_intervals(tmp_path: Path, count: int) -> None:
    """The unlit side of a ball cannot be told from the background; one light moves all outlines by 1 to 2 px alike."""
    lights = RIGS[count]
    priors = measured(tmp_path, Rendering(lights, places(8, RADIUS, count), RADIUS, wall=False, blur_px=1.0))
    assert len(priors.lights) == count
    assert priors.lights_covariance is not None
    _, squares = distances(priors, lights)
    # The median would be 2.4: a larger bound would let through intervals that are half as wide as they must be.
    assert max(squares) < chi_squared.quantile(0.95, 3)
    # across the view the lights are still known
    assert np.sqrt(priors.lights_covariance[:, [0, 1], [0, 1]]).max() < 1.5
