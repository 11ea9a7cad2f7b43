"""How well a given field of view alone holds the lenses of wide endoscopes; seeds are fixed.

Over a round view of 480 px, the lens is drawn for each kind about the given field of view: its own field with
`FOCAL_SD`, its centre with `CENTRE_SD_SHARE` of the picture's width. Where it sees a pixel is compared with where the
guess of `--fov DEG --fov-of view` sees it. A field that a kind cannot span (an orthographic lens 180 deg) is drawn
again. Alpha 0.001 for each kind, field and radius: the 95 % region must hold 92 % of the drawn lenses.
"""

import numpy as np
import pytest
from scipy.stats import binom

from simtest.calibration import Calibration, CameraPrior, Priors
from simtest.estimators.prior_parts import camera_part
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array, Camera, ViewMask
from simtest.geometry.vectors import tangent_coordinates
from simtest.reconstruction.assumptions import (
    CENTRE_SD_SHARE,
    DISTORTION_SD,
    FOCAL_SD,
    calibration_of_round_view,
)
from simtest.runtime import chi_squared

DRAWS = 300
LEAST = binom.ppf(0.001, DRAWS, 0.92) / DRAWS
SCOPES = ("equidistant", "equisolid", "stereographic", "orthographic")
SHARES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
WIDTH, HEIGHT, RADIUS_PX = 640, 480, 240.0

KINDS = {
    "equidistant": (lambda angle: angle, lambda r: r, np.pi),
    "equisolid": (lambda angle: 2 * np.sin(angle / 2), lambda r: 2 * np.arcsin(r / 2), np.pi),
    "stereographic": (lambda angle: 2 * np.tan(angle / 2), lambda r: 2 * np.arctan(r / 2), np.pi),
    "orthographic": (np.sin, np.arcsin, np.pi / 2),
    "pinhole": (np.tan, np.arctan, np.pi / 2),
}
"""Image radius over the focal length by the angle from the axis, its inverse, and the largest angle."""


def seen_at(kind: str, fov_deg: float, pixels: Array, rng: np.random.Generator) -> Array:
    """Return the directions that drawn lenses of a kind see at pixels, shape (N, 2), one each; NaN beyond the lens."""
    radius_of, angle_of, most = KINDS[kind]
    stated = np.radians(fov_deg) / 2
    edge = np.full(len(pixels), np.inf)
    while (wide := edge >= most).any():
        edge[wide] = stated * (1 + FOCAL_SD * rng.standard_normal(int(wide.sum())))
    centre = np.array([WIDTH / 2, HEIGHT / 2]) + CENTRE_SD_SHARE * WIDTH * rng.standard_normal(pixels.shape)
    away = pixels - centre
    length = np.linalg.norm(away, axis=1)
    reach = length / RADIUS_PX * radius_of(edge)
    with np.errstate(invalid="ignore"):
        angle = angle_of(reach)
    across = away / length[:, None] * np.sin(angle)[:, None]
    return np.column_stack([across, np.cos(angle)])


def held(kind: str, fov_deg: float, share: float, draws: int, guessed=calibration_of_round_view) -> float:
    """Return the share of draws in the 95 % region of the normal by the camera alone, at a share of the radius."""
    rng = np.random.default_rng([52, int(fov_deg), int(100 * share)])
    view = ViewMask(WIDTH / 2, HEIGHT / 2, RADIUS_PX)
    guess = guessed(fov_deg, WIDTH, HEIGHT, view)
    turn = 0.6
    pixel = np.array([view.cx, view.cy]) + share * RADIUS_PX * np.array([np.cos(turn), np.sin(turn)])
    sightline = guess.camera.unproject(pixel)
    estimate = Estimate(-sightline, -sightline[None], pixel)
    part = camera_part(estimate, guess.camera, guess.priors.camera)
    true = seen_at(kind, fov_deg, np.tile(pixel, (draws, 1)), rng)
    # A lens that ends before the pixel, as some draws of an orthographic one do, shows nothing there.
    true = true[np.isfinite(true).all(axis=1)]
    off = np.array([tangent_coordinates(-sightline, -each) for each in true])
    limit = chi_squared.quantile(0.95, 2)
    inside = np.einsum("ni,ni->n", off, np.linalg.solve(part, off.T).T) <= limit
    return float(inside.mean())


@pytest.mark.parametrize("fov_deg", [90.0, 140.0, 170.0])
def test_the_region_holds_every_kind_of_wide_lens(fov_deg):
    for kind in SCOPES:
        for share in SHARES:
            assert held(kind, fov_deg, share, DRAWS) >= LEAST, (kind, share)


def test_a_guessed_pinhole_does_not():
    """Negative control: the guess that was made of every field of view."""

    def pinhole(fov_deg, width, height, view):
        focal = Camera.from_fov(fov_deg, width, height).fx * 2 * view.radius / width
        prior = CameraPrior(FOCAL_SD, CENTRE_SD_SHARE * width, DISTORTION_SD)
        return Calibration(Camera(width, height, focal, focal, view.cx, view.cy), priors=Priors(camera=prior))

    assert held("equidistant", 140.0, 0.5, DRAWS, pinhole) < 0.7
