"""`photometric_plane`: the published protocol's plane, lit and pictured from two places, fitted to the pixels."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.isophotes import FittedIsophote
from simtest.estimators.least_squares import fit_lobe
from simtest.estimators.photometric import DARK, highlight_pixels, in_tangent_basis
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.vectors import basis_across


@dataclass(frozen=True)
class PlaneFromAside:
    """A plane lit and viewed from V above the BP, pictured by a camera that is not at V [MB, section 3.1].

    The intensity is c max(0, cos beta)^n with cos beta = (h^2 - rho^2) / (h^2 + rho^2), rho the distance from the BP
    and h that of V from the plane. h is set to the BP's depth: it is all but degenerate with n, which leaves the normal
    unaffected. Parameters: tilt of the normal (2), BP at unit depth (2), log n, log c.

    Parameters
    ----------
    rays : ndarray, shape (m, 3)
        Sightlines of the pixels.
    normal : ndarray, shape (3,)
        Unit, facing the camera.
    foot : ndarray, shape (3,)
        BP at unit depth.
    log_exponent, log_scale : float
        log n, log c.
    """

    rays: Array
    normal: Array
    foot: Array
    log_exponent: float
    log_scale: float

    def moved(self, step: Array) -> Self:
        """Tilt the normal in its tangent plane, and add to the others."""
        first, second = basis_across(self.normal)
        normal = self.normal + step[0] * first + step[1] * second
        foot = self.foot + np.array([step[2], step[3], 0.0])
        exponent, scale = self.log_exponent + float(step[4]), self.log_scale + float(step[5])
        return replace(self, normal=normal / np.linalg.norm(normal), foot=foot, log_exponent=exponent, log_scale=scale)

    def evaluate(self) -> tuple[Array, Array]:
        """Return intensities and derivatives."""
        # D: from the BP to the point that each ray hits, at BP depth 1
        N, F = self.normal, self.foot
        steepness = self.rays @ N
        reach = (N @ F) / steepness
        D = self.rays * reach[:, None] - F
        rho2 = np.sum(D * D, axis=1)
        cosine = np.maximum((1 - rho2) / (1 + rho2), DARK)
        exponent = np.exp(self.log_exponent)  # n
        intensity = np.exp(self.log_scale) * cosine**exponent
        by_rho2 = -2 * exponent * intensity / (cosine * (1 + rho2) ** 2)
        # derivatives through rho^2, then by log n and log c
        along = np.sum(D * self.rays, axis=1)
        J = np.empty((len(rho2), 6))
        for i, change in enumerate(basis_across(N)):
            J[:, i] = by_rho2 * 2 * along * ((change @ F) / steepness - reach * (self.rays @ change) / steepness)
        for i in (0, 1):
            J[:, 2 + i] = by_rho2 * 2 * (along * N[i] / steepness - D[:, i])
        J[:, 4] = intensity * np.log(cosine) * exponent
        J[:, 5] = intensity
        return intensity, J


COARSE = 4
"""Every fourth pixel suffices to choose between the two candidates of a plane."""


SAME_RAD = 1e-3
"""Two fits closer than this are one."""


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
        covariance = in_tangent_basis(pixels.covariance(best)[:2, :2], normals[0], basis_across(normals[0]))
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


def _plane(normal: Array, foot: Array, isophote: FittedIsophote, peak: float, rays: Array) -> PlaneFromAside:
    """Start with the exponent that follows from the isophote's radius on the plane."""
    points = isophote.rays()
    reach = (normal @ foot) / (points @ normal)
    rho2 = float(np.median(np.sum((points * reach[:, None] - foot) ** 2, axis=1)))
    cosine = max((1 - rho2) / (1 + rho2), 0.1)
    exponent = np.log(isophote.isovalue) / np.log(cosine)
    return PlaneFromAside(rays, normal, foot, float(np.log(exponent)), float(np.log(peak)))


photometric_plane = PhotometricPlane()
