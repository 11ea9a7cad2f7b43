"""An estimate's uncertainty as a budget: named parts, each a covariance of the normal, and their sum.

A part is the covariance of the normal distribution whose 95 % region holds 95 % of the errors of that kind. For errors
that are normal this is their covariance; for a prior with heavy tails, such as that of a light somewhere beside the
camera, it is a little more (`equivalent_covariance`).

Here stand the parts that a highlight's isophotes show by themselves: the noise of its pixels, carried to quantities
that depend on the isophotes' crossings, ripples, bends and a clipped peak.

Ripples: how isophotes depart from their ellipses, and what that says of an error of their centre. Whatever disturbs a
highlight's pixels, noise that demosaicing, coding or sharpening has correlated, a neighbour, a texture or a relief
below it, moves its isophotes in all harmonics of the direction phi from the centre alike, as far as smoothing leaves
them. Harmonics 0 to 2 are size, centre and ellipse, which a fit takes for the highlight's own. The next ones remain:
they are seen, and say how far the centre may be off, whatever the disturbance is.

Radii are relative to the ellipse's, so that a ripple of variance v in one direction stands for a covariance v E of the
centre, E the ellipse's second moments (its boundary is w^T E^-1 w = 1).

Bends: what isophotes that are no ellipses say of their centre. A highlight whose isophotes are bent holds more than one
point that shines: a second glint that it melts with, or a near miss beside its own (theory.md 7.1b). Both pull the
centre by a share of the highlight's size, and ripples do not show it: the bend lies in harmonics 2 and 3, which the
highlight's own shape has as well. Isophotes of a single highlight are ellipses to a percent or better; a melted one may
look no less like an ellipse than to 2 or 3 %.
"""

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry import Array, Index, Mask, Patch
from simtest.runtime import chi_squared
from simtest.runtime.arrays import AnyArray, Image
from simtest.runtime.fitted import fitted_number
from simtest.runtime.statistics import CONFIDENCE

PARTS = ("noise", "resolution", "shape", "light_offset", "camera", "distance", "response", "relief")
"""Names of the parts.

noise: the sensor's. resolution: pixel, smoothing, point spread, demosaicing and coding, as seen in the residuals.
shape: the drift over isovalues, where curvature changes inside the highlight. light_offset: a light beside the camera,
where it is not told. camera: focal length, centre and distortion, where they are guesses. distance: of the surface from
the camera. response: sharpening, encoding and falloff that nobody told. relief: its slope, where the base's normal is
stated from a single highlight.
"""

STATED = "stated"
"""Name of the one part of an estimate that states a covariance without a budget, as other packages' may."""

MISPLACED = ("noise", "resolution", "shape", "response", STATED)
"""Parts that stand for a highlight's brightest point lying elsewhere than where the normal looks."""

LARGEST_VARIANCE = math.pi**2  # rad^2; no direction is less certain, and what states more has other units
Budget = Mapping[str, Array]  # covariance of each part, shape (2, 2), rad^2, in the basis ``tangent_basis(normal)``


def total(budget: Budget) -> Array:
    """Return the sum of the parts, shape (2, 2), rad^2."""
    if not budget:
        return np.zeros((2, 2))
    # One by one, which for a few parts takes a third of the time of a sum over an axis.
    first, *others = budget.values()
    whole = np.array(first)
    for part in others:
        whole = whole + part
    return whole


def bounded(part: Array) -> Array:
    """Return a part of a budget, scaled down where it says more than that nothing is known of the direction."""
    size = float(np.abs(part).max())
    return part if not size > LARGEST_VARIANCE else part * (LARGEST_VARIANCE / size)


def dominant(budget: Budget) -> str:
    """Return the name of the largest part, by its trace."""
    return max(budget, key=lambda name: float(np.trace(budget[name])))


def deviations(budget: Budget) -> dict[str, float]:
    """Return the standard deviation of each part, rad: the square root of its trace."""
    return {name: float(np.sqrt(max(np.trace(part), 0.0))) for name, part in budget.items()}


