"""The base's normal over a patch of tissue, from highlights of many frames.

With the light at the camera, a highlight at a tissue point X shows that the fine normal there faces the camera; with
the light beside it, that the normal bisects the directions to both (theory.md section 7; the idea of Chen, Goesele and
Seidel 2006). A camera that moves sweeps highlights over the relief. Over a patch of the base, the mean of the normals
found is not the base's: only normals that face a camera are ever seen. So the density of the highlights, or of their
light, is fitted over the patch:

    log lambda_f(X) = alpha_f + o_f(X) + beta . q_f(X) - gamma |q_f(X)|^2 / 2,

q_f(X) the slope, over a reference plane, of the normal that mirrors the light to the camera of frame f. Slopes that are
Gaussian about the base's have gamma = 1/s^2 and beta = gamma q_base (theory.md 7.1). What was never looked at enters by
the integral of lambda over what was seen.

- Counted highlights: one alpha for all frames, and o = 0. The highlights are a Poisson process.
- Light: an alpha for each frame, since each may have its own exposure, and o = log(cos / r^4): the solid angle of the
  tissue at distance r and obliquity, and the falloff of light near the camera. Light has no melted and no missed spots.
  A smooth facet gives more of it, as its slope fills more of the patch: so the mean of all slopes of a patch counts,
  which is almost 0 over many waves of relief, and not the mean over its glints, whose number varies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simtest.errors import Failure, InputError, Reason
from simtest.estimators.sightings import Plane, Sighting, meet, plane_axes
from simtest.geometry import Array
from simtest.geometry.vectors import rotation, tangent_basis
from simtest.runtime.arrays import IntArray

RINGS = 12
"""Rings of the patch's quadrature, each of about one size of cells."""

CELLS = 7
"""Tissue cells across the patch. What one cell shows in all frames counts as one observation: frames see the same
relief again."""

LEAST_CELLS = 6.0
"""Fewer cells that share the highlights state no covariance."""

CHI95 = 5.991464547107979
"""Of two degrees of freedom."""

NEWTON_STEPS, CONVERGED = 60, 1e-9
REFITS = 2
"""Fits on a plane that faces as the last one found. Where a plane is told tilted, parts of the patch lie nearer or
farther than told, and the light's falloff turns the normal found by 2 s^2 of the tilt, s the slope seen, rad."""

POSE_DRAWS = 24
"""Fits with drawn errors of the poses."""


@dataclass(frozen=True)
class PatchNormal:
    """The base's normal over a patch.

    The part ``relief`` of the budget is a jackknife's over tissue cells, widened by Hotelling's 95 % quantile for so
    many cells; ``poses`` is what their stated errors do.

    Parameters
    ----------
    normal : ndarray, shape (3,)
        Unit, world frame.
    budget : dict of str to ndarray, shape (2, 2)
        Parts of the covariance of the angles along `tangents`, rad^2.
    tangents : ndarray, shape (2, 3)
        Unit vectors across the normal.
    slope : float
        Standard deviation of the slopes along one direction, rad: of the relief, with the lobe's own width.
    highlights : int
        Highlights in the patch, or blocks of pixels with their light.
    cells : float
        Tissue cells that share them evenly: (sum w)^2 / sum w^2.
    """

    normal: Array
    budget: dict[str, Array]
    tangents: Array
    slope: float
    highlights: int
    cells: float

    @property
    def covariance(self) -> Array:
        """Sum of the budget's parts, shape (2, 2), rad^2."""
        return np.asarray(sum(self.budget.values()))

    def across(self, normal: Array) -> Array:
        """Return another normal's angles along `tangents`, shape (2,), rad."""
        return np.asarray(self.tangents @ (normal / (normal @ self.normal)))

    def squared_mahalanobis(self, normal: Array) -> float:
        """Return the squared distance of another normal, in standard deviations, shape ()."""
        across = self.across(normal)
        return float(across @ np.linalg.solve(self.covariance, across))


