"""The parts of a budget that no highlight shows by itself: light, camera, falloff, near misses, the base's relief.

The picture itself does not show where the light is: on a plane 10 mm away, a light 1 mm beside the camera moves the
highlight by 2.8 deg and leaves its isophotes ellipses. No test of a fit finds that; only what is told of the rig does,
and what nobody told is a prior.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from simtest.calibration import CameraPrior, Distribution, Normal, Priors
from simtest.calibration.priors import AT_CAMERA_MM, OF_PICTURES
from simtest.estimators.budget import equivalent_covariance
from simtest.estimators.protocol import Estimate
from simtest.estimators.small_spots import GAUSSIAN_RADIUS2, HighlightAxis, smoothed_radius
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.lenses import undistort_with_errors
from simtest.geometry.vectors import basis_across, bisect, tangent_coordinates
from simtest.runtime import chi_squared
from simtest.runtime.fitted import fitted_number
from simtest.runtime.statistics import CONFIDENCE

SIDE = 40  # shares of the offset, and of the distance, that are combined; fewer would miss the tail of near surfaces

ANGLES = np.radians([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 89.0, 105.0, 120.0])
"""Sightline's angles from the optical axis; a fisheye's go beyond 90 deg, where the moves would lie along one line."""

GOLDEN = (np.sqrt(5.0) - 1) / 2
"""Step of the azimuths, as a share of the full circle: neighbours in the list point in different directions."""


@dataclass(frozen=True)
class LightTable:
    """Equivalent variances of the moves over the sightline's angle from the optical axis."""

    # along, across: (A,): variance towards the optical axis and perpendicular to it, rad^2, at each of `ANGLES`.
    along: Array
    across: Array

    def covariance(self, normal: Array, basis: Array) -> Array:
        """Return the covariance of a reversed sightline, shape (2, 2), rad^2, in a basis of its tangent plane."""
        # Scalars, since NumPy's functions take ten times as long on one number.
        x, y, z = normal.tolist()
        angle = math.atan2(math.hypot(x, y), -z)
        along, across = (float(np.interp(angle, ANGLES, values)) for values in (self.along, self.across))
        # the direction towards the optical axis; on the axis both variances are equal
        u, v = basis[:, 2].tolist()
        square = max(u * u + v * v, 1e-24)
        more = (along - across) / square
        return np.array([[across + more * u * u, more * u * v], [more * u * v, across + more * v * v]])


@lru_cache(maxsize=16)
def light_table(offset: Distribution, distance: Distribution) -> LightTable:
    """Tabulate the moves for priors of a light's offset across the optical axis and of the distance, mm.

    The light lies at an offset across the optical axis, in any direction, the surface at a distance along the
    sightline; the true normal bisects the directions to both (theory.md section 3, item 1). The sightline's angle from
    the optical axis alone changes the distribution of the moves, so a table over that angle holds it.
    """
    shares = (np.arange(SIDE) + 0.5) / SIDE
    o, d = (each.ravel() for each in np.meshgrid(offset.quantile(shares), distance.quantile(shares)))
    azimuth = 2 * np.pi * (np.arange(SIDE**2) * GOLDEN % 1.0)
    # Mirrored azimuths make the moves even about the sightline's meridian.
    lights = np.stack([o * np.cos(azimuth), o * np.sin(azimuth), np.zeros(SIDE**2)], axis=1)
    lights = np.concatenate([lights, lights * [1.0, -1.0, 1.0]])
    d = np.concatenate([d, d])
    variances = [np.diag(equivalent_covariance(_moves(angle, lights, d))) for angle in ANGLES.tolist()]
    along, across = np.array(variances).T
    return LightTable(along, across)


