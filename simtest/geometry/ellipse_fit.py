"""Direct least-squares ellipse fit [FF99] in its stable form [HF98], centred and scaled, of many contours at once."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, InputError, Reason
from simtest.geometry.ellipse_pencil import constrained_minimum

Array = npt.NDArray[np.float64]

MIN_POINTS = 6
"""An ellipse has five parameters; with five points or fewer the fit has no residual."""

MAX_COORDINATE = 1e150
"""Beyond it squares overflow."""

MAX_AXIS_RATIO = 1e4
"""A fitted ellipse longer than this over its width is a line."""

_STEP = 64
"""Contours are padded to a multiple of this many points. Their own length alone decides, so that a fit's last bits
do not depend on what else is in the batch."""

_LINE = 1e-14
"""A share of the squared second moments' trace below which their determinant is rounding."""

_RANK = 1e-15
"""A share of the largest moment below which an eigenvalue is rounding."""

_AT_ONCE = 2**16
"""Padded points that are worked on at once: more would leave the processor's cache."""


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
        Similarity from pixels to the centred coordinates, along the points' principal axes.
    """

    normalised: Array
    normalised_from_image: Array

    @property
    def image(self) -> Array:
        """The conic in pixels, shape (3, 3)."""
        T = self.normalised_from_image
        return np.asarray(T.T @ self.normalised @ T)


@dataclass(frozen=True)
class FittedConics:
    """Ellipses of several contours (see `FittedConic`).

    Parameters
    ----------
    normalised, normalised_from_image : ndarray, shape (N, 3, 3)
        As of `FittedConic`; those of a failed fit mean nothing.
    failures : mapping
        Failure by the contour's number.
    """

    normalised: Array
    normalised_from_image: Array
    failures: Mapping[int, Failure] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.normalised)

    def __getitem__(self, index: int) -> FittedConic | Failure:
        # Failures are numbered from 0: one that is asked for from the end must be found too.
        index = range(len(self))[operator.index(index)]
        failure = self.failures.get(index)
        return failure or FittedConic(self.normalised[index], self.normalised_from_image[index])


class _Failures:
    """The first failure of each contour."""

    def __init__(self) -> None:
        self.found: dict[int, Failure] = {}

    def add(self, which: npt.NDArray[np.bool_], reason: Reason, detail: str) -> None:
        for index in np.flatnonzero(which):
            self.found.setdefault(int(index), Failure(reason, detail))


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

    Raises
    ------
    InputError
        If the points are no numbers of shape (N, 2).
    """
    return fit_ellipses([points])[0]