@dataclass(frozen=True)
class _Points:
    """Points of the patch in frames: what their slopes are multiplied by, their weights, tissue cells and frames.

    `terms` holds q and -|q|^2/2, shape (N, 3). `weight` is the light of what was seen, and log of the offset of what
    was looked at.
    """

    terms: Array
    weight: Array
    cell: IntArray
    frame: IntArray


@dataclass(frozen=True)
class _Fitted:
    """The maximum: parameters (beta, gamma); rate and centred terms of what was looked at; the frames' mean terms."""

    parameters: Array
    rate: Array
    centred: Array
    mean: Array


def base_normal(
    sightings: Sequence[Sighting], plane: Plane, radius_mm: float, pose_sd: tuple[float, float] = (0.0, 0.0)
) -> PatchNormal | Failure:
    """Estimate the base's normal over the disc of a plane around its point.

    Parameters
    ----------
    sightings : sequence of Sighting
        Of the frames, with told poses: all with light (`light_of`), or all without.
    plane : Plane
        Where the base lies, coarsely; its point is the middle of the patch.
    radius_mm : float
        Of the patch, mm.
    pose_sd : tuple of float
        Standard deviations of the told poses, each frame's own: of the centre along each axis, mm, and of the turn
        about each axis, rad.

    Returns
    -------
    PatchNormal or Failure
        ``no_estimate`` where too few cells hold highlights, or the highlights do not get rarer away from any slope.

    Raises
    ------
    InputError
        If the radius is not positive, or only some of the sightings hold light.
    """
    if not radius_mm > 0:
        raise InputError(f"radius_mm = {radius_mm!r}: must be positive")
    with_light = sum(sighting.light is not None for sighting in sightings)
    if with_light not in (0, len(sightings)):
        raise InputError(f"sightings: {with_light} of {len(sightings)} hold light; must be all or none")
    found = _fit(sightings, plane, radius_mm)
    for _ in range(REFITS):
        if isinstance(found, Failure):
            return found
        plane = Plane(plane.point, found.normal)
        found = _fit(sightings, plane, radius_mm)
    if isinstance(found, Failure) or not any(pose_sd):
        return found
    # What errors of the poses do: fits with drawn ones.
    rng, drawn = np.random.default_rng(0), []
    for _ in range(POSE_DRAWS):
        moved = [_moved(each, rng, *pose_sd) for each in sightings]
        other = _fit(moved, plane, radius_mm)
        if isinstance(other, PatchNormal):
            drawn.append(found.across(other.normal))
    if len(drawn) < POSE_DRAWS // 2:
        return Failure(Reason.NO_ESTIMATE, f"errors of the poses leave {len(drawn)} of {POSE_DRAWS} fits")
    return replace(found, budget=found.budget | {"poses": np.cov(np.transpose(drawn))})


def _moved(sighting: Sighting, rng: np.random.Generator, centre_mm: float, turn_rad: float) -> Sighting:
    pose = sighting.world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ rotation(rng.normal(0, turn_rad, 3))
    pose[:3, 3] += rng.normal(0, centre_mm, 3)
    return replace(sighting, world_from_camera=pose)


