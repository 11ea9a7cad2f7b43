"""Direct least-squares ellipse fit [FF99] in its stable form [HF98], centred and scaled; fits many contours at once."""

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, InputError, Reason
from simtest.geometry.ellipse_pencil import constrained_minimum
from simtest.runtime.arrays import AnyArray, Array, Index, Mask

MIN_POINTS = 6
"""An ellipse has five parameters; with five points or fewer the fit has no residual."""

MAX_COORDINATE = 1e150
"""Beyond it squares overflow."""

MAX_AXIS_RATIO = 1e4
"""A fitted ellipse longer than this over its width is a line."""

_LINE = 1e-14
"""A determinant of second moments below this share of their squared trace is rounding: the points lie on a line."""

_RANK = 1e-15
"""An eigenvalue below this share of the largest moment is rounding."""

_AT_ONCE = 2**18
"""Points that are fitted at once: more would only take memory."""


@dataclass(frozen=True)
class FittedConic:
    """An ellipse in coordinates centred on its points and scaled by their spread.

    It is kept with its transform: in pixels, the entries of a small ellipse far from the origin would cancel.

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

    def centre_and_matrix(self) -> tuple[Array, Array]:
        """Return centre, px, and Q of the ellipse as (x - centre)^T Q (x - centre) = 1."""
        return self._centre_and_matrix

    @cached_property
    def _centre_and_matrix(self) -> tuple[Array, Array]:
        C, T = self.normalised, self.normalised_from_image
        centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
        level = -(C[2, 2] + C[:2, 2] @ centre)
        Q = T[:2, :2].T @ C[:2, :2] @ T[:2, :2] / level
        return np.asarray(np.linalg.solve(T[:2, :2], centre - T[:2, 2])), np.asarray(Q)

    def relative_radii(self, points: Array) -> Array:
        """Return the distance of points, shape (N, 2), px, from the centre over the ellipse's radius that way."""
        centre, Q = self.centre_and_matrix()
        gap = points - centre
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", gap, Q, gap)))


@dataclass(frozen=True)
class FittedConics:
    """Ellipses of several contours (see `FittedConic`).

    Parameters
    ----------
    normalised, normalised_from_image : ndarray, shape (N, 3, 3)
        As of `FittedConic`; those of a failed fit mean nothing.
    failures : mapping
        Failure by the contour's index.
    """

    normalised: Array
    normalised_from_image: Array
    failures: Mapping[int, Failure] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.normalised)

    def __getitem__(self, index: int) -> FittedConic | Failure:
        # A negative index must find its failure too.
        index = range(len(self))[operator.index(index)]
        if (failure := self.failures.get(index)) is not None:
            return failure
        return FittedConic(self.normalised[index], self.normalised_from_image[index])


class _Failures:
    """The first failure of each contour."""

    def __init__(self) -> None:
        self._noted: list[tuple[Mask, Reason, str]] = []

    def add(self, which: Mask, reason: Reason, detail: str) -> None:
        self._noted.append((which, reason, detail))

    @property
    def found(self) -> dict[int, Failure]:
        found: dict[int, Failure] = {}
        # Usually there are none, which one test of all finds.
        if np.array([which for which, _, _ in self._noted]).any():
            for which, reason, detail in self._noted:
                for index in np.flatnonzero(which).tolist():
                    found.setdefault(index, Failure(reason, detail))
        return found


def fit_ellipse(points: npt.ArrayLike) -> FittedConic | Failure:
    """Fit an ellipse to points, array_like of shape (N, 2): minimise the algebraic distance with 4 a c - b^2 = 1.

    The direct fit [FF99, HF98]. A Failure for fewer than 6 points, values that are not finite, points on a line, or no
    elliptic solution.

    Raises
    ------
    InputError
        If the points are no numbers of shape (N, 2).
    """
    return fit_ellipses([points])[0]


def fit_ellipses(contours: Sequence[npt.ArrayLike]) -> FittedConics:
    """Fit an ellipse to each of several contours, array_like of shape (N_i, 2), px (see `fit_ellipse`).

    Raises
    ------
    InputError
        If a contour is no numbers of shape (N, 2).
    """
    count = len(contours)
    # candidates: contours of six points and more
    normalised, transforms = np.zeros((2, count, 3, 3)) + np.eye(3)
    failures: dict[int, Failure] = {}
    arrays = [_points(points, index) for index, points in enumerate(contours)]
    long_enough = []
    for index, xy in enumerate(arrays):
        if len(xy) < MIN_POINTS:
            failures[index] = Failure(Reason.TOO_FEW_POINTS, f"{len(xy)} points; at least {MIN_POINTS} are needed")
        else:
            long_enough.append(index)
    # fit them, a bounded number of points at once
    for part in _parts(long_enough, [len(xy) for xy in arrays]):
        fitted = _fit_together([arrays[i] for i in part])
        normalised[part], transforms[part] = fitted.normalised, fitted.normalised_from_image
        failures |= {part[i]: failure for i, failure in fitted.failures.items()}
    return FittedConics(normalised, transforms, failures)


