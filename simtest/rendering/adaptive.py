"""Frames of several samples a pixel that take them only where the picture is not smooth.

Where the radiance f is smooth, its mean over a pixel is f + (f_xx + f_yy) / 24 at the centre, up to fourth derivatives;
second differences give the second derivatives. This errs far less than samples do, whose error is a share of the
gradient. All else, the edges of anything, narrow lobes and what may hide between centres, is left to samples. The
choice rests on the rays through the centres alone, and none of them is averaged with the samples, so that these stay
without bias.

Edges of a mesh that the centres miss follow from the mesh itself: outlines as the camera sees them, behind which the
mesh hides itself; sharp ones, across which the normal turns fast; and outlines as a light sees them, which cast
shadows. All are drawn into the image, the shadows by rays that pass them on both sides.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry.camera import Camera
from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import vectors_to_kernel
from simtest.rendering.rays import Hit, Rays, in_tiles
from simtest.rendering.tissue_kernels import ReliefKernel
from simtest.rendering.trace import Progress, Tell, Tracer
from simtest.rendering.truth import CHANNELS, ShapeLabels
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.lights import CosineProfile, LightSpec, is_at_camera
from simtest.spec.scene import Scene
from simtest.surfaces import Shape, TriangleMesh

BEHIND = 1.02
"""A point is hidden if it lies farther away than this times the surface around its pixel."""

STEP_PX = 0.5
"""Between the points of a stroke."""

MOST_STEPS = 4096
"""Points of one stroke: it is longer than any frame."""


class Strokes:
    """Marks the pixels, shape (H, W), that lines cross.

    `depth`, shape (H, W), is the distance along the rays through the pixels' centres, mm; NaN where there is no
    surface.
    """

    def __init__(self, camera: Camera, depth: Image) -> None:
        self.camera = camera
        self.marked: Mask = np.zeros((camera.height, camera.width), dtype=bool)
        # The farthest around: a line at an edge of the depth may be seen beside it.
        known = np.where(np.isfinite(depth), depth, np.float32(np.inf)).astype(np.float32)
        self._farthest = BEHIND * cv2.dilate(known, np.ones((3, 3), np.uint8))

    def project(self, points: Array) -> Array:
        """Return the pixels of points, shape (N, 3), camera frame, mm; NaN where the lens images nothing."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.camera.project(points)

    def draw(self, points: Array, line: IntArray) -> None:
        """Draw lines through points, shape (N, 3), camera frame, mm; `line` is the index of each point's, in order."""
        if not len(points):
            return
        places, distances = self.project(points), np.linalg.norm(points, axis=1)
        self._mark(places, distances)
        # Straight strokes from each point to the next of its line.
        linked = np.flatnonzero((line[1:] == line[:-1]) & np.isfinite(places[1:] + places[:-1]).all(axis=1))
        starts, ends = places[linked], places[linked + 1]
        size = np.array([self.camera.width, self.camera.height])
        inside = (np.maximum(starts, ends) > 0).all(axis=1) & (np.minimum(starts, ends) < size).all(axis=1)
        linked, starts, ends = linked[inside], starts[inside], ends[inside]
        # Points between the two ends of each stroke.
        steps = np.clip(np.ceil(np.linalg.norm(ends - starts, axis=1) / STEP_PX), 1, MOST_STEPS).astype(np.int64)
        inner = steps - 1
        stroke = np.repeat(np.arange(len(steps)), inner)
        number = 1 + np.arange(len(stroke)) - np.repeat(np.cumsum(inner) - inner, inner)
        between = starts[stroke] + (number / steps[stroke])[:, None] * (ends - starts)[stroke]
        nearer = np.minimum(distances[linked], distances[linked + 1])
        self._mark(between, nearer[stroke])

    def _mark(self, places: Array, distances: Array) -> None:
        """Mark the pixels of positions that are not hidden at their distances."""
        with np.errstate(invalid="ignore"):
            inside = ((places >= 0) & (places < [self.camera.width, self.camera.height])).all(axis=1)
        column, row = places[inside].astype(np.int64).T
        seen = distances[inside] <= self._farthest[row, column]
        self.marked[row[seen], column[seen]] = True


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
    """The edges of a mesh, which a Mitsuba scene holds as its only surface."""

    def __init__(self, scene: Any, mesh: TriangleMesh) -> None:
        self._scene, self._shape = scene, scene.shapes()[0]
        self._vertices = mesh.vertices
        self._ends, self._sides = edges_of(mesh.faces)
        self._lanes = [mi.UInt32(np.ascontiguousarray(column, dtype=np.uint32)) for column in
                       (*self._ends.T, *self._sides.T)]  # fmt: skip

    def marks(
        self, camera: Camera, model_from_camera: Array, lights: Array, depth: Image, turn: float, px_per_rad: float
    ) -> Mask:
        """Return the pixels that an edge may cross, shape (H, W).

        `lights`, shape (L, 3), camera frame, mm, are those that cast shadows. `depth`, shape (H, W), is the distance
        along the rays through the pixels' centres, mm, NaN where there is no surface: edges behind it are not marked.
        `turn` is that of the normal by which the lobe falls off, rad.
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
        shape = self._shape
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
    """Return vertices and triangles on both sides of edges, (E, 2) each; twice the first where not of two."""
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


ALLOWED = 0.1
"""Bound on the rule's error, as a share of the change over a pixel. Most errors are far smaller."""

