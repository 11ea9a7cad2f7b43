"""Depth completion: a coarse depth map is corrected so that it agrees with sparse normals.

With the distance rho = exp(v) along the unit sightline s of each pixel the surface is X = exp(v) s. A normal n at a
pixel is perpendicular to both derivatives of X, which fixes the gradient of v there, whatever the distance:

    grad v = -(n . grad s) / (n . s).

So a normal is a linear constraint on v. The correction d = v - v0 of the coarse map is taken as a smooth random field,
a Matern field of smoothness 2 by its precision tau^2 (kappa^2 - Laplacian)^3 [Lindgren, Rue & Lindstroem 2011, An
explicit link between Gaussian fields and Gaussian Markov random fields, section 2], with the standard deviation and
correlation length that the user states of the coarse map. Its mean, given the normals with their covariances, is the
answer: a screened Poisson problem of higher order. (In the ordinary one, kappa^2 - Laplacian, gradients are white
noise, so that a single normal would move nothing around it.)
"""

from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import Array, Index, Mask

STEP_PX = 0.5
"""Half the way over which the derivative of the sightline is taken."""

LEAST_SLOPE_SD = 1e-3
"""Smallest standard deviation of a slope, rad: the grid's own error, which keeps exact normals from ruling alone."""


@dataclass(frozen=True)
class CoarseError:
    """What is known of a coarse map's error.

    Parameters
    ----------
    share : float
        Standard deviation of the relative error of the distance.
    length_px : float
        Distance over which the error is correlated (about 0.14 are left of the correlation there), px.
    """

    share: float
    length_px: float

    def check(self) -> None:
        """Raise `InputError` for what is not allowed."""
        if not 1e-4 <= self.share <= 1:
            raise InputError(f"share = {self.share:g}: must be 0.0001 to 1, the relative error of the coarse map")
        if not 2 <= self.length_px <= 1e4:
            raise InputError(f"length_px = {self.length_px:g}: must be 2 to 10000 px")


def complete(
    distance_mm: Array, camera: Camera, pixels: Array, normals: Array, covariances: Array, error: CoarseError
) -> Array:
    """Correct a coarse map of distances by sparse normals.

    Parameters
    ----------
    distance_mm : ndarray, shape (H, W)
        Coarse distances along the sightlines, mm; NaN where there is none.
    camera : Camera
        Of the map's size.
    pixels : ndarray, shape (N, 2)
        Where the normals were seen, px; pixel centres lie at + 0.5.
    normals : ndarray, shape (N, 3)
        Unit normals, camera frame, facing the camera.
    covariances : ndarray, shape (N, 2, 2)
        Of the normals, rad^2, in `tangent_basis`.
    error : CoarseError
        What is known of the coarse map's error.

    Returns
    -------
    ndarray, shape (H, W)
        The corrected distances, mm; NaN as before.
    """
    from scipy.sparse import block_diag
    from scipy.sparse.linalg import splu

    error.check()
    _check(distance_mm, camera, pixels, normals, covariances)
    coarse = np.log(distance_mm)
    known = np.isfinite(coarse)
    gradients, spreads = log_distance_gradients(camera, pixels, normals, covariances)
    precision = _prior_precision(known, error)
    rows, used = _difference_rows(known, pixels)
    weights = block_diag([np.linalg.inv(spread) for spread in spreads[used]], format="csr") if len(used) else None
    weighted = np.zeros(int(known.sum()))
    if weights is not None:
        precision = precision + rows.T @ weights @ rows
        weighted = rows.T @ (weights @ (gradients[used].ravel() - rows @ coarse[known]))
    corrected = coarse.copy()
    corrected[known] += splu(precision.tocsc()).solve(weighted)
    return np.asarray(np.exp(corrected))


def log_distance_gradients(camera: Camera, pixels: Array, normals: Array, covariances: Array) -> tuple[Array, Array]:
    """Return the gradients of log distance that normals fix, per px, shape (N, 2), and their covariances (N, 2, 2)."""
    sightlines, slopes = _sightline_slopes(camera, pixels)
    found = _gradient(sightlines, slopes, normals)
    first, second = tangent_basis(normals)
    # How the gradient turns with the normal, by differences along the two tangents.
    turn = 1e-5
    jacobian = np.stack(
        [(_gradient(sightlines, slopes, normals + turn * tangent) - found) / turn for tangent in (first, second)],
        axis=-1,
    )
    spreads = jacobian @ covariances @ np.swapaxes(jacobian, 1, 2)
    # One radian of slope is a gradient of one over a focal length.
    own = LEAST_SLOPE_SD**2 * np.einsum("nik,njk->nij", slopes, slopes)
    return found, spreads + own


