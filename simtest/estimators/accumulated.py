"""Highlights of many frames, accumulated on the tissue: a map of fine normals, and the base's normal by patches.

With the light at the camera, a highlight at a tissue point X shows that the fine normal there faces the camera
(theory.md section 7; the idea of Chen, Goesele and Seidel 2006). A camera that moves sweeps highlights over the relief.
Over a patch of the base, the mean of the normals found is not the base's: only normals that face a camera are ever
seen. So the highlights are taken as a Poisson process over the patch. Its density in each frame follows the slope that
a highlight takes at X:

    log lambda_f(X) = alpha + beta . q_f(X) - gamma |q_f(X)|^2 / 2,

q_f(X) the slope, over a reference plane, of the normal that faces the camera of frame f. Slopes that are Gaussian
about the base's have gamma = 1/s^2 and beta = gamma q_base (theory.md 7.1). What was never looked at enters by the
integral of lambda over what was seen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.errors import Failure, Reason
from simtest.geometry import Array
from simtest.geometry.vectors import rotation, tangent_basis
from simtest.runtime.arrays import IntArray, Mask

RINGS = 9
"""Rings of the patch's quadrature, each of about one size of cells."""

CELLS = 7
"""Tissue cells across the patch. Highlights of one cell, in all frames, count as one observation: frames see the same
relief again."""

LEAST_CELLS = 6
"""Fewer cells that hold highlights state no covariance."""

CHI95 = 5.991464547107979
"""Of two degrees of freedom."""

NEWTON_STEPS, CONVERGED = 60, 1e-9
POSE_DRAWS = 24
"""Fits with drawn errors of the poses."""


@dataclass(frozen=True)
class Sighting:
    """The highlights of one frame.

    Parameters
    ----------
    world_from_camera : ndarray, shape (4, 4)
        Told pose, mm.
    sightlines : ndarray, shape (N, 3)
        Unit sightlines of its highlights, camera frame.
    in_view : callable, optional
        Takes unit directions of the camera frame, shape (M, 3), and returns which lie in the frame's view, a mask of
        shape (M,); default all.
    """

    world_from_camera: Array
    sightlines: Array
    in_view: Callable[[Array], Mask] | None = None


@dataclass(frozen=True)
class Plane:
    """What is known of the base beforehand: a plane, from a coarse depth or model.

    Parameters
    ----------
    point, normal : ndarray, shape (3,)
        Of the plane, world frame, mm; the unit normal towards the cameras. Neither need be exact: they place
        highlights on the tissue and are no evidence of the normal.
    """

    point: Array
    normal: Array


@dataclass(frozen=True)
class FineMap:
    """Fine normals on the tissue.

    Parameters
    ----------
    position, normal : ndarray, shape (N, 3)
        World frame, mm; unit normals.
    frame : ndarray of int, shape (N,)
        Frame of each.
    """

    position: Array
    normal: Array
    frame: IntArray


@dataclass(frozen=True)
class PatchNormal:
    """The base's normal over a patch.

    The covariance is a jackknife's over tissue cells, widened by Hotelling's 95 % quantile for so many cells.

    Parameters
    ----------
    normal : ndarray, shape (3,)
        Unit, world frame.
    covariance : ndarray, shape (2, 2)
        Of the angles about `tangents`, rad^2.
    tangents : ndarray, shape (2, 3)
        Unit vectors across the normal.
    slope : float
        Standard deviation of the relief's slope along one direction, rad.
    highlights, cells : int
        Highlights in the patch, and tissue cells that hold any.
    """

    normal: Array
    covariance: Array
    tangents: Array
    slope: float
    highlights: int
    cells: int

    def squared_mahalanobis(self, normal: Array) -> float:
        """Return the squared distance of another normal, in standard deviations, shape ()."""
        across = self.tangents @ (normal / (normal @ self.normal))
        return float(across @ np.linalg.solve(self.covariance, across))


