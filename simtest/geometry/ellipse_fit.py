"""Direct least-squares ellipse fit [FF99] in its stable form [HF98], centred and scaled."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason

Array = npt.NDArray[np.float64]

MIN_POINTS = 6
"""An ellipse has five parameters; with five points or fewer the fit has no residual."""

MAX_COORDINATE = 1e150
"""Beyond it squares overflow."""

MAX_AXIS_RATIO = 1e4
"""A fitted ellipse longer than this over its width is a line."""


@dataclass(frozen=True)
class FittedConic:
    """An ellipse in coordinates centred on its points and scaled by their spread.

    Kept with its transform, because the conic of a small ellipse far from the image's origin has entries that
    cancel to nothing.

    Parameters
    ----------
    normalised : ndarray, shape (3, 3)
        Symmetric, in the centred coordinates, positive outside.
    normalised_from_image : ndarray, shape (3, 3)
        Similarity from pixels to the centred coordinates.
    """

    normalised: Array
    normalised_from_image: Array

    @property
    def image(self) -> Array:
        """The conic in pixels, shape (3, 3)."""
        T = self.normalised_from_image
        return np.asarray(T.T @ self.normalised @ T)


def fit_ellipse(points: npt.ArrayLike) -> FittedConic | Failure:
    """Fit an ellipse to points: minimise the algebraic distance subject to 4 a c - b^2 = 1 [FF99, HF98].

    Parameters
    ----------
    points : array_like, shape (N, 2)
        Pixels.

    Returns
    -------
    FittedConic or Failure
        A Failure for fewer than 6 points, values that are not finite, points on a line, or no elliptic solution.
    """
    xy = np.asarray(points, dtype=float)
    if xy.ndim != 2 or xy.shape[1] != 2 or len(xy) < MIN_POINTS:
        return Failure(Reason.TOO_FEW_POINTS, f"{len(xy)} points; at least {MIN_POINTS} are needed")
    if not np.isfinite(xy).all():
        return Failure(Reason.NOT_FINITE, "contour points hold NaN or infinity")
    if np.abs(xy).max() > MAX_COORDINATE:
        return Failure(Reason.NOT_FINITE, f"contour points beyond {MAX_COORDINATE:g}")
    centre = xy.mean(axis=0)
    scale = float(np.sqrt(((xy - centre) ** 2).sum(axis=1).mean() / 2))
    if not scale > 1e-12 * (1 + float(np.abs(centre).max())):
        return Failure(Reason.DEGENERATE_CONIC, "all points coincide")
    coefficients = _fit_normalised((xy - centre) / scale)
    if isinstance(coefficients, Failure):
        return coefficients
    a, b, c, d, e, f = coefficients
    conic = np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])
    if np.trace(conic[:2, :2]) < 0:
        conic = -conic
    failure = _check(conic)
    if failure is not None:
        return failure
    transform = np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1.0]])
    return FittedConic(conic / np.linalg.norm(conic), transform)


def _fit_normalised(xy: Array) -> Array | Failure:
    """Give a x^2 + b x y + c y^2 + d x + e y + f = 0 by Halir & Flusser's reduced 3 x 3 eigenproblem."""
    x, y = xy.T
    quadratic, linear = np.stack([x * x, x * y, y * y], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    S1, S2, S3 = quadratic.T @ quadratic, quadratic.T @ linear, linear.T @ linear
    try:
        T = -np.linalg.solve(S3, S2.T)
        M = S1 + S2 @ T
        reduced = np.stack([M[2] / 2, -M[1], M[0] / 2])
        _, vectors = np.linalg.eig(reduced)
    except np.linalg.LinAlgError:
        return Failure(Reason.DEGENERATE_CONIC, "the points lie on a line")
    # The two solutions that are no ellipse may coincide, as on a circle; rounding then makes them a complex pair.
    real = np.abs(vectors.imag).max(axis=0) <= 1e-9
    vectors = np.real(vectors)
    condition = np.where(real, 4 * vectors[0] * vectors[2] - vectors[1] ** 2, -np.inf)
    if not (condition > 0).any():
        return Failure(Reason.NOT_AN_ELLIPSE, "the fit has no elliptic solution")
    quadratic_part = vectors[:, int(np.argmax(condition))]
    return np.concatenate([quadratic_part, T @ quadratic_part])


def _check(conic: Array) -> Failure | None:
    """Refuse a conic that is no real ellipse, or so long that it is a line."""
    low, high = np.linalg.eigvalsh(conic[:2, :2])
    if not np.isfinite(conic).all():
        return Failure(Reason.NOT_FINITE, "the fit overflowed")
    if low <= 0 or np.linalg.det(conic) >= 0:
        return Failure(Reason.NOT_AN_ELLIPSE, "the fitted conic is no real ellipse")
    if high > MAX_AXIS_RATIO**2 * low:
        return Failure(Reason.DEGENERATE_CONIC, f"axes differ by more than a factor {MAX_AXIS_RATIO:g}")
    return None