def _moves(angle: float, lights: Array, distance: Array) -> Array:
    """Return the moves of the normal at a sightline in the plane y = 0, shape (N, 2): along that plane and across."""
    sightline = np.array([np.sin(angle), 0.0, np.cos(angle)])
    to_light = lights - distance[:, None] * sightline
    normals = to_light / np.linalg.norm(to_light, axis=1)[:, None] - sightline
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    along, across = normals @ [np.cos(angle), 0.0, -np.sin(angle)], normals[:, 1]
    sine = np.hypot(along, across)
    scale = np.where(sine > 0, np.arctan2(sine, -normals @ sightline) / np.maximum(sine, 1e-300), 1.0)
    return np.stack([along, across], axis=1) * scale[:, None]


CROWD = 3
"""A frame with more highlights than this for each light shows relief or folds: a smooth patch shows one for each."""

WIDEST = OF_PICTURES.near_miss_sd**2
LEAST = np.radians(fitted_number("near_misses.least")) ** 2
SPREAD_PX, NARROWER = fitted_number("near_misses.spread"), fitted_number("near_misses.narrower")

LEAST_RADIUS_PX, DARK = 0.5, 0.1
"""Of a spot before smoothing; and least diffuse light over the frame's brightest highlight that tells a lobe's width:
bodies are not darker, but frames of the specular light alone are."""

APART = 3  # lights of a larger number are a ring, whose highlights melt: it counts as so many

SEVERAL = 0.5
"""Share of the variance under two or three lights. Which light made a highlight is then seldom known, and that error is
as large as the part of the budget that stands for it, or smaller, never several times larger: the sum of both parts
would hold 99 % and more."""


def near_miss_variance(patch: Patch, lights: int, of_few: float = 0.0) -> float:
    """Return the variance of a highlight's normal along each axis by the chance that it is a near miss, rad^2.

    Where a surface is rough or folded, a bright spot need not hold a point at which the normal bisects the directions
    to light and camera: a minimum of the misfit tau above 0 shines too (theory.md 7.1b). Such a near miss looks like
    any other spot, and the estimate is off by abs(tau) in an unknown direction. What the picture tells is its
    contrast c to the strongest channel of the body's diffuse light: with a Gaussian lobe of standard deviation s it is
    c0 exp(-tau^2 / (2 s^2)), and since a wide lobe spreads the same light over a larger angle, c0 = E / s^2. The miss

        tau^2 = 2 s^2 ln(E / (s^2 c))

    that a spot of contrast c can hide grows with the lobe's width until that dims the lobe's own peak to c. Whatever
    the width, it is at most 2 E / (e c), so that the variance goes with 1 / c, down to `LEAST`. Of a clipped one c
    is the least; a frame most of whose highlights are clipped has a lobe that is narrower still.

    `patch`: the highlight, with the frame's other ones; `lights`: how many lights there are, at least 1; `of_few`: what
    stands for `WIDEST`, rad, in a frame that does not show more than `CROWD` highlights for each light.
    """
    few = patch.others_px is not None and len(patch.others_px) + 1 <= CROWD * min(lights, APART)
    widest = of_few**2 if few else WIDEST
    if widest == 0:
        return 0.0
    share = SEVERAL if 1 < lights <= APART else 1.0
    return float(share * max((1 - NARROWER * patch.clipped_share) * widest / _contrast(patch), LEAST))


def _contrast(patch: Patch) -> float:
    """Return a highlight's height over the diffuse light beside it, before point spread and smoothing.

    Both dim a spot of few pixels.
    """
    radius, base = smoothed_radius(patch) or (math.inf, 0.0)
    size2 = max(radius**2 - GAUSSIAN_RADIUS2 * patch.smoothing_px**2, LEAST_RADIUS_PX**2)
    diffuse = max(patch.diffuse + base * patch.peak_value, DARK * max(*patch.others_value, patch.peak_value, 0.0))
    return (1 - base) * patch.peak_value / diffuse * (1 + SPREAD_PX**2 / size2)


