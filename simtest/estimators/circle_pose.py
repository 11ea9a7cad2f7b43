"""`circle_pose`: the published reconstruction [MB, section 2.3] of one isovalue, and its region on a plane."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CIRCLE_POSE_ISOVALUE
from simtest.errors import Failure
from simtest.estimators.budget import gram
from simtest.estimators.family import IsophoteFamily
from simtest.estimators.highlight import fit_small, isophote_of_each
from simtest.estimators.isophotes import FittedIsophote
from simtest.estimators.protocol import Estimate, Law
from simtest.geometry import Array, Camera, CirclePoses, Mask, Patch, circle_poses
from simtest.geometry.cones import PoseRegion
from simtest.geometry.patch import slope_divisor_px2

STEP = 1e-5  # step of the differences between conic and ellipse, as a share of the largest of their parameters

POOLED_ISOVALUES = (0.1, 0.2, 0.3)
"""Low ones: the distance of the circles' projected centres grows with the square of the isophote's size."""

CLEAR_MARGIN = 3.0  # where the isovalue's own choice is as clear as this, in standard deviations, no others are used

AMBIGUOUS_MARGIN = 2.0

MIN_SEPARATION = 0.35
"""A circle's peak lies at one centre, not half-way: below this share of the centres' distance the lead is no choice."""


@dataclass(frozen=True)
class _Choice:
    """Which candidate each of N highlights prefers."""

    lead: Array  # (N,): how much nearer to the peak N+'s projected centre is than N-'s, px
    apart: Array  # (N,): distance of the two centres, px
    deviation: Array  # (N,): standard deviation of the lead, px; NaN where the noise is not known

    @property
    def margin(self) -> Array:
        """How clear the choice is, in standard deviations; NaN where the noise is not known."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self.deviation > 0, np.abs(self.lead) / self.deviation, np.nan))

    @property
    def is_degenerate(self) -> Mask:
        """Whether the peak is at neither centre, or the centres are too near to each other to tell."""
        return np.asarray(
            (np.abs(self.lead) < MIN_SEPARATION * self.apart) | (self.apart < CLEAR_MARGIN * self.deviation)
        )