def equivalent_covariance(moves: Array) -> Array:
    """Return the covariance whose 95 % region about 0 holds 95 % of moves of the normal, shape (N, 2), rad.

    It has the shape of their mean square.
    """
    square = moves.T @ moves / len(moves)
    # Moves along one line have a singular mean square.
    floor = 1e-9 * float(np.trace(square))
    if floor <= 0:
        return np.zeros((2, 2))
    distances = np.einsum("ni,ni->n", moves, np.linalg.solve(square + floor * np.eye(2), moves.T).T)
    return np.asarray(square * (quantile(distances, CONFIDENCE) / chi_squared.quantile(CONFIDENCE, 2)))


def quantile(values: Array, share: float) -> float:
    """Return the value below which a share of numbers, shape (n,), lies, as `np.quantile`, which loads `numpy.ma`."""
    if np.isnan(values.max()):
        return math.nan
    place = share * (len(values) - 1)
    below = int(place)
    low, high = np.partition(values, (below, min(below + 1, len(values) - 1)))[[below, min(below + 1, len(values) - 1)]]
    left = place - below
    return float(high - (high - low) * (1 - left) if left >= 0.5 else low + (high - low) * left)


def equivalent_variance(moves: Array) -> float:
    """Return the variance of errors along one line, shape (N,), rad, so that the region of a budget holds 95 % of them.

    Across the line the budget's other parts are met by normal errors, which take their share of the region's 95 %: with
    x the error and v the variance, x^2 / v plus a chi-squared variable of one degree of freedom stays below the
    quantile. For normal errors v is their variance.
    """
    squares = np.square(moves)
    if not squares.max() > 0:
        return 0.0
    limit = chi_squared.quantile(CONFIDENCE, 2)
    low, high = 0.0, float(squares.max())
    # Bisection: more variance holds more.
    for _ in range(60):
        v = (low + high) / 2
        left = np.sqrt(np.maximum(limit - squares / max(v, 1e-300), 0.0))
        held = float(np.mean(np.interp(left, _ROOTS, _SHARES)))  # by chi-squared of one degree of freedom
        low, high = (v, high) if held < CONFIDENCE else (low, v)
    return high


def line_covariance(moves: Array) -> Array:
    """Return the covariance of moves that lie all but along one line, shape (N, 2), rad (see `equivalent_variance`)."""
    square = moves.T @ moves / len(moves)
    values, vectors = np.linalg.eigh(square)
    along = np.outer(vectors[:, 1], vectors[:, 1])
    return np.asarray(equivalent_variance(moves @ vectors[:, 1]) * along + square - values[1] * along)


_ROOTS = np.linspace(0.0, 4.0, 401)
_SHARES = np.array([math.erf(root / math.sqrt(2)) for root in _ROOTS.tolist()])


Rows = npt.NDArray[np.float32]

KERNEL_SIGMAS = 4.0  # half-width of the smoothing kernel over its standard deviation


def conics_by_crossings(
    tangents: Array, gradient: Array, steps: Array, parts: Sequence[slice], weighted: Sequence[bool]
) -> tuple[Array, Array]:
    """Compute how fitted conics a x^2 + b x y + c y^2 + d x + e y = 1 move with their points.

    To first order a fit to points near an ellipse moves as the linear fit does, where a gradient-weighted fit weights
    each point by the conic's gradient.

    `tangents`, `gradient`, `steps`, (2, N): the points of all conics, the conic's gradient there, and the motion of
    each point per unit along its line; `parts`: the points of each conic; `weighted`: whether each fit is
    gradient-weighted. Returns `by_moment`, `moments`, (K, 5, 5) and (5, N): conic k moves by by_moment[k] @ moments[:,
    parts[k]] as its points move.
    """
    (x, y), (by_x, by_y) = tangents, gradient
    design = np.array([x * x, x * y, y * y, x, y])
    moments = design
    if any(weighted):
        counts = [part.stop - part.start for part in parts]
        moments = design / np.where(np.repeat(weighted, counts), by_x**2 + by_y**2, 1.0)
    normal = np.array([moments[:, part] @ design[:, part].T for part in parts])
    # Powers of small tangents differ by orders of magnitude, so the equations are scaled to a diagonal of 1.
    scale = 1 / np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    scales = scale[:, :, None] * scale[:, None, :]
    by_moment = -scales * np.linalg.inv(normal * scales)
    return by_moment, moments * (by_x * steps[0] + by_y * steps[1])


