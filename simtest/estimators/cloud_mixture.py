"""A mixture of clouds over sightlines: gaussian each in its own tangent plane, cut by the view, with stray spots.

A cloud is a gaussian density of spots around the base's highlight point (theory.md 7.1). Only spots inside the view are
seen, so a cloud at its border is fitted as a truncated gaussian: its unseen part is what the model expects there.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from simtest.calibration.frame import median
from simtest.geometry import Array, Camera, Mask
from simtest.geometry.vectors import basis_across

MOST_CLOUDS = 6
STEPS, CLOSE = 80, 1e-4
"""Most steps of expectation and maximisation, and the gain in log likelihood for each spot that ends them."""

PARAMETERS = 6
"""Of a cloud: its share, centre and covariance."""

LEAST_HALF = 3
"""A cloud is not cut into parts of fewer spots."""

FIRST_STRAY, LEAST_STRAY = 0.02, 1e-4
"""Share of the spots that belong to no cloud: at first, and at least."""

LEAST_SEEN = 0.05
"""A cloud of which less is in view is not followed farther out."""

TYPICAL = math.radians(3.5)
PRIOR_WEIGHT = 2.0
"""A cloud's extent along one direction, rad, and how many spots this prior counts for: the slopes of tissue are 2 to 8
deg over gains of 0.5 to 3."""

CLUMPING = 1.1
"""Spots of one relief are not independent: so many of them tell what one independent spot does (theory.md 7.5)."""

LEAST_EXTENT = math.radians(0.3)
"""Of any cloud along any direction, rad."""

FRONT = 0.2
"""A sightline whose cosine with a cloud's centre is below this is not in its tangent plane."""

GRID = 32
"""Cells of the view along its longer side, over which densities are integrated."""


@dataclass(frozen=True)
class Window:
    """The view as cells: their sightlines, shape (M, 3), and solid angles, sr, shape (M,)."""

    sightlines: Array
    solid: Array

    @property
    def total(self) -> float:
        """Solid angle of the view, sr."""
        return float(self.solid.sum())


