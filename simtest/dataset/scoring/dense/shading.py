"""Normals and depths of a whole frame by shading alone: a baseline for dense methods.

The surface is matt, of one unknown albedo, and lit by a point light at the camera. With the distance d(s) along the
unit sightline s and v = log d, a Lambertian surface shines by

    I = rho cos(theta) / d^2 = rho exp(-2 v) / sqrt(1 + |grad v|^2),

grad the gradient on the sphere of sightlines: the image irradiance equation of perspective shape from shading with
attenuation [Prados & Faugeras 2005, Shape from shading: a well-posed problem?, equation (1) with f(r) = 1 / r^2]. The
attenuation makes it well posed but for the scale, which the albedo hides. It is solved here in the least-squares sense

    minimise  sum w (v + log(I / rho) / 2 + log(1 + |grad v|^2) / 4)^2 + SMOOTHNESS sum |second differences of v|^2

by Gauss-Newton steps from coarse to fine, with robust weights w, and none at highlights and clipped or dark pixels.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from simtest.calibration import Calibration
from simtest.geometry import Camera
from simtest.runtime.arrays import Array, Image, Mask

SIDES_PX = (24, 48, 96)
"""Longer side of the grid at each stage."""

STEPS = 12
"""Gauss-Newton steps of a stage, at most."""

CONVERGED, HALVINGS = 1e-4, 6
SMOOTHNESS = 0.3
"""Weight of a second difference of log distance between neighbouring cells against a residual of log intensity."""

ROBUST = 0.1
"""Residuals beyond this weigh less (Huber)."""

BRIGHT, DARK = 1.5, 0.02
"""A pixel beyond so many times the median around it is a highlight; one below this share of the frame's is dark."""

WINDOW_CELLS = 9
"""Side of the window of that median, in cells of the finest grid."""

LEAST_COVER = 0.25
"""A cell with a smaller share of usable pixels tells nothing."""


def shading_maps(values: Image, calibration: Calibration) -> tuple[Array, Array]:
    """Compute the normals and distances of a frame by shading alone.

    Parameters
    ----------
    values : ndarray of float32, shape (H, W) or (H, W, 3)
        The frame as encoded.
    calibration : Calibration
        Camera, response and falloff; lights are taken to be at the camera whatever it says.

    Returns
    -------
    normal : ndarray, shape (H, W, 3)
        Unit, camera frame, facing the camera; NaN where no sightline or no light is.
    distance : ndarray, shape (H, W)
        Along the ray, in a unit that the albedo hides: the median is 1.
    """
    camera, corrected = calibration.camera, calibration.correct(values)
    seen = np.ones(corrected.intensity.shape, dtype=bool) if camera.seen is None else camera.seen
    usable = seen & np.isfinite(corrected.intensity)
    if corrected.saturated is not None:
        usable &= ~corrected.saturated
    intensity = np.nan_to_num(corrected.intensity).astype(np.float32)
    unanswered = np.full((*intensity.shape, 3), np.nan), np.full(intensity.shape, np.nan)
    if not (usable & (intensity > 0)).any():
        return unanswered
    usable &= _is_matt(intensity, usable)
    log_distance: Array | None = None
    for side in SIDES_PX:
        cells = _cells(intensity, usable, camera, side)
        if cells is None:
            continue
        start = -cells.log_intensity / 2 if log_distance is None else _resized(log_distance, cells.log_intensity.shape)
        log_distance = _solve(cells, start)
    if log_distance is None:
        return unanswered
    rays = camera.unproject(camera.pixel_centres())
    full = _resized(log_distance, intensity.shape)
    normal = _normals(full, rays)
    lost = ~seen | ~np.isfinite(normal).all(axis=-1)
    normal[lost] = np.nan
    distance = np.exp(full - np.median(full[~lost])) if not lost.all() else full
    return normal, np.where(lost, np.nan, distance)


def _is_matt(intensity: Image, usable: Mask) -> Mask:
    """Return the pixels that are neither highlights nor dark, shape (H, W)."""
    from scipy.ndimage import median_filter

    small = _mean_where(intensity, usable, _grid(intensity.shape, SIDES_PX[-1]))[0]
    level = float(np.quantile(intensity[usable], 0.9))
    around = cv2.resize(
        median_filter(small, WINDOW_CELLS), intensity.shape[::-1], interpolation=cv2.INTER_LINEAR
    )  # fmt: skip
    shines = cv2.dilate((intensity > BRIGHT * around).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return np.asarray(~shines & (intensity > DARK * level))


def _grid(shape: tuple[int, ...], side: int) -> tuple[int, int]:
    """Return rows and columns of a grid over a frame, with a longer side of at most `side`."""
    share = min(1.0, side / max(shape))
    return max(3, round(shape[0] * share)), max(3, round(shape[1] * share))


def _mean_where(image: Image, where: Mask, grid: tuple[int, int]) -> tuple[Image, Image]:
    """Return the mean of an image over the usable pixels of each cell, and their share."""
    size = grid[::-1]
    share = cv2.resize(where.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(where, image, np.float32(0)), size, interpolation=cv2.INTER_AREA)
    return np.asarray(total / np.maximum(share, 1e-6), np.float32), np.asarray(share, np.float32)


@dataclass(frozen=True)
class _Cells:
    """A grid over the frame: log intensity, its weights, shape (h, w), and the metric of sightlines a cell."""

    log_intensity: Array
    weight: Array
    metric: tuple[Array, Array, Array]


def _cells(intensity: Image, usable: Mask, camera: Camera, side: int) -> _Cells | None:
    """Return the grid of a stage; None where no cell tells anything."""
    height, width = grid = _grid(intensity.shape, side)
    mean, share = _mean_where(intensity, usable, grid)
    known = (share >= LEAST_COVER) & (mean > 0)
    if not known.any():
        return None
    logs = np.log(np.where(known, mean, 1.0)).astype(float)
    # The albedo is unknown: the median intensity stands at log distance 0.
    logs = np.where(known, logs - np.median(logs[known]), 0.0)
    x = (np.arange(width) + 0.5) * camera.width / width
    y = (np.arange(height) + 0.5) * camera.height / height
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1))
    down, across = (np.asarray(part) for part in np.gradient(rays, axis=(0, 1)))
    metric = ((across**2).sum(axis=-1), (across * down).sum(axis=-1), (down**2).sum(axis=-1))
    sound = np.logical_and.reduce([np.isfinite(part) for part in metric])
    fill = [float(np.median(part[sound])) for part in metric]
    held = tuple(np.where(sound, part, own) for part, own in zip(metric, fill, strict=True))
    return _Cells(logs, np.where(known & sound, share, 0.0).astype(float), (held[0], held[1], held[2]))


