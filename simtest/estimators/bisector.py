"""`bisector`: with the light's position known, the normal bisects the directions to light and camera.

Which of several lights made a highlight, the positions of the other highlights around it decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeGuard

import numpy as np

from simtest.calibration import NO_PRIORS, Distribution, Normal, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget, line_covariance
from simtest.estimators.highlight import OfHighlight
from simtest.estimators.prior_parts import add_common_parts, told_light_part
from simtest.estimators.protocol import Estimate, Law
from simtest.estimators.small_spots import HighlightAxis
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.vectors import basis_across, bisect

LARGEST_MISFIT = 0.25  # largest misfit of the offsets that the mirror geometry predicts, as a share of their length
CLEAR = 2.0  # the next best light must fit this many times worse for the choice to be clear

ALONE = 3.0
"""The highlights of one place must lie this many times nearer together than the next one does. On rough tissue glints
meet the lights' arrangement by chance: of two lights 16 times in 100, half of them wrongly; of three 3 times in 100,
which are half of all choices that seem clear there."""

STEP = 1e-4  # step of the differences of the normal, rad, and as a share of the distance

NARROW = 0.15
"""Standard deviation of a told distance, as a share of it, up to which the light's angle is taken as linear in it; at
0.3 a surface at half the distance would lie three stated deviations off."""

DISTANCES = (np.arange(32) + 0.5) / 32  # shares of a prior on the distance at which the normal's moves are computed


@dataclass(frozen=True)
class Bisector(OfHighlight):
    """The bisector of the directions to the light and to the camera at P = d s (theory.md section 3, item 1).

    s is the sightline of the BP: the cones' axis followed to t -> 1, less the shift of the radiance's peak by the
    falloff with the distance from the light. That falloff has the slope g = -2 grad log|L - P|, so the peak lies g/H
    towards the light; 1/H are the lobe's moments, known from the isophotes.

    A distance that is told with a small normal error moves the normal by its derivative. Over any other distribution,
    such as the working range where no distance is told, the normal is that at the distribution's median, and the part
    ``distance`` of the budget holds the moves from there. The light's angle goes with 1/d, so this is the median of
    the normals, with the smallest mean error; and it is nearer to the true one than the reversed sightline wherever the
    surface is nearer than twice the median, which for a uniform distribution is everywhere. The mean of the normals
    would follow the few near distances, and be worse than no correction beyond 55 of 5 to 80 mm.

    The candidates are those of the lights that may have made the highlight, the proposed one first. With several
    lights the positions of the other highlights decide between them (`light_of_highlight`). Where they do not, the
    lights' mean position is used, flagged ``ambiguous_light``, and the part ``light_offset`` of the budget is the
    mean square of what the single lights would give, over the distances. Fails with ``not_known`` without lights.
    """

    laws: ClassVar[tuple[Law, ...]] = ("bisector", "axis_ratio_seen")

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`); the lights must be told."""
        if not priors.lights_mm:
            return Failure(Reason.NOT_KNOWN, "needs the lights' positions")
        return super().estimate(patch, camera, priors)

    def of(self, highlight: HighlightAxis, priors: Priors) -> Estimate:
        """Estimate the normal at a fitted highlight."""
        lights, flags = priors.lights, highlight.flags
        own = light_of_highlight(highlight, priors)
        order = [*lights] if own is None else [lights[own]]
        if own is None:
            # What is seen is then usually the lights' common lobe.
            order.insert(0, lights.mean(axis=0))
            flags = (*flags, "ambiguous_light")
        found = [_normal(highlight, light, priors.distance) for light in order]
        normal, sightline = found[0]
        estimate = Estimate(
            normal=normal,
            candidates=np.array([candidate for candidate, _ in found]),
            look_px=highlight.camera.project(sightline),
            axis_ratio=highlight.axis_ratio,
            isophotes=highlight.isophotes,
            budget=_budget(highlight, order, own, found[0], priors),
            flags=flags,
        )
        return add_common_parts(estimate, highlight.camera, priors, highlight)


