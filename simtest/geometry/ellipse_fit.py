"""Ellipses fitted to many contours at once, and to contours that are seen in part.

The direct least-squares fit [FF99] in its stable form [HF98], centred and scaled, weights points by the conic's
gradient. Where a part of the contour is missing, that shortens the ellipse on the missing side (theory.md section 6).
The fit of an arc takes each residual as the distance from the conic to first order [Sampson 1982].
"""

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, InputError, Reason
from simtest.runtime.arrays import AnyArray, Array, Index, Mask

_NEWTON_STEPS = 2

# Entries of a flattened matrix whose products make the minors of its first row and of its middle: DF - E^2, CE - BF,
# BE - CD and AF - C^2. For few matrices a call costs more than its products, so all are multiplied at once.
_FACTORS = np.array([[4, 2, 1, 0, 5, 1, 2, 2], [8, 5, 5, 8, 5, 8, 4, 2]])

# The same for the cross products of rows 1 and 2, 2 and 0, 0 and 1: u1 v2 - u2 v1, u2 v0 - u0 v2, u0 v1 - u1 v0.
_CROSSES = np.array(
    [
        [4, 5, 3, 7, 8, 6, 1, 2, 0, 5, 3, 4, 8, 6, 7, 2, 0, 1],
        [8, 6, 7, 2, 0, 1, 5, 3, 4, 7, 8, 6, 1, 2, 0, 4, 5, 3],
    ]
)

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

_AT_ONCE = 2**14
"""Points that are fitted at once: the tables of more leave the processor's cache, which doubles the time."""

_QUARTIC, _CUBIC, _QUADRATIC = [0, 1, 2, 1, 2, 3, 2, 3, 4], [5, 6, 6, 7, 7, 8], slice(9, 12)
"""Indices in the table of moments of (x^2, x y, y^2) with themselves, with (x, y) and with 1."""

_CIRCLE = np.eye(3)

MIN_ARC_RAD = np.radians(120.0)
"""Shorter arcs do not determine the ellipse: at this length the centre is already a hundred times as noisy as that of
a whole ellipse."""

_ARC_EVALUATIONS = 30

_ARC_TOLERANCE = 1e-10


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

    @cached_property
    def centre_and_matrix(self) -> tuple[Array, Array]:
        """Centre, px, and Q of the ellipse as (x - centre)^T Q (x - centre) = 1."""
        C, T = self.normalised, self.normalised_from_image
        centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
        level = -(C[2, 2] + C[:2, 2] @ centre)
        Q = T[:2, :2].T @ C[:2, :2] @ T[:2, :2] / level
        return np.asarray(np.linalg.solve(T[:2, :2], centre - T[:2, 2])), np.asarray(Q)

    def relative_radii(self, points: Array) -> Array:
        """Return the distance of points, shape (N, 2), px, from the centre over the ellipse's radius that way."""
        centre, Q = self.centre_and_matrix
        gap = points - centre
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", gap, Q, gap)))


@dataclass(frozen=True)
class FittedConics:
    """Ellipses of several contours (see `FittedConic`)."""

    normalised: Array  # (N, 3, 3): as of `FittedConic`; those of a failed fit mean nothing
    normalised_from_image: Array  # (N, 3, 3): as of `FittedConic`; those of a failed fit mean nothing
    failures: Mapping[int, Failure] = field(default_factory=dict)  # failure by the contour's index

    def __len__(self) -> int:
        return len(self.normalised)

    def __getitem__(self, index: int) -> FittedConic | Failure:
        # A negative index must find its failure too.
        index = range(len(self))[operator.index(index)]
        if (failure := self.failures.get(index)) is not None:
            return failure
        return FittedConic(self.normalised[index], self.normalised_from_image[index])


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


@dataclass(frozen=True)
class FittedArc:
    """An ellipse fitted to a part of its contour.

    Parameters
    ----------
    conic : FittedConic
        As of `simtest.geometry.fit_ellipse`.
    arc : float
        Range of eccentric anomalies that the points cover: 2 pi less their largest gap, rad.
    residual : float
        RMS distance of the points from the ellipse over the ellipse's mean radius, sqrt(a b).
    """

    conic: FittedConic
    arc: float
    residual: float