def facing(sightline: Array, priors: Priors) -> float:
    """Return the largest angle, rad, between the normal facing a told light and the one bisecting it and the camera."""
    to_lights = priors.lights - priors.distance.mean * sightline
    cosines = -(to_lights @ sightline) / np.maximum(np.linalg.norm(to_lights, axis=-1), AT_CAMERA_MM)
    return float(np.arccos(np.clip(cosines, -1.0, 1.0)).max(initial=0.0)) / 2


NEAR_SHARE = 0.05
"""Share of the distances that are nearer than the one at which a told light's offset must be negligible."""

NEGLIGIBLE = 0.1  # a squared error below this share of the stated variance is left out

SPOT_SPREAD = math.radians(fitted_number("spots_on_relief.spread"))
SPOT_ONSET = math.radians(fitted_number("spots_on_relief.onset"))

STEEPER, FADES = fitted_number("steeper.share"), math.radians(fitted_number("steeper.fades"))
"""Highlights lie where a surface bends (theory.md 7.1), and pits and ridges are steep where they bend: all glints by
1.07 (colon), 1.80 (liver) and 2.42 times (stomach; 12,000 points of each relief, script not kept). A view that cuts a
cloud may also show its steep side alone. A plane shows the whole cloud of a relief that is alike everywhere, so that it
is 1 there."""

STEP_MM = 1e-3  # step of a light's position, mm, for the differences of the normal
SHARES = (np.arange(64) + 0.5) / 64  # at these shares a prior of one number is sampled

TILT = math.radians(10.0)
"""Standard deviation an axis of the angle between a falloff's axis and the optical axis: light guides beside an oblique
lens or with lenses of their own shine up to 25 deg aside."""

LEAST_COSINE = 0.1  # cosine of the angle from its axis down to which a falloff is followed; little light is left there

_LATTICE = (np.arange(64)[:, None] * [1, 41, 49, 37, 53] % 64 + 0.5) / 64
_TURNS = np.repeat(np.arange(4.0), 2)[:, None] + np.tile([0.5, -0.5], 4)[:, None] * _LATTICE[:, 2]
SAMPLES = np.tile(_LATTICE, (8, 1))
SAMPLES[:, 2] = _TURNS.ravel() / 4
"""Shares of the five priors of a falloff, shape (N, 5): a lattice that takes each 64th of each prior once.

The tilt's directions are mirrored and turned by quarters, so that the part turns with the picture.
"""

CAMERA_SAMPLES = np.tile((np.arange(128)[:, None] * [1, 79, 97, 73] % 128 + 0.5) / 128, (2, 1))
CAMERA_SAMPLES[128:, 2] = 1 - CAMERA_SAMPLES[128:, 2]
"""Shares of the four priors of a camera, shape (M, 4): a lattice, and the same mirrored at the centre's sightline."""


def add_untold_parts(
    estimate: Estimate, camera: Camera, priors: Priors, family: HighlightAxis | None = None
) -> Estimate:
    """Add what nobody told to the budget of a normal that is a reversed sightline.

    Where no light is told, it lies somewhere beside the camera: part ``light_offset``. Where lights are told, and all
    at the camera, there is no such part, unless their positions are told with a covariance. Where one is told
    elsewhere, half its angle at the surface is a known error of a reversed sightline, not a random one: the estimate
    gets the flag ``light_offset`` and states no uncertainty; `bisector` answers instead. Parts ``camera`` and
    ``response`` follow where the priors leave the camera's geometry or the falloff open, and ``shape`` grows where the
    highlight may be a near miss.

    An estimate without a covariance gets none of them. The highlight's moments say how far a falloff moves the peak,
    its patch whether it may be a near miss.
    """
    if priors.lights_mm:
        judged = _with_told_lights(estimate, priors)
        if judged.budget is not None and (part := mean_light_part(judged.normal, priors)) is not None:
            judged = judged.with_parts(light_offset=part)
        return add_common_parts(judged, camera, priors, family)
    if estimate.budget is None:
        return estimate
    estimate = estimate.with_parts(light_offset=light_offset_part(estimate.normal, priors))
    return add_common_parts(estimate, camera, priors, family)


