"""Depth completion: normals are linear in log distance, and correct a coarse map where they stand."""

import numpy as np
import pytest

from simtest.geometry import BrownConrady, Camera, KannalaBrandt
from simtest.geometry.vectors import tangent_basis
from studies.depth_completion import LEAST_SLOPE_SD, CoarseError, complete, log_distance_gradients

CENTRE, RADIUS = np.array([3.0, -2.0, 40.0]), 25.0
LENSES = {"pinhole": None, "Brown-Conrady": BrownConrady(-0.15, 0.03), "fisheye": KannalaBrandt(0.02, -0.01, 0.0, 0.0)}
ERROR = CoarseError(0.05, 40.0)
SURE = np.full((1, 2, 2), 0.0) + np.radians(0.1) ** 2 * np.eye(2)


def camera(lens="pinhole"):
    return Camera(80, 64, 70.0, 70.0, 40.0, 32.0, distortion=LENSES[lens])


def ball(lens="pinhole", pixels=None):
    """Return the distance and normals of a ball that fills the frame."""
    rays = camera(lens).unproject(camera(lens).pixel_centres() if pixels is None else pixels)
    along = rays @ CENTRE
    # seen from inside, so that every ray meets it
    distance = along + np.sqrt(along**2 - CENTRE @ CENTRE + (RADIUS + 30) ** 2)
    return distance, (CENTRE - rays * distance[..., None]) / (RADIUS + 30)


def field(seed):
    """Return an error of the kind that `ERROR` states: a Gaussian field of that size and length."""
    import scipy.ndimage

    noise = np.random.default_rng(seed).normal(size=(64, 80))
    smooth = scipy.ndimage.gaussian_filter(noise, 10.0, mode="wrap")
    return 0.05 * smooth / smooth.std()


def spots(seed, count):
    """Return pixel centres inside the frame, the ball's normals there, and covariances."""
    random = np.random.default_rng(seed)
    pixels = np.stack([random.integers(3, 77, count), random.integers(3, 61, count)], axis=1) + 0.5
    return pixels, ball(pixels=pixels)[1], np.repeat(SURE, count, axis=0)


@pytest.mark.parametrize("lens", LENSES)
def test_a_normal_fixes_the_gradient_of_log_distance(lens):
    pixels = np.array([[40.5, 32.5], [12.5, 50.5], [70.5, 9.5]])
    normals = ball(lens, pixels)[1]
    found, _ = log_distance_gradients(camera(lens), pixels, normals, np.repeat(SURE, 3, axis=0))
    step = 1e-3
    for axis in (0, 1):
        ahead, behind = (np.log(ball(lens, pixels + sign * step * np.eye(2)[axis])[0]) for sign in (1, -1))
        # The sightline's own derivative is taken over one pixel.
        assert np.abs(found[:, axis] - (ahead - behind) / (2 * step)).max() < 2e-5


def test_without_normals_nothing_changes():
    coarse = ball()[0] * np.exp(field(1))
    none = np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 2, 2))
    assert np.allclose(complete(coarse, camera(), *none, ERROR), coarse, rtol=1e-9)


@pytest.mark.parametrize("kind", ["round", "long and oblique"])
def test_the_correction_is_that_of_dense_gaussian_conditioning(kind):
    """The field's covariance is a dense matrix here, and each normal a row of it, by differences of the closed form."""
    size, kappa = 12, 4 / ERROR.length_px
    small = Camera(size, size, 15.0, 15.0, 6.0, 6.0)
    random = np.random.default_rng(7)
    coarse = 40.0 * np.exp(0.05 * random.normal(size=(size, size)).cumsum(0).cumsum(1) / 8)
    columns, rows = np.array([2, 5, 6, 8, 9, 3]), np.array([3, 8, 2, 6, 9, 6])
    pixels = np.stack([columns, rows], axis=1) + 0.5
    rays = small.unproject(pixels)
    normals = random.normal(size=(6, 3)) * 0.3 - rays
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    factors = np.radians(
        random.uniform(2, 5, (6, 2, 2)) if kind != "round" else np.eye(2) * np.arange(2, 8)[:, None, None]
    )
    covariances = factors @ factors.transpose(0, 2, 1) + np.radians(1) ** 2 * np.eye(2)
    # prior: tau^2 (kappa^2 - Laplacian)^3 with free edges
    second = 2.0 * np.eye(size) - np.eye(size, k=1) - np.eye(size, k=-1)
    second[0, 0] = second[-1, -1] = 1.0
    operator = kappa**2 * np.eye(size**2) + np.kron(second, np.eye(size)) + np.kron(np.eye(size), second)
    prior = np.linalg.inv(operator @ operator @ operator) * 8 * np.pi * kappa**4 * ERROR.share**2
    # observations: grad v = -(n . grad s) / (n . s), two rows a pixel
    take, value, noise = np.zeros((12, size**2)), np.zeros(12), np.zeros((12, 12))
    for i, (column, row) in enumerate(zip(columns, rows, strict=True)):
        place = row * size + column
        take[2 * i, [place + 1, place - 1]] = take[2 * i + 1, [place + size, place - size]] = 0.5, -0.5
        slopes = np.array([small.unproject(pixels[i] + h) - small.unproject(pixels[i] - h) for h in np.eye(2) / 2])
        value[2 * i : 2 * i + 2] = -slopes @ normals[i] / (normals[i] @ rays[i])
        basis = np.stack(tangent_basis(normals[i : i + 1]))[:, 0]
        # d/dn of that quotient along the two tangents
        along = normals[i] @ rays[i]
        turn = (-(slopes @ basis.T) * along + np.outer(slopes @ normals[i], basis @ rays[i])) / along**2
        block = slice(2 * i, 2 * i + 2)
        noise[block, block] = turn @ covariances[i] @ turn.T + LEAST_SLOPE_SD**2 * slopes @ slopes.T
    gain = prior @ take.T @ np.linalg.inv(take @ prior @ take.T + noise)
    wanted = gain @ (value - take @ np.log(coarse).ravel())
    correction = np.log(complete(coarse, small, pixels, normals, covariances, ERROR) / coarse).ravel()
    assert np.abs(wanted).max() > 0.01
    assert np.abs(correction - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_unknown_pixels_stay_unknown():
    coarse = ball()[0] * np.exp(field(31))
    coarse[20:30, 20:40] = np.nan
    pixels, normals, sure = spots(31, 20)
    made = complete(coarse, camera(), pixels, normals, sure, ERROR)
    assert (np.isnan(made) == np.isnan(coarse)).all()
