"""`bisector`: with the light's position known, the normal bisects the directions to light and camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtest.calibration import NO_PRIORS, Distribution, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget
from simtest.estimators.highlight_fit import HighlightAxis, fit_highlight, fit_highlights
from simtest.estimators.light_assignment import light_of_highlight
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.vectors import basis_across

STEP = 1e-4
"""Step of the differences of the normal, rad, and as a share of the distance."""


@dataclass(frozen=True)
class Bisector:
    """The bisector of the directions to the light and to the camera at P = d s (theory.md section 3, item 1).

    s is the sightline of the BP: the cones' axis followed to t -> 1, less the shift of the radiance's peak by the
    falloff with the distance from the light. That falloff has the slope g = -2 grad log|L - P|, so the peak lies g/H
    towards the light; 1/H are the lobe's moments, known from the isophotes.

    Parameters
    ----------
    isovalues : tuple of float
        Each t in (0, 1).
    """

    isovalues: tuple[float, ...] = CONE_AXIS_ISOVALUES

    def prepare(self, patches: Sequence[Patch], camera: Camera) -> None:
        """Fit several highlights at once (see `simtest.estimators.protocol.PreparedEstimator`)."""
        fit_highlights(patches, camera, self.isovalues)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`); lights and distance must be known.

        The candidates are those of the lights that may have made the highlight, the proposed one first. With several
        lights the positions of the other highlights decide between them (`light_of_highlight`). Where they do not, the
        lights' mean position is used, flagged ``ambiguous_light``. Fails as `cone_axis` does, and with ``not_known``
        without lights or distance. In a highlight too small for isophotes s is the sightline of its centre, flagged
        ``unresolved``, and no axis ratio is stated.
        """
        if not priors.lights_mm or priors.distance_mm is None:
            return Failure(Reason.NOT_KNOWN, "needs the lights' places and a distance")
        family = fit_highlight(patch, camera, self.isovalues)
        if isinstance(family, Failure):
            return family
        lights, distance, flags = priors.lights, priors.distance_mm, family.flags
        own = light_of_highlight(family, priors)
        order = [*lights] if own is None else [lights[own]]
        if own is None:
            # What is seen is then usually the lights' common lobe.
            order.insert(0, lights.mean(axis=0))
            flags = (*flags, "ambiguous_light")
        candidates = np.array([_normal(family, light, distance.mean)[0] for light in order])
        normal, sightline = _normal(family, order[0], distance.mean)
        return Estimate(
            normal=normal,
            candidates=candidates,
            look_px=camera.project(sightline),
            axis_ratio=family.axis_ratio,
            isophotes=family.isophotes,
            budget=_budget(family, order[0], distance, normal),
            flags=flags,
        )


bisector = Bisector()


def bisect(position: Array, light: Array) -> Array:
    """Return the unit vector that bisects the directions from a point to the light and to the camera, shape (3,)."""
    to_light, to_camera = light - position, -position
    both = to_light / np.linalg.norm(to_light) + to_camera / np.linalg.norm(to_camera)
    return np.asarray(both / np.linalg.norm(both))


def _normal(family: HighlightAxis, light: Array, distance: float, turn: Array | None = None) -> tuple[Array, Array]:
    """Return normal and sightline of the BP; `turn`, rad in the family's basis, moves the measured sightline."""
    sightline = family.peak_axis if turn is None else family.peak_axis + turn @ family.basis
    sightline = sightline / np.linalg.norm(sightline)
    position = distance * sightline
    normal = bisect(position, light)
    # The surface point moves with the image's tangent along the plane perpendicular to the normal.
    steps = distance * (family.basis - np.outer(family.basis @ normal / (normal @ sightline), sightline))
    to_light = light - position
    # the falloff's slope shifts the peak by g/H
    slope = 2 * steps @ to_light / (to_light @ to_light)
    sightline = sightline - (family.moments @ slope) @ family.basis
    sightline /= np.linalg.norm(sightline)
    return bisect(distance * sightline, light), sightline


def _budget(family: HighlightAxis, light: Array, distance: Distribution, normal: Array) -> Budget | None:
    """Return the budget of the normal: that of the axis at the peak, and the distance."""
    if family.peak_budget is None:
        return None
    across = basis_across(normal)
    turned = [_normal(family, light, distance.mean, STEP * unit)[0] for unit in np.eye(2)]
    J = across @ (np.array(turned) - normal).T / STEP
    farther, _ = _normal(family, light, distance.mean * (1 + STEP))
    by_distance = across @ (farther - normal) / (STEP * distance.mean) * distance.sd
    own = {name: J @ part @ J.T for name, part in family.peak_budget.items()}
    return {**own, "distance": np.outer(by_distance, by_distance)}