def _gradient(sightlines: Array, slopes: Array, normals: Array) -> Array:
    """Return grad v = -(n . grad s) / (n . s), shape (N, 2); slopes are (N, 2, 3)."""
    along = np.einsum("ni,ni->n", normals, sightlines)
    return np.asarray(-np.einsum("nki,ni->nk", slopes, normals) / along[:, None])


def _sightline_slopes(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """Return unit sightlines, shape (N, 3), and their derivatives along columns and rows, per px, shape (N, 2, 3)."""
    steps = STEP_PX * np.eye(2)
    slopes = [(camera.unproject(pixels + step) - camera.unproject(pixels - step)) / (2 * STEP_PX) for step in steps]
    return camera.unproject(pixels), np.stack(slopes, axis=1)


def _prior_precision(known: Mask, error: CoarseError) -> Any:
    """Return the precision of the correction at the known pixels, a sparse matrix, shape (K, K)."""
    from scipy.sparse import diags, identity

    kappa = sqrt(16) / error.length_px
    tau2 = 1 / (8 * pi * kappa**4 * error.share**2)
    index = np.full(known.shape, -1)
    index[known] = np.arange(known.sum())
    count = int(known.sum())
    edges = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    pairs = np.concatenate([np.stack([a[m], b[m]], 1) for a, b in edges for m in [(a >= 0) & (b >= 0)]])
    incidence = _incidence(pairs, count)
    operator = kappa**2 * identity(count, format="csr") + incidence.T @ incidence
    cubed = operator @ operator @ operator
    # A tiny ridge keeps the factors positive in spite of rounding.
    return tau2 * cubed + diags(np.full(count, 1e-12 * tau2))


def _incidence(pairs: Array, count: int) -> Any:
    from scipy.sparse import csr_matrix

    rows = np.repeat(np.arange(len(pairs)), 2)
    return csr_matrix((np.tile([-1.0, 1.0], len(pairs)), (rows, pairs.ravel())), shape=(len(pairs), count))


def _difference_rows(known: Mask, pixels: Array) -> tuple[Any, Index]:
    """Return sparse rows, two a pixel, that take central differences of v there, and the pixels that have them."""
    from scipy.sparse import csr_matrix

    height, width = known.shape
    index = np.cumsum(known.ravel()).reshape(known.shape) - 1
    column, row = np.floor(pixels).astype(int).T
    inside = (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    column, row = (np.where(inside, value, 1) for value in (column, row))
    around = [(row, column + 1), (row, column - 1), (row + 1, column), (row - 1, column)]
    used = np.flatnonzero(inside & np.all([known[at] for at in around], axis=0))
    columns = np.stack([index[at][used] for at in around], axis=1).ravel()
    rows = np.repeat(np.arange(2 * len(used)), 2)
    values = np.tile([0.5, -0.5], 2 * len(used))
    return csr_matrix((values, (rows, columns)), shape=(2 * len(used), int(known.sum()))), used


def _check(distance_mm: Array, camera: Camera, pixels: Array, normals: Array, covariances: Array) -> None:
    if distance_mm.shape != (camera.height, camera.width):
        raise InputError(
            f"distance_mm is {distance_mm.shape[1]} x {distance_mm.shape[0]} px: must be of the camera's size, "
            f"{camera.width} x {camera.height}"
        )
    known = distance_mm[np.isfinite(distance_mm)]
    if not known.size or (known <= 0).any():
        raise InputError("distance_mm: must be positive, or NaN where there is none, and known somewhere")
    count = len(pixels)
    for name, value, shape in (
        ("pixels", pixels, (count, 2)), ("normals", normals, (count, 3)), ("covariances", covariances, (count, 2, 2)),
    ):  # fmt: skip
        if np.shape(value) != shape or not np.isfinite(value).all():
            raise InputError(f"{name} has shape {np.shape(value)}; must be {shape}, all finite")
    if count and (np.linalg.eigvalsh(covariances) <= 0).any():
        raise InputError("covariances: must be positive definite, rad^2")
