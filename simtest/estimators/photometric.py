"""`photometric`: maximum-likelihood fit of a Phong lobe to the pixels of a highlight (theory.md sections 2 and 3)."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.flags import isophote_flags
from simtest.estimators.goodness import excess_of_misfit, is_misfit
from simtest.estimators.isophote_family import IsophoteFamily, fit_isophote_family
from simtest.estimators.light_offset import add_light_offset_uncertainty
from simtest.estimators.lobe_fit import fit_lobe
from simtest.estimators.lobe_models import ColocatedQuadric, PlaneFromAside
from simtest.estimators.protocol import Estimate, FittedIsophote
from simtest.geometry import Camera, Patch, cone_rays
from simtest.geometry.vectors import tangent_basis

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

REGIONS = (0.05, 0.1, 0.2, 0.3, 0.5)
"""Isovalues whose region's pixels are fitted: the first one that closes. Further out there is little but noise."""

CUT_REGION = 0.3
"""Of a highlight that the border or the view cuts: the isovalue down to which the pixels that are seen are fitted."""

START_ISOVALUE = 0.3
"""Of the circle pose that a plane seen from aside starts with."""

MAX_PIXELS = 16384
"""Of a larger region every second, third ... pixel is fitted, evenly spread."""


COARSE = 4
"""Every so many pixels tell the two candidates of a plane apart."""


MISFIT_SHARE = 0.9
"""Variance of a misfitting lobe's normal over the squared shift that its misfit shows, or the squared drift of the
isophotes' axis: what 614 highlights of the generated colon showed (`simtest.estimators.isophote_family`)."""

SAME_RAD = 1e-3
"""Two fits closer than this are one."""


@dataclass(frozen=True)
class HighlightPixels:
    """Pixels that are fitted: their sightlines and intensities, and which are clipped."""

    rays: Array
    observed: Array
    clipped: Mask | None
    noise: float | Array | None

    def every(self, step: int) -> "HighlightPixels":
        """Give every so many pixels."""
        clipped = None if self.clipped is None else self.clipped[::step]
        noise = self.noise[::step] if isinstance(self.noise, np.ndarray) else self.noise
        return HighlightPixels(self.rays[::step], self.observed[::step], clipped, noise)


