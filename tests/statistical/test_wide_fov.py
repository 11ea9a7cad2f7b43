"""Lenses of wide endoscopes over a round view, of which the field of view alone is known; seeds are fixed.

Alpha 0.001 for each kind, field and radius: the 95 % region by the guessed camera must hold 92 % of the drawn lenses.
"""

import pytest
from scipy.stats import binom

from simtest.calibration import Calibration, CameraPrior, Priors
from simtest.geometry import Camera
from simtest.reconstruction.assumptions import CENTRE_SD_SHARE, DISTORTION_SD, FOCAL_SD
from studies import wide_fov as study

DRAWS = 300
LEAST = binom.ppf(0.001, DRAWS, 0.92) / DRAWS
SCOPES = ("equidistant", "equisolid", "stereographic", "orthographic")


@pytest.mark.parametrize("fov_deg", [90.0, 140.0, 170.0])
def test_the_region_holds_every_kind_of_wide_lens(fov_deg):
    for kind in SCOPES:
        for share in study.SHARES:
            held, _ = study.held(kind, fov_deg, share, DRAWS)
            assert held >= LEAST, (kind, share)


def test_a_guessed_pinhole_does_not(monkeypatch):
    """Negative control: the guess that was made of every field of view."""

    def pinhole(fov_deg, width, height, view):
        focal = Camera.from_fov(fov_deg, width, height).fx * 2 * view.radius / width
        prior = CameraPrior(FOCAL_SD, CENTRE_SD_SHARE * width, DISTORTION_SD)
        return Calibration(Camera(width, height, focal, focal, view.cx, view.cy), priors=Priors(camera=prior))

    monkeypatch.setattr(study, "calibration_of_round_view", pinhole)
    assert study.held("equidistant", 140.0, 0.5, DRAWS)[0] < 0.7
