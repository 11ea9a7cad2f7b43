"""Plane, sphere and cylinder as meshes, which deform as their closed forms cannot: finest around the anchor.

The mesh is what the renderer sees. Points, normals and curvatures remain those of the closed form.
"""

import math
from functools import cached_property

import numpy as np

from simtest.runtime.arrays import Array, IntArray
from simtest.surfaces.analytic import Cylinder, Plane, Sphere, grid_faces
from simtest.surfaces.model import RayHits, Shape, SurfaceModel, SurfacePoints, TriangleMesh

STEP = 0.01
"""Cells around the anchor, over its distance: about 4 px wide at f = 406."""

FINE = 1.0
"""Half-width of the fine cells' zone, over the anchor's distance."""

GROWTH = 1.15
"""Of each cell over its inner neighbour, beyond."""

LEAST_CELLS = 48
"""Along a quarter of a circle, however small."""

REACH = 50.0
"""Half-size of plane and cylinder, over the anchor's distance."""

MOST_COARSE = 120
"""Cells along a quarter of a sphere, away from the anchor, at most."""

# The six faces of a cube, turned from the first, whose middle is the anchor; their edges beside it match.
_SIDES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, 0, 1), (0, 1, 0), (-1, 0, 0)), ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)), ((1, 0, 0), (0, 0, -1), (0, 1, 0)), ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
)  # fmt: skip
_FINE_ACROSS, _FINE_ALONG = (True, False, False, True, True, True), (True, True, True, False, False, True)


def graded(half: float, fine: float, step: float) -> Array:
    """Return nodes from -half to half, shape (N,): even steps within `fine` of 0, growing steps beyond."""
    count = max(math.ceil(min(fine, half) / step), 1)
    side = [min(fine, half) / count * n for n in range(count + 1)]
    width = side[1]
    while side[-1] < half:
        width *= GROWTH
        side.append(side[-1] + width)
    # The last cell is not much narrower than its neighbour.
    if len(side) > count + 2 and half - side[-2] < width / 2:
        side.pop()
    positive = np.array([*side[1:-1], half])
    return np.concatenate([-positive[::-1], [0.0], positive])


class GradedMesh(SurfaceModel):
    """An analytic surface that is rendered as a mesh.

    Parameters
    ----------
    form : Plane, Sphere or Cylinder
        The surface.
    """

    def __init__(self, form: Plane | Sphere | Cylinder) -> None:
        self._form = form
        self.model_from_camera, self.solid, self.relief = form.model_from_camera, form.solid, form.relief

    @property
    def at_rest(self) -> SurfaceModel:
        """The analytic surface."""
        return self._form

    @cached_property
    def _mesh(self) -> TriangleMesh:
        match self._form:
            case Plane(distance=d):
                return _plane(d)
            case Sphere(radius=R, distance=d, inside=inside):
                return _sphere(R, d, inside)
            case Cylinder(radius=R, distance=d, inside=inside):
                return _cylinder(R, d, inside)

    def shape(self) -> Shape:
        """Return the mesh, with the exact normals at its vertices."""
        form = self._form
        size = "" if isinstance(form, Plane) else f" {form.radius!r} {form.inside}"
        return Shape("mesh", False, np.eye(4), self._mesh, f"graded {type(form).__name__} {form.distance!r}{size}")

    def vertex_shape_operators(self) -> Array:
        """Return S of the closed form at the vertices (see `SurfaceModel.vertex_shape_operators`)."""
        N, form = self._mesh.normals, self._form
        if isinstance(form, Plane):
            return np.zeros((len(N), 3, 3))
        across = np.diag([1.0, 0.0, 1.0] if isinstance(form, Cylinder) else [1.0, 1.0, 1.0])
        k = (-1 if form.inside else 1) / form.radius
        return np.asarray(k * (across - N[:, :, None] * N[:, None, :]))

    def clearance(self, points: Array) -> Array:
        """Return the closed form's clearance (see `SurfaceModel.clearance`)."""
        return self._form.clearance(points)

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the points of the closed form (see `SurfaceModel.points`)."""
        return self._form.points(origins, directions, hits)


def _plane(d: float) -> TriangleMesh:
    side = graded(REACH * d, FINE * d, STEP * d)
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))
    normals = np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))
    return TriangleMesh(np.stack([x, y, 0 * x], axis=1), grid_faces(len(side) - 1, len(side) - 1), normals.copy())


def _cylinder(R: float, d: float, inside: bool) -> TriangleMesh:
    angle, y = graded(math.pi, FINE * d / R, _angle(R, d)), graded(REACH * d, FINE * d, STEP * d)
    sine = np.sin(angle)
    # The seam opposite the anchor is closed.
    sine[[0, -1]] = 0.0
    outward = np.zeros((len(y), len(angle), 3))
    outward[..., 0], outward[..., 2] = sine, np.cos(angle) * (-1 if inside else 1)
    points = R * outward + [0.0, 0.0, R if inside else -R]
    points[..., 1] = y[:, None]
    return _packed(points, outward, grid_faces(len(angle) - 1, len(y) - 1), inside)


def _sphere(R: float, d: float, inside: bool) -> TriangleMesh:
    quarter = math.pi / 4
    fine = np.tan(graded(quarter, FINE * d / R, _angle(R, d)))
    fine[[0, -1]] = -1.0, 1.0
    cells = min(round(2 * quarter / _angle(R, d)), MOST_COARSE)
    coarse = np.tan(np.linspace(-quarter, quarter, cells + 1))
    coarse[[0, -1]] = -1.0, 1.0
    outward, faces, count = [], [], 0
    for turn, across, along in zip(_SIDES, _FINE_ACROSS, _FINE_ALONG, strict=True):
        u, v = (fine if finely else coarse for finely in (across, along))
        s, t = (grid.ravel() for grid in np.meshgrid(u, v))
        # In this order, vertices that faces share are equal to the last bit.
        corner = np.stack([s, t, np.ones_like(s)], axis=1) / np.sqrt(1 + (s * s + t * t))[:, None]
        outward.append(corner @ np.array(turn, dtype=float).T)
        faces.append(grid_faces(len(u) - 1, len(v) - 1) + count)
        count += len(s)
    normals = np.concatenate(outward)
    normals[:, 2] *= -1 if inside else 1
    points = R * normals + [0.0, 0.0, R if inside else -R]
    return _packed(points, normals, np.concatenate(faces), inside)


def _angle(R: float, d: float) -> float:
    """Return the angle of a fine cell about the centre, rad."""
    return min(STEP * d / R, math.pi / 2 / LEAST_CELLS)


def _packed(points: Array, outward: Array, faces: IntArray, inside: bool) -> TriangleMesh:
    """Return the mesh with its normals on the camera's side."""
    return TriangleMesh(points.reshape(-1, 3), faces, outward.reshape(-1, 3) * (-1 if inside else 1))