def photometric(patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
    """Fit a quadric patch seen by a camera with its own light, started from `cone_axis`.

    N = -s with s the sightline of the BP; beside it the shape d S, the lobe's scale and, with the shape all but
    degenerate, its exponent are open. Under white noise it is the maximum-likelihood estimate. Clipped pixels count
    as "at least this bright". Pixels are those before smoothing where the patch has them.

    Where the residuals hold more structure than the frame's noise, the flag is ``misfit``, and the covariance holds
    how far the normal moves when only the pixels around the peak are fitted. It also holds how far the isophotes' axis
    drifts where that is more than noise.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    priors : Priors
        Its lights are used, to say where they are beside the camera (`simtest.estimators.light_offset`).

    Returns
    -------
    Estimate or Failure
        One candidate with its covariance; it looks at the fitted BP. Flags as of `cone_axis`, and ``misfit``.
    """
    spot = fit_isophote_family(patch, camera, CONE_AXIS_ISOVALUES)
    if isinstance(spot, Failure):
        return spot
    pixels = highlight_pixels(patch, camera, cut=any(isophote.cut for isophote in spot.isophotes))
    if isinstance(pixels, Failure):
        return pixels
    fitted = fit_lobe(_quadric(spot, pixels.rays), pixels.observed, pixels.clipped)
    if fitted is None:
        return Failure(Reason.NOT_CONVERGED, "the fit of a quadric did not converge")
    e, f, s = fitted.model.frame
    covariance = _turned(fitted.covariance[:2, :2], fitted.model.normal, np.stack([e, f]))
    ratio = _axis_ratio(fitted.model)
    flags, excess = isophote_flags(spot), spot.drift_excess
    if pixels.noise is not None and is_misfit(fitted, pixels.observed, pixels.clipped, pixels.noise):
        excess = max(excess_of_misfit(fitted, pixels.observed, pixels.clipped), excess)
        flags = (*flags, "misfit")
    covariance = covariance + MISFIT_SHARE * excess * np.eye(2)
    estimate = Estimate(
        normal=fitted.model.normal,
        candidates=fitted.model.normal[None],
        look_px=camera.project(s),
        axis_ratio=ratio,
        isophotes=spot.isophotes,
        covariance=covariance,
        flags=flags,
    )
    return add_light_offset_uncertainty(estimate, priors)


def photometric_plane(patch: Patch, camera: Camera, start_isovalue: float = START_ISOVALUE) -> Estimate | Failure:
    """Fit a plane that is lit from above the BP and pictured from aside [MB, section 3.1], started from `circle_pose`.

    Both candidates of the pose are fitted. They see the picture's perspective differently, so that the sum of squares
    tells them apart: `choice_margin` is the root of its difference over the noise.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    start_isovalue : float
        Of the circle pose; higher ones are tried where it does not close.

    Returns
    -------
    Estimate or Failure
        The fitted normals, the better one first, with its covariance; it looks at the fitted BP.
    """
    start = _pose(patch, camera, start_isovalue)
    if isinstance(start, Failure):
        return start
    pixels = highlight_pixels(patch, camera)
    if isinstance(pixels, Failure):
        return pixels
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
    best = fit_lobe(replace(fits[0].model, rays=pixels.rays), pixels.observed, pixels.clipped) if fits else None
    if best is None:
        return Failure(Reason.NOT_CONVERGED, "no fit of a plane converged")
    basis = np.stack([direction[0] for direction in tangent_basis(best.model.normal[None])])
    covariance = _turned(best.covariance[:2, :2], best.model.normal, basis)
    margin = None
    if len(fits) > 1 and best.sigma > 0:
        margin = float(np.sqrt(COARSE * (fits[1].chi2 - fits[0].chi2)) / best.sigma)
    normals = np.stack([fitted.model.normal for fitted in (best, *fits[1:])])
    return Estimate(
        normal=normals[0],
        candidates=normals,
        look_px=camera.project(best.model.foot),
        isophotes=start.isophotes,
        choice_margin=margin,
        covariance=covariance,
    )


def _pose(patch: Patch, camera: Camera, isovalue: float) -> Estimate | Failure:
    """Give the circle pose at the first isovalue that closes."""
    tried = [isovalue, *(t for t in (0.4, 0.5, 0.6, 0.7) if t > isovalue)]
    results = (circle_pose(patch, camera, t) for t in tried)
    first: Failure | None = None
    for result in results:
        if not isinstance(result, Failure):
            return result
        first = first or result
    assert first is not None
    return first


def highlight_pixels(patch: Patch, camera: Camera, cut: bool = False) -> HighlightPixels | Failure:
    """Gather the pixels of the first region that closes; of a highlight that is cut, those that are seen."""
    closed = (t for t in REGIONS if not isinstance(patch.crossings(t), Failure))
    t = next(closed, CUT_REGION if cut else None)
    if t is None:
        return Failure(Reason.NO_CLOSED_ISOPHOTE, f"none around the peak up to t = {REGIONS[-1]:g}")
    rows, columns = np.nonzero(patch.inside(t, cut))
    step = -(-len(rows) // MAX_PIXELS)
    # A step that shares no factor with a row's length spreads over the columns too.
    rows, columns = rows[::step], columns[::step]
    centres = np.stack([columns, rows], axis=1) + 0.5 + np.array(patch.origin_px)
    rays = camera.unproject(centres)
    sound = np.isfinite(rays).all(axis=1)
    values = patch.values if patch.raw is None else patch.raw
    clipped = None if patch.saturated is None else patch.saturated[rows, columns][sound]
    stated = patch.noise
    noise = stated[rows, columns][sound].astype(float) if isinstance(stated, np.ndarray) else stated
    return HighlightPixels(rays[sound], values[rows, columns][sound].astype(float), clipped, noise)


def _quadric(spot: IsophoteFamily, rays: Array) -> ColocatedQuadric:
    """Start from the middle isophote: its larger half-axis as on a plane gives n, the smaller one then gives K."""
    isophote = spot.isophotes[len(spot.isophotes) // 2]
    s = spot.axis
    e, f = (basis[0] for basis in tangent_basis(s[None]))
    basis = np.stack([e, f, s])
    cone = basis @ isophote.cone @ basis.T
    # On the plane across s at unit distance the cone is an ellipse: w^T Q w = 1.
    values, vectors = np.linalg.eigh(cone[:2, :2] / -cone[2, 2])
    exponent = -np.log(isophote.isovalue) * values[0] / 2
    gain = np.sqrt(values[1] / values[0])
    K = (gain - 1) * np.outer(vectors[:, 1], vectors[:, 1])
    shape = np.array([K[0, 0], K[0, 1], K[1, 1]])
    return ColocatedQuadric(rays, basis, shape, float(np.log(spot.patch.peak_value)), float(exponent))


def _plane(normal: Array, foot: Array, isophote: FittedIsophote, peak: float, rays: Array) -> PlaneFromAside:
    """Start with the exponent that the isophote's radius on the plane stands for."""
    points = isophote_rays(isophote)
    reach = (normal @ foot) / (points @ normal)
    rho2 = float(np.median(np.sum((points * reach[:, None] - foot) ** 2, axis=1)))
    cosine = max((1 - rho2) / (1 + rho2), 0.1)
    exponent = np.log(isophote.isovalue) / np.log(cosine)
    return PlaneFromAside(rays, normal, foot, float(np.log(exponent)), float(np.log(peak)))


def isophote_rays(isophote: FittedIsophote) -> Array:
    """Give sightlines along a fitted isophote, shape (N, 3)."""
    return cone_rays(isophote.cone, isophote.sightline)


def _axis_ratio(model: ColocatedQuadric) -> float:
    """Give the smaller over the larger abs(1 + d k)."""
    gains = np.abs(1 + np.linalg.eigvalsh(model.shape))
    return float(gains.min() / gains.max())


def _turned(covariance: Array, normal: Array, basis: Array) -> Array:
    """Express a covariance of tilts along `basis`, rows, in the tangent basis of the normal."""
    turn = np.stack([direction[0] for direction in tangent_basis(normal[None])]) @ basis.T
    return np.asarray(turn @ covariance @ turn.T)
