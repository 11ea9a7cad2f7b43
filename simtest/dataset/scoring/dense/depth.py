"""Depth maps: what their values count, how they are aligned with the truth, and the normals that they imply."""

from typing import Literal

import numpy as np

from simtest.calibration.frame import MAD_TO_SIGMA
from simtest.geometry import Camera
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer
from simtest.validation.depth_maps import depth_normals

DepthKind = Literal["z", "ray"]
KINDS: tuple[DepthKind, ...] = ("z", "ray")
"""Along the optical axis, or along the pixel's ray."""

Alignment = Literal["none", "scale", "affine"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "scale", "affine")
"""As stated; times a factor a frame; times a factor plus a shift a frame."""

ROUNDS = 20
TUNING = 4.685
"""Of Tukey's weights, in standard deviations: 95 % as efficient as least squares on normal errors."""

TRIALS, JUDGED = 100, 2000
"""Pairs of pixels that the affine start tries, and pixels that judge each, at least."""

MOST_PIXELS = 20_000
"""Pixels of a frame that fit its alignment, evenly spread."""

LEAST_PIXELS = 3


def depth_factor(camera: Camera, kind: DepthKind) -> Array:
    """Return the depth of a kind over the distance along the ray, at each pixel's centre, shape (H, W)."""
    if kind == "ray":
        return np.ones((camera.height, camera.width))
    z = camera.unproject(camera.pixel_centres())[..., 2]
    return np.where(z > 0, z, np.nan)


def align(depth: Array, truth: Array, how: Alignment) -> tuple[float, float]:
    """Return the factor and the shift, in the truth's unit, that bring depths to the truth.

    They minimise the relative residuals (a depth + b - t) / t by iteratively reweighted least squares with Tukey's
    weights [Beaton & Tukey 1974], from a least-median start [Rousseeuw 1984]: up to nearly half of the pixels may be
    wrong.

    Parameters
    ----------
    depth, truth : ndarray, shape (N,)
        Positive and finite.
    how : str
        One of `ALIGNMENTS`.

    Returns
    -------
    factor, shift : float
        NaN where there are too few pixels.
    """
    if how == "none":
        return 1.0, 0.0
    if len(depth) < LEAST_PIXELS:
        return float("nan"), float("nan")
    every = max(1, len(depth) // MOST_PIXELS)
    depth, truth = depth[::every], truth[::every]
    columns = [depth / truth] if how == "scale" else [depth / truth, 1 / truth]
    design = np.stack(columns, axis=1)
    # Units differ by orders of magnitude: columns of about 1 keep the equations well conditioned.
    scale = np.median(design, axis=0)
    design = design / scale
    fitted = _start(design)
    for _ in range(ROUNDS):
        residual = np.abs(design @ fitted - 1)
        reach = TUNING * max(MAD_TO_SIGMA * float(np.median(residual)), 1e-12)
        weight = np.where(residual < reach, (1 - (residual / reach) ** 2) ** 2, 0.0)
        weighed = design * weight[:, None]
        last, fitted = fitted, np.linalg.lstsq(weighed.T @ design, weighed.sum(axis=0), rcond=None)[0]
        if np.allclose(last, fitted, rtol=1e-10, atol=1e-12):
            break
    fitted = fitted / scale
    return float(fitted[0]), float(fitted[1]) if how == "affine" else 0.0


def _start(design: Array) -> Array:
    """Return the fit through one or two pixels with the least median residual, among `TRIALS` draws."""
    if design.shape[1] == 1:
        return np.array([1 / np.median(design[:, 0])])
    rng = from_integer(0)
    tried = design[:: max(1, len(design) // JUDGED)]
    best, least = np.array([1 / np.median(design[:, 0]), 0.0]), np.inf
    for _ in range(TRIALS):
        pair = design[rng.choice(len(design), 2, replace=False)]
        if abs(np.linalg.det(pair)) < 1e-12:
            continue
        fitted = np.linalg.solve(pair, np.ones(2))
        median = float(np.median(np.abs(tried @ fitted - 1)))
        if median < least:
            best, least = fitted, median
    return best


def normals_of_distance(distance: Array, rays: Array) -> Array:
    """Return the normals of a map of distances along the rays, shape (H, W, 3); NaN where there is none.

    The points lie on the camera's own rays, and the normal is perpendicular to their central differences: exact on a
    plane, through any lens. A pixel next to a hole, a fold's edge or the frame's border has none.
    """
    return depth_normals(distance[..., None] * rays, radius_px=1)


def spread(depth: Array, truth: Array) -> float:
    """Return the spread of the relative errors of depths after an affine alignment: 0 where these are alike."""
    factor, shift = align(depth, truth, "affine")
    values = (factor * depth + shift) / truth - 1
    values = values[np.isfinite(values)]
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0
