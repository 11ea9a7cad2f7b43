"""`cloud`: the base's normal from the cloud of highlights that relief makes of one (theory.md 7.1 and 7.5).

Spots alone do not tell a highlight point from a fold that nearly faces the camera, nor how far changes of the base's
gains move their centroid. The diffuse light does (`cloud_light`), as well as the albedo lets it.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors, exactly
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget, equivalent_covariance
from simtest.estimators.cloud_light import SECTORS, DiffuseLight, Spots, find_spots, spots_could_be_seen
from simtest.estimators.cloud_mixture import (
    CLUMPING,
    LEAST_SEEN,
    Cloud,
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
from simtest.geometry import Array, Camera, Mask
from simtest.geometry.vectors import basis_across
from simtest.runtime import chi_squared
from simtest.runtime.fitted import fitted_number
from simtest.runtime.statistics import CONFIDENCE

LIGHT, JACKKNIFE = math.radians(fitted_number("clouds.light")), fitted_number("clouds.jackknife")
OWN_SHARE = fitted_number("clouds.own_share")
ASIDE = math.radians(fitted_number("clouds.aside"))
CHANCE, DIMMER = fitted_number("clouds.chance"), fitted_number("clouds.dimmer")
LEAST_GAIN = fitted_number("clouds.least_gain")
MOST_RMS = fitted_number("clouds.most_rms")
BENDS, MOST_EXTENT = fitted_number("clouds.bends"), math.radians(fitted_number("clouds.most_extent"))

TYPICAL_SLOPE, SLOPES = math.radians(9.0), (math.radians(3.0), math.radians(20.0))
"""Of a relief, where nothing tells, and what is possible. The extent of one cloud tells it to a factor of 2 only, so it
counts for half of the logarithm."""


@dataclass(frozen=True)
class BaseEvidence:
    """What the diffuse light says of a cloud, in ``basis_across(cloud.centre)``."""

    shows: bool  # whether the frame shows diffuse light: the base is tissue
    told: bool = False  # whether enough is seen between the spots around this cloud
    # (2,): turn of the base's normal at the cloud's sightline from the reversed centre, rad.
    turn: Array = field(default_factory=lambda: np.zeros(2))
    covariance: Array = field(default_factory=lambda: np.zeros((2, 2)))  # (2, 2): of `turn`, rad^2, by the fit
    gains: Array = field(default_factory=lambda: np.eye(2))  # (2, 2): I + dS of the base


def evidence_of(cloud: Cloud, light: DiffuseLight, priors: Priors) -> BaseEvidence:
    """Return what the diffuse light says of a cloud.

    `cloud`: as the spots tell it; `light`: of its frame; `priors`: what is told of the lights and the falloff.
    """
    fit = light.around(cloud.sightline, cloud.covariance) if light.shows else None
    if fit is None:
        return BaseEvidence(light.shows)
    across = basis_across(cloud.centre) @ basis_across(cloud.sightline).T
    gradient, gains = across @ fit.gradient, across @ fit.gains @ across.T
    # The lights' mean turns the light by m = L / d, and the normal at the cloud by m / 2, which its centre allows for.
    back = np.linalg.inv(2 * np.eye(2) + gains)
    turn = cloud.turns.mean(axis=0) - back @ gradient
    fitted = JACKKNIFE**2 * across @ fit.covariance @ across.T
    if (power := priors.falloff_power) is not None:
        # Light that falls as cos^k of the angle from the axis.
        slope = basis_across(cloud.centre)[:, 2] / max(float(cloud.centre[2]), 1e-3)
        fitted = fitted + (power.mean**2 + power.sd**2) * np.outer(slope, slope)
    return BaseEvidence(light.shows, True, turn, LIGHT**2 * np.eye(2) + back @ fitted @ back, gains)


LEAST_SPOTS = 6
"""A cloud of fewer spots gets no answer: a lone large highlight is a cloud of one."""

LEAST_IN_VIEW, LEAST_VERIFIABLE = 0.95, 0.5
"""Nor does a cloud of which less is in view, whose centre would be a guess; on tissue the diffuse light tells more."""

LEAST_SHOWN = 0.3
"""Of a cloud whose density others are compared with."""

LARGELY_SEEN = 0.98
"""A cloud of which less is in view is flagged."""

UNEVEN = 0.2
"""Standard deviation of the spots that each light makes, as a share of an even part."""

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
    a cloud lies around the sightline at which the base faces the camera, or comes nearest to it; the diffuse light says
    how far the base is turned there, and both are averaged (`evidence_of`). Lights that are told have each their part
    of the cloud, half their angle at the surface off that sightline; lights that are not told apart are one mixture.

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
        ``wide`` where it is longer than `MOST_EXTENT`; ``base_unverified`` where no diffuse light is seen to tell;
        ``clouds_refused`` where another cloud of the frame gets no answer.
        The axis ratio, and the curvature's directions, hold for isotropic relief. Fails with ``no_estimate`` where no
        cloud has spots enough in view, or none that has tells the normal to `MOST_RMS`, beside an untold light, or
        where the diffuse light says that the base is turned from the lights there.
        """
        spots = find_spots(frame)
        if len(spots.peaks) < self.least_spots:
            return self._too_few(len(spots.peaks))
        groups = Groups.of(frame, spots, camera, priors)
        light, estimates, refused = DiffuseLight(frame), list[Estimate](), list[Failure]()
        least_seen = LEAST_VERIFIABLE if light.shows and not priors.plane else LEAST_IN_VIEW
        for cloud, own in zip(groups.clouds, groups.spots, strict=True):
            if len(own.peaks) >= self.least_spots and cloud.seen >= least_seen and groups.looks_in_view(cloud):
                made = _estimate(cloud, own, groups, priors, light)
                if isinstance(made, Failure):
                    refused.append(made)
                else:
                    estimates.append(made)
        if not estimates:
            return refused[0] if refused else self._none_whole(groups, least_seen)
        if refused:
            estimates = [replace(each, flags=(*each.flags, "clouds_refused")) for each in estimates]
        return sorted(estimates, key=lambda estimate: -len(_shape(estimate).points_px))

    def _too_few(self, count: int) -> Failure:
        what = "1 bright spot" if count == 1 else f"{count} bright spots"
        return Failure(Reason.NO_ESTIMATE, f"{what}: a cloud takes {self.least_spots}; a lone highlight is none")

    def _none_whole(self, groups: "Groups", least_seen: float) -> Failure:
        counts = [len(own.peaks) for own in groups.spots]
        largest = int(np.argmax(counts))
        seen = 100 * groups.clouds[largest].seen
        return Failure(
            Reason.NO_ESTIMATE,
            f"the largest cloud has {counts[largest]} spots and {seen:.0f} % of it in view: it takes "
            f"{self.least_spots}, {100 * least_seen:.0f} %, and its centre in view",
        )