def raw_moves(pixels: Index, moves: Array, width: int, noise: float | Image, smoothing_px: float) -> Rows:
    """Return how far one standard deviation of noise in each raw pixel moves K quantities, shape (K, P).

    The transpose of smoothing carries derivatives by smoothed pixels to raw pixels, whose noise is independent. The
    product of the result with its transpose is therefore the quantities' covariance.

    `pixels`, (N,): indices in the flattened patch, whose rows are `width` long; each may occur several times; `moves`,
    (K, N): change of each quantity per unit of intensity there; `noise`, (h, w): standard deviation before smoothing by
    a Gaussian of `smoothing_px`.
    """
    # box around the pixels, with a margin of the kernel's half-width
    rows = pixels // width
    columns = pixels - rows * width
    top, bottom, left, right = int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1
    margin = int(np.ceil(KERNEL_SIGMAS * smoothing_px))
    wide, high = right - left + 2 * margin, bottom - top + 2 * margin
    flat = (rows - (top - margin)) * wide + (columns - (left - margin))
    # Scaled by the noise first, so that the numbers have the size of angles, whatever the unit of the intensities.
    scale = float(noise.max()) if isinstance(noise, np.ndarray) else noise
    # Single precision, which takes half the time, suffices for standard deviations.
    raw = np.empty((len(moves), high * wide), np.float32)
    for image, each in zip(raw, moves, strict=True):
        image[:] = np.bincount(flat, scale * each, high * wide)
    # The margins separate the images, so one call smooths all.
    smoothed = _smooth_transposed(raw.reshape(-1, wide), smoothing_px, margin).reshape(len(moves), high, wide)
    if isinstance(noise, np.ndarray) and scale > 0:
        smoothed *= np.pad(noise[top:bottom, left:right] / np.float32(scale), margin, mode="edge")
    return smoothed.reshape(len(moves), -1)


def gram(rows: Rows) -> Array:
    """Return the products of few long rows, shape (K, P), with each other, shape (K, K)."""
    # A copy, because BLAS's routine for a matrix times its own transpose is several times slower on so few rows.
    with np.errstate(over="ignore", invalid="ignore"):
        products = np.dot(rows, rows.copy().T).astype(float)
    if not np.isfinite(products).all():
        # Noise far above the signal leaves the range of single precision.
        products = rows.astype(float) @ rows.astype(float).T
    return np.asarray((products + products.T) / 2)


def _smooth_transposed(images: Rows, sigma_px: float, margin: int) -> Rows:
    """Smooth images, one below the other, that are 0 in a margin of the kernel's half-width."""
    if sigma_px <= 0:
        return images
    side = 2 * margin + 1
    return np.asarray(cv2.GaussianBlur(images, (side, side), sigma_px, borderType=cv2.BORDER_CONSTANT), np.float32)


HARMONICS = np.array([4, 5, 6])
"""Harmonic 3 is left out: it comes with the drift of the centre, of which more is known, where curvature changes."""

BY_CHANCE = 2.0
"""Ripples of less than so many times the power that the sensor's noise makes say nothing: 6 % of highlights with noise
alone exceed it."""

BY_PIXELS = 3e-4
"""Power that linear interpolation between pixels leaves in a harmonic, times the fourth power of the radius in px."""

LARGEST_GAP = 3.0  # a point of a cut isophote stands for so many mean distances between points at most

_ANGLES = (np.arange(256) + 0.5) * np.pi / 256
_COSINES = np.cos(np.outer(np.append(1, HARMONICS), _ANGLES))


