"""`cloud`: the base's normal from the cloud of highlights that relief makes of one (theory.md 7.1 and 7.5)."""

import math
from dataclasses import dataclass

import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors, exactly
from simtest.errors import Failure, Reason
from simtest.estimators.budget import CONFIDENCE, Budget, equivalent_covariance
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
from simtest.estimators.cloud_spots import find_spots
from simtest.estimators.prior_parts import add_camera_and_falloff, light_offset_part
from simtest.estimators.protocol import Estimate, EstimatedCurvature
from simtest.geometry import Array, Camera, chi_squared
from simtest.geometry.vectors import basis_across

LEAST_SPOTS = 6
"""A cloud of fewer spots gets no answer: a lone large highlight is a cloud of one."""

LEAST_IN_VIEW = 0.95
"""Nor does a cloud of which less is in view, whose centre would be a guess."""

LARGELY_SEEN = 0.98
"""A cloud of which less is in view is flagged."""

UNEVEN = 0.2
"""Standard deviation of the spots that each light makes, as a share of an even part."""

BENDS, BENDS_LONG = 0.35, 0.4
"""How far the centre may be off since the base's gains change inside the cloud, standard deviation as a share of the
cloud's extent: in any direction, and along a cloud that is longer than wide by what it is longer. Livers and colons
need as much; a plane, where it is told to be one, none."""

LEAST_INDEPENDENT = 2.5
"""Fewer independent spots state no extent at all."""

SHARES = (np.arange(32) + 0.5) / 32
"""At these shares a prior on the distance is sampled."""

ROUND_SIGMA = 2.0
"""A cloud is long where the log of its axis ratio is so many standard deviations off that of a round one."""


@dataclass(frozen=True)
class CloudCentre:
    """The centre of a cloud of spots carries the base's normal, where a single highlight carries the fine one.

    Spots are found in the frame (`cloud_spots`) and grouped into clouds (`cloud_mixture`). With the light at the camera
    a cloud lies around the sightline at which the base faces the camera. Lights that are told have each their part of
    the cloud, half their angle at the surface off that sightline; lights that are not told apart are one mixture.

    Parameters
    ----------
    least_spots : int
        A cloud of fewer gets no answer.
    """

    least_spots: int = LEAST_SPOTS

    def estimate_frame(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> list[Estimate] | Failure:
        """Estimate the base's normal of each cloud, that of most spots first (see `FrameEstimator`).

        Each estimate has ``target`` base and a `cloud`. Flags: ``anisotropic_or_curved`` where the cloud is longer than
        wide, which a curved base and an anisotropic relief do alike; ``cut`` where a part of it is out of view. The
        axis ratio, and the curvature's directions, hold for isotropic relief. Fails with ``no_estimate``
        where no cloud has spots enough in view.
        """
        spots = find_spots(frame)
        if len(spots.peaks) < self.least_spots:
            return self._too_few(len(spots.peaks))
        turns, window = _turns(priors), window_of(camera, frame.seen)
        mixture = fit_mixture(camera.unproject(spots.points_px), window, turns)
        owner = np.where(mixture.belongs.sum(axis=1) > 0.5, mixture.belongs.argmax(axis=1), -1)
        estimates = []
        for i, cloud in enumerate(mixture.clouds):
            own = spots.points_px[owner == i]
            if len(own) >= self.least_spots and cloud.seen >= LEAST_IN_VIEW and _is_in_view(cloud, camera, frame):
                estimates.append(_estimate(cloud, own, window, camera, priors))
        if not estimates:
            return self._none_whole(mixture, owner)
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


def _estimate(cloud: Cloud, points_px: Array, window: Window, camera: Camera, priors: Priors) -> Estimate:
    """Return the estimate of one cloud."""
    independent = max(len(points_px) / CLUMPING, LEAST_INDEPENDENT)
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
        budget=_budget(cloud, window, independent, priors),
        flags=_flags(cloud, shape),
        curvature=EstimatedCurvature(vectors, shape.axis_ratio),
        target="base",
        cloud=shape,
    )
    return add_camera_and_falloff(estimate, camera, priors)


def _budget(cloud: Cloud, window: Window, independent: float, priors: Priors) -> Budget:
    """Return the budget of a cloud's normal: the relief's chance, the base's bends, and the lights."""
    normal, half = -cloud.centre, basis_across(cloud.centre)
    # The bases across a direction and its reverse are not the same.
    turn = basis_across(normal) @ half.T
    sampling = sampling_covariance(cloud, window, independent) * small_sample(independent)
    bends = np.zeros((2, 2)) if priors.plane else BENDS**2 * cloud.covariance
    if not priors.plane and _is_long(cloud.covariance, independent):
        bends = bends + BENDS_LONG**2 * _longer(cloud.covariance)
    budget = {"relief": turn @ sampling @ turn.T, "shape": turn @ bends @ turn.T}
    if not priors.lights_mm:
        budget["light_offset"] = light_offset_part(normal, priors)
    elif not _is_at_camera(priors):
        # Lights may make different numbers of spots; the mean of all moves with the distance.
        spread = cloud.spread * UNEVEN**2 / len(cloud.turns)
        budget["light_offset"] = turn @ spread @ turn.T
        middle = half @ priors.lights.mean(axis=0) / 2
        moves = np.outer(1 / priors.distance.quantile(SHARES) - 1 / priors.distance.mean, turn @ middle)
        budget["distance"] = equivalent_covariance(moves)
    return budget


def _is_long(covariance: Array, independent: float) -> bool:
    """Return whether a cloud is longer than wide, beyond chance."""
    small, large = np.linalg.eigvalsh(covariance)
    # The log of a round cloud's axis ratio has a standard deviation of about 1 / sqrt(n).
    return bool(math.log(large / small) / 2 * math.sqrt(independent) > ROUND_SIGMA)


def _longer(covariance: Array) -> Array:
    """Return what a covariance has along its longer axis beyond a round one."""
    return np.asarray(covariance - np.linalg.eigvalsh(covariance)[0] * np.eye(2))


def small_sample(independent: float) -> float:
    """Return what a sampling covariance is multiplied by, so that its 95 % region holds 95 % of the errors.

    The extent is estimated from the same spots: Hotelling's T^2 of two dimensions, 2 (n - 1) / (n - 2) F(2, n - 2).
    """
    rest = max(independent - 2, 0.5)
    F = rest / 2 * ((1 - CONFIDENCE) ** (-2 / rest) - 1)
    return 2 * (independent - 1) / rest * F / chi_squared.quantile(CONFIDENCE, 2)


def _flags(cloud: Cloud, shape: CloudShape) -> tuple[str, ...]:
    flags = []
    if _is_long(cloud.covariance, shape.independent):
        flags.append("anisotropic_or_curved")
    if cloud.seen < LARGELY_SEEN:
        flags.append("cut")
    return tuple(flags)
