"""`photometric`: maximum-likelihood fit of a Phong lobe to the pixels of a highlight (theory.md sections 2 and 3)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.goodness import correlation_of_noise, excess_of_misfit, is_misfit
from simtest.estimators.highlight_fit import fit_highlight, fit_highlights
from simtest.estimators.isophote_family import IsophoteFamily
from simtest.estimators.isophote_fit import FittedIsophote
from simtest.estimators.lobe_fit import LobeFit, Model, fit_lobe
from simtest.estimators.lobe_models import ColocatedQuadric, PlaneFromAside
from simtest.estimators.prior_parts import add_untold_parts
from simtest.estimators.protocol import Estimate, Law
from simtest.estimators.small_spot import SmallSpot
from simtest.geometry import Array, Camera, Mask, Patch
from simtest.geometry.vectors import basis_across
from simtest.runtime.arrays import Index
from simtest.runtime.fitted import fitted_number

REGIONS = (0.05, 0.1, 0.2, 0.3, 0.5)
"""The pixels inside the first of these isophotes that closes are fitted. Further out there is little but noise."""

CUT_REGION = 0.3
"""For a highlight that the border or the view cuts: seen pixels are fitted down to this isovalue."""

MAX_PIXELS = 16384
"""In a larger region every second, third ... pixel is fitted, evenly spread."""

COARSE = 4
"""Every fourth pixel suffices to choose between the two candidates of a plane."""

MISFIT_SHARE = fitted_number("misfit.share")

MISFIT_FACTOR = 1.5
"""A misfit is told where it makes the stated standard deviation this many times larger: texture and lobes of another
form leave structure in nearly every real highlight, and it seldom matters."""

SAME_RAD = 1e-3
"""Two fits closer than this are one."""


@dataclass(frozen=True)
class HighlightPixels:
    """The fitted pixels: sightlines, intensities, noise, which are clipped, and rows and columns, shape (2, m)."""

    rays: Array
    observed: Array
    clipped: Mask | None
    noise: float | Array | None
    places: Index

    def correlation(self, fitted: LobeFit[Model]) -> float:
        """Return by how much the noise's correlation raises the covariance of a fit (`correlation_of_noise`)."""
        if self.noise is None:
            return 1.0
        return correlation_of_noise(fitted, self.observed, self.clipped, self.noise, self.places)

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
class Photometric:
    """A quadric patch with a co-located light, fitted to the pixels from `cone_axis` as start.

    N = -s with s the sightline of the BP. The shape d S and the lobe's scale are fitted too; its exponent, all but
    degenerate with the shape, is held. Under white noise this is the maximum-likelihood estimate; where coding or
    demosaicing has correlated the noise, the covariance is that of noise so correlated. Clipped pixels count
    as "at least this bright". Pixels are those before smoothing where the patch has them.

    What the priors leave open is added to the budget (`simtest.estimators.prior_parts`).
    """

    laws: ClassVar[tuple[Law, ...]] = ("sightline",)

    def prepare(self, patches: Sequence[Patch], camera: Camera) -> None:
        """Fit the isophotes of several highlights at once (see `simtest.estimators.protocol.PreparedEstimator`)."""
        fit_highlights(patches, camera, CONE_AXIS_ISOVALUES)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`).

        The estimate has one candidate with its covariance and looks at the fitted BP. Flags are those of `cone_axis`,
        and ``misfit`` where the residuals hold more structure than the frame's noise and the stated error is larger by
        half or more for it: the covariance then includes how far the normal moves when only the pixels around the peak
        are fitted. It also includes the drift of the isophotes' axis where that is more than noise. A highlight too
        small for isophotes gets the normal of its centre, flagged ``unresolved``. Where the patch does not know its
        noise no uncertainty is stated, as by the estimators of isophotes.
        """
        family = fit_highlight(patch, camera, CONE_AXIS_ISOVALUES)
        if isinstance(family, Failure):
            return family
        if isinstance(family, SmallSpot):
            return add_untold_parts(family.estimate(), camera, priors, family)
        pixels = highlight_pixels(patch, camera, any(isophote.cut for isophote in family.isophotes), family.least)
        if isinstance(pixels, Failure):
            return pixels
        fitted = fit_lobe(_quadric(family, pixels.rays), pixels.observed, pixels.clipped)
        if fitted is None:
            return Failure(Reason.NOT_CONVERGED, "the fit of a quadric did not converge")
        e, f, s = fitted.model.frame
        covariance = _turned(pixels.covariance(fitted)[:2, :2], fitted.model.normal, np.stack([e, f]))
        excess, misfit = 0.0, False
        if pixels.noise is not None and is_misfit(fitted, pixels.observed, pixels.clipped, pixels.noise):
            misfit = True
            excess = excess_of_misfit(fitted, pixels.observed, pixels.clipped)
        else:
            covariance = covariance * pixels.correlation(fitted)
        budget = {"noise": covariance, **beyond_noise(family, excess)}
        estimate = Estimate(
            normal=fitted.model.normal,
            candidates=fitted.model.normal[None],
            look_px=camera.project(s),
            axis_ratio=_axis_ratio(fitted.model),
            isophotes=family.isophotes,
            budget=None if pixels.noise is None else budget,
            flags=family.flags,
        )
        estimate = add_untold_parts(estimate, camera, priors, family)
        # A bend of the isophotes and the residuals of the fit show the same structure.
        added = float(np.trace(budget["shape"] - family.drift_error))
        return _with_misfit_told(estimate, added) if misfit else estimate


@dataclass(frozen=True)
class PhotometricPlane:
    """A plane lit from above the BP and pictured from aside [MB, section 3.1], fitted from `circle_pose` as start.

    Both candidates of the pose are fitted. The picture's perspective differs between them, so the sum of squares
    separates them: `choice_margin` is the root of its difference over the noise.

    Parameters
    ----------
    start_isovalue : float
        Of the circle pose; higher ones are tried where it does not close.
    """

    start_isovalue: float = 0.3

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`); priors are not used.

        The estimate holds the fitted normals, the better one first, with its covariance, and looks at the fitted BP.
        """
        start = self._start(patch, camera)
        if isinstance(start, Failure):
            return start
        pixels = highlight_pixels(patch, camera)
        if isinstance(pixels, Failure):
            return pixels
        # candidates: a plane from each pose, fitted to few pixels
        foot = camera.unproject(patch.peak_px)
        few, fits = pixels.every(COARSE), []
        for normal in start.candidates:
            if normal @ foot < 0:
                model = _plane(normal, foot / foot[2], start.isophotes[0], patch.peak_value, few.rays)
                fitted = fit_lobe(model, few.observed, few.clipped)
                if fitted is not None and (pixels.rays @ fitted.model.normal < 0).all():
                    fits.append(fitted)
        fits.sort(key=lambda fitted: fitted.chi2)
        if len(fits) > 1 and fits[0].model.normal @ fits[1].model.normal > np.cos(SAME_RAD):
            # Near the branch point both lead to one minimum.
            fits.pop()
        # refine the better one with all pixels
        best = fit_lobe(replace(fits[0].model, rays=pixels.rays), pixels.observed, pixels.clipped) if fits else None
        if best is None:
            return Failure(Reason.NOT_CONVERGED, "no fit of a plane converged")
        margin = None
        if len(fits) > 1 and best.sigma > 0:
            margin = float(np.sqrt(COARSE * (fits[1].chi2 - fits[0].chi2)) / best.sigma)
        normals = np.stack([fitted.model.normal for fitted in (best, *fits[1:])])
        covariance = _turned(pixels.covariance(best)[:2, :2], normals[0], basis_across(normals[0]))
        return Estimate(
            normal=normals[0],
            candidates=normals,
            look_px=camera.project(best.model.foot),
            isophotes=start.isophotes,
            choice_margin=margin,
            budget=None if pixels.noise is None else {"noise": covariance},
        )

    def _start(self, patch: Patch, camera: Camera) -> Estimate | Failure:
        """Return the circle pose at the first isovalue that closes, or the first one's Failure."""
        tried = (self.start_isovalue, *(t for t in (0.4, 0.5, 0.6, 0.7) if t > self.start_isovalue))
        poses = (replace(circle_pose, isovalue=t, with_region=False).estimate(patch, camera) for t in tried)
        first = next(poses)
        if isinstance(first, Estimate):
            return first
        return next((pose for pose in poses if isinstance(pose, Estimate)), first)


photometric, photometric_plane = Photometric(), PhotometricPlane()


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


def _plane(normal: Array, foot: Array, isophote: FittedIsophote, peak: float, rays: Array) -> PlaneFromAside:
    """Start with the exponent that follows from the isophote's radius on the plane."""
    points = isophote.rays()
    reach = (normal @ foot) / (points @ normal)
    rho2 = float(np.median(np.sum((points * reach[:, None] - foot) ** 2, axis=1)))
    cosine = max((1 - rho2) / (1 + rho2), 0.1)
    exponent = np.log(isophote.isovalue) / np.log(cosine)
    return PlaneFromAside(rays, normal, foot, float(np.log(exponent)), float(np.log(peak)))


def _axis_ratio(model: ColocatedQuadric) -> float:
    """Return the smaller over the larger abs(1 + d k)."""
    gains = np.abs(1 + np.linalg.eigvalsh(model.shape))
    return float(gains.min() / gains.max())


def _turned(covariance: Array, normal: Array, basis: Array) -> Array:
    """Express a covariance of tilts along `basis`, rows, in the tangent basis of the normal."""
    turn = basis_across(normal) @ basis.T
    return np.asarray(turn @ covariance @ turn.T)