cloud = CloudCentre()


def _shape(estimate: Estimate) -> CloudShape:
    assert estimate.cloud is not None
    return estimate.cloud


@dataclass(frozen=True)
class Groups:
    """The spots of a frame as clouds."""

    camera: Camera
    window: Window
    seen: Mask | None  # (H, W): the view; None: all of the frame
    clouds: tuple[Cloud, ...]
    spots: tuple[Spots, ...]  # of each cloud

    @classmethod
    def of(cls, frame: Frame, spots: Spots, camera: Camera, priors: Priors) -> "Groups":
        """Group spots into clouds.

        The share of an area that glints goes as the density of slopes, the number of its glints does not: bright ones
        merge. So each spot counts by its area.
        """
        window, weights = window_of(camera, spots_could_be_seen(frame)), spots.areas_px / spots.areas_px.mean()
        mixture = fit_mixture(camera.unproject(spots.points_px), window, _turns(priors), weights)
        owner = np.where(mixture.belongs.sum(axis=1) > 0.5, mixture.belongs.argmax(axis=1), -1)
        own = tuple(spots.of(owner == i) for i in range(len(mixture.clouds)))
        return cls(camera, window, frame.seen, mixture.clouds, own)

    def looks_in_view(self, cloud: Cloud) -> bool:
        """Return whether the pixel that a cloud's estimate looks at is in the view."""
        look_px = self.camera.project(cloud.sightline)
        if not (np.isfinite(look_px).all() and self.camera.contains(look_px)):
            return False
        size = self.camera.width, self.camera.height
        column, row = (min(int(v), most - 1) for v, most in zip(look_px, size, strict=True))
        return self.seen is None or bool(self.seen[row, column])

    @cached_property
    def _densest(self) -> float:
        """The density of the densest cloud that has spots enough and is seen enough to tell it; 0 if there is none."""
        told = [
            density_of(cloud)
            for cloud, own in zip(self.clouds, self.spots, strict=True)
            if len(own.peaks) >= LEAST_SPOTS and cloud.seen >= LEAST_SHOWN
        ]
        return max(told, default=0.0)

    def dimness(self, cloud: Cloud) -> float:
        """Return twice the log of the density of spots of the densest cloud over that of this one, at least 0."""
        return 2 * math.log(max(self._densest / density_of(cloud), 1.0))