def _resized(values: Array, shape: tuple[int, ...]) -> Array:
    return np.asarray(cv2.resize(values, shape[::-1], interpolation=cv2.INTER_CUBIC), float)


def _solve(cells: _Cells, start: Array) -> Array:
    """Minimise the energy from a start, shape (h, w), by Gauss-Newton steps that are halved until it falls."""
    from scipy import sparse
    from scipy.linalg import solveh_banded

    dx, dy, bends = _differences(start.shape)
    g11, g12, g22 = (part.ravel() for part in cells.metric)
    area = np.maximum(g11 * g22 - g12**2, 1e-12)
    logs, known = cells.log_intensity.ravel(), cells.weight.ravel()
    smooth = SMOOTHNESS * (bends.T @ bends)

    def judged(v: Array) -> tuple[float, Array, Array, Array, Array]:
        """Return the energy, the residuals and their weights, and the slope's share along x and y."""
        vx, vy = dx @ v, dy @ v
        along_x, along_y = (g22 * vx - g12 * vy) / area, (g11 * vy - g12 * vx) / area
        slope2 = np.maximum(vx * along_x + vy * along_y, 0.0)
        residual = v + logs / 2 + np.log1p(slope2) / 4
        size = np.abs(residual)
        # Huber's loss and weights
        loss = np.where(size < ROBUST, residual**2, 2 * ROBUST * size - ROBUST**2)
        weight = known * np.minimum(1.0, ROBUST / np.maximum(size, 1e-12))
        share = 0.5 / (1 + slope2)
        return float(known @ loss + v @ (smooth @ v)), residual, weight, share * along_x, share * along_y

    v = start.ravel().astype(float)
    energy, residual, weight, of_x, of_y = judged(v)
    for _ in range(STEPS):
        jacobian = sparse.identity(len(v)) + sparse.diags(of_x) @ dx + sparse.diags(of_y) @ dy
        weighted = sparse.diags(weight) @ jacobian
        system = jacobian.T @ weighted + smooth + 1e-6 * sparse.identity(len(v))
        # Its lower diagonals: a banded Cholesky factor takes a quarter of the time of a sparse one.
        below = sparse.tril(system).tocoo()
        diagonals = np.zeros((int((below.row - below.col).max()) + 1, len(v)))
        diagonals[below.row - below.col, below.col] = below.data
        step = solveh_banded(diagonals, -(weighted.T @ residual + smooth @ v), overwrite_ab=True, lower=True)
        for _ in range(HALVINGS):
            tried = judged(v + step)
            if tried[0] < energy:
                break
            step = step / 2
        else:
            break
        v, (energy, residual, weight, of_x, of_y) = v + step, tried
        if np.abs(step).max() < CONVERGED:
            break
    return np.asarray(v.reshape(start.shape))


def _differences(shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Return the sparse operators of the central differences along x and y, and of the second differences."""
    from scipy import sparse

    height, width = shape
    (first_x, second_x), (first_y, second_y) = (_of_line(count) for count in (width, height))
    one_x, one_y = sparse.identity(width), sparse.identity(height)
    dx, dy = sparse.kron(one_y, first_x).tocsr(), sparse.kron(first_y, one_x).tocsr()
    bends = [sparse.kron(one_y, second_x), sparse.kron(second_y, one_x), np.sqrt(2) * (dx @ dy)]
    return dx, dy, sparse.vstack(bends).tocsr()


def _of_line(count: int) -> tuple[Any, Any]:
    """Return the first differences, one-sided at the ends, and the second differences along a line of cells."""
    from scipy import sparse

    first = sparse.diags([-0.5, 0.5], [-1, 1], (count, count)).tolil()
    first[0, :2] = [-1.0, 1.0]
    first[-1, -2:] = [-1.0, 1.0]
    return first.tocsr(), sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], (count - 2, count)).tocsr()


def _normals(log_distance: Array, rays: Array) -> Array:
    """Return the unit normals, along grad v - s, of a log distance on the sightlines, shape (H, W, 3)."""
    down, across = (np.asarray(part) for part in np.gradient(rays, axis=(0, 1)))
    vy, vx = np.gradient(log_distance)
    g11, g12, g22 = (across**2).sum(axis=-1), (across * down).sum(axis=-1), (down**2).sum(axis=-1)
    area = g11 * g22 - g12**2
    with np.errstate(invalid="ignore", divide="ignore"):
        gradient = ((g22 * vx - g12 * vy) / area)[..., None] * across + ((g11 * vy - g12 * vx) / area)[..., None] * down
        normal = gradient - rays
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(normal)