bisector = Bisector()


def is_narrow(distance: Distribution) -> TypeGuard[Normal]:
    """Whether a distance is known so well that the normal moves with it along a line."""
    return isinstance(distance, Normal) and distance.sd <= NARROW * distance.mean


def _sampled(distance: Distribution) -> Array:
    """Return the distances, mm, over which a part of the budget is the mean: one where it is known well, shape (D,)."""
    return np.array([_middle(distance)]) if is_narrow(distance) else distance.quantile(DISTANCES)


def _middle(distance: Distribution) -> float:
    """Return the distance, mm, that the normal is taken at: the median, also the mean of a small normal error."""
    return distance.mean if is_narrow(distance) else float(distance.quantile(np.array([0.5]))[0])


def _normal(family: HighlightAxis, light: Array, distance: Distribution) -> tuple[Array, Array]:
    """Return normal and sightline of the BP in the middle of the distances."""
    normals, sightlines = _normals(family, light, np.array([_middle(distance)]))
    return normals[0], sightlines[0]


def _normals(family: HighlightAxis, light: Array, distances: Array, turn: Array | None = None) -> tuple[Array, Array]:
    """Return normals and sightlines of the BP at distances, shape (D,), both (D, 3).

    `turn`, rad in the family's basis, moves the measured sightline.
    """
    sightline = family.peak_axis if turn is None else family.peak_axis + turn @ family.basis
    sightline = sightline / np.linalg.norm(sightline)
    d = distances[:, None]
    position = d * sightline
    normal = bisect(position, light)
    # The surface point moves with the image's tangent along the plane perpendicular to the normal.
    tilts = normal @ family.basis.T / (normal @ sightline)[:, None]
    steps = distances[:, None, None] * (family.basis - tilts[:, :, None] * sightline)
    to_light = light - position
    # the falloff's slope shifts the peak by g/H
    slope = 2 * np.einsum("dki,di->dk", steps, to_light) / np.sum(to_light * to_light, axis=1)[:, None]
    sightlines = sightline - slope @ family.moments @ family.basis
    sightlines /= np.linalg.norm(sightlines, axis=1)[:, None]
    return bisect(d * sightlines, light), sightlines


def _budget(
    family: HighlightAxis, lights: Sequence[Array], own: int | None, found: tuple[Array, Array], priors: Priors
) -> Budget | None:
    """Return the budget of normal and sightline by the first light: of the axis at the peak, the distance, the lights.

    `own` is that light's index among those told, None where it is not clear which one made the highlight.
    """
    if family.peak_budget is None:
        return None
    (normal, sightline), light, distance = found, lights[0], priors.distance
    across, middle = basis_across(normal), np.array([_middle(distance)])
    unturned = _normals(family, light, middle)[0][0]
    turned = [_normals(family, light, middle, STEP * unit)[0][0] for unit in np.eye(2)]
    J = across @ (np.array(turned) - unturned).T / STEP
    budget = {name: J @ part @ J.T for name, part in family.peak_budget.items()}
    budget["distance"] = _distance_part(family, light, distance, across)
    if own is None:
        budget["light_offset"] = _light_part(family, lights, distance, normal)
    if (told := priors.lights_covariance) is not None:
        # The mean of lights whose errors are alike, as a wrong scale makes them, is as uncertain as one of them.
        covariance = told.mean(axis=0) if own is None else told[own]
        part = told_light_part(sightline, normal, light, covariance, _sampled(distance))
        budget["light_offset"] = budget.get("light_offset", 0.0) + part
    return budget


def _light_part(family: HighlightAxis, lights: Sequence[Array], distance: Distribution, normal: Array) -> Array:
    """Return the covariance of the first light's normal by the others, shape (2, 2), rad^2, in a basis across it.

    It is the mean square over the lights and the distances, since the angle between two lights goes with 1/d.
    """
    first, *single = (_normals(family, light, _sampled(distance))[0] for light in lights)
    moved = np.concatenate([normals - first for normals in single]) @ basis_across(normal).T
    return np.asarray(moved.T @ moved / len(moved))


