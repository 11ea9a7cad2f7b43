"""`cloud`: the base's normal from the cloud of highlights that relief makes of one (theory.md 7.1 and 7.5).

Spots alone do not tell a highlight point from a fold that nearly faces the camera, nor how far changes of the base's
gains move their centroid. The diffuse light does (`cloud_light`), as well as the albedo lets it.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors, exactly
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget, equivalent_covariance
from simtest.estimators.cloud_light import DiffuseLight, Shading, find_spots
from simtest.estimators.cloud_mixture import (
    CLUMPING,
    Cloud,
    Mixture,
    Turns,
    Window,
    at_camera,
    fit_mixture,
    sampling_covariance,
    window_of,
)
from simtest.estimators.cloud_shape import LOBE_RAD2, CloudShape, slope_of
from simtest.estimators.prior_parts import add_common_parts, light_offset_part, mean_light_part
from simtest.estimators.protocol import Estimate, EstimatedCurvature
from simtest.geometry import Array, Camera
from simtest.geometry.vectors import basis_across
from simtest.runtime import chi_squared
from simtest.runtime.fitted import fitted_number
from simtest.runtime.statistics import CONFIDENCE

ALBEDO_SLOPE, JACKKNIFE_CUBIC = fitted_number("clouds.albedo_slope"), fitted_number("clouds.jackknife_cubic")
MOST_MISFIT = math.radians(fitted_number("clouds.most_misfit"))
MOST_EXTENT = math.radians(fitted_number("clouds.most_extent"))
LEAST_GAIN = fitted_number("clouds.least_gain")

REFUSED, DOUBTED = 0.95, 0.68
"""A misfit that a base with a highlight point there exceeds with less than the rest gets no answer, or a flag."""


@dataclass(frozen=True)
class BaseEvidence:
    """What the diffuse light says of a cloud, in ``basis_across(cloud.centre)``."""

    shows: bool  # whether the frame shows diffuse light: the base is tissue
    # Chi-squared with 2 degrees of freedom where the cloud's centre is at a highlight point; 0 where nothing is told.
    statistic: float = 0.0
    misfit: float = 0.0  # turn of the base at the cloud's centre from where it would face the lights, rad
    told: bool = False  # whether the misfit is known to about `MOST_MISFIT`
    # (2, 2): inverse covariance of `shift`, rad^-2; zero where nothing is told.
    information: Array = field(default_factory=lambda: np.zeros((2, 2)))
    shift: Array = field(default_factory=lambda: np.zeros(2))  # (2,): from the cloud's centre to the highlight point

    @property
    def refutes(self) -> bool:
        """Whether the base has no highlight point at the cloud's centre."""
        return self.statistic > chi_squared.quantile(REFUSED, 2)

    @property
    def doubts(self) -> bool:
        """Whether the base is likely not to have a highlight point there."""
        return self.statistic > chi_squared.quantile(DOUBTED, 2)


def evidence_of(cloud: Cloud, light: DiffuseLight, sampling: Array, priors: Priors) -> BaseEvidence:
    """Return what the diffuse light says of a cloud.

    `cloud`: as the spots tell it; `light`: of its frame; `sampling`, (2, 2): covariance of its centre by the number of
    its spots, in ``basis_across(cloud.centre)``, rad^2; `priors`: what is told of the lights and the falloff.
    """
    fits = light.around(cloud.sightline, cloud.covariance) if light.shows else None
    if fits is None:
        return BaseEvidence(light.shows)
    turn = basis_across(cloud.centre) @ basis_across(cloud.sightline).T
    quadric, cubic = (_turned(fit, turn) for fit in fits)
    # The lights' mean turns the light by m = L / d, and the normal at the cloud by m / 2: the misfit is -m / 2.
    expected = -cloud.turns.mean(axis=0)
    off = quadric.gradient + quadric.steepness @ expected
    fitted = quadric.covariance + _untold(cloud, quadric, priors)
    centre = quadric.steepness @ quadric.gains @ sampling @ quadric.gains @ quadric.steepness
    statistic = float(off @ np.linalg.solve(fitted + ALBEDO_SLOPE**2 * np.eye(2) + centre, off))
    back = np.linalg.inv(quadric.steepness)
    told = bool(np.linalg.eigvalsh(back @ fitted @ back)[-1] < MOST_MISFIT**2)
    information, shift = np.zeros((2, 2)), np.zeros(2)
    if priors.lights_mm:
        information, shift = _highlight_point(cubic, expected, _untold(cloud, cubic, priors))
    return BaseEvidence(light.shows, statistic, float(np.linalg.norm(back @ off)), told, information, shift)