def density_of(cloud: Cloud) -> float:
    """Return the density of a cloud's spots at its centre, up to a factor that all clouds of a frame share."""
    return cloud.share / max(cloud.seen, LEAST_SEEN) / math.sqrt(float(np.linalg.det(cloud.covariance)))


def _turns(priors: Priors) -> Turns:
    """Return where each light has its part of a cloud: on a plane, at L_perp / 2 d from the reversed normal."""
    if _is_at_camera(priors):
        return at_camera
    lights, twice = priors.lights, 2 * priors.distance.mean
    return lambda centre: lights @ basis_across(centre).T / twice


def _is_at_camera(priors: Priors) -> bool:
    """Return whether no light is told that lies beside the camera."""
    return not len(priors.lights) or not np.linalg.norm(priors.lights, axis=1).max() > 0


def _estimate(cloud: Cloud, spots: Spots, groups: Groups, priors: Priors, light: DiffuseLight) -> Estimate | Failure:
    """Return the estimate of one cloud, or why it says nothing of the base's normal."""
    camera, count = groups.camera, len(spots.points_px)
    independent = max(count / CLUMPING, LEAST_INDEPENDENT)
    sampling = sampling_covariance(cloud, groups.window, independent) * small_sample(independent)
    evidence = BaseEvidence(False) if priors.plane else evidence_of(cloud, light, priors)
    if evidence.shows:
        made = _on_tissue(cloud, sampling, evidence, groups.dimness(cloud), count, priors)
        if isinstance(made, Failure):
            return made
        cloud, normal, budget = made
        if not groups.looks_in_view(cloud):
            return _unstated(count, "the diffuse light says that its centre lies out of view")
    else:
        normal = -cloud.centre
        bends = np.zeros((2, 2)) if priors.plane else _bends(cloud, camera.unproject(spots.points_px), spots)
        budget = _budget(cloud, normal, {"relief": sampling, "shape": bends}, priors)
    lobe = LOBE_RAD2 if priors.lobe_curvature is None else exactly(1 / priors.lobe_curvature.mean)
    slope = slope_of(cloud.covariance, independent, lobe)
    shape = CloudShape(spots.points_px, cloud.covariance, independent, cloud.seen, lobe, slope)
    # The cloud is longest where the gain is smallest.
    vectors = np.linalg.eigh(cloud.covariance)[1][:, ::-1].T @ basis_across(cloud.centre)
    estimate = Estimate(
        normal=normal,
        candidates=normal[None],
        look_px=camera.project(cloud.sightline),
        axis_ratio=shape.axis_ratio,
        budget=budget,
        flags=_flags(cloud, shape, evidence, priors),
        curvature=EstimatedCurvature(vectors, shape.axis_ratio),
        target="base",
        cloud=shape,
    )
    return add_common_parts(estimate, camera, priors)


def _on_tissue(
    cloud: Cloud, sampling: Array, evidence: BaseEvidence, dimness: float, spots: int, priors: Priors
) -> tuple[Cloud, Array, Budget] | Failure:
    """Return a cloud on tissue moved to the base's highlight point, its normal and its budget.

    The spots say that the base faces the lights at the centre, the diffuse light how far it is turned there: both are
    averaged, weighted by their covariances. Where the gain allows it the centre moves to where the base faces the
    lights; along directions of a smaller gain the normal turns in its place.
    """
    half, turn = basis_across(cloud.centre), evidence.turn
    own, untold = spots_covariance(cloud, sampling, dimness), np.zeros((2, 2))
    if not priors.lights_mm:
        across = half @ basis_across(-cloud.centre).T
        untold = across @ light_offset_part(-cloud.centre, priors) @ across.T
    # A light beside the camera turns the normal at the spots by half of its angle, and the light by all of it.
    gap = own + small_sample(SECTORS) * evidence.covariance + untold
    if float(turn @ np.linalg.solve(gap, turn)) > chi_squared.quantile(CONFIDENCE, 2):
        off = math.degrees(float(np.linalg.norm(turn)))
        return _unstated(
            spots, f"the diffuse light says that the base is turned by {off:.0f} deg from facing the light"
        )
    # Far from facing the light its logarithm is no quadric.
    of_light = evidence.covariance + OWN_SHARE**2 * float(turn @ turn) * np.eye(2)
    weight = _positive(own - untold) @ np.linalg.inv(own + of_light + untold) if evidence.told else np.zeros((2, 2))
    rest, common = np.eye(2) - weight, np.eye(2) + weight
    parts = {"relief": rest @ own @ rest.T, "shape": weight @ of_light @ weight.T}
    rms = math.degrees(math.sqrt(float(np.trace(parts["relief"] + parts["shape"]))))
    if rms > MOST_RMS:
        return _unstated(spots, f"its normal would be known to {rms:.1f} deg")
    if untold.any():
        parts["light_offset"] = common @ untold @ common.T
    moved, normal = _turned(cloud, weight @ turn, evidence.gains, _turns(priors))
    across = basis_across(moved.centre) @ half.T
    parts = {name: across @ part @ across.T for name, part in parts.items()}
    return moved, normal, _budget(moved, normal, parts, priors)


