"""`photometric`: maximum-likelihood fit of a Phong lobe to the pixels of a highlight (theory.md sections 2 and 3).

Tests of goodness say whether it explains its pixels, and how far the normal depends on which are fitted.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from simtest.calibration import Priors
from simtest.calibration.frame import COLOURED
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget
from simtest.estimators.family import IsophoteFamily
from simtest.estimators.highlight import OfHighlight, along, of_spot
from simtest.estimators.least_squares import LobeFit, Model, fit_lobe
from simtest.estimators.protocol import Estimate, Law
from simtest.estimators.small_spots import HighlightAxis, SmallSpot
from simtest.geometry import Array, Camera, Mask, Patch
from simtest.geometry.vectors import basis_across, tangent_coordinates
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Index
from simtest.runtime.fitted import fitted_number

DARK = 1e-6  # least cosine of the lobe's angle: below it the specular term is 0 and has no logarithm

RINGS, SECTORS = 6, 8
"""The lobe is divided by the model's intensity into rings of equally many pixels, each ring into sectors."""

MIN_IN_BIN = 8
LEVEL = 1e-3  # a fit is a misfit if noise alone would leave as much structure in less than this share of fits
FLOOR = 2e-3  # structure below this share of the peak does not count: rendering and sampling leave as much
INNER = 0.5  # near the peak all smooth lobes agree: pixels above this share of it are fitted for comparison

CORRELATED_PX, SUMMED_DEVIATIONS = 4, 2.0
"""Coding and demosaicing correlate the noise of pixels this far apart along an axis at most. The sum of white noise's
correlations exceeds 1 by so many of its standard deviations once in 40 highlights."""

REGIONS = (0.05, 0.1, 0.2, 0.3, 0.5)
"""The pixels inside the first of these isophotes that closes are fitted. Further out there is little but noise."""

CUT_REGION = 0.3  # for a highlight that the border or the view cuts: seen pixels are fitted down to this isovalue
MAX_PIXELS = 16384  # in a larger region every second, third ... pixel is fitted, evenly spread

MISFIT_SHARE = fitted_number("misfit.share")

MISFIT_FACTOR = 1.5
"""A misfit is told where it makes the stated standard deviation this many times larger: texture and lobes of another
form leave structure in nearly every real highlight, and it seldom matters."""


@dataclass(frozen=True)
class HighlightPixels:
    """The fitted pixels: sightlines, intensities, noise, which are clipped, and rows and columns, shape (2, m)."""

    rays: Array
    observed: Array
    clipped: Mask | None
    noise: float | Array | None
    places: Index

    def correlation(self, fitted: LobeFit[Model]) -> float:
        """Return by how much the noise's correlation between pixels raises the covariance of a fit; 1: not at all.

        A smooth model takes from correlated noise the sum of its correlations over all distances. Both the smoothed
        frame's noise and the residuals must show more than chance; the larger one counts.
        """
        raised = float(np.mean(np.square(0.0 if self.noise is None else self.noise))) / max(fitted.sigma**2, 1e-300)
        if raised < COLOURED**2:
            return 1.0
        rows, columns = self.places - self.places.min(axis=1, keepdims=True)
        kept = np.ones(len(self.observed)) if self.clipped is None else (~self.clipped).astype(float)
        residual = kept * (self.observed - fitted.model.evaluate()[0])
        sums, pairs = (_products(values, rows, columns) for values in (residual, kept))
        summed = float((sums / np.maximum(pairs, 1.0)).sum()) / fitted.sigma**2
        chance = SUMMED_DEVIATIONS * math.sqrt((2 * CORRELATED_PX + 1) ** 2 / len(self.observed))
        return max(raised, summed) if summed > 1 + chance else 1.0

    def covariance(self, fitted: LobeFit[Model]) -> Array:
        """Return the covariance of a fit's parameters, whose pixels differ in noise as told; its size is measured."""
        size = fitted.sigma**2 * float(np.mean(np.square(0.0 if self.noise is None else self.noise)))
        if not isinstance(self.noise, np.ndarray) or not size > 0:
            return fitted.covariance
        intensity, J = fitted.model.evaluate()
        if self.clipped is not None:
            J[self.clipped & (intensity > self.observed)] = 0.0
        by_pixel = fitted.covariance @ J.T * self.noise
        return np.asarray(by_pixel @ by_pixel.T / size)

    def every(self, step: int) -> "HighlightPixels":
        """Return every so many pixels."""
        clipped = None if self.clipped is None else self.clipped[::step]
        noise = self.noise[::step] if isinstance(self.noise, np.ndarray) else self.noise
        return HighlightPixels(self.rays[::step], self.observed[::step], clipped, noise, self.places[:, ::step])