def add_common_parts(
    estimate: Estimate, camera: Camera, priors: Priors, family: HighlightAxis | None = None
) -> Estimate:
    """Add the parts ``camera`` and ``response``, where the priors leave them open, and ``shape`` by near misses.

    The floors of a picture (`simtest.calibration.priors.Floors`) add to ``resolution`` and ``response``.

    An estimate without a budget stays without; so does one whose part ``camera`` cannot be computed.
    """
    if estimate.budget is None:
        return estimate
    parts: dict[str, Array] = {}
    if family is not None and not priors.plane:
        variance = near_miss_variance(family.patch, max(len(priors.lights_mm), 1), priors.open.near_miss_sd)
        if priors.open.off_peak > 0 and (score := family.patch.score) is not None:
            # The lower the score, the rather it is the maximum of a body's shading, which faces the light, or that of a
            # part of it which shadows cut off: along each axis as far again.
            variance += (1 - score) * facing(family.axis, priors) ** 2
        parts |= {"shape": variance * np.eye(2)} if variance > 0 else {}
    if not priors.camera.is_exact:
        if (turned := camera_part(estimate, camera, priors.camera)) is None:
            return estimate.without_uncertainty()
        parts["camera"] = turned
    if priors.falloff_power is not None and family is not None:
        parts["response"] = falloff_part(estimate.normal, family, priors.falloff_power, priors)
    if priors.open.feature_sd > 0:
        parts["resolution"] = priors.open.feature_sd**2 * np.eye(2)
    if priors.open.response_sd > 0 and family is not None:
        turn = basis_across(estimate.normal) @ family.basis.T
        moved = priors.open.response_sd**2 * turn @ family.seen_moments @ turn.T
        parts["response"] = parts.get("response", 0.0) + moved
    return estimate.with_parts(**parts)


def light_offset_part(normal: Array, priors: Priors) -> Array:
    """Return the covariance of a reversed sightline by a light that nobody told, shape (2, 2), rad^2."""
    table = light_table(priors.light_offset_mm, priors.distance)
    return table.covariance(normal, basis_across(normal))


def told_light_part(sightline: Array, normal: Array, light: Array, covariance: Array, distances: Array) -> Array:
    """Return the covariance of a normal that bisects the directions to the camera and to a light told with a spread.

    The normal turns by half the angle by which the light moves, as seen from the surface (theory.md section 3, item 1).

    `sightline`, `normal`, `light`, (3,): unit sightline and unit normal, camera frame; nominal position of the light,
    mm; `covariance`, (3, 3): of the light's position, mm^2; `distances`, (D,): distances of the surface along the
    sightline, mm, each as likely; the part is the mean over them. Returns (2, 2): rad^2, in the basis
    ``tangent_basis(normal)``.
    """
    across = basis_across(normal)
    position = distances[:, None] * sightline
    # central differences over a thousandth of a mm
    steps = STEP_MM * np.eye(3)[:, None, :]
    moved = bisect(position, light + steps) - bisect(position, light - steps)
    J = moved @ across.T / (2 * STEP_MM)  # (3, D, 2)
    return np.asarray(np.einsum("ida,ij,jdb->ab", J, covariance, J) / len(distances))


def mean_light_part(normal: Array, priors: Priors) -> Array | None:
    """Return `told_light_part` of a normal for the lights' mean position; None where the positions are exact.

    Errors of the lights are taken to be alike, as a wrong scale makes them. The sightline is the reversed normal, which
    changes the part by less than the square of the light's angle.
    """
    if priors.lights_covariance is None:
        return None
    light, covariance = priors.lights.mean(axis=0), priors.lights_covariance.mean(axis=0)
    return told_light_part(-normal, normal, light, covariance, priors.distance.quantile(SHARES))