def _parts(members: list[int], lengths: list[int]) -> Iterator[list[int]]:
    """Split contours into parts of not too many points in all."""
    part: list[int] = []
    total = 0
    for index in members:
        if part and total + lengths[index] > _AT_ONCE:
            yield part
            part, total = [], 0
        part.append(index)
        total += lengths[index]
    if part:
        yield part


def _points(points: npt.ArrayLike, index: int) -> Array:
    """Return a contour as an array of shape (N, 2)."""
    try:
        xy = np.asarray(points, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"contour {index}: must be numbers of shape (N, 2)") from None
    if xy.shape == (0,):
        return xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InputError(f"contour {index} has shape {xy.shape}: must be (N, 2)")
    return xy


@dataclass(frozen=True)
class _Batch:
    """Points of B contours one after the other.

    Every sum runs over one contour's points alone, so that a fit's last bits do not depend on the rest of the batch.

    Parameters
    ----------
    points : ndarray, shape (2, N)
    counts : ndarray of int, shape (B,)
        Points of each contour.
    """

    points: Array
    counts: Index

    @classmethod
    def of(cls, contours: list[Array]) -> "_Batch":
        counts = np.array([len(xy) for xy in contours])
        return cls(np.concatenate(contours).T.copy(), counts)

    @cached_property
    def first(self) -> Index:
        """First point of each contour, shape (B,)."""
        return np.asarray(np.cumsum(self.counts) - self.counts)

    def sums(self, table: Array) -> Array:
        """Sum a table over each contour's points, from shape (K, N) to (K, B)."""
        return np.add.reduceat(table, self.first, axis=1)

    def spread(self, values: AnyArray) -> AnyArray:
        """Repeat the value of each contour for its points, from shape (..., B) to (..., N)."""
        return np.repeat(values, self.counts, axis=-1)


def _fit_together(contours: list[Array]) -> FittedConics:
    """Fit B contours."""
    batch, failures = _Batch.of(contours), _Failures()
    extent = np.maximum.reduceat(np.abs(batch.points), batch.first, axis=1).max(axis=0)
    failures.add(~np.isfinite(extent), Reason.NOT_FINITE, "contour points hold NaN or infinity")
    failures.add(extent > MAX_COORDINATE, Reason.NOT_FINITE, f"contour points beyond {MAX_COORDINATE:g}")
    if found := failures.found:
        batch.points[:, batch.spread(np.isin(np.arange(len(contours)), list(found)))] = 0.0
    transforms = _normalise(batch, failures)
    conics = _fit_normalised(batch, failures)
    _check(conics, failures)
    return FittedConics(conics, transforms, failures.found)


def _normalise(batch: _Batch, failures: _Failures) -> Array:
    """Move points to their centre, principal axes and unit spread; return the similarities, shape (B, 3, 3).

    In the principal axes the moments of a long ellipse are graded, and no digits are lost between them.
    """
    points, counts = batch.points, batch.counts
    centre = np.zeros((2, len(counts)))
    # Twice: far from the origin the first mean is off by rounding, and all points would share that offset.
    for _ in range(2):
        mean = batch.sums(points) / counts
        points -= batch.spread(mean)
        centre += mean
    # scale: the root of the mean variance
    x, y = points
    xx, xy, yy = batch.sums(np.array([x * x, x * y, y * y]))
    scale = np.sqrt((xx + yy) / counts / 2)
    together = ~(scale > 1e-12 * (1 + np.abs(centre).max(axis=0)))
    failures.add(together, Reason.DEGENERATE_CONIC, "all points coincide")
    if together.any():
        points[:, batch.spread(together)] = 0.0
        scale[together] = 1.0
    # principal axes
    angle = np.arctan2(2 * xy, xx - yy) / 2
    cos, sin = np.cos(angle) / scale, np.sin(angle) / scale
    transforms = np.zeros((len(counts), 3, 3))
    transforms[:, 0, 0] = transforms[:, 1, 1] = cos
    transforms[:, 0, 1], transforms[:, 1, 0] = sin, -sin
    transforms[:, 0, 2], transforms[:, 1, 2] = -cos * centre[0] - sin * centre[1], sin * centre[0] - cos * centre[1]
    transforms[:, 2, 2] = 1.0
    cos, sin = batch.spread(np.array([cos, sin]))
    points[:] = cos * x + sin * y, cos * y - sin * x
    return transforms