@dataclass(frozen=True)
class Photometric(OfHighlight):
    """A quadric patch with a co-located light, fitted to the pixels from `cone_axis` as start (see `OfHighlight`).

    N = -s with s the sightline of the BP. The shape d S and the lobe's scale are fitted too; its exponent, all but
    degenerate with the shape, is held. Under white noise this is the maximum-likelihood estimate; where coding or
    demosaicing has correlated the noise, the covariance is that of noise so correlated. Clipped pixels count
    as "at least this bright". Pixels are those before smoothing where the patch has them.

    The estimate has one candidate and looks at the fitted BP. It is flagged ``misfit`` where the residuals hold more
    structure than the frame's noise and the stated error is larger by half or more for it: the covariance then includes
    how far the normal moves when only the pixels around the peak are fitted. It also includes the drift of the
    isophotes' axis where that is more than noise. Where the patch does not know its noise no uncertainty is stated.
    """

    laws: ClassVar[tuple[Law, ...]] = ("sightline",)

    def of(self, highlight: HighlightAxis, priors: Priors) -> Estimate | Failure:
        """Estimate the normal at a fitted highlight."""
        if isinstance(highlight, SmallSpot):
            return of_spot(highlight, priors)
        patch, camera = highlight.patch, highlight.camera
        pixels = highlight_pixels(patch, camera, any(isophote.cut for isophote in highlight.isophotes), highlight.least)
        if isinstance(pixels, Failure):
            return pixels
        fitted = fit_lobe(_quadric(highlight, pixels.rays), pixels.observed, pixels.clipped)
        if fitted is None:
            return Failure(Reason.NOT_CONVERGED, "the fit of a quadric did not converge")
        e, f, s = fitted.model.frame
        covariance = in_tangent_basis(pixels.covariance(fitted)[:2, :2], fitted.model.normal, np.stack([e, f]))
        excess, misfit = 0.0, False
        if is_misfit(fitted, pixels):
            misfit, excess = True, excess_of_misfit(fitted, pixels)
        else:
            covariance = covariance * pixels.correlation(fitted)
        budget = {"noise": covariance, **beyond_noise(highlight, excess)}
        gains = np.abs(1 + np.linalg.eigvalsh(fitted.model.shape))  # abs(1 + d k)
        estimate = along(
            highlight, s, None if pixels.noise is None else budget, priors, axis_ratio=float(gains.min() / gains.max())
        )
        # A bend of the isophotes and the residuals of the fit show the same structure.
        added = float(np.trace(budget["shape"] - highlight.drift_error))
        return _with_misfit_told(estimate, added) if misfit else estimate


photometric = Photometric()


def _with_misfit_told(estimate: Estimate, added: float) -> Estimate:
    """Add the flag ``misfit`` where what structure adds to the covariance's trace, rad^2, makes a difference."""
    if estimate.covariance is None:
        return estimate
    without = float(np.trace(estimate.covariance)) - added
    if added < (MISFIT_FACTOR**2 - 1) * without:
        return estimate
    return replace(estimate, flags=(*estimate.flags, "misfit"))


def beyond_noise(family: IsophoteFamily, excess: float = 0.0) -> Budget:
    """Return the parts of a fitted lobe's budget that its noise does not show.

    They are those of a misfit's squared shift, `excess`, rad^2, or of the axis's drift, and of bends and clipping.
    """
    shape = MISFIT_SHARE * max(excess, family.drift_excess) * np.eye(2) + family.bend_error()
    clipping = {"resolution": family.clipping} if family.clipping.any() else {}
    return {"shape": shape + family.drift_error, **clipping}