def fine_map(sightings: Sequence[Sighting], plane: Plane) -> FineMap:
    """Return the fine normals that the highlights of frames show, with the light at the camera.

    Parameters
    ----------
    sightings : sequence of Sighting
        Highlights of the frames, with told poses.
    plane : Plane
        Where the base lies, coarsely.

    Returns
    -------
    FineMap
        Each normal is the reverse of its sightline, and lies where the sightline meets the plane. Highlights whose
        sightline does not meet it are left out.
    """
    positions, normals, frames = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for number, sighting in enumerate(sightings):
        rotation, centre = sighting.world_from_camera[:3, :3], sighting.world_from_camera[:3, 3]
        rays = sighting.sightlines @ rotation.T
        with np.errstate(divide="ignore"):
            distance = ((plane.point - centre) @ plane.normal) / (rays @ plane.normal)
        met = np.isfinite(distance) & (distance > 0)
        positions.append(centre + distance[met, None] * rays[met])
        normals.append(-rays[met])
        frames.append(np.full(int(met.sum()), number))
    return FineMap(np.concatenate(positions), np.concatenate(normals), np.concatenate(frames))


def base_normal(
    sightings: Sequence[Sighting], plane: Plane, radius_mm: float, pose_sd: tuple[float, float] = (0.0, 0.0)
) -> PatchNormal | Failure:
    """Estimate the base's normal over the disc of a plane around its point.

    Parameters
    ----------
    sightings : sequence of Sighting
        Highlights of the frames, with told poses.
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
    """
    found = _fit(sightings, plane, radius_mm)
    if isinstance(found, Failure) or not any(pose_sd):
        return found
    # What errors of the poses do: fits with drawn ones.
    rng, drawn = np.random.default_rng(0), []
    for _ in range(POSE_DRAWS):
        moved = [_moved(each, rng, *pose_sd) for each in sightings]
        other = _fit(moved, plane, radius_mm)
        if isinstance(other, PatchNormal):
            drawn.append(found.tangents @ (other.normal / (other.normal @ found.normal)))
    if len(drawn) < POSE_DRAWS // 2:
        return Failure(Reason.NO_ESTIMATE, f"errors of the poses leave {len(drawn)} of {POSE_DRAWS} fits")
    return PatchNormal(**{**vars(found), "covariance": found.covariance + np.cov(np.transpose(drawn))})


def _moved(sighting: Sighting, rng: np.random.Generator, centre_mm: float, turn_rad: float) -> Sighting:
    pose = sighting.world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ rotation(rng.normal(0, turn_rad, 3))
    pose[:3, 3] += rng.normal(0, centre_mm, 3)
    return Sighting(pose, sighting.sightlines, sighting.in_view)


def _fit(sightings: Sequence[Sighting], plane: Plane, radius_mm: float) -> PatchNormal | Failure:
    """Fit the process, with a covariance over tissue cells."""
    first, second = tangent_basis(plane.normal[None])
    axes = np.concatenate([first, second])
    seen = fine_map(sightings, plane)
    inside = np.linalg.norm((seen.position - plane.point) @ axes.T, axis=1) < radius_mm
    terms = _terms(seen.normal[inside], plane.normal, axes)
    cells = _cells((seen.position[inside] - plane.point) @ axes.T, radius_mm)
    if len(np.unique(cells)) < LEAST_CELLS:
        return Failure(Reason.NO_ESTIMATE, f"highlights in {len(np.unique(cells))} cells: takes {LEAST_CELLS}")
    # What was looked at: points of the patch, in each frame that sees them.
    spots, area = _quadrature(radius_mm)
    world = plane.point + spots @ axes
    looked, owners = [], []
    for sighting in sightings:
        towards = sighting.world_from_camera[:3, 3] - world
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        kept = np.ones(len(world), dtype=bool)
        if sighting.in_view is not None:
            kept = np.asarray(sighting.in_view(-towards @ sighting.world_from_camera[:3, :3]))
        looked.append(_terms(towards[kept], plane.normal, axes))
        owners.append(_cells(spots[kept], radius_mm))
    fitted = _maximise(terms.sum(axis=0), np.concatenate(looked), area)
    if isinstance(fitted, Failure):
        return fitted
    parameters, rate, information = fitted
    # Scores by tissue cell: what one cell shows in all frames is one observation.
    all_looked, all_owners = np.concatenate(looked), np.concatenate(owners)
    score, own_information = np.zeros((CELLS * CELLS, 4)), np.zeros((CELLS * CELLS, 4, 4))
    np.add.at(score, cells, terms)
    np.add.at(score, all_owners, -rate[:, None] * all_looked)
    np.add.at(own_information, all_owners, rate[:, None, None] * all_looked[:, :, None] * all_looked[:, None, :])
    # As the estimate moves without the cell (jackknife): cells of much weight pull it towards themselves.
    moves = np.linalg.solve(information - own_information, score[:, :, None])[:, :, 0]
    held = int(np.unique(cells).size)
    spread = moves.T @ moves * _inflation(held)
    gamma, beta = parameters[3], parameters[1:3]
    q = beta / gamma
    # q = beta/gamma; the derivative by (alpha, beta, gamma).
    by = np.array([[0, 1, 0, -q[0]], [0, 0, 1, -q[1]]]) / gamma
    normal = plane.normal + q @ axes
    length = np.linalg.norm(normal)
    normal /= length
    tangents = np.concatenate(tangent_basis(normal[None]))
    turn = tangents @ axes.T / length
    covariance = turn @ by @ spread @ by.T @ turn.T
    return PatchNormal(normal, covariance, tangents, float(gamma**-0.5), len(terms), held)