def ripples(tangents: Array, conics: Array, counts: Index) -> AnyArray:
    """Return the harmonics of isophotes' radii about their ellipses, relative to these, shape (K, 3), complex.

    `tangents`, (2, N): points of all isophotes, one after the other; `conics`, (K, 5): (a, b, c, d, e) of each
    isophote's a x^2 + b x y + c y^2 + d x + e y = 1; `counts`, (K,): points of each. Returns (K, 3): c - i s of the
    terms c cos(m phi) + s sin(m phi), m = 4, 5, 6.
    """
    a, b, c, d, e = conics.T
    h, determinant = b / 2, a * c - b * b / 4
    centre = np.array([h * e / 2 - c * d / 2, h * d / 2 - a * e / 2]) / determinant
    # In coordinates in which the ellipse is the unit circle: w = L^T (x - centre), A = L L^T.
    size = 1 - (d * centre[0] + e * centre[1]) / 2
    first = np.sqrt(a / size)
    across, last = h / size / first, np.sqrt(determinant / a / size)
    number = np.repeat(np.arange(len(counts)), counts)
    x, y = tangents - centre[:, number]
    u, v = first[number] * x + across[number] * y, last[number] * y
    phase, radius = np.arctan2(v, u), np.hypot(u, v)
    # Each point stands for half the gaps to its neighbours.
    order = np.argsort(phase + 8.0 * number)
    phase = phase[order]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    ends = starts + counts - 1
    gaps = np.empty_like(phase)
    gaps[:-1] = phase[1:] - phase[:-1]
    gaps[ends] = 2 * np.pi + phase[starts] - phase[ends]
    gaps = np.minimum(gaps, (LARGEST_GAP * 2 * np.pi / counts)[number])
    before = np.roll(gaps, 1)
    before[starts] = gaps[ends]
    weighted = (gaps + before) / (2 * np.pi) * (radius[order] - 1)
    # exp(-i m phi) by products, which take a tenth of the time
    turn = ((u - 1j * v) / radius)[order]
    square = turn * turn
    fourth = square * square
    return np.asarray(np.add.reduceat(weighted * np.array([fourth, fourth * turn, fourth * square]), starts, axis=1).T)


def excess(
    each: AnyArray, weights: Array, levels: Array, by_noise: float, size_px2: float, smoothing_px: float
) -> float:
    """Return the variance of a combined centre that ripples beyond noise stand for, relative to the mean ellipse.

    `each`, (K, 3): of `ripples`; `weights`, (K,): of the isophotes' centres in the combined one; `levels`, (K,): -ln t
    of each; `by_noise`: variance of the combined centre by the sensor's noise, relative to the mean ellipse;
    `size_px2`: squared mean radius of the mean ellipse, px^2; `smoothing_px`: standard deviation of the smoothing, px.
    """
    # A contour's radius is relative to its own ellipse, whose size goes with the root of the level.
    share = np.sqrt(np.maximum(levels / levels.mean(), 0.0))
    power = np.abs((weights * share) @ each) ** 2 / 2
    radius2 = size_px2 / smoothing_px**2 if smoothing_px > 0 else np.inf
    known = BY_CHANCE * by_noise * spectrum(radius2) + BY_PIXELS / size_px2**2
    return max(float(np.mean(power - known)), 0.0)


def spectrum(radius2: float) -> Array:
    """Return the power of white noise in the harmonics over that in the first one, shape (3,).

    `radius2` is the squared radius over the squared width of the smoothing; inf where nothing was smoothed.

    Smoothed by a Gaussian of width s, noise on a circle of radius r has the correlation exp(-z (1 - cos phi)) with
    z = r^2 / 2 s^2. Its Fourier series are modified Bessel functions, I_m(z) / I_1(z).
    """
    if not np.isfinite(radius2) or radius2 > 2e4:
        return np.ones(len(HARMONICS))
    z = max(radius2 / 2, 1e-6)
    terms = _COSINES @ np.exp(z * (np.cos(_ANGLES) - 1))
    return np.asarray(np.maximum(terms[1:] / terms[0], 0.0))


MELTED, MELTED_RESIDUAL = fitted_number("bends.melted"), fitted_number("bends.melted_residual")
STEEPNESS = fitted_number("bends.steepness")