def fit_arc(points: npt.ArrayLike) -> FittedArc | Failure:
    """Fit an ellipse to an arc, array_like of shape (N, 2): the least sum of `(F / |grad F|)^2`, F the conic's value.

    The ellipse is `|L^T (x - c)| = 1` with L lower triangular, so every step stays an ellipse. The direct fit is the
    starting point. A Failure where `fit_ellipse` fails, where the fit does not converge to an ellipse, and, with the
    reason ``too_few_points``, for arcs shorter than 120 deg.

    Raises
    ------
    InputError
        If the points are no numbers of shape (N, 2).
    """
    # start: the direct fit, in its centred and scaled coordinates
    start = fit_ellipse(points)
    if isinstance(start, Failure):
        return start
    T = start.normalised_from_image
    xy = np.asarray(points, dtype=float) @ T[:2, :2].T + T[:2, 2]
    C = start.normalised
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    L = np.linalg.cholesky(C[:2, :2] / -(C[2, 2] + C[:2, 2] @ centre))
    first = np.array([*centre, L[0, 0], L[1, 0], L[1, 1]])
    with np.errstate(all="ignore"):
        found = _refined(xy, first)
    if found is None:
        return Failure(Reason.NOT_CONVERGED, "the arc's fit did not converge")
    return _checked_arc(xy, found[0], T, float(np.sqrt(np.mean(found[1] ** 2))))


def _refined(xy: Array, p: Array) -> tuple[Array, Array] | None:
    """Return parameters and residuals of the least sum, or None: by lmder's steps [More 1978], without its import."""
    (f, J), scale, delta, moved = _residuals(xy, p), np.zeros(5), np.inf, False
    for _ in range(_ARC_EVALUATIONS - 1):
        columns, size = np.linalg.norm(J, axis=0), float(np.linalg.norm(f))
        if size == 0 or np.max(np.abs(J.T @ f) / columns) <= _ARC_TOLERANCE * size:
            return p, f
        scale = np.maximum(scale, columns)
        if not np.isfinite(scaled := J / scale).all():
            break
        U, s, V = np.linalg.svd(scaled, full_matrices=False)
        b, damping = -s * (U.T @ f), 0.0
        # least damping at which the step is no more than a tenth longer than the trusted one
        while (length := float(np.linalg.norm(step := b / (s * s + damping)))) > 1.1 * delta:
            damping += (length / delta - 1) * length**2 / np.sum(step**2 / (s * s + damping))
        delta, step = delta if moved else length, V.T @ step / scale
        tried, slopes = _residuals(xy, p + step)
        ratio, damped = float(np.linalg.norm(tried)) / size, damping * (length / size) ** 2
        linear = (float(np.linalg.norm(J @ step)) / size) ** 2
        fall, expected = 1 - ratio**2 if ratio < 10 else -1.0, linear + 2 * damped
        gain = fall / expected if expected else 0.0
        if not gain > 0.25:
            share = 0.5 if fall >= 0 else 0.5 * (linear + damped) / (linear + damped - 0.5 * fall)
            delta = (share if ratio < 10 and share >= 0.1 else 0.1) * min(delta, 10 * length)
        elif damping == 0 or gain >= 0.75:
            delta = 2 * length
        if gain >= 1e-4:
            p, f, J, moved = p + step, tried, slopes, True
        has_settled = max(abs(fall), expected) <= _ARC_TOLERANCE and gain <= 2
        if has_settled or delta <= _ARC_TOLERANCE * np.linalg.norm(scale * p):
            return p, f
    return None