ROUNDING = 3e-7
"""Error of single precision, as a share of the whole radiance; what is less does not count."""

LEAST_SCALE_PX = 4.0
"""The light's own scale, px on the surface, below which it may change within a pixel."""

BORDER_PX = 2
"""Pixels along the frame's border, whose neighbours are not all known."""

_CURVE = np.array([[1, -2, 1]], dtype=np.float32)
_SLOPE = np.array([[-0.5, 0, 0.5]], dtype=np.float32)
_AROUND = np.ones((3, 3), np.uint8)


def mean_of_pixel(centres: Image) -> Image:
    """Return the mean over each pixel of a smooth function, from its values at the centres, shape (H, W)."""
    across, down = _filtered(centres, _CURVE)
    return np.asarray(centres + (across + down) * np.float32(1 / 24))


def uneven(centres: Image, whole: Image) -> Mask:
    """Return where `mean_of_pixel` of a part of the radiance may err by more than samples do, shape (H, W).

    A kink of the slope errs by up to a twelfth of what it changes second differences by between neighbours; with both
    directions and both signs a 24th of their spread among the pixels around.
    """
    spread = sum(cv2.dilate(curve, _AROUND) - cv2.erode(curve, _AROUND) for curve in _filtered(centres, _CURVE))
    change = cv2.blur(cv2.magnitude(*_filtered(centres, _SLOPE)), (3, 3))
    return np.asarray(spread > 24 * (ALLOWED * change + ROUNDING * whole))


def _filtered(centres: Image, kernel: Image) -> list[Image]:
    """Return differences along x and y."""
    return [cv2.filter2D(centres, -1, each, borderType=cv2.BORDER_REPLICATE) for each in (kernel, kernel.T)]


def pixels_per_rad(camera: Camera) -> float:
    """Return the fewest pixels per rad of sightlines over a frame."""
    x, y = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    points = np.stack([x, y], axis=-1)
    rays = camera.unproject(points)
    steps = [np.linalg.norm(camera.unproject(points + step) - rays, axis=-1) for step in np.eye(2)]
    return float(1 / np.nanmax(steps))


@dataclass(frozen=True)
class Clues:
    """What the rays through the centres tell beside the radiance, in the same kernel."""

    labels: ShapeLabels  # Of the shape; they come first
    lights: Array  # (L, 3): camera frame, mm
    # Angle, rad, within which each light's emission may change; 1 where it is alike in all directions
    beams: list[float]
    px_per_rad: float  # See `pixels_per_rad`

    def trace(self, preliminary: Any, hit: Hit, rays: Rays, rotation: Any, relief: ReliefKernel | None) -> list[Any]:
        """Compute labels, gaps (normal minus bisector, three channels a light), and the least scale of lights, px."""
        channels = self.labels.trace(preliminary, hit, rays, rotation, relief)
        seats = [(mi.Vector3f(*light.tolist()), mi.Float(beam)) for light, beam in
                 zip(self.lights, self.beams, strict=True)]  # fmt: skip
        sharpness = mi.Float(self.px_per_rad)
        dr.make_opaque(seats, sharpness)
        position, normal = rays.sightline * hit.base.t, rotation @ mi.Vector3f(hit.fine.sh_frame.n)
        # Pixels per mm of the surface, along the direction in which it is seen shortest.
        facing = dr.abs(dr.dot(rotation @ mi.Vector3f(hit.base.sh_frame.n), rays.sightline))
        per_mm, scale = facing * sharpness / hit.base.t, mi.Float(dr.inf)
        for light, beam in seats:
            towards = light - position
            distance = dr.norm(towards)
            bisector = dr.normalize(towards / distance - rays.sightline)
            channels += [dr.select(hit.base.is_valid(), gap, dr.nan) for gap in normal - bisector]
            scale = dr.minimum(scale, beam * distance * per_mm)
        return [*channels, scale]


