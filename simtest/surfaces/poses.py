"""Camera poses by number, and along a path through a lumen; never in tissue.

The same label and number give the same pose. In a closed tube a path follows the centreline. The inside of another
lumen is sampled on a grid; the path joins the two cells that are farthest apart, by the route that keeps farthest from
the wall, and is then smoothed.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import igl
import numpy as np
import scipy
from numpy.random import Generator

from simtest.errors import InputError
from simtest.geometry.vectors import tangent_basis, unit
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.seeds import Stage, generator
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.colon import Colon
from simtest.surfaces.model import SurfaceModel, TriangleMesh, remembered
from simtest.surfaces.triangles import MIN_CLEARANCE_MM, MeshedSurface, MeshProbe
from simtest.surfaces.tube import Tube

CLEARANCE_SHARE = 0.6
"""In a narrower lumen: share of the largest clearance found."""

AXIS_RANGE_MM = (10.0, 45.0)
"""Preferred distance along the optical axis to the wall of a lumen: working distances of a colonoscope."""

ORGAN_RANGE_MM = (40.0, 150.0)
"""Distance of a camera outside an organ from the point it looks at."""

ORGAN_TILT_DEG = 25.0
"""Largest angle between the sightline and the normal of the point it looks at."""


_DIRECTIONS = 64
_TARGETS = 64

Surface = TypeVar("Surface", bound=MeshedSurface)


def nearest_mm(lumen: bool) -> float:
    """Return the distance, mm, from the wall of a lumen or from an organ that chosen viewpoints keep at least."""
    return (AXIS_RANGE_MM if lumen else ORGAN_RANGE_MM)[0]


def at_viewpoint(surface: Surface, label: str, viewpoint: int) -> Surface:
    """Return a surface with a camera at the pose of a label and number: inside a shell, outside what is solid."""
    return surface.posed((organ_pose if surface.solid else lumen_pose)(label, viewpoint, surface))


def lumen_pose(label: str, viewpoint: int, surface: MeshedSurface) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera inside a lumen, at the pose of a label and number.

    The site keeps `MIN_CLEARANCE_MM` or, in a narrow lumen, `CLEARANCE_SHARE` of the largest clearance found. The
    direction is random among those whose axis meets the wall within `AXIS_RANGE_MM`; if there are none, the one whose
    axis meets it closest to that range. Raises `InputError` if no candidate lies in the lumen.
    """
    rng = generator(0, "viewpoint", label, viewpoint, Stage.VIEWPOINT)
    # site
    candidates = surface.sites(rng)
    room = surface.clearance(candidates)
    if not room.max() > 0:
        raise InputError(f"{label}: viewpoint {viewpoint}: no free place for the camera; kind lumen needs a cavity")
    allowed = np.flatnonzero(room >= min(MIN_CLEARANCE_MM, CLEARANCE_SHARE * float(room.max())))
    # Roomier sites are likelier: those at the limit show little but one patch of wall.
    site = candidates[rng.choice(allowed, p=room[allowed] / room[allowed].sum())]
    # direction
    directions = unit(rng.normal(size=(_DIRECTIONS, 3)))
    distance = surface.probe.cast(np.broadcast_to(site, directions.shape), directions)
    low, high = AXIS_RANGE_MM
    outside = np.maximum(np.maximum(low - distance, distance - high), 0.0)
    return _pose(site, directions[int(np.argmin(outside))], rng)  # argmin: the first in range