def spots_covariance(cloud: Cloud, sampling: Array, dimness: float) -> Array:
    """Return the covariance of the base's turn at a cloud's centre as the spots tell it, shape (2, 2), rad^2.

    By the number of spots; by changes of curvature and folds; and since a base that nowhere faces the lights still
    glitters most where it comes nearest: by sqrt(2 ln(A_max / A)) of the relief's slope, A the density of spots.
    """
    extent = math.sqrt(float(np.trace(cloud.covariance)) / 2)
    slope = math.sqrt(TYPICAL_SLOPE * min(max(extent, SLOPES[0]), SLOPES[1]))
    relative = np.linalg.solve(cloud.covariance, sampling)
    share = CHANCE**2 * float(np.trace(relative)) / 2 + DIMMER**2 * dimness
    return (ASIDE**2 + slope**2 * share) * np.eye(2)


def _positive(matrix: Array) -> Array:
    """Return the nearest symmetric matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray(vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T)


def _turned(cloud: Cloud, turn: Array, gains: Array, turns: Turns) -> tuple[Cloud, Array]:
    """Return a cloud moved to where the base faces the lights, and the base's normal at its new sightline.

    `turn`, (2,): of the base's normal at the cloud from the reversed centre, rad.
    """
    half = basis_across(cloud.centre)
    values, vectors = np.linalg.eigh(gains)
    parts = vectors.T @ turn
    moves = values >= LEAST_GAIN
    way = vectors[:, moves] @ (parts[moves] / values[moves])
    left = vectors[:, ~moves] @ parts[~moves]
    centre = cloud.centre - way @ half
    centre /= np.linalg.norm(centre)
    across = basis_across(centre) @ half.T
    normal = left @ half - centre
    moved = replace(cloud, centre=centre, covariance=across @ cloud.covariance @ across.T, turns=turns(centre))
    return moved, np.asarray(normal / np.linalg.norm(normal))


def _unstated(spots: int, why: str) -> Failure:
    return Failure(Reason.NO_ESTIMATE, f"a cloud of {spots} spots states no normal: {why}")


def _extent(cloud: Cloud) -> float:
    """Return the longer semi-axis of a cloud, rad."""
    return float(np.sqrt(np.linalg.eigvalsh(cloud.covariance)[-1]))


def _bends(cloud: Cloud, sightlines: Array, spots: Spots) -> Array:
    """Return the covariance of a cloud's centre by changes of the base's gains inside it, shape (2, 2), rad^2.

    Where the density of spots is p(w), w the base's misfit and quadratic in x, the centroid is off by half of
    E[x |x|^2], x in extents of the cloud about the centroid. What N gaussian spots show of it by chance has a variance
    of 2 / N along each direction and is taken off. Tissue bends by `BENDS` at least, shown or not.
    """
    points, _ = cloud.coordinates(sightlines)
    front = np.asarray(np.isfinite(points).all(axis=1))
    points, spots = points[front], spots.of(front)
    if len(cloud.turns) > 1 or len(points) < LEAST_SPOTS:
        return np.asarray(BENDS**2 * cloud.covariance)
    weights = spots.areas_px / spots.areas_px.sum()
    gap = points - weights @ points
    x = np.linalg.solve(np.linalg.cholesky((weights * gap.T) @ gap), gap.T)
    off = (x * (x**2).sum(axis=0)) @ weights / 2
    excess = float(off @ off) / 2 - 2 * CLUMPING / len(points)
    return np.asarray(max(excess, 0.0) * cloud.covariance)


def _budget(cloud: Cloud, normal: Array, parts: dict[str, Array], priors: Priors) -> Budget:
    """Return the budget of a cloud's normal: parts across its centre, shape (2, 2), and the lights."""
    half = basis_across(cloud.centre)
    # The bases across a direction and its reverse are not the same.
    turn = basis_across(normal) @ half.T
    budget = {name: turn @ part @ turn.T for name, part in parts.items()}
    if not priors.lights_mm:
        budget.setdefault("light_offset", light_offset_part(normal, priors))
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
        if not evidence.told:
            flags.append("base_unverified")
    return tuple(flags)