def _distance_part(family: HighlightAxis, light: Array, distance: Distribution, across: Array) -> Array:
    """Return the covariance of the normal by the distance, shape (2, 2), rad^2, in the basis `across`."""
    if is_narrow(distance):
        near_and_far = distance.mean * np.array([1.0, 1 + STEP])
        normals = _normals(family, light, near_and_far)[0]
        by_distance = across @ (normals[1] - normals[0]) / (STEP * distance.mean) * distance.sd
        return np.outer(by_distance, by_distance)
    # Moves over a wide range of distances lie all but along one line.
    return line_covariance(_normals(family, light, distance.quantile(DISTANCES))[0] @ across.T)


def light_of_highlight(family: HighlightAxis, priors: Priors) -> int | None:
    """Return the index of the light that made a highlight; None where that is not clear.

    The highlights of lights at L_i lie at w_i in the image with M (w_i - w_j) = (L_i - L_j)_perp / (2 d): the bisector
    turns by half the light's angle, the normal turns against the sightline by M. M is the root of the lobe's H up to a
    factor, which is fitted. It is taken as positive: no surface that is concave beyond its centre of curvature. Of the
    frame's other highlights, which the patch names, the nearest are used, one for each other light; with them the
    highlight must stand alone (`ALONE`).
    """
    if not np.ptp(priors.lights, axis=0).any():
        return 0  # all at one place
    # observed offsets, turned by M into those of the lights up to a factor
    peaks = _other_peaks(family)
    others = peaks[: len(priors.lights_mm) - 1]
    gaps, count = np.linalg.norm(peaks, axis=1), len(others)
    if len(peaks) > count and not gaps[count] > ALONE * gaps[count - 1]:
        return None
    values, vectors = np.linalg.eigh(family.moments)
    if not len(others) or values[0] <= 0:
        return None
    M = vectors @ np.diag(np.sqrt(values[0] / values)) @ vectors.T
    seen = others @ M
    # misfit if light i made this highlight
    lights = priors.lights @ family.basis.T
    misfits = np.array([_misfit(seen, np.delete(lights, i, axis=0) - light) for i, light in enumerate(lights)])
    first, second = np.argsort(misfits, kind="stable")[:2]
    clear = misfits[first] < LARGEST_MISFIT and misfits[second] > max(CLEAR * misfits[first], LARGEST_MISFIT)
    return int(first) if clear else None


def _misfit(seen: Array, offsets: Array) -> float:
    """Return how badly other peaks, shape (K, 2), fit the other lights' offsets, shape (L - 1, 2), up to a factor > 0.

    The misfit is the RMS of the residual over that of the offsets; 0 is a perfect fit.
    """
    best = np.inf
    # Each pairing of the first peak sets the factor; the other peaks then take the nearest light.
    for offset in offsets:
        factor = max(float(seen[0] @ offset / (seen[0] @ seen[0])), 0.0)
        gaps = np.linalg.norm(factor * seen[:, None] - offsets[None], axis=2)
        taken = np.concatenate([[int(np.argmin(np.linalg.norm(offsets - offset, axis=1)))], gaps[1:].argmin(axis=1)])
        if len(set(taken.tolist())) < len(taken):
            continue
        matched = offsets[taken]
        # refine the factor with all pairs
        factor = max(float(np.sum(seen * matched) / np.sum(seen * seen)), 0.0)
        if (size := float(np.linalg.norm(matched))) > 0:
            best = min(best, float(np.linalg.norm(factor * seen - matched)) / size)
    return best


def _other_peaks(family: HighlightAxis) -> Array:
    """Return the offsets of the other highlights, the nearest first, tangents in the basis, shape (K, 2)."""
    others, peak = family.patch.neighbours_px, family.patch.peak_px
    order = np.argsort(np.linalg.norm(others - peak, axis=1), kind="stable")
    return np.asarray(family.tangents(others[order]) - family.tangents(peak[None]))
