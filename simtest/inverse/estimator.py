"""`inverse_rendering`: a quadric patch fitted by differentiating the renderer; the yardstick of the others."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.bisector import bisect
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import gain_of_stiffness, sign_hypotheses
from simtest.estimators.lobe_fit import LobeFit, fit_lobe
from simtest.estimators.photometric import HighlightPixels, highlight_pixels
from simtest.estimators.protocol import Estimate, EstimatedCurvature
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import tangent_basis
from simtest.inverse.patch import RenderedQuadric
from simtest.inverse.patch_renderer import PatchRenderer

Array = npt.NDArray[np.float64]


STEP = 1e-5
"""Step of the differences of the normal, rad, and as a share of the distance."""

PATHS = 64
"""Paths a pixel, where there are inter-reflections."""

ROUNDING = 1e-7
"""Relative error of a sum of squares of residuals in single precision."""


def inverse_rendering(
    patch: Patch,
    camera: Camera,
    priors: Priors = NO_PRIORS,
    path_depth: int = 2,
    base: bool = True,
    exponent: bool = False,
    variant: str | None = None,
) -> Estimate | Failure:
    """Fit a rendered quadric patch with a Phong lobe to the pixels, started from `cone_axis`.

    Open are the BP's sightline, which the highlight's condition ties the normal to, the shape d S in all three
    components, the lobe's scale and, as asked for, a Lambertian base and the lobe's exponent. The patch is a paraboloid
    or, where that leaves less, a quadric that is a sphere or cylinder where its curvatures are. The renderer is
    differentiated by Dr.Jit's forward mode; the fit is Levenberg and Marquardt's. Under white noise it is the
    maximum-likelihood estimate. Clipped pixels count as "at least this bright". Pixels are those before smoothing.

    With the lights and a distance known the patch is lit from there; else from the camera, at any distance.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    priors : Priors
        Lights and distance, and the lobe's curvature, from which the exponent follows.
    path_depth : int
        2: direct light; more adds path_depth - 2 inter-reflections of the patch with itself, twice as wide as
        far, with a lobe of strength 1; they follow scale and base, and are not differentiated by place and shape.
    base : bool
        Whether a Lambertian base is open; else there is none.
    exponent : bool
        Whether the exponent is open. Else it is the known one or, where the lobe is not known, the one with which the
        surface is straight along the spot's longer axis: of n and d S a picture with noise tells sqrt(n) (I + d S).
    variant : str, optional
        Mitsuba variant; default by `simtest.rendering.backend.requested_variant`.

    Returns
    -------
    Estimate or Failure
        One candidate with its covariance, from the Gauss-Newton matrix and what the distance's uncertainty adds, and
        `curvature`: its hypotheses are what the picture's second order leaves, as in `curved`, the fitted one first,
        where the lobe is known.

    Raises
    ------
    BackendError
        If the rendering backend cannot be used.
    """
    start = cone_axis(patch, camera)
    if isinstance(start, Failure):
        return start
    pixels = highlight_pixels(patch, camera, cut=any(isophote.cut for isophote in start.isophotes))
    if isinstance(pixels, Failure):
        return pixels
    renderer = PatchRenderer(pixels.rays, path_depth, PATHS, variant)
    model = _start(start, patch, priors, renderer, (exponent, base))
    fitted = _fitted(model, pixels)
    if fitted is None:
        return Failure(Reason.NOT_CONVERGED, "the fit of a rendered patch did not converge")
    found = fitted.model
    gains = 1 + np.linalg.eigvalsh(found.shape)
    return Estimate(
        normal=found.normal,
        candidates=found.normal[None],
        look_px=camera.project(found.sightline),
        axis_ratio=float(np.abs(gains).min() / np.abs(gains).max()),
        isophotes=start.isophotes,
        covariance=_covariance(fitted, priors),
        flags=start.flags,
        curvature=_curvature(found, priors),
    )


def _start(
    start: Estimate, patch: Patch, priors: Priors, renderer: PatchRenderer, opened: tuple[bool, bool]
) -> RenderedQuadric:
    """Start from the middle isophote: its half-axes give K where n is known, else n as on a surface that is flat once.

    On the plane across s at unit distance the isophote is w^T Q w = 1, and -2 ln t Q = c M^2 + 2 M.
    """
    s = -start.normal
    distance, light, lights = _lit(priors)
    normal = bisect(distance * s, light)
    basis = np.stack([vector[0] for vector in tangent_basis(normal[None])])
    frame = np.concatenate([basis - np.outer(basis @ s, s), s[None]])
    isophote = start.isophotes[len(start.isophotes) // 2]
    cone = frame @ isophote.cone @ frame.T
    values, vectors = np.linalg.eigh(cone[:2, :2] / -cone[2, 2])
    stiffness = -2 * np.log(isophote.isovalue) * values
    lobe = priors.lobe_curvature
    if lobe is None:
        # m = 1 along the longer axis.
        lobe = max(float(stiffness[0]) - 2, 1.0)
    M = vectors @ np.diag(gain_of_stiffness(stiffness, lobe)) @ vectors.T
    stretch = np.sqrt(lobe / 4) * np.array([M[0, 0], M[0, 1], M[1, 1]])
    logs = float(np.log(patch.peak_value)), float(np.log(lobe / 4))
    return RenderedQuadric(renderer, s, basis[0], distance, light, lights, stretch, *logs, 0.0, *opened)


def _fitted(start: RenderedQuadric, pixels: HighlightPixels) -> LobeFit[RenderedQuadric] | None:
    """Fit a paraboloid, from there a sphere or cylinder, and keep what leaves less."""
    flat = fit_lobe(start, pixels.observed, pixels.clipped, ROUNDING)
    begun = start if flat is None else flat.model
    round_one = fit_lobe(replace(begun, roundness=1.0), pixels.observed, pixels.clipped, ROUNDING)
    fits = [fit for fit in (flat, round_one) if fit is not None and np.isfinite(fit.chi2)]
    return min(fits, key=lambda fit: fit.chi2, default=None)


def _lit(priors: Priors) -> tuple[float, Array, Array]:
    """Give distance, the highlight's light and all lights; the camera's place and 1 mm where they are not known."""
    if not priors.lights_mm or priors.distance_mm is None:
        return 1.0, np.zeros(3), np.zeros((1, 3))
    return priors.distance_mm, priors.lights.mean(axis=0), priors.lights


def _covariance(fitted: LobeFit[RenderedQuadric], priors: Priors) -> Array:
    """Give the covariance of the normal in its tangent basis, shape (2, 2)."""
    model = fitted.model
    across = np.stack([vector[0] for vector in tangent_basis(model.normal[None])])
    steps = [model.moved(np.append(STEP * unit, np.zeros(len(fitted.covariance) - 2))).normal for unit in np.eye(2)]
    J = across @ (np.array(steps) - model.normal).T / STEP
    by_distance = np.zeros(2)
    if priors.distance_sd_mm > 0 and priors.distance_mm is not None:
        farther = bisect(model.distance * (1 + STEP) * model.sightline, model.light)
        by_distance = across @ (farther - model.normal) / (STEP * model.distance) * priors.distance_sd_mm
    return np.asarray(J @ fitted.covariance[:2, :2] @ J.T + np.outer(by_distance, by_distance))


def _curvature(model: RenderedQuadric, priors: Priors) -> EstimatedCurvature:
    values, vectors = np.linalg.eigh(model.shape)
    gains = 1 + values
    order = np.argsort(np.abs(gains), kind="stable")
    gains, directions = gains[order], vectors.T[order] @ model.basis
    hypotheses = None
    if priors.lobe_curvature is not None:
        c = priors.lobe_curvature
        listed = sign_hypotheses(c * gains**2 + 2 * gains, c)
        # The fitted signs first: they were what the fit started from.
        hypotheses = listed[np.argsort(np.sum((listed - gains) ** 2, axis=1) > 1e-6, kind="stable")]
    ratio = float(np.abs(gains[0] / gains[1]))
    return EstimatedCurvature(directions, ratio, hypotheses)