def organ_pose(label: str, viewpoint: int, surface: MeshedSurface) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera outside an organ, looking at a random point of it.

    The distance is random in `ORGAN_RANGE_MM`, the sightline within `ORGAN_TILT_DEG` of the normal and free of
    obstacles. Raises `InputError` if no drawn point can be seen from such a position.
    """
    rng = generator(0, "viewpoint", label, viewpoint, Stage.VIEWPOINT)
    # candidates
    points, normals = surface.probe.targets(rng, _TARGETS)
    away = _cap(normals, math.radians(ORGAN_TILT_DEG), rng)
    distance = rng.uniform(*ORGAN_RANGE_MM, size=_TARGETS)
    cameras = points + distance[:, None] * away
    # A hit well before the target means that something else is in the way.
    free = (surface.clearance(cameras) > 0) & (surface.probe.cast(cameras, -away) > distance - 0.5)
    if not free.any():
        raise InputError(f"{label}: viewpoint {viewpoint}: no free view of the surface found; kind organ needs one")
    chosen = int(np.argmax(free))  # the first
    return _pose(cameras[chosen], -away[chosen], rng)


def _cap(axes: Array, half_angle: float, rng: Generator) -> Array:
    """Draw directions even in the cap of the half angle, rad, around each of the unit axes, shape (N, 3)."""
    cosine = rng.uniform(math.cos(half_angle), 1.0, size=len(axes))
    around = rng.uniform(0, 2 * math.pi, size=len(axes))
    first, second = tangent_basis(axes)
    side = np.cos(around)[:, None] * first + np.sin(around)[:, None] * second
    return cosine[:, None] * axes + np.sqrt(1 - cosine**2)[:, None] * side


def _pose(site: Array, forward: Array, rng: Generator) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera at a site looking forward, with a random roll."""
    first, second = (vector[0] for vector in tangent_basis(forward[None]))
    roll = rng.uniform(0, 2 * math.pi)
    pose = np.eye(4)
    pose[:3, 0] = math.cos(roll) * first + math.sin(roll) * second
    pose[:3, 1] = math.cos(roll) * second - math.sin(roll) * first
    pose[:3, 2] = forward
    pose[:3, 3] = site
    return pose


MAX_CELLS = 1_500_000
"""Cells of the grid over the mesh's bounding box, at most."""

MIN_PITCH_MM = 1.0
STEP_MM = 1.0
"""Distance between the path's points."""

SMOOTHING_MM = 6.0
"""Standard deviation of the Gaussian along the path that removes the steps of the grid."""

MIN_LENGTH_MM = 20.0
WALL_MM = 1.0
"""The path is cut where it comes closer to the wall, and its longest piece is kept."""

_NEIGHBOURS = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)]
"""Half of a cell's 26: each pair of cells is joined once."""


@dataclass(frozen=True)
class CameraPath:
    """A smooth curve inside a lumen, with a frame that turns no more than the curve does."""

    points: Array  # (N, 3): model frame, mm, evenly spaced
    # tangents, sides: (N, 3): unit vectors along the path and across it
    tangents: Array
    sides: Array
    length: float  # mm

    def at(self, position: float) -> tuple[Array, Array, Array]:
        """Return point, mm, unit tangent and side at a position of 0 to `length`, mm; straight on beyond the ends."""
        # interpolated between the two nearest points
        inside = min(max(position, 0.0), self.length)
        index = inside / self.length * (len(self.points) - 1)
        low = min(int(index), len(self.points) - 2)
        share = index - low
        point, tangent, side = (
            (1 - share) * rows[low] + share * rows[low + 1] for rows in (self.points, self.tangents, self.sides)
        )
        # orthonormal again
        tangent /= np.linalg.norm(tangent)
        side -= (side @ tangent) * tangent
        return point + (position - inside) * tangent, tangent, side / np.linalg.norm(side)


def camera_path(surface: SurfaceModel) -> CameraPath:
    """Find the camera path through the mesh of a lumen, closed or open at its ends; the last few are cached."""
    if isinstance(surface, Colon) and surface.tube.recipe.closed:
        return _along_centreline(surface.tube, surface.probe)
    mesh = surface.shape().mesh
    assert mesh is not None
    return _camera_path(mesh)


@remembered
def _along_centreline(tube: Tube, probe: MeshProbe) -> CameraPath:
    along = np.arange(-tube.depth, tube.recipe.length_mm + tube.depth, STEP_MM)
    return _clear_of_wall(tube.centreline(along), probe)