def _turned(fit: Shading, turn: Array) -> Shading:
    """Return a fit in another basis."""
    return Shading(turn @ fit.gradient, turn @ fit.covariance @ turn.T, turn @ fit.gains @ turn.T)


def _untold(cloud: Cloud, fit: Shading, priors: Priors) -> Array:
    """Return the covariance of grad ln L by a light and a falloff that nobody told, shape (2, 2), per rad^2."""
    half, covariance = basis_across(cloud.centre), np.zeros((2, 2))
    if not priors.lights_mm:
        turn = fit.steepness @ half @ basis_across(-cloud.centre).T
        covariance = turn @ light_offset_part(-cloud.centre, priors) @ turn.T
    if (power := priors.falloff_power) is not None:
        # Light that falls as cos^k of the angle from the axis.
        slope = half[:, 2] / max(float(cloud.centre[2]), 1e-3)
        covariance = covariance + (power.mean**2 + power.sd**2) * np.outer(slope, slope)
    return covariance


def _highlight_point(fit: Shading, expected: Array, untold: Array) -> tuple[Array, Array]:
    """Return the inverse covariance of where the misfit is as expected, rad^-2, and that place from the centre."""
    gains, directions = np.linalg.eigh(fit.gains)
    covariance = JACKKNIFE_CUBIC**2 * fit.covariance + ALBEDO_SLOPE**2 * np.eye(2) + untold
    information, shift = np.zeros((2, 2)), np.zeros(2)
    for gain, direction in zip(gains, directions.T, strict=True):
        if gain < LEAST_GAIN:
            continue
        slope = gain * (2 + gain)
        information += slope**2 / (direction @ covariance @ direction) * np.outer(direction, direction)
        shift += (direction @ fit.gradient / slope + direction @ expected / gain) * direction
    return information, shift


LEAST_SPOTS = 6
"""A cloud of fewer spots gets no answer: a lone large highlight is a cloud of one."""

LEAST_UNVERIFIED = 15
"""Nor does a cloud of fewer spots on tissue whose diffuse light does not tell whether the base faces the light there:
so few show no shape, and folds that come near to facing the light make such groups."""

LEAST_IN_VIEW = 0.95
"""Nor does a cloud of which less is in view, whose centre would be a guess."""

LARGELY_SEEN = 0.98
"""A cloud of which less is in view is flagged."""

UNEVEN = 0.2
"""Standard deviation of the spots that each light makes, as a share of an even part."""

BENDS = fitted_number("clouds.bends")

LEAST_INDEPENDENT = 2.5
"""Fewer independent spots state no extent at all."""

SHARES = (np.arange(32) + 0.5) / 32
"""At these shares a prior on the distance is sampled."""

ROUND_SIGMA = 2.0
"""A cloud is long where the log of its axis ratio is so many standard deviations off that of a round one."""