_QUARTIC, _CUBIC, _QUADRATIC = [0, 1, 2, 1, 2, 3, 2, 3, 4], [5, 6, 6, 7, 7, 8], slice(9, 12)
"""Indices in the table of moments of (x^2, x y, y^2) with themselves, with (x, y) and with 1."""


_CIRCLE = np.eye(3)


def _moments(batch: _Batch) -> Array:
    """Sum x^4, x^3 y, x^2 y^2, x y^3, y^4, x^3, x^2 y, x y^2, y^3, x^2, x y, y^2 over each contour; shape (B, 12)."""
    x, y = batch.points
    table = np.empty((12, len(x)))
    xx, yy = table[9], table[11]
    np.multiply(x, batch.points, out=table[9:11])
    np.multiply(y, y, out=yy)
    np.multiply(xx, table[_QUADRATIC], out=table[0:3])
    np.multiply(yy, table[10:12], out=table[3:5])
    np.multiply(xx, batch.points, out=table[5:7])
    np.multiply(yy, batch.points, out=table[7:9])
    return np.ascontiguousarray(batch.sums(table).T)


def _fit_normalised(batch: _Batch, failures: _Failures) -> Array:
    """Fit conics to normalised points by the reduced 3 x 3 eigenproblem [HF98], shape (B, 3, 3).

    The sums of x and of y are 0, so the linear and the constant part do not mix.
    """
    # scatter matrices of the design's three parts [HF98]
    moments = _moments(batch)
    S1, S2 = moments[:, _QUARTIC].reshape(-1, 3, 3), moments[:, _CUBIC].reshape(-1, 3, 2)
    S3 = moments[:, _QUADRATIC]
    xx, xy, yy = S3.T
    spread = xx * yy - xy * xy
    on_line = ~(spread > _LINE * (xx + yy) ** 2)
    failures.add(on_line, Reason.DEGENERATE_CONIC, "the points lie on a line")
    # eliminate d, e, f: for given a, b, c the residual is least at (d, e) = -linear (a, b, c), f = -constant (a, b, c)
    inverse = np.array([yy, -xy, -xy, xx]) / np.where(on_line, 1.0, spread)
    linear = np.ascontiguousarray(inverse.T).reshape(-1, 2, 2) @ S2.transpose(0, 2, 1)
    constant = S3 / batch.counts[:, None]
    M = S1 - S2 @ linear - S3[:, :, None] * constant[:, None, :]
    M = (M + M.transpose(0, 2, 1)) / 2
    # One eigenvalue of M is 0 on an exact ellipse; where two are 0, as for four points, many conics fit.
    trace, rounding = np.einsum("nii->n", M), _RANK * np.einsum("nii->n", S1)
    minors = (trace * trace - (M * M).sum(axis=(1, 2))) / 2
    many = ~((trace > rounding) & (minors > rounding * trace))
    failures.add(many, Reason.DEGENERATE_CONIC, "the points do not determine an ellipse")
    # solve; a circle's problem stands in for those without a solution
    M[many | on_line] = _CIRCLE
    quadratic = constrained_minimum(M)
    a, b, c = quadratic.T
    d, e = -(linear @ quadratic[:, :, None])[:, :, 0].T
    f = -(constant * quadratic).sum(axis=1)
    # In rows: the order in which the norm is summed depends on the layout.
    conics = np.ascontiguousarray(np.array([a, b / 2, d / 2, b / 2, c, e / 2, d / 2, e / 2, f]).T)
    conics *= (np.where(a + c < 0, -1.0, 1.0) / np.sqrt((conics * conics).sum(axis=1)))[:, None]
    return np.asarray(conics.reshape(-1, 3, 3))


def _check(conics: Array, failures: _Failures) -> None:
    """Note a failure for conics that are no real ellipse, or so long that they are lines."""
    a, b, c = conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]
    high = (a + c + np.hypot(a - c, 2 * b)) / 2
    # The smaller eigenvalue as product over the larger one: the difference would cancel.
    low = (a * c - b * b) / high
    not_real = ~((low > 0) & (np.linalg.det(conics) < 0))
    failures.add(not_real, Reason.NOT_AN_ELLIPSE, "the fitted conic is no real ellipse")
    too_long = ~(high <= MAX_AXIS_RATIO**2 * low)
    failures.add(too_long, Reason.DEGENERATE_CONIC, f"axes differ by more than a factor {MAX_AXIS_RATIO:g}")