@dataclass(frozen=True)
class CirclePoseEstimator:
    """The normal of a plane from one isophote, taken as the image of a circle.

    The article leaves the choice between N+ and N- to a person. Both make the same angle with the cone's axis, so the
    one is proposed whose projected circle centre (along C'^-1 N) is nearer to the sub-pixel peak. Where that is not
    clear at the isovalue, lower ones are used as well; the pose stays that of the isovalue.

    Parameters
    ----------
    isovalue : float
        t in (0, 1).
    with_region : bool
        Whether estimates on planes state a region; it takes longer than all else together.
    """

    isovalue: float = CIRCLE_POSE_ISOVALUE
    with_region: bool = True
    laws: ClassVar[tuple[Law, ...]] = ("circle_pose", "axis_ratio_seen")

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`); of the priors `plane` alone is used.

        The estimate has two candidates and looks at the projected circle centre. `choice_margin` is the difference of
        the two distances over its standard deviation, where the noise is known. Flags: ``ambiguous`` where that is
        below 2; ``near_degenerate`` where the peak is nearer to the middle than to either centre, or noise hides the
        centres' distance: usually the light is at the camera, and the two-fold model does not apply. `region` holds the
        normals that the isophote's noise allows: about both candidates, which near the branch point are one region. It
        is stated only where the surface is known to be a plane: on a curved one the isophote is no circle, and the
        normal is off by tens of degrees (theory.md section 4), whatever the light. Fails with
        ``unresolved`` where a highlight is too small for its isophotes to carry its shape.
        """
        return self.estimate_batch([patch], camera, priors)[0]

    def estimate_batch(
        self, patches: Sequence[Patch], camera: Camera, priors: Priors = NO_PRIORS
    ) -> list[Estimate | Failure]:
        """Estimate several normals at once, many times faster than one by one where regions are left out."""
        small = fit_small(patches, camera)
        resolved = [patch if spot is None else spot.no_shape for patch, spot in zip(patches, small, strict=True)]
        fitted = isophote_of_each(resolved, camera, self.isovalue)
        pairs = zip(patches, fitted, strict=True)
        pending = [(patch, isophote) for patch, isophote in pairs if not isinstance(isophote, Failure)]
        posed = zip(pending, _pose(pending, camera), strict=True)
        made = (self._stated(result, patch, camera, priors) for (patch, _), result in posed)
        return [isophote if isinstance(isophote, Failure) else next(made) for isophote in fitted]

    def _stated(self, result: Estimate | Failure, patch: Patch, camera: Camera, priors: Priors) -> Estimate | Failure:
        """Add the region, where it is wanted and the surface is known to be a plane."""
        if isinstance(result, Failure) or not self.with_region or not priors.plane:
            return result
        return replace(result, region=pose_region(patch, camera, result.isophotes[0]))


circle_pose = CirclePoseEstimator()


def _pose(fitted: Sequence[tuple[Patch, FittedIsophote]], camera: Camera) -> list[Estimate | Failure]:
    """Return the estimates of fitted isophotes, without regions."""
    if not fitted:
        return []
    # candidates: the two poses of each cone, and where they project their circle's centre
    poses = _poses([isophote for _, isophote in fitted])
    looks = camera.project(poses.centres)
    patches = [patch for patch, _ in fitted]
    # choice: the centre nearer to the peak
    noise = _peak_deviation(patches, [isophote for _, isophote in fitted], poses, camera)
    choice = _choose(patches, looks, noise)
    choice = _pooled(choice, patches, poses, camera, noise)
    # the chosen candidate first
    order = np.where(choice.lead >= 0, 0, 1)[:, None] ^ np.array([[0, 1]])
    normals = np.take_along_axis(poses.normals, order[:, :, None], axis=1)
    looks = np.take_along_axis(looks, order[:, :, None], axis=1)
    margins, degenerate = choice.margin, choice.is_degenerate
    made: list[Estimate | Failure] = []
    for i, (_, isophote) in enumerate(fitted):
        margin = float(margins[i]) if np.isfinite(margins[i]) else None
        flags = ("ambiguous",) if margin is not None and margin < AMBIGUOUS_MARGIN else ()
        estimate = Estimate(
            normals[i, 0], normals[i], looks[i, 0], float(poses.axis_ratios[i]), (isophote,), margin,
            flags=(*flags, "near_degenerate") if degenerate[i] else flags,
        )  # fmt: skip
        made.append(poses.failures.get(i) or estimate)
    return made


def _poses(isophotes: Sequence[FittedIsophote]) -> CirclePoses:
    return circle_poses(np.array([i.cone for i in isophotes]), np.array([i.sightline for i in isophotes]))


def _choose(patches: Sequence[Patch], looks: Array, deviation: Array) -> _Choice:
    """Compare the distances of the projected centres, shape (N, 2, 2), px, from the peaks."""
    gaps = np.linalg.norm(looks - np.array([patch.peak_px for patch in patches])[:, None], axis=2)
    apart = np.linalg.norm(looks[:, 0] - looks[:, 1], axis=1)
    return _Choice(gaps[:, 1] - gaps[:, 0], apart, deviation)


def _pooled(choice: _Choice, patches: Sequence[Patch], poses: CirclePoses, camera: Camera, deviation: Array) -> _Choice:
    """Add lower isovalues one by one until the choice is clear; leads are averaged, since their noise is the peak's."""
    lead, apart, count = choice.lead.copy(), choice.apart.copy(), np.ones(len(patches))
    for isovalue in POOLED_ISOVALUES:
        asked = np.flatnonzero(~(choice.margin >= CLEAR_MARGIN))
        if not len(asked):
            break
        fitted = isophote_of_each([patches[i] for i in asked.tolist()], camera, isovalue)
        sound = [(i, found) for i, found in zip(asked.tolist(), fitted, strict=True) if not isinstance(found, Failure)]
        if not sound:
            continue
        # candidates at this isovalue, in the order of the isovalue's own
        own = _poses([found for _, found in sound])
        here = np.array([i for i, _ in sound])  # indices among all highlights
        # The candidate that continues N+ is the nearer one of the two.
        nearness = np.einsum("nkj,nj->nk", own.normals, poses.normals[here, 0])
        order = np.where(nearness[:, 0] >= nearness[:, 1], 0, 1)[:, None] ^ np.array([[0, 1]])
        looks = np.take_along_axis(camera.project(own.centres), order[:, :, None], axis=1)
        lower = _choose([patches[i] for i in here.tolist()], looks, deviation[here])
        # pool what is usable
        usable = np.isfinite(lower.lead) & np.array([k not in own.failures for k in range(len(here))])
        here = here[usable]
        lead[here] += lower.lead[usable]
        apart[here] += lower.apart[usable]
        count[here] += 1
        choice = _Choice(lead / count, apart / count, deviation)
    return choice


def _peak_deviation(
    patches: Sequence[Patch], isophotes: Sequence[FittedIsophote], poses: CirclePoses, camera: Camera
) -> Array:
    """Return the standard deviation of the lead, px, shape (N,): twice that of the peak along the line of the centres.

    The smoothed noise's slope over the lobe's second derivative at its peak, I0 (-2 ln t) / r^2, r the isophote's
    radius along the line, is the peak's shift.
    """
    known = np.array([p.noise_at_peak for p in patches], dtype=float)  # NaN where it is not known
    divisor = slope_divisor_px2([p.smoothing_px for p in patches])
    height = np.array([p.peak_value for p in patches])
    # shift of the peak: noise slope over the lobe's curvature
    level = -2 * np.log([isophote.isovalue for isophote in isophotes])
    ends = camera.project(np.stack([poses.axes + poses.narrow, poses.axes - poses.narrow]))
    radius = np.linalg.norm(ends[0] - ends[1], axis=1) / 2
    return np.asarray(2 * known / divisor * radius**2 / (height * level))


def pose_region(patch: Patch, camera: Camera, isophote: FittedIsophote) -> PoseRegion | None:
    """Compute the normals that an isophote's noise allows to a circle; None where the noise is not known.

    Smoothing and the contour's linear interpolation widen the ellipse equally in all directions of the image (theory.md
    section 4). That is subtracted; else the region would lie about the normals of another cone.
    """
    pose = isophote.pose()
    if patch.noise is None or isinstance(pose, Failure):
        return None
    try:
        return _region(IsophoteFamily.of(patch, camera, [isophote], [pose]))
    except np.linalg.LinAlgError:
        # The crossings do not determine the conic.
        return None


def _region(family: IsophoteFamily) -> PoseRegion | None:
    conic, noise = family.conics[0], gram(family.moved_by_noise(np.eye(5)[None]))  # as seen, after smoothing
    # the ellipse before smoothing: same centre, smaller moments
    shrink = np.append(np.zeros(2), -(family.added_px2(family.levels)[0] * family.px2)[np.triu_indices(2)])
    ellipse, turn = _ellipse(conic), _jacobian(_ellipse, conic)
    own = ellipse + shrink
    if np.linalg.eigvalsh(_matrix(own))[0] <= 0:
        return None
    # its conic's covariance, from that of the smoothed one
    back = _jacobian(_conic, own) @ turn
    covariance = back @ noise @ back.T
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        # Without noise the region is its two members alone.
        return None
    region = PoseRegion(np.concatenate([family.basis, family.axis[None]]), _conic(own), covariance)
    return region if np.isfinite(region.statistic(family.poses[0].normals)).all() else None


def _ellipse(conic: Array) -> Array:
    """Return centre and second moments (x, y, xx, xy, yy) of (a, b, c, d, e), shape (..., 5)."""
    a, b, c, d, e = np.moveaxis(conic, -1, 0)
    determinant = 4 * a * c - b * b
    x, y = (b * e - 2 * c * d) / determinant, (b * d - 2 * a * e) / determinant
    scale = 2 * (1 + a * x * x + b * x * y + c * y * y) / determinant
    return np.stack([x, y, 2 * c * scale, -b * scale, 2 * a * scale], axis=-1)


def _conic(ellipse: Array) -> Array:
    """Return (a, b, c, d, e) of centre and second moments: the inverse of `_ellipse`."""
    x, y, xx, xy, yy = np.moveaxis(ellipse, -1, 0)
    determinant = xx * yy - xy * xy
    a, half, c = yy / determinant, -xy / determinant, xx / determinant
    dx, dy = a * x + half * y, half * x + c * y
    return np.stack([a, 2 * half, c, -2 * dx, -2 * dy], axis=-1) / (1 - x * dx - y * dy)[..., None]


def _matrix(ellipse: Array) -> Array:
    xx, xy, yy = ellipse[2:]
    return np.array([[xx, xy], [xy, yy]])


def _jacobian(function: Callable[[Array], Array], at: Array) -> Array:
    """Compute a function's derivatives by central differences, shape (5, 5)."""
    step = STEP * np.abs(at).max()
    steps = step * np.eye(5)
    return np.asarray((function(at + steps) - function(at - steps)).T / (2 * step))