def _fit(sightings: Sequence[Sighting], plane: Plane, radius_mm: float) -> PatchNormal | Failure:
    """Fit the density, with a covariance over tissue cells."""
    axes = plane_axes(plane)
    seen = _seen(sightings, plane, axes, radius_mm)
    shown = np.bincount(seen.cell, seen.weight, CELLS**2)
    held = float(shown.sum() ** 2 / (shown**2).sum()) if shown.any() else 0.0
    if held < LEAST_CELLS:
        filled = f"highlights fill {held:.1f} of the patch's {CELLS**2} cells"
        return Failure(Reason.NO_ESTIMATE, f"{filled}; must be {LEAST_CELLS:g} or more")
    looked = _looked(sightings, plane, axes, radius_mm)
    fitted = _maximise(seen, looked)
    if isinstance(fitted, Failure):
        return fitted
    # Scores by tissue cell: what one cell shows in all frames is one observation.
    score, own_information = np.zeros((CELLS**2, 3)), np.zeros((CELLS**2, 3, 3))
    np.add.at(score, seen.cell, seen.weight[:, None] * (seen.terms - fitted.mean[seen.frame]))
    np.add.at(score, looked.cell, -fitted.rate[:, None] * fitted.centred)
    weighted = fitted.rate[:, None, None] * fitted.centred[:, :, None] * fitted.centred[:, None, :]
    np.add.at(own_information, looked.cell, weighted)
    # As the estimate moves without the cell (jackknife): cells of much weight pull it towards themselves.
    try:
        moves = np.linalg.solve(weighted.sum(axis=0) - own_information, score[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return Failure(Reason.NO_ESTIMATE, "the highlights of one cell carry the whole estimate")
    spread = moves.T @ moves * _inflation(held)
    beta, gamma = fitted.parameters[:2], fitted.parameters[2]
    q = beta / gamma
    # q = beta/gamma; the derivative by (beta, gamma).
    by = np.array([[1, 0, -q[0]], [0, 1, -q[1]]]) / gamma
    normal = plane.normal + q @ axes
    length = np.linalg.norm(normal)
    normal /= length
    tangents = np.concatenate(tangent_basis(normal[None]))
    turn = tangents @ axes.T / length
    covariance = turn @ by @ spread @ by.T @ turn.T
    return PatchNormal(normal, {"relief": covariance}, tangents, float(gamma**-0.5), len(seen.cell), held)


def _seen(sightings: Sequence[Sighting], plane: Plane, axes: Array, radius_mm: float) -> _Points:
    """Return the highlights, or their light, in the patch."""
    terms, weights, cells = [np.empty((0, 3))], [np.empty(0)], [np.empty(0, dtype=np.int64)]
    frames = [np.empty(0, dtype=np.int64)]
    for number, sighting in enumerate(sightings):
        position, met = meet(sighting, plane)
        across = (position - plane.point) @ axes.T
        inside = met & (np.linalg.norm(np.where(met[:, None], across, np.inf), axis=1) < radius_mm)
        terms.append(_terms(sighting.facing(position[inside]), plane.normal, axes))
        light = sighting.light
        weights.append(np.ones(int(inside.sum())) if light is None else light[inside])
        cells.append(_cells(across[inside], radius_mm))
        frames.append(np.full(int(inside.sum()), 0 if light is None else number))
    return _Points(np.concatenate(terms), np.concatenate(weights), np.concatenate(cells), np.concatenate(frames))


def _looked(sightings: Sequence[Sighting], plane: Plane, axes: Array, radius_mm: float) -> _Points:
    """Return points of the patch that stand for equal areas, in each frame that sees them."""
    spots = _quadrature(radius_mm)
    world, own = plane.point + spots @ axes, _cells(spots, radius_mm)
    terms, offsets, cells, frames = [], [], [], []
    for number, sighting in enumerate(sightings):
        towards = sighting.world_from_camera[:3, 3] - world
        distance = np.linalg.norm(towards, axis=1)
        towards /= distance[:, None]
        cosine = towards @ plane.normal
        kept = cosine > 0
        if sighting.in_view is not None:
            kept &= np.asarray(sighting.in_view(-towards @ sighting.world_from_camera[:3, :3]))
        count = int(kept.sum())
        terms.append(_terms(sighting.facing(world[kept]), plane.normal, axes))
        is_light = sighting.light is not None
        offsets.append(np.log(cosine[kept]) - 4 * np.log(distance[kept]) if is_light else np.zeros(count))
        cells.append(own[kept])
        frames.append(np.full(count, number if is_light else 0))
    return _Points(np.concatenate(terms), np.concatenate(offsets), np.concatenate(cells), np.concatenate(frames))


def _inflation(cells: float) -> float:
    """Return Hotelling's 95 % quantile of two components over that of chi squared, for scores of so many cells."""
    return cells * (0.05 ** (-2 / (cells - 1)) - 1) / CHI95


def _terms(normals: Array, reference: Array, axes: Array) -> Array:
    """Return q and -|q|^2/2 of normals, shape (N, 3): what beta and gamma are multiplied by."""
    q = (normals @ axes.T) / (normals @ reference)[:, None]
    return np.concatenate([q, -np.sum(q * q, axis=1, keepdims=True) / 2], axis=1)


def _maximise(seen: _Points, looked: _Points) -> _Fitted | Failure:
    """Maximise the likelihood by Newton's method; it is concave.

    With each frame's alpha at its own maximum it is sum w terms . p - sum_f W_f log(sum exp(offset + looked . p)), W_f
    the weight of what frame f shows.
    """
    # A frame that shows nothing of the patch has no weight; one that shows what it cannot have looked at is no frame.
    count = 1 + int(max(seen.frame.max(initial=0), looked.frame.max(initial=0)))
    regarded = np.bincount(looked.frame, minlength=count) > 0
    weight = np.where(regarded[seen.frame], seen.weight, 0.0)
    shown = np.bincount(seen.frame, weight, count)
    total = weight @ seen.terms
    scale = np.maximum(np.abs(looked.terms).max(axis=0, initial=0.0), 1e-12)
    x = looked.terms / scale

    def at(p: Array) -> tuple[float, Array, Array, Array]:
        """Return the log likelihood, the rates, the terms less their frame's mean, and these means."""
        log_rate = looked.weight + x @ p
        most = np.full(count, -np.inf)
        np.maximum.at(most, looked.frame, log_rate)
        rate = np.exp(log_rate - most[looked.frame])
        sums = np.bincount(looked.frame, rate, count)
        rate *= (shown / np.where(regarded, sums, 1.0))[looked.frame]
        logs = np.where(regarded, np.log(np.where(regarded, sums, 1.0)) + np.where(regarded, most, 0.0), 0.0)
        moments = [np.bincount(looked.frame, rate * column, count) for column in x.T]
        mean = np.asarray(np.stack(moments, axis=1) / np.where(shown > 0, shown, 1.0)[:, None], dtype=float)
        return float(total / scale @ p - shown @ logs), rate, x - mean[looked.frame], mean

    p = np.zeros(3)
    value, rate, centred, mean = at(p)
    for _ in range(NEWTON_STEPS):
        information = (centred * rate[:, None]).T @ centred
        ridge = 1e-12 * np.trace(information) * np.eye(3)
        if not ridge.any():
            return Failure(Reason.NO_ESTIMATE, "the patch was not looked at")
        step = np.linalg.solve(information + ridge, total / scale - rate @ x)
        size = 1.0
        # Halve the step until it gains.
        while (tried := at(p + size * step))[0] < value - 1e-9 * abs(value) and size > 1e-6:
            size /= 2
        p = p + size * step
        value, rate, centred, mean = tried
        if np.abs(size * step).max() < CONVERGED:
            break
    if not p[2] > 0:
        return Failure(Reason.NO_ESTIMATE, "highlights get no rarer away from any slope: no centre of slopes was seen")
    return _Fitted(p / scale, rate, centred * scale, mean * scale)


def _quadrature(radius_mm: float) -> Array:
    """Return points of a disc that stand for equal areas, shape (N, 2), mm."""
    points = []
    for ring in range(RINGS):
        count = 2 * ring + 1
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        # Rings of 2 n + 1 cells have equal cells where their radii are spaced evenly; the mean square radius is exact.
        r = radius_mm / RINGS * np.sqrt(ring**2 + ring + 0.5)
        points.append(r * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points)


def _cells(points: Array, radius_mm: float) -> IntArray:
    """Return the number of the tissue cell that holds each point of the patch, shape (N,)."""
    at = np.clip(((points / radius_mm + 1) / 2 * CELLS).astype(np.int64), 0, CELLS - 1)
    return np.asarray(at[:, 0] * CELLS + at[:, 1])
