"""Where a picture of a mesh may have edges that rays through pixels' centres miss: they follow from the mesh itself.

Three kinds of edges of the mesh can: outlines as the camera sees them, behind which the mesh hides itself; sharp ones,
across which the normal turns fast; and outlines as a light sees them, which cast shadows. All are drawn into the image,
the shadows by rays that pass them on both sides.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.geometry.camera import Camera
from simtest.rendering.kernel_arrays import vectors_to_kernel
from simtest.rendering.strokes import BEHIND, Strokes
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.surfaces import TriangleMesh

MOST_LIGHTS = 31
"""Lights whose outlines fit into one number beside the camera's."""

OUTLINE = 1
"""Bit of the edges that the camera may see as such; the next ones are those of the lights."""

SHARP = 0.1
"""Turn of the normal, rad, within an edge of up to a pixel, from which it is sharp whatever the lobe."""

ASIDE_PX = 0.05
"""How far beside an outline the rays pass that find its shadow."""

MARGIN_RAD = 0.01
"""By how much the cone of view is taken wider."""

MOST_POINTS = 1024
"""Points of one edge; between them the strokes are straight."""


class _View:
    """A cone that holds a frame's sightlines, in the model frame: its axis and half-angle, rad; and the depth's end."""

    def __init__(self, camera: Camera, model_from_camera: Array, depth: Image) -> None:
        x, y = np.meshgrid(np.linspace(0, camera.width, 17), np.linspace(0, camera.height, 17))
        rays = camera.unproject(np.stack([x, y], axis=-1)).reshape(-1, 3) @ model_from_camera[:3, :3].T
        # A lens that sees nothing in some corner may see anything beyond the rest.
        whole = bool(np.isfinite(rays).all())
        total = np.nansum(rays, axis=0)
        self.axis = total / np.linalg.norm(total)
        self.angle = float(np.arccos(np.clip(rays @ self.axis, -1, 1)).max()) + MARGIN_RAD if whole else np.pi
        self.centre = model_from_camera[:3, 3]
        self.farthest = BEHIND * float(depth.max()) if np.isfinite(depth).all() else np.inf