@remembered
def _camera_path(mesh: TriangleMesh) -> CameraPath:
    # grid
    probe = MeshProbe(mesh)
    pitch = max(MIN_PITCH_MM, float(np.prod(np.ptp(mesh.vertices, axis=0)) / MAX_CELLS) ** (1 / 3))
    cells, corner = _inside_cells(mesh, pitch)
    centres = corner + pitch * cells
    if not len(centres):
        raise InputError("surface.view: the mesh has no inside for a camera path; view = auto places single cameras")
    # route and smooth path
    room = probe.distance(centres)
    rough = centres[_roomiest_route(cells, room)]
    return _clear_of_wall(_resampled(rough, pitch), probe)


def _clear_of_wall(path: Array, probe: MeshProbe) -> CameraPath:
    """Return the part of an evenly spaced path that is clear of the wall."""
    path = _without_ends(path, probe.distance(path))
    length = STEP_MM * (len(path) - 1)
    if length < MIN_LENGTH_MM:
        raise InputError(
            f"surface.view: a camera path of {max(length, 0):.3g} mm fits into the mesh; at least {MIN_LENGTH_MM:g} mm "
            "are needed; view = auto places single cameras"
        )
    tangents = unit(np.gradient(path, axis=0))
    return CameraPath(path, tangents, _sides(tangents), length)


def _inside_cells(mesh: TriangleMesh, pitch: float) -> tuple[IntArray, Array]:
    """Return the grid's cells inside the mesh's largest cavity, shape (N, 3), and the centre of cell (0, 0, 0), mm."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    counts = np.maximum(np.ceil((high - low) / pitch).astype(int), 1)
    corner = low + pitch / 2
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
    # The winding number identifies the inside of an open tube too: it is 1/2 where a cap would close the end.
    winding = igl.fast_winding_number(
        np.ascontiguousarray(mesh.vertices),
        np.ascontiguousarray(mesh.faces),
        np.ascontiguousarray(corner + pitch * grid.reshape(-1, 3)),
    )
    inside = np.abs(np.asarray(winding)).reshape(counts) > 0.5
    labels, count = scipy.ndimage.label(inside, np.ones((3, 3, 3)))
    if count > 1:
        # The largest cavity; label 0 is the outside.
        inside = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    return np.argwhere(inside), corner


def _roomiest_route(cells: IntArray, room: Array) -> IntArray:
    """Return the cells' numbers along the roomiest route between the two cells farthest apart."""
    # Graph of the cells: each is joined to its 26 neighbours. A border of empty cells saves the check of the ends.
    size = cells.max(axis=0) + 3
    number = np.full(size, -1, dtype=np.int64)
    number[tuple((cells + 1).T)] = np.arange(len(cells))
    first, second, length = [], [], []
    for step in _NEIGHBOURS:
        other = number[tuple((cells + 1 + step).T)]
        here = np.flatnonzero(other >= 0)
        first.append(here)
        second.append(other[here])
        length.append(np.full(len(here), math.sqrt(sum(s * s for s in step))))
    i, j, steps = np.concatenate(first), np.concatenate(second), np.concatenate(length)

    def graph(weights: Array) -> "scipy.sparse.csr_matrix":
        return scipy.sparse.csr_matrix((weights, (i, j)), shape=(len(cells), len(cells)))

    def farthest(start: int) -> int:
        distance = scipy.sparse.csgraph.dijkstra(graph(steps), directed=False, indices=start)
        return int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))

    # Farthest from the roomiest cell is one end, farthest from that one the other.
    start = farthest(int(np.argmax(room)))
    end = farthest(start)
    # Cubed, so that a detour through the middle is cheaper than a short cut along the wall.
    cost = steps / np.maximum((room[i] + room[j]) / 2, 1e-3) ** 3
    _, before = scipy.sparse.csgraph.dijkstra(graph(cost), directed=False, indices=start, return_predecessors=True)
    route = [end]
    while route[-1] != start and before[route[-1]] >= 0:
        route.append(int(before[route[-1]]))
    return np.array(route[::-1])