@dataclass(frozen=True)
class CloudCentre:
    """The centre of a cloud of spots carries the base's normal, where a single highlight carries the fine one.

    Spots are found in the frame (`cloud_light`) and grouped into clouds (`cloud_mixture`). With the light at the camera
    a cloud lies around the sightline at which the base faces the camera; the diffuse light says whether there is one,
    and moves the centre to it (`evidence_of`). Lights that are told have each their part of the cloud, half their angle
    at the surface off that sightline; lights that are not told apart are one mixture.

    Parameters
    ----------
    least_spots : int
        A cloud of fewer gets no answer.
    """

    least_spots: int = LEAST_SPOTS

    def estimate_frame(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> list[Estimate] | Failure:
        """Estimate the base's normal of each cloud, that of most spots first (see `FrameEstimator`).

        Each estimate has ``target`` base and a `cloud`. Flags: ``anisotropic_or_curved`` where the cloud is longer than
        wide, which a curved base and an anisotropic relief do alike; ``cut`` where a part of it is out of view;
        ``wide`` where it is longer than `MOST_EXTENT`; ``base_doubted`` where the diffuse light says that the base is
        likely turned from the lights at its centre; ``base_unverified`` where too little diffuse light is seen to tell;
        ``clouds_refused`` where another cloud of the frame gets no answer.
        The axis ratio, and the curvature's directions, hold for isotropic relief. Fails with ``no_estimate`` where no
        cloud has spots enough in view, or the base has no single highlight point at any one's centre (`evidence_of`).
        """
        spots = find_spots(frame)
        if len(spots.peaks) < self.least_spots:
            return self._too_few(len(spots.peaks))
        turns, window = _turns(priors), window_of(camera, frame.seen)
        mixture = fit_mixture(camera.unproject(spots.points_px), window, turns)
        owner = np.where(mixture.belongs.sum(axis=1) > 0.5, mixture.belongs.argmax(axis=1), -1)
        light = DiffuseLight(frame)
        estimates: list[Estimate] = []
        refused: list[Failure] = []
        for i, cloud in enumerate(mixture.clouds):
            own = spots.points_px[owner == i]
            if len(own) >= self.least_spots and cloud.seen >= LEAST_IN_VIEW and _is_in_view(cloud, camera, frame):
                made = _estimate(cloud, own, window, camera, priors, light)
                if isinstance(made, Failure):
                    refused.append(made)
                else:
                    estimates.append(made)
        if not estimates:
            return refused[0] if refused else self._none_whole(mixture, owner)
        if refused:
            estimates = [replace(each, flags=(*each.flags, "clouds_refused")) for each in estimates]
        return sorted(estimates, key=lambda estimate: -len(_shape(estimate).points_px))

    def _too_few(self, count: int) -> Failure:
        what = "1 bright spot" if count == 1 else f"{count} bright spots"
        return Failure(Reason.NO_ESTIMATE, f"{what}: a cloud takes {self.least_spots}; a lone highlight is none")

    def _none_whole(self, mixture: Mixture, owner: Array) -> Failure:
        counts = [int(np.count_nonzero(owner == i)) for i in range(len(mixture.clouds))]
        largest = int(np.argmax(counts))
        seen = 100 * mixture.clouds[largest].seen
        return Failure(
            Reason.NO_ESTIMATE,
            f"the largest cloud has {counts[largest]} spots and {seen:.0f} % of it in view: it takes "
            f"{self.least_spots}, {100 * LEAST_IN_VIEW:.0f} %, and its centre in view",
        )


cloud = CloudCentre()


def _shape(estimate: Estimate) -> CloudShape:
    assert estimate.cloud is not None
    return estimate.cloud


def _turns(priors: Priors) -> Turns:
    """Return where each light has its part of a cloud: on a plane, at L_perp / 2 d from the reversed normal."""
    if _is_at_camera(priors):
        return at_camera
    lights, twice = priors.lights, 2 * priors.distance.mean
    return lambda centre: lights @ basis_across(centre).T / twice


def _is_at_camera(priors: Priors) -> bool:
    """Return whether no light is told that lies beside the camera."""
    return not len(priors.lights) or not np.linalg.norm(priors.lights, axis=1).max() > 0


def _is_in_view(cloud: Cloud, camera: Camera, frame: Frame) -> bool:
    """Return whether the pixel that a cloud's estimate looks at is in the view."""
    look_px = camera.project(cloud.sightline)
    if not (np.isfinite(look_px).all() and camera.contains(look_px)):
        return False
    column, row = (min(int(v), size - 1) for v, size in zip(look_px, (camera.width, camera.height), strict=True))
    return frame.seen is None or bool(frame.seen[row, column])


def _estimate(
    cloud: Cloud, points_px: Array, window: Window, camera: Camera, priors: Priors, light: DiffuseLight
) -> Estimate | Failure:
    """Return the estimate of one cloud, or why its centre says nothing of the base's normal."""
    independent = max(len(points_px) / CLUMPING, LEAST_INDEPENDENT)
    sampling = sampling_covariance(cloud, window, independent)
    evidence = BaseEvidence(False) if priors.plane else evidence_of(cloud, light, sampling, priors)
    if (doubt := _refusal(cloud, evidence, len(points_px))) is not None:
        return doubt
    bends = np.zeros((2, 2)) if priors.plane else _bends(cloud, camera.unproject(points_px), evidence)
    cloud, parts = _with_light(cloud, sampling * small_sample(independent), bends, evidence, _turns(priors))
    if not _is_in_view(cloud, camera, light.frame):
        return _unstated(len(points_px), "the diffuse light says that its centre lies out of view")
    normal = -cloud.centre
    lobe = LOBE_RAD2 if priors.lobe_curvature is None else exactly(1 / priors.lobe_curvature.mean)
    slope = slope_of(cloud.covariance, independent, lobe)
    shape = CloudShape(points_px, cloud.covariance, independent, cloud.seen, lobe, slope)
    # The cloud is longest where the gain is smallest.
    vectors = np.linalg.eigh(cloud.covariance)[1][:, ::-1].T @ basis_across(cloud.centre)
    estimate = Estimate(
        normal=normal,
        candidates=normal[None],
        look_px=camera.project(cloud.sightline),
        axis_ratio=shape.axis_ratio,
        budget=_budget(cloud, parts, priors),
        flags=_flags(cloud, shape, evidence, priors),
        curvature=EstimatedCurvature(vectors, shape.axis_ratio),
        target="base",
        cloud=shape,
    )
    return add_common_parts(estimate, camera, priors)


def _refusal(cloud: Cloud, evidence: BaseEvidence, spots: int) -> Failure | None:
    """Return why a cloud gets no answer: the base has no highlight point there, several, or nothing shows one."""
    if evidence.refutes:
        off = math.degrees(evidence.misfit)
        why = f"the diffuse light says that the base is turned by {off:.0f} deg from facing the light at its centre"
    elif evidence.shows and _extent(cloud) > MOST_EXTENT:
        most, extent = (math.degrees(value) for value in (MOST_EXTENT, _extent(cloud)))
        why = f"its extent is {extent:.0f} deg, over {most:.0f}: the base has several highlight points there or none"
    elif evidence.shows and not evidence.told and spots < LEAST_UNVERIFIED:
        why = f"the diffuse light does not tell whether the base faces the light there: it takes {LEAST_UNVERIFIED}"
    else:
        return None
    return _unstated(spots, why)


def _unstated(spots: int, why: str) -> Failure:
    return Failure(Reason.NO_ESTIMATE, f"a cloud of {spots} spots states no normal: {why}")


def _extent(cloud: Cloud) -> float:
    """Return the longer semi-axis of a cloud, rad."""
    return float(np.sqrt(np.linalg.eigvalsh(cloud.covariance)[-1]))


def _bends(cloud: Cloud, sightlines: Array, evidence: BaseEvidence) -> Array:
    """Return the covariance of a cloud's centre by changes of the base's gains inside it, shape (2, 2), rad^2.

    Where the density of spots is p(w), w the base's misfit and quadratic in x, the centroid is off by half of
    E[x |x|^2], x in extents of the cloud about the centroid. What N gaussian spots show of it by chance has a variance
    of 2 / N along each direction and is taken off. Tissue bends by `BENDS` at least, shown or not.
    """
    points, _ = cloud.coordinates(sightlines)
    points = points[np.isfinite(points).all(axis=1)]
    if len(cloud.turns) > 1 or len(points) < LEAST_SPOTS:
        return np.asarray(BENDS**2 * cloud.covariance)
    gap = points - points.mean(axis=0)
    x = np.linalg.solve(np.linalg.cholesky(gap.T @ gap / len(gap)), gap.T)
    off = (x * (x**2).sum(axis=0)).mean(axis=1) / 2
    excess = float(off @ off) / 2 - 2 * CLUMPING / len(points)
    return np.asarray(max(excess, BENDS**2 if evidence.shows else 0.0) * cloud.covariance)


def _with_light(
    cloud: Cloud, sampling: Array, bends: Array, evidence: BaseEvidence, turns: Turns
) -> tuple[Cloud, dict[str, Array]]:
    """Return a cloud whose centre the diffuse light has moved, weighted by both covariances, and the parts of its own.

    The parts ``relief`` and ``shape`` are in the basis across the cloud's new centre.
    """
    parts = {"relief": sampling, "shape": bends}
    if not evidence.information.any():
        return cloud, parts
    alone = np.linalg.inv(sampling + bends)
    together = np.linalg.inv(alone + evidence.information)
    rest, basis = together @ alone, basis_across(cloud.centre)
    centre = cloud.centre + together @ evidence.information @ evidence.shift @ basis
    centre /= np.linalg.norm(centre)
    turn = basis_across(centre) @ basis.T
    parts = {
        "relief": rest @ sampling @ rest.T,
        "shape": rest @ bends @ rest.T + together @ evidence.information @ together,
    }
    moved = replace(cloud, centre=centre, covariance=turn @ cloud.covariance @ turn.T, turns=turns(centre))
    return moved, {name: turn @ part @ turn.T for name, part in parts.items()}


def _budget(cloud: Cloud, parts: dict[str, Array], priors: Priors) -> Budget:
    """Return the budget of a cloud's normal: the parts of its centre, shape (2, 2), and the lights."""
    normal, half = -cloud.centre, basis_across(cloud.centre)
    # The bases across a direction and its reverse are not the same.
    turn = basis_across(normal) @ half.T
    budget = {name: turn @ part @ turn.T for name, part in parts.items()}
    if not priors.lights_mm:
        budget["light_offset"] = light_offset_part(normal, priors)
    elif not _is_at_camera(priors):
        # Lights may make different numbers of spots; the mean of all moves with the distance.
        spread = cloud.spread * UNEVEN**2 / len(cloud.turns)
        budget["light_offset"] = turn @ spread @ turn.T
        middle = half @ priors.lights.mean(axis=0) / 2
        moves = np.outer(1 / priors.distance.quantile(SHARES) - 1 / priors.distance.mean, turn @ middle)
        budget["distance"] = equivalent_covariance(moves)
    if (part := mean_light_part(normal, priors)) is not None:
        budget["light_offset"] = budget.get("light_offset", 0.0) + part
    return budget


def _is_long(covariance: Array, independent: float) -> bool:
    """Return whether a cloud is longer than wide, beyond chance."""
    small, large = np.linalg.eigvalsh(covariance)
    # The log of a round cloud's axis ratio has a standard deviation of about 1 / sqrt(n).
    return bool(math.log(large / small) / 2 * math.sqrt(independent) > ROUND_SIGMA)


def small_sample(independent: float) -> float:
    """Return what a sampling covariance is multiplied by, so that its 95 % region holds 95 % of the errors.

    The extent is estimated from the same spots: Hotelling's T^2 of two dimensions, 2 (n - 1) / (n - 2) F(2, n - 2).
    """
    rest = max(independent - 2, 0.5)
    F = rest / 2 * ((1 - CONFIDENCE) ** (-2 / rest) - 1)
    return 2 * (independent - 1) / rest * F / chi_squared.quantile(CONFIDENCE, 2)


def _flags(cloud: Cloud, shape: CloudShape, evidence: BaseEvidence, priors: Priors) -> tuple[str, ...]:
    flags = []
    if _is_long(cloud.covariance, shape.independent):
        flags.append("anisotropic_or_curved")
    if cloud.seen < LARGELY_SEEN:
        flags.append("cut")
    if not priors.plane:
        if _extent(cloud) > MOST_EXTENT:
            flags.append("wide")
        if evidence.doubts:
            flags.append("base_doubted")
        elif not evidence.told:
            flags.append("base_unverified")
    return tuple(flags)