def camera_part(estimate: Estimate, camera: Camera, prior: CameraPrior) -> Array | None:
    """Return the covariance of the normal by the camera's geometry, shape (2, 2), rad^2; None where it looks nowhere.

    The normal turns with the sightline that it looks along. At the pixel looked at, cameras drawn from the prior have
    other ones; those that see nothing there, past their lens's limit, never saw this highlight. Of a pinhole the mean
    square is computed, where a share s of its scale that is not known divides the pixels of the centre by 1 - s: that
    of 1 / (1 - s) is 1 + 3 s^2 to leading order.
    """
    look, sightline = estimate.look_px, camera.unproject(estimate.look_px)
    basis, focal = basis_across(estimate.normal), camera.K[:2, :2]
    if not np.isfinite(sightline).all():
        return None
    from_centre = look - [camera.cx, camera.cy]
    if camera.distortion is not None:
        scales, shifts, errors = _cameras(prior)
        # The centre's shifts are along and across the way from there, so that the part turns with the picture.
        along = from_centre / math.hypot(*from_centre) if from_centre.any() else np.array([1.0, 0.0])
        shifts = shifts @ np.array([along, [-along[1], along[0]]])
        points = np.asarray(np.linalg.solve(focal, ((from_centre - shifts) / scales).T).T, dtype=float)
        seen = undistort_with_errors(camera.distortion, points, errors, prior.edge_reach, sightline)
        moves = ((seen - sightline) @ basis.T)[np.isfinite(seen).all(axis=1)]
        if not len(moves):
            return None
        square, wide = moves.T @ moves / len(moves), equivalent_covariance(moves)
        return wide if np.trace(wide) > np.trace(square) else np.asarray(square)
    reach2 = float(np.sum(np.linalg.solve(focal, from_centre) ** 2))
    across = prior.distortion_sd * (reach2 - prior.edge_reach**2)
    outwards = prior.distortion_sd * (3 * reach2 - prior.edge_reach**2)
    along = np.outer(from_centre, from_centre)
    widened = 3 * (outwards**2 - across**2) * along / max(np.trace(along), 1e-12) + (1 + 3 * across**2) * np.eye(2)
    J = basis @ camera.step_of_pixels(look).T
    return np.asarray(J @ ((prior.focal_sd**2 + across**2) * along + prior.centre_sd_px**2 * widened) @ J.T)


@lru_cache(maxsize=16)
def _cameras(prior: CameraPrior) -> tuple[Array, Array, Array]:
    """Return drawn ratios of focal lengths, (M, 1), shifts of the centre, px, (M, 2), and radial errors, (M,)."""
    drawn = Normal(0.0, 1.0).quantile(CAMERA_SAMPLES)
    drawn /= np.sqrt(np.mean(drawn**2, axis=0))
    scales = np.maximum(1 + prior.focal_sd * drawn[:, :1], 0.3)
    return scales, prior.centre_sd_px * drawn[:, 1:3], prior.distortion_sd * drawn[:, 3]


def falloff_part(normal: Array, family: HighlightAxis, power: Distribution, priors: Priors) -> Array:
    """Return the covariance of the normal by a falloff cos^k that is left in the frame, shape (2, 2), rad^2.

    Its slope moves the peak by the lobe's moments 1/H times the slope (theory.md section 4). The moments are those as
    seen, so that highlights of few pixels get a little too much. The angle is that at the lens or, where lights beside
    it are given, as likely at one of them, from an axis that is tilted by `TILT`.
    """
    powers, axes = _falloffs(power, TILT)
    sightline, steps, place = family.axis, family.basis, family.axis[None]
    if priors.has_light_beside:
        # place and steps of the surface as seen from there, over its distance
        which = (SAMPLES[:, 3] * 2 * len(priors.lights)).astype(int)
        origins = np.concatenate([np.zeros_like(priors.lights), priors.lights])[which]
        place = sightline - origins / _distances(priors.distance)
        steps = steps - np.outer(steps @ normal / (sightline @ normal), sightline)
    squares = np.sum(place * place, axis=1, keepdims=True)
    reached = np.maximum(np.sum(place * axes, axis=1, keepdims=True), LEAST_COSINE * np.sqrt(squares))
    slopes = axes @ steps.T / reached - place @ steps.T / squares
    shift = basis_across(normal) @ family.basis.T @ family.seen_moments
    return equivalent_covariance(powers * slopes @ shift.T)