def _resampled(rough: Array, pitch: float) -> Array:
    """Smooth a row of points and space it evenly by `STEP_MM`."""
    for width in (pitch, SMOOTHING_MM):
        rough = np.asarray(scipy.ndimage.gaussian_filter1d(_evenly(rough), width / STEP_MM, axis=0, mode="nearest"))
    return _evenly(rough)


def _evenly(points: Array) -> Array:
    position = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.arange(0.0, position[-1], STEP_MM)
    return np.stack([np.interp(even, position, column) for column in points.T], axis=1)


def _without_ends(path: Array, room: Array) -> Array:
    """Keep the longest piece clear of the wall, without its ends.

    The two cells farthest apart lie in corners, into which the path turns within about its own width.
    """
    # the longest piece
    kept = _longest_run(room >= WALL_MM)
    path, room = path[kept], room[kept]
    usual = float(np.median(room)) if len(room) else 0.0
    # without its narrow ends, and at least the usual room from either end
    wide = np.flatnonzero(room >= min(MIN_CLEARANCE_MM, CLEARANCE_SHARE * usual))
    if not len(wide):
        return path[:0]
    cut = math.ceil(usual / STEP_MM)
    return path[max(wide[0], cut) : min(wide[-1] + 1, len(path) - cut)]


def _longest_run(flags: Mask) -> slice:
    """Return the longest run of true values."""
    labels, count = scipy.ndimage.label(flags)
    if not count:
        return slice(0, 0)
    return scipy.ndimage.find_objects(labels)[int(np.argmax(np.bincount(labels)[1:]))][0]


def _sides(tangents: Array) -> Array:
    """Transport a side vector along the path, turning it no more than the tangents turn."""
    sides = np.empty_like(tangents)
    sides[0] = tangent_basis(tangents[:1])[0][0]
    for n in range(1, len(tangents)):
        side = sides[n - 1] - (sides[n - 1] @ tangents[n]) * tangents[n]
        sides[n] = side / np.linalg.norm(side)
    return sides


def path_pose(spec: AnatomySurface, surface: SurfaceModel) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera on or beside the camera path.

    With `view` path it is on the path and looks at the point `look_ahead_mm` ahead; with off_axis it does so from
    beside the path, by `off_axis_share` of the room up to `MIN_CLEARANCE_MM` before the wall; with wall it is on the
    path and looks across it. `around_deg` is the direction across. The pose changes smoothly with it and with
    `path_share`.

    Raises `InputError` if the surface is an organ, or its mesh has no room for a path.
    """
    if surface.solid:
        raise InputError(f"surface.view = {spec.view}: {spec.label} is an organ; a path needs a lumen; allowed: auto")
    path = camera_path(surface)
    position = spec.path_share * path.length
    site, tangent, side = path.at(position)
    other = np.cross(tangent, side)
    angle = math.radians(spec.around_deg)
    across = math.cos(angle) * side + math.sin(angle) * other
    # site and target
    target = path.at(position + spec.look_ahead_mm)[0]
    if spec.view == "wall":
        target = site + across
    elif spec.view == "off_axis":
        site = site + spec.off_axis_share * _room(surface, site, across) * across
    forward = (target - site) / np.linalg.norm(target - site)
    # The picture's x axis: the path's side, or its direction for a view across it.
    right = tangent if spec.view == "wall" else side
    right = right - (right @ forward) * forward
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = site
    return pose


def _room(surface: SurfaceModel, site: Array, across: Array) -> float:
    """Return how far, mm, a camera may move from a site along a direction and keep its clearance."""
    steps = np.arange(0.0, 100.0, 0.25)
    least = min(MIN_CLEARANCE_MM, float(surface.clearance(site[None])[0]))
    blocked = surface.clearance(site + steps[:, None] * across) < least - 1e-9
    return float(steps[max(int(np.argmax(blocked)) - 1, 0)]) if blocked.any() else float(steps[-1])
