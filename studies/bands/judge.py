"""Which bands carry the organ's normal, how wide its region is, and why others are refused."""

import math
from dataclasses import dataclass

import numpy as np

from simtest.calibration import Frame, Priors
from simtest.estimators.cloud import evidence_of
from simtest.estimators.cloud_light import DiffuseLight
from simtest.estimators.cloud_mixture import Cloud
from simtest.estimators.prior_parts import light_offset_part
from simtest.geometry.vectors import basis_across, bisect
from simtest.runtime.arrays import Array
from studies.bands.cells import Cells
from studies.bands.fit import Band, Fit

SLOPES_RAD = np.radians([3.0, 5.0, 8.0, 12.0, 17.0, 20.0])
"""The slopes' width is a prior: one frame hardly tells it."""

CHANGING = 0.35
"""Turn of the centre by curvature that changes, over the slopes' width."""

REGION = 3.0
"""Squared radius of the 95 % region over the mean square of the error."""

LEAST_GLINTS, LEAST_CONTRAST, LEAST_SHARE, LEAST_USABLE, MOST_TRACE = 8.0, 3.0, 0.25, 0.5, 0.36
LEAST_OCTANTS = 0.15
"""Share of a band's expected glints that its three emptiest octants hold together, at least."""


@dataclass(frozen=True)
class Answer:
    """A band's normal with the radius of its 95 % region, rad; `refused` says why it is none."""

    normal: Array
    radius: float
    band: Band
    refused: str = ""


def judge(frame: Frame, cells: Cells, fit: Fit, priors: Priors) -> list[Answer]:
    """Return an answer for each band, the strongest first."""
    light = DiffuseLight(frame)
    strongest = max((band.amplitude for band in fit.bands), default=0.0)
    each, whole = fit.rates(cells.sightlines)
    answers = []
    for k, band in enumerate(fit.bands):
        belongs = np.divide(each[k], whole, out=np.zeros_like(whole), where=whole > 0)
        refused = _refusal(frame, cells, band, belongs, fit, strongest, light, priors)
        answers.append(Answer(_normal(band, priors), _radius(band, strongest, priors), band, refused))
    return sorted(answers, key=lambda answer: -answer.band.amplitude)


def _normal(band: Band, priors: Priors) -> Array:
    """Return the normal that bisects the directions to the camera and to the lights' mean, where they are told."""
    if not len(priors.lights):
        return -band.centre
    normal = bisect(priors.distance.mean * band.centre[None], priors.lights.mean(axis=0))[0]
    return np.asarray(normal / np.linalg.norm(normal))


def _radius(band: Band, strongest: float, priors: Priors) -> float:
    """Return the radius of the 95 % region: the slopes' width is a prior."""
    Z = band.L @ band.covariance @ band.L.T
    share = float(np.trace(Z)) + 2 * CHANGING**2 + 2 * max(0.0, math.log(strongest / band.amplitude))
    # The curvature is not told apart from the slopes: a narrow band's slopes are narrow, or its curvature is strong.
    slope = min(float(np.sqrt(np.mean(SLOPES_RAD**2))), 1.5 * float(band.extents.max()))
    if len(lights := priors.lights):
        # Which of several lights made a band is not told.
        halves = lights @ basis_across(band.centre).T / (2 * priors.distance.mean)
        untold = float(halves.var(axis=0).sum())
    else:
        untold = float(np.trace(light_offset_part(-band.centre, priors)))
    return math.sqrt(REGION * (slope**2 * share + untold))


def _refusal(
    frame: Frame, cells: Cells, band: Band, belongs: Array, fit: Fit, strongest: float, light: DiffuseLight,
    priors: Priors,
) -> str:  # fmt: skip
    """Return why a band is no answer, or nothing."""
    pixel = frame.camera.project(band.centre)
    if not (np.isfinite(pixel).all() and frame.camera.contains(pixel)):
        return "its centre is out of view"
    nearest = int(np.argmin(np.hypot(*(cells.pixels_px - pixel).T)))
    rate = band.terms(cells.sightlines)[3]
    usable = float(rate @ cells.usable / max(rate.sum() * cells.area_px, 1e-9))
    glints = float((belongs * cells.glints).sum() / fit.dispersion)
    Z = band.L @ band.covariance @ band.L.T
    if cells.usable[nearest] == 0:
        return "its centre could not be seen"
    if usable < LEAST_USABLE:
        return f"{100 * usable:.0f} % of it could be seen"
    if glints < LEAST_GLINTS:
        return f"{glints:.1f} effective glints"
    if band.amplitude < LEAST_CONTRAST * fit.background:
        return "it hardly stands out"
    if band.amplitude < LEAST_SHARE * strongest:
        return f"{band.amplitude / strongest:.2f} of the strongest: a slope seen from afar"
    if np.trace(Z) > MOST_TRACE:
        return "its centre is not determined"
    if _octants(cells, band, belongs) < LEAST_OCTANTS:
        return "its maximum lies beside its glints"
    inverse = np.linalg.inv(band.L)
    cloud = Cloud(band.centre, inverse @ inverse.T, np.zeros((1, 2)), 1.0)
    evidence = evidence_of(cloud, light, band.covariance, priors)
    if evidence.refutes:
        return f"the diffuse light says that the organ is turned by {math.degrees(evidence.misfit):.0f} deg there"
    return ""


def _octants(cells: Cells, band: Band, belongs: Array) -> float:
    """Return the share of a band's glints in its three emptiest octants, where the fit expects 3/8."""
    v = band.terms(cells.sightlines)[1]
    octant = ((np.arctan2(v[:, 1], v[:, 0]) / (2 * np.pi) + 0.5) * 8).astype(int) % 8
    near = np.hypot(*v.T) < 2.0
    counts = np.bincount(octant[near], weights=(belongs * cells.glints)[near], minlength=8)
    return float(np.sort(counts)[:3].sum() / max(counts.sum(), 1e-9))


def turned(normal: Array, other: Array) -> float:
    """Return the angle between two unit normals, rad."""
    return float(np.arccos(np.clip(normal @ other, -1.0, 1.0)))