def bend_variance(residuals: Array, by_noise: Array, moments: Array, slope: float) -> float:
    """Return the variance of a highlight's centre along each axis, by the bend of its isophotes, rad^2.

    `residuals`, (K,): RMS distance of each isophote from its ellipse, over its radius. The least counts: outer
    isophotes may bend towards neighbours that do not reach the peak; `by_noise`, (K,): what of it may be noise;
    `moments`, (2, 2): second moments of the highlight, rad^2; `slope`: of the axis
    (`simtest.estimators.family.AxisErrors`).
    """
    bend = float(np.sqrt(np.maximum(residuals**2 - by_noise**2, 0.0)).min())
    share = max(
        slope * bend if bend > MELTED_RESIDUAL else 0.0, MELTED * min(1.0, (bend / MELTED_RESIDUAL) ** STEEPNESS)
    )
    return share**2 * float(np.sqrt(max(np.linalg.det(moments), 0.0)))


NEARLY_CLIPPED = 0.93
"""Pixels above this share of the clipped ones' intensity count as clipped: coding blurs the plateau."""

AROUND_PX = 17
"""Side of the square around a pixel whose clipped ones are meant: where a falloff was divided away, those elsewhere are
brighter or darker."""

PLATEAU_SHARE, BENT_SHARE = fitted_number("plateau.share"), fitted_number("plateau.bent_share")
BENT_RESIDUAL, MOST_BENT = fitted_number("plateau.bent_residual"), fitted_number("plateau.most_bent")


def clipped_pixels(patch: Patch, box: tuple[slice, slice] = np.s_[:, :]) -> Mask | None:
    """Return the clipped pixels in a box of a patch, and those as bright as they are; None where there is none."""
    if patch.saturated is None or not patch.saturated.any():
        return None
    (top, bottom, _), (left, right, _) = map(slice.indices, box, patch.values.shape)
    y, x = max(top - AROUND_PX, 0), max(left - AROUND_PX, 0)
    around = np.s_[y : bottom + AROUND_PX, x : right + AROUND_PX]
    saturated, raw = patch.saturated[around], (patch.values if patch.raw is None else patch.raw)[around]
    inside = saturated.astype(np.float32)
    share, sums = (cv2.blur(each, (AROUND_PX, AROUND_PX)) for each in (inside, inside * raw.astype(np.float32)))
    nearly = (share > 0.5 / AROUND_PX**2) & (raw * share >= NEARLY_CLIPPED * sums)
    return np.asarray(saturated | nearly)[top - y : bottom - y, left - x : right - x]


def plateau_area_px(patch: Patch, isovalue: float) -> int:
    """Return how many pixels inside an isophote are clipped; where the region cuts it, inside it and the cut."""
    clipped = clipped_pixels(patch)
    return 0 if clipped is None else int(np.count_nonzero(clipped & patch.inside(isovalue, cut=True)))


def hidden_peak_moments(area_px: int, moments: Array, px2: Array, residual: float) -> Array:
    """Return the covariance of the peak's sightline about the isophotes' axis, rad^2, shape (2, 2).

    The peak lies somewhere on the clipped plateau, which has the isophotes' shape.

    `area_px`: pixels of the plateau; `moments`, (2, 2): second moments of the isophotes, rad^2, of any scale; `px2`,
    (2, 2): 1 px^2 in squared tangents; `residual`: RMS distance of the innermost isophote from its ellipse, over its
    radius.
    """
    # a uniform ellipse of area A has moments of determinant (A / 4 pi)^2
    scale = area_px / (4 * math.pi) * math.sqrt(max(float(np.linalg.det(px2)), 0.0))
    size = math.sqrt(max(float(np.linalg.det(moments)), 0.0))
    shape = moments / size if size > 0 else px2 / math.sqrt(float(np.linalg.det(px2)))
    share = PLATEAU_SHARE + BENT_SHARE * min(residual / BENT_RESIDUAL, MOST_BENT) ** 3
    return np.asarray(share * scale * shape)
