"""`inverse_rendering`: a quadric patch fitted by differentiating the renderer, as a reference for the others."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.bisector import DISTANCES, is_narrow, light_of_highlight
from simtest.estimators.budget import Budget, line_covariance
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import gain_of_stiffness, sign_hypotheses
from simtest.estimators.family import IsophoteFamily
from simtest.estimators.highlight import fit_highlight, fit_small
from simtest.estimators.least_squares import LobeFit, fit_lobe
from simtest.estimators.photometric import HighlightPixels, beyond_noise, highlight_pixels
from simtest.estimators.prior_parts import add_common_parts, light_offset_part, mean_light_part
from simtest.estimators.protocol import Estimate, EstimatedCurvature, Law
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.vectors import basis_across, bisect
from simtest.inverse.patch import PatchRenderer, RenderedQuadric

STEP = 1e-5
"""Step of the differences of the normal, rad, and as a share of the distance."""

ROUNDING = 1e-7
"""Relative error of a sum of squares of residuals in single precision."""


@dataclass(frozen=True)
class InverseRendering:
    """A rendered quadric patch with a Phong lobe, fitted to the pixels from `cone_axis` as start.

    The fit determines the BP's sightline, to which the highlight's condition ties the normal, the shape d S in all
    three components, the lobe's scale and, if wanted, a Lambertian base. The patch is a paraboloid or, where that
    leaves a smaller residual, a quadric that is a sphere or cylinder where its curvatures are. The renderer is
    differentiated by Dr.Jit's forward mode; the fit is Levenberg and Marquardt's. Under white noise this is the
    maximum-likelihood estimate. Clipped pixels count as "at least this bright". Pixels are those before smoothing.

    With lights given the patch is lit from there, at the mean of the prior on the distance; else from the camera, at
    any distance. Of several, the arrangement of the highlights must tell which one is reflected (`light_of_highlight`).
    The exponent is the known one or, where the lobe is not known, the one with which the surface is straight along the
    highlight's longer axis: a noisy picture determines sqrt(n) (I + d S) alone.

    Parameters
    ----------
    base : bool
        Whether a Lambertian base is fitted; else there is none.
    """

    base: bool = True
    laws: ClassVar[tuple[Law, ...]] = ("bisector",)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate normal and curvature (see `simtest.estimators.Estimator`).

        The estimate has one candidate. Its covariance is that of the Gauss-Newton matrix, of the distance's uncertainty
        and, as by `photometric`, of the isophotes' drift, bends and clipping. Where the lobe is known, the hypotheses
        of `curvature` are what the picture's second order allows, as in `curved`, the fitted one first. Fails with
        ``unresolved`` where a highlight is too small for a shape, and with ``not_known`` where several lights are given
        and it is not clear which one it is of.

        Raises
        ------
        BackendError
            If the rendering backend cannot be used.
        """
        if (spot := fit_small([patch], camera)[0]) is not None:
            return spot.no_shape
        start, family = cone_axis.estimate(patch, camera), fit_highlight(patch, camera, CONE_AXIS_ISOVALUES)
        if isinstance(start, Failure) or not isinstance(family, IsophoteFamily):
            return start
        own = 0 if len(priors.lights_mm) < 2 else light_of_highlight(family, priors)
        if own is None:
            return Failure(Reason.NOT_KNOWN, f"needs to know which of {len(priors.lights_mm)} lights it reflects")
        pixels = highlight_pixels(patch, camera, cut=any(isophote.cut for isophote in start.isophotes))
        if isinstance(pixels, Failure):
            return pixels
        fitted = _fitted(_start(start, patch, priors, own, PatchRenderer(pixels.rays), self.base), pixels)
        if fitted is None:
            return Failure(Reason.NOT_CONVERGED, "the fit of a rendered patch did not converge")
        model = fitted.model
        gains = 1 + np.linalg.eigvalsh(model.shape)
        covariance = pixels.correlation(fitted) * pixels.covariance(fitted)
        budget = {**_budget(model, covariance, _of_light(priors, own)), **beyond_noise(family)}
        estimate = Estimate(
            normal=model.normal,
            candidates=model.normal[None],
            look_px=camera.project(model.sightline),
            axis_ratio=float(np.abs(gains).min() / np.abs(gains).max()),
            isophotes=start.isophotes,
            budget=None if pixels.noise is None else budget,
            flags=start.flags,
            curvature=_curvature(model, priors),
        )
        return add_common_parts(estimate, camera, priors, family)


inverse_rendering = InverseRendering()