def window_of(camera: Camera, seen: Mask | None = None) -> Window:
    """Return the cells of a camera's view, or of the pixels of it that are seen."""
    step = max(camera.width, camera.height) / GRID
    columns, rows = (np.arange(step / 2, size, step) for size in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    if seen is not None:
        pixels = pixels[seen[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]]
    corners = [camera.unproject(pixels + half) for half in ((-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5))]
    across, down = corners[1] - corners[0], corners[3] - corners[2]
    solid = np.linalg.norm(np.cross(across, down), axis=1) * step**2
    sightlines = camera.unproject(pixels)
    sound = np.isfinite(sightlines).all(axis=1) & np.isfinite(solid)
    return Window(sightlines[sound], solid[sound])


Turns = Callable[[Array], Array]
"""Where each light has its part of a cloud: from a centre, shape (3,), the points of the plane across it at unit
distance, shape (L, 2), in ``basis_across(centre)``."""


def at_camera(centre: Array) -> Array:
    """Return the turns of one light at the camera."""
    return np.zeros((1, 2))


@dataclass(frozen=True)
class Cloud:
    """One cloud of a mixture; of several lights, a part alike for each."""

    # (3,): unit sightline around which the cloud of a light at the camera would lie: the reversed normal of the base.
    centre: Array
    # (2, 2): of each light's spots in the plane across `centre` at unit distance, in ``basis_across(centre)``.
    covariance: Array
    turns: Array  # (L, 2): centres of the lights' parts in that plane
    share: float  # of the spots that are seen
    seen: float = 1.0  # part of the cloud that lies in the view

    @property
    def sightline(self) -> Array:
        """Unit sightline of the mean of all parts."""
        middle = self.centre + self.turns.mean(axis=0) @ basis_across(self.centre)
        return np.asarray(middle / np.linalg.norm(middle))

    @property
    def spread(self) -> Array:
        """Covariance of the lights' parts, shape (2, 2)."""
        gap = self.turns - self.turns.mean(axis=0)
        return np.asarray(gap.T @ gap / len(gap))

    def coordinates(self, sightlines: Array) -> tuple[Array, Array]:
        """Return points of the tangent plane, shape (N, 2), and the cosines with the centre, shape (N,).

        Points that are not in front have NaN.
        """
        cosine = sightlines @ self.centre
        points = sightlines @ basis_across(self.centre).T / np.where(cosine > FRONT, cosine, np.nan)[:, None]
        return points, cosine

    def densities(self, sightlines: Array) -> Array:
        """Return the density of each light's part, for each unit of solid angle, shape (N, L); their sum is the cloud.

        That of the whole cloud is 1 in all.
        """
        points, cosine = self.coordinates(sightlines)
        gap = points[:, None] - self.turns
        distance2 = np.einsum("nli,ij,nlj->nl", gap, np.linalg.inv(self.covariance), gap)
        scale = 2 * np.pi * np.sqrt(np.linalg.det(self.covariance)) * len(self.turns)
        value = np.exp(-distance2 / 2) / scale
        # A unit of solid angle covers 1 / cosine^3 of the plane.
        area = np.where(cosine > FRONT, cosine, 1.0) ** 3
        return np.asarray(np.where(np.isfinite(value), value / area[:, None], 0.0))


@dataclass(frozen=True)
class Mixture:
    """Clouds, and the share of stray spots.

    `belongs` holds the probability that each spot is of each cloud, shape (N, K); `score` is what clouds are counted
    by: the log likelihood of independent spots less half the number of parameters times the log of their number.
    """

    clouds: tuple[Cloud, ...]
    stray: float
    belongs: Array
    score: float


def fit_mixture(sightlines: Array, window: Window, turns: Turns = at_camera, weights: Array | None = None) -> Mixture:
    """Fit as many clouds as the spots tell apart, at least one.

    `sightlines`, (N, 3): unit, of the spots; `window`: the view; `turns`: where each light has its part of a cloud;
    `weights`, (N,): how many independent spots each counts for, default one.
    """
    if weights is None:
        weights = np.ones(len(sightlines))
    best = current = _fit([_cloud_of(sightlines, weights, turns)], sightlines, weights, window, turns)
    while len(current.clouds) < MOST_CLOUDS:
        # Split each cloud in turn, and keep the best of the mixtures with one more.
        starts = [_split(current, i, sightlines, weights, turns) for i in range(len(current.clouds))]
        tries = [_fit(start, sightlines, weights, window, turns) for start in starts if start is not None]
        if not tries:
            break
        current = max(tries, key=lambda mixture: mixture.score)
        if current.score > best.score:
            best = current
        elif len(current.clouds) > len(best.clouds) + 1:
            break
    return best


def _cloud_of(sightlines: Array, weights: Array, turns: Turns, share: float = 1.0) -> Cloud:
    """Return the cloud of spots that all belong to it and are all that there is."""
    mean = weights @ sightlines
    centre = mean / np.linalg.norm(mean)
    # The spots' mean is that of the lights' parts.
    shifted = centre - turns(centre).mean(axis=0) @ basis_across(centre)
    cloud = Cloud(shifted / np.linalg.norm(shifted), np.eye(2) * TYPICAL**2, turns(centre), share)
    points, _ = cloud.coordinates(sightlines)
    front = _sound_rows(points)
    points, weights = points[front] - cloud.turns.mean(axis=0), weights[front]
    count = float(weights.sum())
    return replace(cloud, covariance=_sound((weights * points.T) @ points - count * cloud.spread, count))


def _sound(square: Array, count: float) -> Array:
    """Return the covariance of a sum of squares of so many points, with the prior's share, not below the least."""
    covariance = (square + PRIOR_WEIGHT * TYPICAL**2 * np.eye(2)) / (count + PRIOR_WEIGHT)
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(vectors @ np.diag(np.maximum(values, LEAST_EXTENT**2)) @ vectors.T)


def _split(mixture: Mixture, index: int, sightlines: Array, weights: Array, turns: Turns) -> list[Cloud] | None:
    """Return the clouds with one of them cut in two across its longest direction; None where it holds too few."""
    points, _ = mixture.clouds[index].coordinates(sightlines)
    own = (mixture.belongs.argmax(axis=1) == index) & np.isfinite(points).all(axis=1)
    if np.count_nonzero(own) < 2 * LEAST_HALF:
        return None
    cloud = mixture.clouds[index]
    coordinate = points @ np.linalg.eigh(cloud.covariance + cloud.spread)[1][:, 1]
    upper = coordinate > median(coordinate[own])
    halves = [own & upper, own & ~upper]
    if min(np.count_nonzero(half) for half in halves) < LEAST_HALF:
        return None
    parts = [_cloud_of(sightlines[half], weights[half], turns, cloud.share / 2) for half in halves]
    return [other for i, other in enumerate(mixture.clouds) if i != index] + parts


def _fit(clouds: list[Cloud], sightlines: Array, weights: Array, window: Window, turns: Turns) -> Mixture:
    """Fit clouds from a start by expectation and maximisation."""
    stray, last, total, count = FIRST_STRAY, -np.inf, sum(cloud.share for cloud in clouds), float(weights.sum())
    clouds = [replace(cloud, share=(1 - stray) * cloud.share / total) for cloud in clouds]
    for step in range(STEPS + 1):
        # expectation, by densities of what is seen; it comes last too, so that all that is returned is of one fit
        inside = [cloud.densities(window.sightlines) * window.solid[:, None] for cloud in clouds]
        seen = [min(max(float(part.sum()), LEAST_SEEN), 1.0) for part in inside]
        joint = [c.share * c.densities(sightlines) / z for c, z in zip(clouds, seen, strict=True)]
        whole = sum(part.sum(axis=1) for part in joint) + stray / window.total
        value = float(weights @ np.log(whole))
        if value - last < CLOSE * count or step == STEPS:
            break
        last = value
        # maximisation
        belongs = [part * (weights / whole)[:, None] for part in joint]
        stray = max(1 - sum(float(part.sum()) for part in belongs) / count, LEAST_STRAY)
        clouds = [
            _moved(cloud, part, count, sightlines, window, cells, turns)
            for cloud, part, cells in zip(clouds, belongs, inside, strict=True)
        ]
    # As many equal spots tell as much as these do.
    equal = count**2 / float(weights @ weights) / CLUMPING
    score = value * equal / count - PARAMETERS / 2 * len(clouds) * math.log(max(equal, 2.0))
    # The prior on the extents keeps a cloud from shrinking onto a few spots.
    score += sum(_prior(cloud) for cloud in clouds)
    finished = tuple(replace(cloud, seen=z) for cloud, z in zip(clouds, seen, strict=True))
    return Mixture(finished, stray, np.stack([part.sum(axis=1) / whole for part in joint], axis=1), score)


def _prior(cloud: Cloud) -> float:
    """Return the log of the extents' prior, an inverse Wishart density, over that at the typical extent."""
    shrunk = np.linalg.inv(cloud.covariance) * TYPICAL**2
    return PRIOR_WEIGHT * (math.log(float(np.linalg.det(shrunk))) - float(np.trace(shrunk)) + 2) / 2


def _moved(
    cloud: Cloud, belongs: Array, total: float, sightlines: Array, window: Window, inside: Array, turns: Turns
) -> Cloud:
    """Return a cloud after one step: by the moments of its spots and of the part of it that is out of view.

    `belongs` holds the probability that each spot is of each light's part, shape (N, L), `inside` the cloud's part in
    each cell of the view and of each light, shape (M, L).
    """
    count = float(belongs.sum())
    if count < LEAST_HALF:
        return replace(cloud, share=max(count, 1e-3) / total)
    mean, square = _moments(cloud, sightlines, belongs / count)
    # what is out of view: the whole cloud less its part in view
    z = min(max(float(inside.sum()), LEAST_SEEN), 1.0)
    if inside.sum() < 1:
        in_mean, in_square = _moments(cloud, window.sightlines, inside)
        mean, square = z * mean - in_mean, z * square + cloud.covariance - in_square
    covariance = _sound(count * (square - np.outer(mean, mean)), count)
    # The new centre, and the covariance in its own basis.
    basis = basis_across(cloud.centre)
    centre = cloud.centre + mean @ basis
    centre /= np.linalg.norm(centre)
    turn = basis_across(centre) @ basis.T
    return Cloud(centre, turn @ covariance @ turn.T, turns(centre), count / total)


def _moments(cloud: Cloud, sightlines: Array, weights: Array) -> tuple[Array, Array]:
    """Return weighted sums of the points about their light's part, shape (2,), and of their squares, shape (2, 2)."""
    points, _ = cloud.coordinates(sightlines)
    gap = np.where(np.isfinite(points), points, 0.0)[:, None] - cloud.turns
    weights = np.where(_sound_rows(points)[:, None], weights, 0.0)
    return np.einsum("nl,nli->i", weights, gap), np.einsum("nl,nli,nlj->ij", weights, gap, gap)


def _sound_rows(points: Array) -> Mask:
    """Return which points, shape (N, 2), are in front."""
    return np.asarray(np.isfinite(points).all(axis=1))


def sampling_covariance(cloud: Cloud, window: Window, count: float) -> Array:
    """Return the covariance of a cloud's centre from so many independent spots in view, shape (2, 2), rad^2.

    By the Fisher information of a gaussian of unknown extent that the view cuts: of a whole one C / n. The parts of
    several lights count to the extent, as if they were not told apart.
    """
    whole = replace(cloud, covariance=cloud.covariance + cloud.spread, turns=cloud.turns.mean(axis=0)[None])
    cells, _ = whole.coordinates(window.sightlines)
    sound = _sound_rows(cells)
    scale = np.sqrt(np.diag(whole.covariance))
    x, y = (np.where(sound[:, None], cells - whole.turns[0], 0.0) / scale).T
    share = whole.densities(window.sightlines)[:, 0] * window.solid * sound
    if not share.sum() > 0:
        return np.asarray(whole.covariance)
    share /= share.sum()
    # Sufficient statistics, in units of the extent.
    T = np.stack([x, y, x**2, x * y, y**2])
    gap = T - (T @ share)[:, None]
    inverse = np.linalg.pinv((gap * share) @ gap.T, rcond=1e-9, hermitian=True)[:2, :2]
    C = whole.covariance / scale
    return np.asarray(C @ inverse @ C.T / count)