def angular_extent(vectors: Array) -> float:
    """Return the angle that vectors, shape (N, 2), cover around the origin: 2 pi less their largest gap, rad."""
    phases = np.sort(np.arctan2(vectors[:, 1], vectors[:, 0]))
    return 2 * np.pi - float(np.max(np.diff(phases, append=phases[0] + 2 * np.pi)))


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in the plane."""

    centre: Array  # (2,): px
    semi_major: float  # px
    semi_minor: float  # px
    angle: float  # direction of the major axis, rad from x to y, in (-pi/2, pi/2]


def ellipse_of_conic(conic: npt.ArrayLike) -> Ellipse:
    """Compute centre and axes of a symmetric conic, shape (3, 3), that is a real ellipse."""
    C = np.asarray(conic, dtype=float)
    C = C if np.trace(C[:2, :2]) > 0 else -C
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    level = -(C[2, 2] + C[:2, 2] @ centre)
    values, vectors = np.linalg.eigh(C[:2, :2])
    major = vectors[:, 0]
    angle = float(np.arctan2(major[1], major[0]))
    angle = angle - np.pi if angle > np.pi / 2 else angle + np.pi if angle <= -np.pi / 2 else angle
    return Ellipse(centre, float(np.sqrt(level / values[0])), float(np.sqrt(level / values[1])), angle)


def _constrained_minimum(M: Array) -> Array:
    """Minimise q^T M q subject to q^T C q = 4 a c - b^2 = 1 for q = (a, b, c).

    M, shape (B, 3, 3), is symmetric, positive semidefinite and of rank 2 at least. The result, shape (B, 3), is unit.
    It solves (M - l C) q = 0 for the one l >= 0: since C has one positive eigenvalue, all three l are real and the
    other two are negative.
    """
    # coefficients of det(M - l C) = c0 + c1 l + c2 l^2 - 4 l^3
    entries = M.reshape(-1, 9)
    products = entries.T[_FACTORS[0]] * entries.T[_FACTORS[1]]
    minors = products[:4] - products[4:]
    c0 = (entries.T[:3] * minors[:3]).sum(axis=0)
    c1, c2 = minors[3] - 4 * minors[2], 4 * (entries[:, 2] - entries[:, 4])
    # largest root by Vieta's formula, its last digits by Newton's steps
    shift = c2 / 12
    square, quarter = shift * shift, c1 / 4
    radius = np.sqrt(np.maximum(quarter / 3 + square, 0))
    cosine = (c0 / 4 + shift * (quarter + 2 * square)) / (2 * radius * radius * radius)
    root = 2 * radius * np.cos(np.arccos(np.maximum(np.minimum(cosine, 1), -1)) / 3) + shift
    for _ in range(_NEWTON_STEPS):
        slope = c1 + root * (2 * c2 - 12 * root)
        root = root - (c0 + root * (c1 + root * (c2 - 4 * root))) / slope
    q = _null_vector(M, root)
    # The Rayleigh quotient q^T M q / q^T C q squares the vector's error: one more step gives full precision.
    root = np.einsum("ni,nij,nj->n", q, M, q) / (4 * q[:, 0] * q[:, 2] - q[:, 1] ** 2)
    return _null_vector(M, root)


def _null_vector(M: Array, root: Array) -> Array:
    """Return the null vectors of M - l C, unit, shape (B, 3): the longest cross product of two rows."""
    N = M.copy()
    N[:, 0, 2] -= 2 * root
    N[:, 2, 0] -= 2 * root
    N[:, 1, 1] += root
    entries = N.reshape(-1, 9)
    products = entries.take(_CROSSES[0], axis=1) * entries.take(_CROSSES[1], axis=1)
    crosses = (products[:, :9] - products[:, 9:]).reshape(-1, 3, 3)
    squares = (crosses * crosses).sum(axis=2)
    best, each = squares.argmax(axis=1), np.arange(len(M))
    return np.asarray(crosses[each, best] / np.sqrt(squares[each, best])[:, None])


_Noted = list[tuple[Mask, Reason, str]]
"""Which contours fail, and why; of several reasons of one the first counts."""


def _first_failures(noted: _Noted) -> dict[int, Failure]:
    found: dict[int, Failure] = {}
    # Usually there are none, which one test of all finds.
    if np.array([which for which, _, _ in noted]).any():
        for which, reason, detail in noted:
            for index in np.flatnonzero(which).tolist():
                found.setdefault(index, Failure(reason, detail))
    return found


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
    """

    points: Array  # (2, N)
    counts: Index  # (B,): points of each contour

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
    batch = _Batch.of(contours)
    failures: _Noted = []
    extent = np.maximum.reduceat(np.abs(batch.points), batch.first, axis=1).max(axis=0)
    failures.append((~np.isfinite(extent), Reason.NOT_FINITE, "contour points hold NaN or infinity"))
    failures.append((extent > MAX_COORDINATE, Reason.NOT_FINITE, f"contour points beyond {MAX_COORDINATE:g}"))
    if found := _first_failures(failures):
        batch.points[:, batch.spread(np.isin(np.arange(len(contours)), list(found)))] = 0.0
    transforms = _normalise(batch, failures)
    conics = _fit_normalised(batch, failures)
    _check(conics, failures)
    return FittedConics(conics, transforms, _first_failures(failures))


def _normalise(batch: _Batch, failures: _Noted) -> Array:
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
    failures.append((together, Reason.DEGENERATE_CONIC, "all points coincide"))
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


def _moments(batch: _Batch) -> Array:
    """Sum x^4, x^3 y, x^2 y^2, x y^3, y^4, x^3, x^2 y, x y^2, y^3, x^2, x y, y^2 over each contour; shape (B, 12)."""
    x, y = batch.points
    squares = np.array([x * x, x * y, y * y])
    xx, _, yy = squares
    table = np.concatenate([xx * squares, yy * squares[1:], xx * batch.points, yy * batch.points, squares])
    return np.ascontiguousarray(batch.sums(table).T)