def _start(
    start: Estimate, patch: Patch, priors: Priors, own: int, renderer: PatchRenderer, open_base: bool
) -> RenderedQuadric:
    """Start from the middle isophote: its half-axes give K if n is known, else n as if one curvature were 0.

    On the plane across s at unit distance the isophote is w^T Q w = 1, and -2 ln t Q = c M^2 + 2 M.
    """
    s = -start.normal
    distance, light, lights = _lit(priors, own)
    normal = bisect(distance * s, light)
    basis = basis_across(normal)
    frame = np.concatenate([basis - np.outer(basis @ s, s), s[None]])
    # stiffness H from the isophote's half-axes
    isophote = start.isophotes[len(start.isophotes) // 2]
    cone = frame @ isophote.cone @ frame.T
    values, vectors = np.linalg.eigh(cone[:2, :2] / -cone[2, 2])
    stiffness = -2 * np.log(isophote.isovalue) * values
    # Where the lobe is not known: m = 1 along the longer axis.
    known = priors.lobe_curvature
    lobe = max(float(stiffness[0]) - 2, 1.0) if known is None else known.mean
    M = vectors @ np.diag(gain_of_stiffness(stiffness, lobe)) @ vectors.T
    stretch = np.sqrt(lobe / 4) * np.array([M[0, 0], M[0, 1], M[1, 1]])
    logs = float(np.log(patch.peak_value)), float(np.log(lobe / 4))
    return RenderedQuadric(renderer, s, basis[0], distance, light, lights, stretch, *logs, 0.0, open_base)


def _fitted(start: RenderedQuadric, pixels: HighlightPixels) -> LobeFit[RenderedQuadric] | None:
    """Fit a paraboloid, then from there a sphere or cylinder, and keep the one with the smaller residual."""
    flat = fit_lobe(start, pixels.observed, pixels.clipped, ROUNDING)
    begun = start if flat is None else flat.model
    round_one = fit_lobe(replace(begun, roundness=1.0), pixels.observed, pixels.clipped, ROUNDING)
    fits = [fit for fit in (flat, round_one) if fit is not None and np.isfinite(fit.chi2)]
    return min(fits, key=lambda fit: fit.chi2, default=None)


def _lit(priors: Priors, own: int) -> tuple[float, Array, Array]:
    """Return distance, the highlight's light and all lights; 1 mm and the camera's position where none is given."""
    if not priors.lights_mm:
        return 1.0, np.zeros(3), np.zeros((1, 3))
    return priors.distance.mean, priors.lights[own], priors.lights


def _of_light(priors: Priors, own: int) -> Priors:
    """Return the priors with the highlight's light alone."""
    one = slice(own, own + 1)
    return replace(priors, lights_mm=priors.lights_mm[one], lights_covariance_mm2=priors.lights_covariance_mm2[one])


def _budget(model: RenderedQuadric, covariance: Array, priors: Priors) -> Budget:
    """Return the budget of the normal: noise, and distance or, where no light is told, the light's offset."""
    across = basis_across(model.normal)
    steps = [model.moved(np.append(STEP * unit, np.zeros(len(covariance) - 2))).normal for unit in np.eye(2)]
    J = across @ (np.array(steps) - model.normal).T / STEP
    noise = J @ covariance[:2, :2] @ J.T
    if not priors.lights_mm:
        return {"noise": noise, "light_offset": light_offset_part(model.normal, priors)}
    by_light = mean_light_part(model.normal, priors)
    known = {"noise": noise} if by_light is None else {"noise": noise, "light_offset": by_light}
    distances = priors.distance.quantile(DISTANCES)
    if is_narrow(priors.distance):
        distances = model.distance * np.array([1.0, 1 + STEP])
    moves = bisect(distances[:, None] * model.sightline, model.light) @ across.T
    if not is_narrow(priors.distance):
        return {**known, "distance": line_covariance(moves)}
    by_distance = (moves[1] - moves[0]) / (STEP * model.distance) * priors.distance.sd
    return {**known, "distance": np.outer(by_distance, by_distance)}


def _curvature(model: RenderedQuadric, priors: Priors) -> EstimatedCurvature:
    """Return the fitted curvature, with the sign hypotheses where the lobe is known."""
    values, vectors = np.linalg.eigh(model.shape)
    gains = 1 + values
    order = np.argsort(np.abs(gains), kind="stable")
    gains, directions = gains[order], vectors.T[order] @ model.basis
    hypotheses = None
    if priors.lobe_curvature is not None:
        c = priors.lobe_curvature.mean
        listed = sign_hypotheses(c * gains**2 + 2 * gains, c)
        # The fitted signs first: the fit started from them.
        hypotheses = listed[np.argsort(np.sum((listed - gains) ** 2, axis=1) > 1e-6, kind="stable")]
    ratio = float(np.abs(gains[0] / gains[1]))
    return EstimatedCurvature(directions, ratio, hypotheses)