class MeshEdges:
    """The edges of a rendered mesh.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    scene : mitsuba.Scene
        Holds the mesh as its only surface.
    mesh : TriangleMesh
        The same.
    """

    def __init__(self, mi: Any, scene: Any, mesh: TriangleMesh) -> None:
        self.mi, self._scene, self._shape = mi, scene, scene.shapes()[0]
        self._vertices = mesh.vertices
        self._ends, self._sides = edges_of(mesh.faces)
        self._lanes = [mi.UInt32(np.ascontiguousarray(column, dtype=np.uint32)) for column in
                       (*self._ends.T, *self._sides.T)]  # fmt: skip

    def marks(
        self, camera: Camera, model_from_camera: Array, lights: Array, depth: Image, turn: float, px_per_rad: float
    ) -> Mask:
        """Return the pixels that an edge may cross, shape (H, W).

        Parameters
        ----------
        camera : Camera
            The camera.
        model_from_camera : ndarray, shape (4, 4)
            Its pose, mm.
        lights : ndarray, shape (L, 3)
            Those that cast shadows, camera frame, mm.
        depth : ndarray, shape (H, W)
            Distance along the rays through the pixels' centres, mm; NaN where there is no surface. Edges behind it are
            not marked.
        turn : float
            Turn of the normal by which the lobe falls off, rad.
        px_per_rad : float
            Pixels per rad of sightlines.
        """
        rotation, centre = model_from_camera[:3, :3], model_from_camera[:3, 3]
        sources = lights @ rotation.T + centre
        view = _View(camera, model_from_camera, depth)
        kinds = self._kinds(view, sources, min(turn, SHARP), px_per_rad)
        strokes = Strokes(camera, depth)
        # Outlines and sharp edges.
        chosen = self._ends[kinds & OUTLINE > 0]
        first, second = ((self._vertices[end] - centre) @ rotation for end in chosen.T)
        lengths = np.linalg.norm(strokes.project(second) - strokes.project(first), axis=1)
        # An end behind the camera: as many points as any edge has.
        points, edge = _along(first, second, np.nan_to_num(lengths, nan=np.inf))
        strokes.draw(points, edge)
        # Shadows, and where they start.
        for i, source in enumerate(sources):
            chosen = self._ends[kinds & (OUTLINE << 1 + i) > 0]
            first, second = self._vertices[chosen[:, 0]], self._vertices[chosen[:, 1]]
            reach = np.maximum(np.linalg.norm(first - source, axis=1), 1e-12)
            lengths = np.linalg.norm(np.cross(second - first, first - source), axis=1) / reach**2 * px_per_rad
            points, edge = _along(first, second, lengths)
            strokes.draw((points - centre) @ rotation, edge)
            along = (second - first)[edge]
            # Rays on both sides of the outline, in one launch.
            both, aside = np.tile(points, (2, 1)), np.repeat([-ASIDE_PX, ASIDE_PX], len(points)) / px_per_rad
            hits = self._cast(both, np.tile(along, (2, 1)), source, aside[:, None])
            strokes.draw((hits - centre) @ rotation, np.concatenate([edge, edge + len(chosen)]))
        return strokes.marked

    def _kinds(self, view: "_View", sources: Array, turn: float, px_per_rad: float) -> npt.NDArray[np.uint32]:
        """Return for each edge the bits of what it is."""
        import drjit as dr

        mi, shape = self.mi, self._shape
        eye, axis = mi.Point3f(*view.centre.tolist()), mi.Vector3f(*view.axis.tolist())
        limit, scale, angle, farthest = (mi.Float(v) for v in (turn, px_per_rad, view.angle, view.farthest))
        seats = [mi.Point3f(*source.tolist()) for source in sources]
        dr.make_opaque(eye, axis, limit, scale, angle, farthest, seats)
        a, b, left, right = self._lanes
        first, second = shape.vertex_position(a), shape.vertex_position(b)
        normals = []
        for face in (left, right):
            p, q, r = (shape.vertex_position(corner) for corner in shape.face_indices(face))
            normals.append(dr.cross(q - p, r - p))

        def outlined(seat: Any) -> Any:
            towards = mi.Vector3f(seat - first)
            return (dr.dot(normals[0], towards) * dr.dot(normals[1], towards) <= 0) | (left == right)

        # Sharp: the normal turns much for each pixel of the edge's length, or within one pixel.
        away = mi.Vector3f(first - eye)
        length = dr.norm(dr.cross(second - first, away)) / dr.squared_norm(away) * scale
        turned = dr.norm(shape.vertex_normal(b) - shape.vertex_normal(a))
        sharp = turned > limit * dr.maximum(length, 1)
        # In view: the ball around the edge meets the cone of view, before the farthest that is seen.
        middle, half = mi.Vector3f((first + second) / 2 - eye), dr.norm(second - first) / 2
        distance = dr.norm(middle)
        apart = dr.acos(dr.clip(dr.dot(middle, axis) / distance, -1, 1)) - dr.asin(dr.minimum(half / distance, 1))
        near = (half >= distance) | ((apart <= angle) & (distance - half <= farthest))
        kinds = dr.select((outlined(eye) | sharp) & near, mi.UInt32(OUTLINE), 0)
        for i, seat in enumerate(seats):
            kinds |= dr.select(outlined(seat), mi.UInt32(OUTLINE << 1 + i), 0)
        return np.array(kinds)

    def _cast(self, points: Array, along: Array, source: Array, aside: Array) -> Array:
        """Return where a light's rays meet the mesh beyond points that they pass by `aside`, rad; NaN where nowhere."""
        mi = self.mi
        if not len(points):
            return points
        rays = points - source
        reach = np.linalg.norm(rays, axis=1, keepdims=True)
        directions = rays / np.maximum(reach, 1e-12)
        across = np.cross(along, directions)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        starts = points + aside * reach * across
        ray = mi.Ray3f(
            vectors_to_kernel(mi.Point3f, mi.Float, starts, np.float32),
            vectors_to_kernel(mi.Vector3f, mi.Float, directions, np.float32),
        )
        distance = np.array(self._scene.ray_intersect_preliminary(ray, True).t, dtype=np.float64)
        return starts + np.where(np.isfinite(distance), distance, np.nan)[:, None] * directions


def edges_of(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges of triangles: their vertices and the triangles on both sides, shape (E, 2) each.

    An edge of one triangle alone, or of more than two, has that triangle, or the first, on both sides.
    """
    count = int(faces.max()) + 1 if len(faces) else 0
    starts, ends = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    keys = np.minimum(starts, ends) * count + np.maximum(starts, ends)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    times = np.diff(first, append=len(keys))
    owner = order // 3
    other = np.where(times == 2, owner[np.minimum(first + 1, len(owner) - 1)], owner[first])
    return np.stack([keys[first] // count, keys[first] % count], axis=1), np.stack([owner[first], other], axis=1)


def _along(first: Array, second: Array, lengths: Array) -> tuple[Array, IntArray]:
    """Return points along edges, about one for each unit of their lengths, and the index of the edge of each."""
    counts = np.ceil(np.clip(lengths, 1, MOST_POINTS)).astype(np.int64) + 1
    edge = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (number / (counts[edge] - 1))[:, None]
    return first[edge] * (1 - share) + second[edge] * share, edge
