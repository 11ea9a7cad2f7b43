"""Plane, sphere, cylinder and quadric patch: every quantity from its closed form, in float64.

All live in a model frame whose origin is the anchor point, z the anchor's normal on the camera's side and x the
first principal direction. Where they deform, plane, sphere and cylinder are rendered as meshes, finest around the
anchor; points, normals and curvatures remain those of the closed form.
"""

import math
from abc import abstractmethod
from functools import cached_property

import numpy as np

from simtest.geometry.vectors import unit
from simtest.runtime.arrays import Array, IntArray
from simtest.spec.surfaces import CylinderSurface, PlaneSurface, QuadricSurface, SphereSurface
from simtest.surfaces.model import (
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    implicit_shape_operator,
    pack_points,
)

PLANE_REACH = 1000.0
"""Half-size of the rendered plane over the anchor's distance: beyond the view even at grazing tilt."""

CYLINDER_REACH = 50.0
"""Half-length of the rendered cylinder over the anchor's distance."""

QUADRIC_REACH = 1.0
"""Half-size of the rendered quadric patch over the anchor's distance."""

QUADRIC_CELLS = 400
"""Cells along one side of the quadric's mesh; a cell is about 2 px wide at f = 406."""


def placement(distance_mm: float, tilt_deg: float, azimuth_deg: float, spin_deg: float) -> Array:
    """Return model_from_camera, shape (4, 4), of a surface anchored on the optical axis.

    The anchor is (0, 0, distance); its normal is (0, 0, -1) leaned by `tilt_deg` towards image direction
    `azimuth_deg`; at tilt 0 the model's x axis is image direction `spin_deg`.
    """
    # Imported here: slow to load, and not every command that imports surfaces makes one.
    from scipy.spatial.transform import Rotation

    # frame at tilt 0: x along spin, z towards the camera
    tilt, azimuth, spin = np.radians([tilt_deg, azimuth_deg, spin_deg])
    x = np.array([np.cos(spin), np.sin(spin), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    frame = np.stack([x, np.cross(z, x), z], axis=1)
    # Tilted about the axis perpendicular to the direction in which the normal leans.
    lean = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    axis = np.cross(z, lean)
    rotation = Rotation.from_rotvec(tilt * axis).as_matrix()
    camera_from_model = np.eye(4)
    camera_from_model[:3, :3] = rotation @ frame
    camera_from_model[:3, 3] = [0.0, 0.0, distance_mm]
    return np.asarray(np.linalg.inv(camera_from_model), dtype=np.float64)


def grid_faces(columns: int, rows: int) -> IntArray:
    """Triangulate (rows + 1) x (columns + 1) vertices stored row by row, counter-clockwise about +z."""
    row, column = np.divmod(np.arange(rows * columns, dtype=np.int64), columns)
    corner = row * (columns + 1) + column
    right, up = corner + 1, corner + columns + 1
    return np.concatenate([np.stack([corner, right, up + 1], axis=1), np.stack([corner, up + 1, up], axis=1)])


STEP = 0.01
"""Cells around the anchor, over its distance: about 4 px wide at f = 406."""

FINE = 1.0
"""Half-width of the fine cells' zone, over the anchor's distance."""

GROWTH = 1.15
"""Of each cell over its inner neighbour, beyond."""

LEAST_CELLS = 48
"""Along a quarter of a circle, however small."""

MESH_REACH = 50.0
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


class _Analytic(SurfaceModel):
    """An analytic surface placed in front of the camera."""

    as_mesh = False
    """Whether it is rendered as a mesh; it must be where it deforms."""

    def __init__(self, spec: PlaneSurface | SphereSurface | CylinderSurface | QuadricSurface) -> None:
        self.model_from_camera = placement(spec.distance_mm, spec.tilt_deg, spec.azimuth_deg, spec.spin_deg)
        self.distance = spec.distance_mm
        self.key = f"graded {type(self).__name__} {spec.distance_mm!r}"

    def shape(self) -> Shape:
        """Return Mitsuba's shape, or the mesh, with the exact normals at its vertices."""
        return Shape("mesh", False, np.eye(4), self.mesh, self.key) if self.as_mesh else self._analytic_shape()

    def _analytic_shape(self) -> Shape:
        raise NotImplementedError

    @cached_property
    @abstractmethod
    def mesh(self) -> TriangleMesh:
        """The mesh in place of Mitsuba's shape."""

    @abstractmethod
    def _shape_operators(self, points: Array, normals: Array) -> Array:
        """Return S at points of the surface for unit normals on the camera's side."""

    def vertex_shape_operators(self) -> Array | None:
        """Return S of the closed form at the vertices (see `SurfaceModel.vertex_shape_operators`)."""
        return self._shape_operators(self.mesh.vertices, self.mesh.normals) if self.as_mesh else None


class Plane(_Analytic):
    """The plane z = 0."""

    def _analytic_shape(self) -> Shape:
        """Return Mitsuba's rectangle, scaled beyond the view."""
        reach = PLANE_REACH * self.distance
        return Shape("plane", False, np.diag([reach, reach, 1.0, 1.0]), None, "plane")

    @cached_property
    def mesh(self) -> TriangleMesh:
        """A square grid, finest around the anchor."""
        d = self.distance
        side = graded(MESH_REACH * d, FINE * d, STEP * d)
        x, y = (grid.ravel() for grid in np.meshgrid(side, side))
        normals = np.tile([0.0, 0.0, 1.0], (len(x), 1))
        return TriangleMesh(np.stack([x, y, 0 * x], axis=1), grid_faces(len(side) - 1, len(side) - 1), normals)

    def _shape_operators(self, points: Array, normals: Array) -> Array:
        return np.zeros((len(points), 3, 3))

    def clearance(self, points: Array) -> Array:
        """Return z (see `SurfaceModel.clearance`)."""
        return np.asarray(points[:, 2])

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Intersect rays with z = 0 (see `SurfaceModel.points`)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origins[:, 2] / directions[:, 2]
        # In front of the camera, and within the rendered part of the plane
        distance = np.where((distance > 0) & np.isfinite(hits.distance), distance, np.nan)
        normal = np.broadcast_to([0.0, 0.0, 1.0], directions.shape)
        return pack_points(origins, directions, distance, normal, np.zeros((len(origins), 3, 3)))


class _Round(_Analytic):
    """A sphere or cylinder through the anchor, its centre on the far side or, seen from inside, on the near side."""

    _across = np.ones(3)
    """1 along the axes that the surface is round in: a cylinder is a circle for the components across its axis."""

    def __init__(self, spec: SphereSurface | CylinderSurface) -> None:
        super().__init__(spec)
        self.radius = spec.radius_mm
        self.inside = spec.side == "inside"
        self.solid = not self.inside
        self.centre = np.array([0.0, 0.0, self.radius if self.inside else -self.radius])
        self.key += f" {self.radius!r} {self.inside}"

    def clearance(self, points: Array) -> Array:
        """Return the distance to the wall (see `SurfaceModel.clearance`)."""
        outwards = np.linalg.norm((points - self.centre) * self._across, axis=1) - self.radius
        return -outwards if self.inside else outwards

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Intersect rays with the surface; S = (I - N N^T)/R across the axis (see `SurfaceModel.points`)."""
        o, towards = origins * self._across - self.centre, directions * self._across
        # The root of |o + t d|^2 = R^2: the near one from outside, the far one from inside
        a = np.sum(towards**2, axis=1)
        b = np.sum(o * towards, axis=1)
        c = np.sum(o**2, axis=1) - self.radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(b**2 - a * c)
            # The form without cancellation: for the near root b < 0, for the far one c < 0.
            distance = (root - b) / a if self.inside else c / (root - b)
        distance = np.where((distance > 0) & np.isfinite(hits.distance), distance, np.nan)
        # Renormalised, to be of unit length to rounding.
        normal = unit((origins + distance[:, None] * directions - self.centre) * self._across / self.radius)
        S = (np.diag(self._across) - normal[:, :, None] * normal[:, None, :]) / self.radius
        return pack_points(origins, directions, distance, normal, S)

    def _shape_operators(self, points: Array, normals: Array) -> Array:
        k = (-1 if self.inside else 1) / self.radius
        return np.asarray(k * (np.diag(self._across) - normals[:, :, None] * normals[:, None, :]))

    def _fine_angle(self) -> float:
        """Return the angle of a fine cell about the centre, rad."""
        return min(STEP * self.distance / self.radius, math.pi / 2 / LEAST_CELLS)

    def _packed(self, points: Array, outward: Array, faces: IntArray) -> TriangleMesh:
        """Return the mesh with its normals on the camera's side."""
        return TriangleMesh(points.reshape(-1, 3), faces, outward.reshape(-1, 3) * (-1 if self.inside else 1))


class Sphere(_Round):
    """A sphere through the anchor."""

    def _analytic_shape(self) -> Shape:
        to_model = np.diag([self.radius, self.radius, self.radius, 1.0])
        to_model[:3, 3] = self.centre
        return Shape("sphere", self.inside, to_model, None, f"sphere {self.inside}")

    @cached_property
    def mesh(self) -> TriangleMesh:
        """The six faces of a cube, finest around the anchor, on the sphere."""
        quarter, R, d = math.pi / 4, self.radius, self.distance
        fine = np.tan(graded(quarter, FINE * d / R, self._fine_angle()))
        fine[[0, -1]] = -1.0, 1.0
        cells = min(round(2 * quarter / self._fine_angle()), MOST_COARSE)
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
        normals[:, 2] *= -1 if self.inside else 1
        return self._packed(R * normals + self.centre, normals, np.concatenate(faces))


class Cylinder(_Round):
    """A cylinder through the anchor, its axis along y."""

    _across = np.array([1.0, 0.0, 1.0])

    def _analytic_shape(self) -> Shape:
        """Return Mitsuba's cylinder: of unit radius about z from 0 to 1, turned to y."""
        half = CYLINDER_REACH * self.distance
        to_model = np.eye(4)
        to_model[:3, 0] = [self.radius, 0, 0]
        to_model[:3, 1] = [0, 0, -self.radius]
        to_model[:3, 2] = [0, 2 * half, 0]
        to_model[:3, 3] = self.centre - [0, half, 0]
        return Shape("cylinder", self.inside, to_model, None, f"cylinder {self.inside}")

    @cached_property
    def mesh(self) -> TriangleMesh:
        """A grid around and along the cylinder, finest around the anchor; the seam opposite is closed."""
        R, d = self.radius, self.distance
        angle, y = graded(math.pi, FINE * d / R, self._fine_angle()), graded(MESH_REACH * d, FINE * d, STEP * d)
        sine = np.sin(angle)
        sine[[0, -1]] = 0.0
        outward = np.zeros((len(y), len(angle), 3))
        outward[..., 0], outward[..., 2] = sine, np.cos(angle) * (-1 if self.inside else 1)
        points = R * outward + self.centre
        points[..., 1] = y[:, None]
        return self._packed(points, outward, grid_faces(len(angle) - 1, len(y) - 1))


class Quadric(_Analytic):
    """The graph z = -(k1 x^2 + k2 y^2)/2; at the anchor its principal curvatures are k1 and k2."""

    as_mesh = True

    def __init__(self, spec: QuadricSurface) -> None:
        super().__init__(spec)
        self.curvatures = np.array([spec.k1_per_mm, spec.k2_per_mm, 0.0])
        self._reach = QUADRIC_REACH * self.distance
        self.key = f"quadric {self.curvatures[0]!r} {self.curvatures[1]!r} {self._reach!r}"

    @cached_property
    def mesh(self) -> TriangleMesh:
        """A grid with the exact vertex normals."""
        side = np.linspace(-self._reach, self._reach, QUADRIC_CELLS + 1)
        vertices, normals = self.over(*(grid.ravel() for grid in np.meshgrid(side, side)))
        return TriangleMesh(vertices, grid_faces(QUADRIC_CELLS, QUADRIC_CELLS), normals)

    def over(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return points and unit normals, shape (N, 3), of the graph over x and y."""
        k1, k2, _ = self.curvatures
        points = np.stack([x, y, -(k1 * x**2 + k2 * y**2) / 2], axis=1)
        return points, unit(np.stack([k1 * x, k2 * y, np.ones_like(x)], axis=1))

    def clearance(self, points: Array) -> Array:
        """Return F/|grad F| of F = z + (k1 x^2 + k2 y^2)/2 (see `SurfaceModel.clearance`)."""
        k = self.curvatures
        value = points[:, 2] + np.sum(k * points**2, axis=1) / 2
        return np.asarray(value / np.linalg.norm(k * points + [0.0, 0.0, 1.0], axis=1))

    def _shape_operators(self, points: Array, normals: Array) -> Array:
        return self._normal_and_operator(points)[1]

    def _normal_and_operator(self, points: Array) -> tuple[Array, Array]:
        gradient = self.curvatures * points + [0.0, 0.0, 1.0]
        return implicit_shape_operator(gradient, np.broadcast_to(np.diag(self.curvatures), (len(points), 3, 3)))

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Intersect rays with the quadric at the root next to the rendered hit (see `SurfaceModel.points`)."""
        k = self.curvatures
        # a t^2 + b t + c = 0 on the ray
        a = np.sum(k * directions**2, axis=1) / 2
        b = directions[:, 2] + np.sum(k * origins * directions, axis=1)
        c = origins[:, 2] + np.sum(k * origins**2, axis=1) / 2
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            root = np.sqrt(b**2 - 4 * a * c)
            # Both roots without cancellation; a = 0 leaves one of them infinite.
            q = -(b + np.copysign(root, b)) / 2
            roots = np.stack([c / q, q / a])
            # A ray may meet the quadric twice: the rendered hit decides which root is meant.
            gap = np.abs(roots - hits.distance)
        gap = np.where(np.isfinite(gap), gap, np.inf)
        distance = np.take_along_axis(roots, gap.argmin(axis=0)[None], axis=0)[0]
        distance = np.where(np.isfinite(gap.min(axis=0)), distance, np.nan)
        P = origins + distance[:, None] * directions
        normal, S = self._normal_and_operator(P)
        return pack_points(origins, directions, distance, normal, S)