def choose(parts: list[Image], depth: Image, gaps: list[Image], scale: Image, half_width: float) -> Mask:
    """Return the pixels that need samples, shape (H, W), by the rays through the centres.

    `parts` are channels of the radiance, `depth` is in mm, NaN where there is no surface; for `gaps` and `scale` see
    `Clues.trace`. A normal that turns by more than `half_width`, rad, at which the lobe falls to half, from pixel to
    pixel may hide a highlight.
    """
    seen = np.isfinite(depth).astype(np.uint8)
    chosen = cv2.dilate(seen, _AROUND) != cv2.erode(seen, _AROUND)
    whole = np.sum(parts, axis=0) * np.float32(2 / len(parts))
    for part in parts:
        chosen |= uneven(part, whole)
    with np.errstate(invalid="ignore"):
        chosen |= scale < LEAST_SCALE_PX
        for first in range(0, len(gaps), 3):
            gap = np.stack(gaps[first : first + 3])
            # From each pixel to the next; the pixels around follow below.
            chosen[:, 1:] |= np.square(np.diff(gap, axis=2)).sum(axis=0) > half_width**2
            chosen[1:] |= np.square(np.diff(gap, axis=1)).sum(axis=0) > half_width**2
    chosen = cv2.dilate(chosen.astype(np.uint8), _AROUND) > 0
    chosen[:BORDER_PX] = chosen[-BORDER_PX:] = True
    chosen[:, :BORDER_PX] = chosen[:, -BORDER_PX:] = True
    return chosen


LEAST_SAMPLES = 4
"""Fewer samples a pixel are taken everywhere."""

LEAST_RADIUS_PX = 8.0
"""An analytic shape that looks smaller than this gets all samples."""


def applies(scene: Scene) -> bool:
    """Return whether the rule for smooth pixels is made for a scene.

    Left out: bounces, which are random; sources of finite size, whose penumbrae need many rays at each centre; relief
    and the colour of tissue, which may be finer than a pixel; instruments, whose edges and shadows no label shows.
    Frames of a moving camera do not come here: each of their steps takes so few samples that the rays through the
    centres would cost more than they save.
    """
    effort, lights = scene.render, scene.rig.lights
    direct = effort.path_depth == 2 and all(light.source is None for light in lights)
    plain = scene.surface.relief is None and scene.albedo is None and not scene.shown_instruments
    enough = effort.adaptive and effort.samples_per_pixel >= LEAST_SAMPLES
    return enough and direct and plain and len(lights) <= MOST_LIGHTS


def beam(light: LightSpec) -> float:
    """Return the angle, rad, within which a light's emission may change; 1 where it is alike in all directions."""
    angles = [1.0]
    if isinstance(light.profile, CosineProfile):
        angles.append(math.sqrt(2 * math.log(2) / max(light.profile.power, 1e-9)))
    else:
        angles.append(math.radians(float(np.diff(light.profile.angle_deg).min())))
    if light.spot_deg is not None:
        angles.append(math.radians(light.spot_deg / 2))
    return min(angles)


def render(
    tracer: Tracer, scene: Scene, shape: Shape, edges: MeshEdges | None, progress: Progress | None
) -> tuple[list[Image], list[Image]]:
    """Return the channels of the mean radiance, and of the labels without curvatures, shape (H, W) each.

    `applies` is true for the scene; `edges` are those of a mesh.
    """
    effort, camera = scene.render, tracer.sightlines.camera
    pixels = camera.width * camera.height
    total = pixels * effort.samples_per_pixel
    # The rays through the centres.
    beams = [beam(light) for light in scene.rig.lights]
    labels = ShapeLabels(tracer.scene.shapes()[0], None, curved=False)
    clues = Clues(labels, scene.rig.true_mm(), beams, pixels_per_rad(camera))
    begun: Progress | None = progress and (lambda done, _, what: progress(done, total, what))
    parts, channels = tracer.centres(None, True, clues, begun)
    first = -1 - 3 * len(clues.lights)
    centres, gaps, scale = channels[:first], channels[first:-1], channels[-1]
    # What follows from them, and which pixels need more.
    depth, width = centres[CHANNELS.index("depth")], scene.reflectance.half_width
    if _is_small(shape, tracer.sightlines.pose, clues.px_per_rad):
        chosen = np.ones(depth.shape, dtype=bool)
    else:
        chosen = choose(parts, depth, gaps, scale, width)
        if edges is not None:
            lights = np.reshape([place for place in scene.rig.true_mm() if not is_at_camera(place)], (-1, 3))
            chosen |= edges.marks(camera, tracer.sightlines.pose, lights, depth, width, clues.px_per_rad)
    means = [mean_of_pixel(part) for part in parts]
    numbers = in_tiles(chosen)
    if len(numbers):
        share = (total - pixels) / (len(numbers) * effort.samples_per_pixel)
        went_on: Tell | None = progress and (
            lambda traced: progress(pixels + round(share * traced), total, "rendering")
        )
        sampled = tracer.means_at(numbers, effort.samples_per_pixel, effort.seed, went_on)
        for mean, channel in zip(means, sampled, strict=True):
            mean.ravel()[numbers] = channel
    return means, centres


def _is_small(shape: Shape, pose: Array, px_per_rad: float) -> bool:
    """Return whether an analytic shape looks so small from a pose that centres may miss it."""
    if shape.kind not in ("sphere", "cylinder"):
        return False
    radius = float(np.linalg.norm(shape.to_model[:3, 0]))
    offset = np.linalg.inv(shape.to_model)[:3] @ pose[:, 3]
    distance = radius * float(np.linalg.norm(offset[: 3 if shape.kind == "sphere" else 2]))
    return radius * px_per_rad < LEAST_RADIUS_PX * distance