def _fit_normalised(batch: _Batch, failures: _Noted) -> Array:
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
    failures.append((on_line, Reason.DEGENERATE_CONIC, "the points lie on a line"))
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
    failures.append((many, Reason.DEGENERATE_CONIC, "the points do not determine an ellipse"))
    # solve; a circle's problem stands in for those without a solution
    M[many | on_line] = _CIRCLE
    quadratic = _constrained_minimum(M)
    a, b, c = quadratic.T
    d, e = -(linear @ quadratic[:, :, None])[:, :, 0].T
    f = -(constant * quadratic).sum(axis=1)
    # In rows: the order in which the norm is summed depends on the layout.
    conics = np.ascontiguousarray(np.array([a, b / 2, d / 2, b / 2, c, e / 2, d / 2, e / 2, f]).T)
    conics *= (np.where(a + c < 0, -1.0, 1.0) / np.sqrt((conics * conics).sum(axis=1)))[:, None]
    return np.asarray(conics.reshape(-1, 3, 3))


def _check(conics: Array, failures: _Noted) -> None:
    """Note a failure for conics that are no real ellipse, or so long that they are lines."""
    a, b, c = conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]
    high = (a + c + np.hypot(a - c, 2 * b)) / 2
    # The smaller eigenvalue as product over the larger one: the difference would cancel.
    low = (a * c - b * b) / high
    not_real = ~((low > 0) & (np.linalg.det(conics) < 0))
    failures.append((not_real, Reason.NOT_AN_ELLIPSE, "the fitted conic is no real ellipse"))
    too_long = ~(high <= MAX_AXIS_RATIO**2 * low)
    failures.append((too_long, Reason.DEGENERATE_CONIC, f"axes differ by more than a factor {MAX_AXIS_RATIO:g}"))


def _residuals(xy: Array, parameters: Array) -> tuple[Array, Array]:
    """Return F / |grad F| of each point, shape (N,), and its derivatives, shape (N, 5)."""
    L = np.array([[parameters[2], 0.0], [parameters[3], parameters[4]]])
    y = xy - parameters[:2]
    u = y @ L
    F = np.sum(u * u, axis=1) - 1
    g = 2 * u @ L.T
    size = np.sqrt(np.sum(g * g, axis=1))
    by_F, by_g = 1 / size, -(F / size**3)[:, None] * g
    J = np.empty((len(xy), 5))
    J[:, :2] = -by_F[:, None] * g - 2 * by_g @ (L @ L.T)
    turned = by_g @ L
    for column, (i, j) in enumerate(((0, 0), (1, 0), (1, 1)), start=2):
        # F moves by 2 u_j y_i with L_ij, grad F by 2 (e_i u_j + L e_j y_i).
        J[:, column] = 2 * (by_F * u[:, j] * y[:, i] + by_g[:, i] * u[:, j] + turned[:, j] * y[:, i])
    return F / size, J


def _checked_arc(xy: Array, parameters: Array, T: Array, rms: float) -> FittedArc | Failure:
    """Return the fitted arc, or a Failure where the conic is no ellipse or the arc too short."""
    centre = parameters[:2]
    L = np.array([[parameters[2], 0.0], [parameters[3], parameters[4]]])
    Q = L @ L.T
    # reject what is no ellipse, or one so long that it is a line
    low, high = np.linalg.eigvalsh(Q) if np.isfinite(Q).all() else (np.nan, np.nan)
    if not (np.isfinite(centre).all() and low > 0 and high <= MAX_AXIS_RATIO**2 * low):
        return Failure(Reason.NOT_AN_ELLIPSE, "the arc's conic is no ellipse")
    u = (xy - centre) @ L
    arc = angular_extent(u)
    if arc < MIN_ARC_RAD:
        least = np.degrees(MIN_ARC_RAD)
        return Failure(Reason.TOO_FEW_POINTS, f"an arc of {np.degrees(arc):.0f} deg; at least {least:.0f} are needed")
    # (x - c)^T Q (x - c) = 1 as a homogeneous conic
    linear = -Q @ centre
    C = np.array([[*Q[0], linear[0]], [*Q[1], linear[1]], [*linear, centre @ Q @ centre - 1]])
    return FittedArc(FittedConic(C / np.linalg.norm(C), T), arc, rms * float(low * high) ** 0.25)