def highlight_pixels(patch: Patch, camera: Camera, cut: bool = False, least: float = 0.0) -> HighlightPixels | Failure:
    """Gather the pixels of the first region from isovalue `least` on that closes; for a cut highlight, those seen."""
    tried = (t for t in (*REGIONS, least) if t > 0 and t >= least)
    closed = (t for t in tried if patch.area_px(t) is not None)
    t = next(closed, CUT_REGION if cut else None)
    if t is None:
        return Failure(Reason.NO_CLOSED_ISOPHOTE, f"none around the peak up to t = {REGIONS[-1]:g}")
    # candidates, evenly thinned where they are many
    rows, columns = np.nonzero(patch.inside(t, cut))
    step = -(-len(rows) // MAX_PIXELS)
    rows, columns = rows[::step], columns[::step]
    centres = np.stack([columns, rows], axis=1) + 0.5 + np.array(patch.origin_px)
    rays = camera.unproject(centres)
    sound = np.isfinite(rays).all(axis=1)  # the lens may see no direction there
    values = patch.values if patch.raw is None else patch.raw
    clipped = None if patch.saturated is None else patch.saturated[rows, columns][sound]
    stated = patch.noise
    noise = stated[rows, columns][sound].astype(float) if isinstance(stated, np.ndarray) else stated
    places = np.stack([rows, columns])[:, sound]
    return HighlightPixels(rays[sound], values[rows, columns][sound].astype(float), clipped, noise, places)


@dataclass(frozen=True)
class ColocatedQuadric:
    """A quadric patch with light and camera at one position (theory.md section 3).

    In units of the distance d to the BP, with s its sightline, the surface is P = s (1 + z) + (x, y) in the tangent
    plane, z = (x, y) K (x, y)^T / 2, K = d S. The radiance is c max(0, cos 2 theta)^n over the squared distance.
    Parameters: rotation of s in its tangent plane (2), K11, K12, K22, log c. n is held, because beside the three of K
    it is all but undetermined.
    """

    rays: Array  # (m, 3): sightlines of the pixels
    frame: Array  # (3, 3): rows e, f, s: tangent basis and sightline of the BP, camera frame
    K: Array  # (3,): K11, K12, K22 in the basis e, f
    log_scale: float  # log c
    exponent: float  # n

    @property
    def normal(self) -> Array:
        """N = -s, shape (3,)."""
        return -self.frame[2]

    @property
    def shape(self) -> Array:
        """K, shape (2, 2), in the basis e, f."""
        k11, k12, k22 = self.K
        return np.array([[k11, k12], [k12, k22]])

    def moved(self, step: Array) -> Self:
        """Turn s, with the basis carried along the shortest way, and add to K and log c."""
        e, f, s = self.frame
        turned = s + step[0] * e + step[1] * f
        turned /= np.linalg.norm(turned)
        # The basis rotates with s along a great circle.
        carried = [v - (turned @ v) / (1 + s @ turned) * (s + turned) for v in (e, f)]
        frame = np.stack([*carried, turned])
        return replace(self, frame=frame, K=self.K + step[2:5], log_scale=self.log_scale + float(step[5]))

    def evaluate(self) -> tuple[Array, Array]:
        """Return intensities and derivatives."""
        # tangents (a, b) of each ray in the basis, and q = (a, b) K (a, b)^T
        e, f, s = self.frame
        along = self.rays @ s
        a, b = (self.rays @ e) / along, (self.rays @ f) / along
        k11, k12, k22 = self.K
        ka, kb = k11 * a + k12 * b, k12 * a + k22 * b
        q = a * ka + b * kb
        # t: hit along the ray; where the ray misses the quadric, its closest approach
        root = np.sqrt(np.maximum(1 - 2 * q, 1e-6))
        t = 2 / (1 + root)
        across = 1 + a * a + b * b
        A, B = 1 - t * q, 1 + t * t * (ka * ka + kb * kb)
        # cos^2 of the angle between view and normal; cos 2 theta = 2 cos^2 - 1
        squared = A * A / (B * across)
        cosine = np.maximum(2 * squared - 1, DARK)
        intensity = np.exp(self.log_scale) * cosine**self.exponent / (t * t * across)

        # derivatives by q, g = ka^2 + kb^2 and across
        dt_dq = t * t / (2 * root)
        dA_dq = -(t + q * dt_dq)
        dB_dq = 2 * t * (ka * ka + kb * kb) * dt_dq
        # d log I = on_q dq + on_g dg + on_across d(across)
        lobe = self.exponent / cosine * 2 * squared
        on_q = lobe * (2 * dA_dq / A - dB_dq / B) - 2 * dt_dq / t
        on_g = -lobe * t * t / B
        on_across = -(lobe + 1) / across
        # derivatives by the tangents, then by the six parameters
        by_a = on_q * 2 * ka + on_g * 2 * (ka * k11 + kb * k12) + on_across * 2 * a
        by_b = on_q * 2 * kb + on_g * 2 * (ka * k12 + kb * k22) + on_across * 2 * b
        J = np.empty((len(a), 6))
        J[:, 0] = -by_a * (1 + a * a) - by_b * a * b
        J[:, 1] = -by_a * a * b - by_b * (1 + b * b)
        J[:, 2] = on_q * a * a + on_g * 2 * ka * a
        J[:, 3] = on_q * 2 * a * b + on_g * 2 * (ka * b + kb * a)
        J[:, 4] = on_q * b * b + on_g * 2 * kb * b
        J[:, 5] = 1.0
        J *= intensity[:, None]
        return intensity, J


def _quadric(family: IsophoteFamily, rays: Array) -> ColocatedQuadric:
    """Start from the middle isophote: n from its larger half-axis as on a plane, then K from the smaller one."""
    isophote = family.isophotes[len(family.isophotes) // 2]
    s = family.axis
    e, f = basis_across(s)
    basis = np.stack([e, f, s])
    cone = basis @ isophote.cone @ basis.T
    # On the plane across s at unit distance the cone is an ellipse: w^T Q w = 1.
    values, vectors = np.linalg.eigh(cone[:2, :2] / -cone[2, 2])
    exponent = -np.log(isophote.isovalue) * values[0] / 2
    gain = np.sqrt(values[1] / values[0])  # 1 + d k across the longer axis
    K = (gain - 1) * np.outer(vectors[:, 1], vectors[:, 1])
    shape = np.array([K[0, 0], K[0, 1], K[1, 1]])
    return ColocatedQuadric(rays, basis, shape, float(np.log(family.patch.peak_value)), float(exponent))


def in_tangent_basis(covariance: Array, normal: Array, basis: Array) -> Array:
    """Express a covariance of tilts along `basis`, rows, in the tangent basis of the normal."""
    turn = basis_across(normal) @ basis.T
    return np.asarray(turn @ covariance @ turn.T)


def is_misfit(fitted: LobeFit[ColocatedQuadric], pixels: HighlightPixels) -> bool:
    """Test whether the residuals hold more structure than the frame's noise: a chi-square test of their local means.

    A sum over single pixels would detect less, since misfits are smooth, and would need the noise to within a percent.
    Clipped pixels are left out; where the noise is not known nothing is tested.
    """
    if pixels.noise is None:
        return False
    model, _ = fitted.model.evaluate()
    e, f = fitted.model.frame[:2]
    rays = fitted.model.rays
    kept = np.ones(len(model), dtype=bool) if pixels.clipped is None else ~pixels.clipped
    residual, level = (pixels.observed - model)[kept], model[kept]
    variance = np.broadcast_to(np.square(pixels.noise), model.shape)[kept]
    if len(residual) < RINGS * SECTORS * MIN_IN_BIN:
        return False
    # bins: rings by intensity, sectors by direction from the axis
    ring = np.searchsorted(np.quantile(level, np.arange(1, RINGS) / RINGS), level)
    angle = np.arctan2(rays[kept] @ f, rays[kept] @ e)
    sector = np.minimum(((angle + np.pi) / (2 * np.pi) * SECTORS).astype(int), SECTORS - 1)
    number = ring * SECTORS + sector
    count, total, spread = (
        np.bincount(number, weights, RINGS * SECTORS) for weights in (np.ones(len(number)), residual, variance)
    )
    # chi-square of the bins' means
    used = count >= MIN_IN_BIN
    mean = total[used] / count[used]
    allowed = spread[used] / count[used] ** 2 + (FLOOR * model.max()) ** 2
    return bool(np.sum(mean**2 / allowed) > chi_squared.quantile(1 - LEVEL, int(np.count_nonzero(used))))


def _products(values: Array, rows: Index, columns: Index) -> Array:
    """Return the sums of products of values at pixels up to `CORRELATED_PX` apart along both axes."""
    grid = np.zeros((int(rows.max()) + 1 + CORRELATED_PX, int(columns.max()) + 1 + CORRELATED_PX))
    grid[rows, columns] = values
    products = np.fft.irfft2(np.abs(np.fft.rfft2(grid)) ** 2, s=grid.shape)
    near = np.arange(-CORRELATED_PX, CORRELATED_PX + 1)
    return np.asarray(products[np.ix_(near, near)])


def excess_of_misfit(fitted: LobeFit[ColocatedQuadric], pixels: HighlightPixels) -> float:
    """Return how far the normal moves, beyond noise, when only the pixels near the peak are fitted, squared, rad^2.

    It is 0 where these pixels alone do not determine a fit.
    """
    model, _ = fitted.model.evaluate()
    near = model > INNER * model.max()
    part = replace(fitted.model, rays=fitted.model.rays[near])
    inner = fit_lobe(part, pixels.observed[near], None if pixels.clipped is None else pixels.clipped[near])
    if inner is None:
        return 0.0
    moved = tangent_coordinates(fitted.model.normal, inner.model.normal)
    # The two fits share pixels: the variance of their difference is the difference of their variances.
    noise = float(np.trace(inner.covariance[:2, :2]) - np.trace(fitted.covariance[:2, :2]))
    return max(float(moved @ moved) - max(noise, 0.0), 0.0)