@lru_cache(maxsize=16)
def _falloffs(power: Distribution, tilt: float) -> tuple[Array, Array]:
    """Return the powers of drawn falloffs, shape (N, 1), and their unit axes, shape (N, 3)."""
    radius, angle = tilt * np.sqrt(-2 * np.log1p(-SAMPLES[:, 1])), 2 * np.pi * SAMPLES[:, 2]
    axes = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(len(radius))], axis=1)
    return power.quantile(SAMPLES[:, :1]), axes / np.linalg.norm(axes, axis=1, keepdims=True)


@lru_cache(maxsize=16)
def _distances(distance: Distribution) -> Array:
    """Return the distances of the surface from the lens in drawn falloffs, mm, shape (N, 1)."""
    return np.asarray(distance.quantile(SAMPLES[:, 4:]))


def to_base(estimate: Estimate, relief: Array) -> Estimate:
    """State the base's normal from a single highlight: the same normal, and the relief's part in its budget.

    The fine normal at a glint differs from the base's by the relief's slope there, which is a normal pair of standard
    deviation s an axis (theory.md 7.4); highlights lie a little wider (`SPOT_SPREAD`). An estimate that states the
    base's normal already is returned as it is; one without uncertainty still has none.
    """
    if estimate.target == "base":
        return estimate
    based = replace(estimate, target="base", region=None)
    return based if based.budget is None else based.with_parts(relief=relief)


def relief_part(priors: Priors) -> Array:
    """Return the covariance of a single highlight's normal about the base's, shape (2, 2), rad^2."""
    return _slope_variance(priors.relief_slope, priors.plane) * np.eye(2)


def _with_told_lights(estimate: Estimate, priors: Priors) -> Estimate:
    """Judge a reversed sightline by the told lights (see `add_untold_parts`)."""
    across = priors.lights @ basis_across(estimate.normal).T
    if np.linalg.norm(across, axis=1).max() < AT_CAMERA_MM:
        return estimate
    if estimate.covariance is not None:
        near = float(priors.distance.quantile(np.array(NEAR_SHARE)))
        # how far each light moves the normal from the reversed sightline
        bisectors = [bisect(-near * estimate.normal, light) for light in priors.lights]
        moved = np.array([tangent_coordinates(estimate.normal, each) for each in bisectors])
        if float(np.max(np.sum(moved**2, axis=1))) < NEGLIGIBLE * np.trace(estimate.covariance):
            return estimate
    return replace(estimate, flags=(*estimate.flags, "light_offset")).without_uncertainty()


@lru_cache(maxsize=16)
def _slope_variance(slope: Distribution, plane: bool) -> float:
    """Return the equivalent variance an axis of highlights' slopes, whose standard deviation follows from a prior.

    Of these pairs the share exp(-r^2 / 2 s^2) lies beyond r. Off a plane their slopes are steeper than the surface's.
    """
    s = slope.quantile(SHARES)
    if not s.max() > 0:
        return 0.0
    steeper = 1.0 if plane else STEEPER / np.hypot(1, s / FADES)
    s = np.hypot(steeper * s, SPOT_SPREAD * np.sqrt(-np.expm1(-((s / SPOT_ONSET) ** 2))))
    low, high = 0.0, 10 * float(s.max())
    # bisection for the radius that 5 % exceed
    for _ in range(60):
        r = (low + high) / 2
        beyond = float(np.mean(np.exp(-(r**2) / (2 * np.maximum(s, 1e-12) ** 2))))
        low, high = (r, high) if beyond > 1 - CONFIDENCE else (low, r)
    return high**2 / chi_squared.quantile(CONFIDENCE, 2)