def _inflation(cells: int) -> float:
    """Return Hotelling's 95 % quantile of two components over that of chi squared, for scores of so many cells."""
    return cells * (0.05 ** (-2 / (cells - 1)) - 1) / CHI95


def _terms(normals: Array, reference: Array, axes: Array) -> Array:
    """Return 1, q, -|q|^2/2 of normals, shape (N, 4): what the process's parameters are multiplied by."""
    q = (normals @ axes.T) / (normals @ reference)[:, None]
    return np.concatenate([np.ones((len(q), 1)), q, -np.sum(q * q, axis=1, keepdims=True) / 2], axis=1)


def _maximise(total: Array, looked: Array, area: float) -> tuple[Array, Array, Array] | Failure:
    """Maximise total . p - area sum exp(looked . p): concave. Return p, rates at the points, and the information."""
    scale = np.maximum(np.abs(looked).max(axis=0), 1e-12)
    x, wanted = looked / scale, total / scale
    p = np.array([np.log(max(total[0], 1.0) / (area * len(x))), 0.0, 0.0, 0.0])
    value = -np.inf
    for _ in range(NEWTON_STEPS):
        rate = area * np.exp(x @ p)
        information = (x * rate[:, None]).T @ x
        step = np.linalg.solve(information + 1e-12 * np.trace(information) * np.eye(4), wanted - x.T @ rate)
        now = float(wanted @ p - rate.sum())
        size = 1.0
        # Halve the step until it gains.
        while size > 1e-6:
            tried = p + size * step
            with np.errstate(over="ignore"):
                value = float(wanted @ tried - area * np.exp(x @ tried).sum())
            if value >= now - 1e-9 * abs(now):
                break
            size /= 2
        p = p + size * step
        if np.abs(size * step).max() < CONVERGED:
            break
    rate = area * np.exp(x @ p)
    if not p[3] > 0:
        return Failure(Reason.NO_ESTIMATE, "highlights get no rarer away from any slope: no centre of slopes was seen")
    information = (x * rate[:, None]).T @ x * np.outer(scale, scale)
    return p / scale, rate, information


def _quadrature(radius_mm: float) -> tuple[Array, float]:
    """Return points of a disc that stand for equal areas, shape (N, 2), mm, and that area, mm^2."""
    points = []
    for ring in range(RINGS):
        count = 2 * ring + 1
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        # Rings of 2 n + 1 cells have equal cells where their radii are spaced evenly; the mean square radius is exact.
        r = radius_mm / RINGS * np.sqrt(ring**2 + ring + 0.5)
        points.append(r * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points), np.pi * (radius_mm / RINGS) ** 2


def _cells(points: Array, radius_mm: float) -> IntArray:
    """Return the number of the tissue cell that holds each point of the patch, shape (N,)."""
    at = np.clip(((points / radius_mm + 1) / 2 * CELLS).astype(np.int64), 0, CELLS - 1)
    return np.asarray(at[:, 0] * CELLS + at[:, 1])