def fit_ellipses(contours: Sequence[npt.ArrayLike]) -> FittedConics:
    """Fit an ellipse to each of several contours (see `fit_ellipse`).

    Parameters
    ----------
    contours : sequence of array_like, shape (N_i, 2)
        Pixels.

    Returns
    -------
    FittedConics
        In the order of the contours.

    Raises
    ------
    InputError
        If a contour is no numbers of shape (N, 2).
    """
    count = len(contours)
    normalised, transforms = np.tile(np.eye(3), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1))
    failures: dict[int, Failure] = {}
    alike: dict[int, list[int]] = {}
    arrays = [_points(points, index) for index, points in enumerate(contours)]
    for index, xy in enumerate(arrays):
        if len(xy) < MIN_POINTS:
            failures[index] = Failure(Reason.TOO_FEW_POINTS, f"{len(xy)} points; at least {MIN_POINTS} are needed")
        else:
            alike.setdefault(-(-len(xy) // _STEP) * _STEP, []).append(index)
    for length, members in alike.items():
        at_once = max(1, _AT_ONCE // length)
        for first in range(0, len(members), at_once):
            part = members[first : first + at_once]
            fitted = _fit_padded([arrays[i] for i in part], length)
            normalised[part], transforms[part] = fitted.normalised, fitted.normalised_from_image
            failures |= {part[i]: failure for i, failure in fitted.failures.items()}
    return FittedConics(normalised, transforms, failures)


def _points(points: npt.ArrayLike, index: int) -> Array:
    """Give a contour as an array of shape (N, 2)."""
    try:
        xy = np.asarray(points, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"contour {index}: must be numbers of shape (N, 2)") from None
    if xy.shape == (0,):
        return xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InputError(f"contour {index} has shape {xy.shape}: must be (N, 2)")
    return xy


def _fit_padded(contours: list[Array], length: int) -> FittedConics:
    """Fit contours of at most `length` points, B of them."""
    counts = np.array([len(xy) for xy in contours])
    present = np.arange(length) < counts[:, None]
    # One table for all steps: x^2, x y, y^2, x, y, 1. Fresh memory for each would cost more than the sums.
    design = np.zeros((6, len(contours), length))
    design[5] = present
    points = design[3:5]
    for i, xy in enumerate(contours):
        points[:, i, : len(xy)] = xy.T
    failures = _Failures()
    extent = np.abs(points).max(axis=(0, 2))
    failures.add(~np.isfinite(extent), Reason.NOT_FINITE, "contour points hold NaN or infinity")
    failures.add(extent > MAX_COORDINATE, Reason.NOT_FINITE, f"contour points beyond {MAX_COORDINATE:g}")
    points[:, list(failures.found)] = 0.0
    transforms = _normalise(points, design[5], counts, failures)
    conics = _fit_normalised(design, counts, failures)
    _check(conics, failures)
    return FittedConics(conics, transforms, failures.found)


def _normalise(points: Array, present: Array, counts: Array, failures: _Failures) -> Array:
    """Move points, shape (2, B, n), to their centre, principal axes and unit spread; give the similarities.

    In the principal axes the moments of a long ellipse are graded, and no digits are lost between them.
    """
    centre = np.zeros((2, len(counts)))
    # Twice: far from the origin the first mean is off by its rounding, and the points would share that offset.
    for _ in range(2):
        mean = points.sum(axis=2) / counts
        points -= mean[:, :, None]
        points *= present
        centre += mean
    (xx, xy), (_, yy) = np.einsum("ibn,jbn->ijb", points, points)
    scale = np.sqrt((xx + yy) / counts / 2)
    together = ~(scale > 1e-12 * (1 + np.abs(centre).max(axis=0)))
    failures.add(together, Reason.DEGENERATE_CONIC, "all points coincide")
    points[:, together] = 0.0
    scale[together] = 1.0
    angle = np.arctan2(2 * xy, xx - yy) / 2
    cos, sin = np.cos(angle) / scale, np.sin(angle) / scale
    transforms = np.zeros((len(counts), 3, 3))
    transforms[:, 0, 0] = transforms[:, 1, 1] = cos
    transforms[:, 0, 1], transforms[:, 1, 0] = sin, -sin
    transforms[:, :2, 2] = -(transforms[:, :2, :2] @ centre.T[:, :, None])[:, :, 0]
    transforms[:, 2, 2] = 1.0
    points[:] = (transforms[:, :2, :2] @ points.transpose(1, 0, 2)).transpose(1, 0, 2)
    return transforms


def _fit_normalised(design: Array, counts: Array, failures: _Failures) -> Array:
    """Give conics of normalised points by the reduced 3 x 3 eigenproblem [HF98], shape (B, 3, 3).

    The last three of `design`, shape (6, B, n), are x, y and 1. The sums of x and of y are 0: the linear and the
    constant part do not mix.
    """
    x, y = design[3:5]
    for row, (first, second) in enumerate(((x, x), (x, y), (y, y))):
        np.multiply(first, second, out=design[row])
    S = design[:3].transpose(1, 0, 2) @ design.transpose(1, 2, 0)
    S1, S2, (xx, xy, yy) = S[:, :, :3], S[:, :, 3:5], S[:, :, 5].T
    spread = xx * yy - xy * xy
    on_line = ~(spread > _LINE * (xx + yy) ** 2)
    failures.add(on_line, Reason.DEGENERATE_CONIC, "the points lie on a line")
    # d, e and f that minimise the residual for given a, b, c: (d, e) = -linear (a, b, c), f = -constant (a, b, c).
    inverse = np.stack([yy, -xy, -xy, xx], axis=1) / np.where(on_line, 1.0, spread)[:, None]
    linear = inverse.reshape(-1, 2, 2) @ S2.transpose(0, 2, 1)
    constant = S[:, :, 5] / counts[:, None]
    M = S1 - S2 @ linear - S[:, :, 5, None] * constant[:, None, :]
    M = (M + M.transpose(0, 2, 1)) / 2
    # One eigenvalue of M is 0 on an exact ellipse; where two are, as on four points, many conics fit.
    trace, rounding = np.trace(M, axis1=1, axis2=2), _RANK * np.trace(S1, axis1=1, axis2=2)
    minors = (trace**2 - (M**2).sum(axis=(1, 2))) / 2
    many = ~((trace > rounding) & (minors > rounding * trace))
    failures.add(many, Reason.DEGENERATE_CONIC, "the points do not determine an ellipse")
    # A circle's problem stands in for those without a solution.
    M[many | on_line] = np.eye(3)
    quadratic = constrained_minimum(M)
    a, b, c = quadratic.T
    d, e = -(linear @ quadratic[:, :, None])[:, :, 0].T
    f = -(constant * quadratic).sum(axis=1)
    conics = np.stack([a, b / 2, d / 2, b / 2, c, e / 2, d / 2, e / 2, f], axis=1)
    conics *= (np.where(a + c < 0, -1.0, 1.0) / np.linalg.norm(conics, axis=1))[:, None]
    return np.asarray(conics.reshape(-1, 3, 3))


def _check(conics: Array, failures: _Failures) -> None:
    """Refuse conics that are no real ellipse, or so long that they are lines."""
    a, b, c = conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]
    high = (a + c + np.hypot(a - c, 2 * b)) / 2
    # low as the product over high: the difference would cancel.
    low = (a * c - b * b) / high
    not_real = ~((low > 0) & (np.linalg.det(conics) < 0))
    failures.add(not_real, Reason.NOT_AN_ELLIPSE, "the fitted conic is no real ellipse")
    too_long = ~(high <= MAX_AXIS_RATIO**2 * low)
    failures.add(too_long, Reason.DEGENERATE_CONIC, f"axes differ by more than a factor {MAX_AXIS_RATIO:g}")
