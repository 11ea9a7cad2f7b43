"""`bisector`: with the light's place known, the normal bisects the directions to light and camera."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.flags import isophote_flags
from simtest.estimators.isophote_family import IsophoteFamily, fit_isophote_family
from simtest.estimators.light_assignment import light_of_highlight
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import tangent_basis

Array = npt.NDArray[np.float64]


STEP = 1e-4
"""Step of the differences of the normal, rad, and as a share of the distance."""


def bisector(
    patch: Patch,
    camera: Camera,
    priors: Priors = NO_PRIORS,
    isovalues: Sequence[float] = CONE_AXIS_ISOVALUES,
) -> Estimate | Failure:
    """Bisect the directions to the light and to the camera at P = d s (theory.md section 3, item 1).

    s is the sightline of the BP: the cones' axis followed to t -> 1, less the shift of the radiance's peak by the
    falloff with the distance from the light. That falloff has the slope g = -2 grad log|L - P|, so the peak lies g/H
    towards the light; 1/H are the lobe's moments, known from the isophotes.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    priors : Priors
        Its lights and distance are needed.
    isovalues : sequence of float
        Each t in (0, 1).

    Returns
    -------
    Estimate or Failure
        A candidate for each light that may have made the highlight, the proposed one first. Fails as `cone_axis` does,
        and with ``not_known`` without lights or distance. With several lights the highlight's own is told by where the
        others are (`light_of_highlight`); where it cannot be told, the lights' mean place is used, flagged
        ``ambiguous_light``.
    """
    if not priors.lights_mm or priors.distance_mm is None:
        return Failure(Reason.NOT_KNOWN, "needs the lights' places and a distance")
    spot = fit_isophote_family(patch, camera, isovalues)
    if isinstance(spot, Failure):
        return spot
    lights, flags = priors.lights, isophote_flags(spot)
    own = light_of_highlight(spot, priors)
    order = [*lights] if own is None else [lights[own]]
    if own is None:
        # What is seen is then as a rule the lights' common lobe.
        order.insert(0, lights.mean(axis=0))
        flags = (*flags, "ambiguous_light")
    candidates = np.array([_normal(spot, light, priors.distance_mm)[0] for light in order])
    normal, sightline = _normal(spot, order[0], priors.distance_mm)
    return Estimate(
        normal=normal,
        candidates=candidates,
        look_px=camera.project(sightline),
        axis_ratio=spot.axis_ratio,
        isophotes=spot.isophotes,
        covariance=_covariance(spot, order[0], priors, normal),
        flags=flags,
    )


def bisect(position: Array, light: Array) -> Array:
    """Give the unit vector that bisects the directions from a point to the light and to the camera, shape (3,)."""
    to_light, to_camera = light - position, -position
    both = to_light / np.linalg.norm(to_light) + to_camera / np.linalg.norm(to_camera)
    return np.asarray(both / np.linalg.norm(both))


def _normal(spot: IsophoteFamily, light: Array, distance: float, turned: Array | None = None) -> tuple[Array, Array]:
    """Give normal and sightline of the BP; `turned`, rad in the spot's basis, moves the measured sightline."""
    sightline = spot.peak_axis if turned is None else spot.peak_axis + turned @ spot.basis
    sightline = sightline / np.linalg.norm(sightline)
    position = distance * sightline
    normal = bisect(position, light)
    # How the surface point moves with the image's tangent: along the plane across the normal.
    steps = distance * (spot.basis - np.outer(spot.basis @ normal / (normal @ sightline), sightline))
    to_light = light - position
    slope = 2 * steps @ to_light / (to_light @ to_light)
    sightline = sightline - (spot.moments @ slope) @ spot.basis
    sightline /= np.linalg.norm(sightline)
    return bisect(distance * sightline, light), sightline


def _covariance(spot: IsophoteFamily, light: Array, priors: Priors, normal: Array) -> Array | None:
    """Give the covariance of the normal by noise and by the distance's uncertainty, shape (2, 2)."""
    if spot.peak_covariance is None or priors.distance_mm is None:
        return None
    across = np.stack([vector[0] for vector in tangent_basis(normal[None])])
    turned = [_normal(spot, light, priors.distance_mm, STEP * unit)[0] for unit in np.eye(2)]
    J = across @ (np.array(turned) - normal).T / STEP
    farther, _ = _normal(spot, light, priors.distance_mm * (1 + STEP))
    by_distance = across @ (farther - normal) / (STEP * priors.distance_mm) * priors.distance_sd_mm
    return np.asarray(J @ spot.peak_covariance @ J.T + np.outer(by_distance, by_distance))
