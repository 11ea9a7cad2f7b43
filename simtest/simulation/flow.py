"""Optical flow between two frames of a sequence, which surface points both of them see, and flow as a picture.

The flow at a pixel's centre is exact: the surface point on its ray, moved to the other frame's moment, and projected by
the other frame's camera. It needs no search for matches, so it is true where a highlight slides over the surface, too.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry import Camera
from simtest.geometry.patch import dilated
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Mask, Picture
from simtest.surfaces.deformation import DeformationAt, DeformedSurface

NONE, SEEN, OUT, HIDDEN, INSTRUMENT = range(5)
"""State of a pixel: its ray meets no surface; the other frame sees its point too; the point lies outside the other
frame's view; something hides it from the other frame; an instrument is seen here."""

STATES = ("no surface", "seen in both", "out of view", "hidden", "instrument")
"""The states' names, by their numbers."""

SLACK = 1e-3
"""What stands before a point by less than this share of its distance does not hide it: the rendered mesh differs from
the smooth surface."""

NEAR = 0.05
"""Within this share of the distance the mesh may seem to hide a point at a grazing ray: the exact surface decides."""

EXACT = 1e-9
"""The same share for points at the edges of what both frames see, where the exact surface decides."""

JUMP = 0.02
"""Where the distances of neighbours differ by more than this share there is an edge."""

PERCENTILE = 99.0
"""Of the flow's lengths: it and longer ones have full colour."""

WHEEL_SHARE = 0.2
"""Diameter of the key's wheel over the picture's height."""

HIDDEN_VALUE = 0.45
"""Brightness of what the other frame does not see; what has no flow is black."""

_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)

Moved = Callable[[Array], Array]
"""Maps points of the world, shape (N, 3), mm, at one frame's moment to where the same material is at the other's."""


def moved_between(session: Session, first_s: float, second_s: float) -> Moved | None:
    """Return what maps points of the world at one moment to where the same tissue is at another; None: they stay."""
    if not isinstance(session.surface, DeformedSurface):
        return None
    parts = session.scene.deformation
    first, second = DeformationAt(parts, first_s), DeformationAt(parts, second_s)
    return lambda points: second.moved(first.at_rest(points))


@dataclass(frozen=True)
class SeenSurface:
    """What a frame sees of the surface, world frame, mm.

    `position`, shape (H, W, 3), is the surface point at each pixel's centre, NaN where there is none, also behind an
    instrument; `instrument` is not 0 where one is seen, None: nowhere.
    """

    camera: Camera
    world_from_camera: Array
    position: Array
    instrument: npt.NDArray[np.uint8] | None = None

    @classmethod
    def of(cls, session: Session) -> "SeenSurface":
        """Return what a session's frame sees."""
        camera, pose = session.camera, np.array(session.surface.model_from_camera)
        depth = session.depths()
        rays = camera.unproject(camera.pixel_centres()).reshape(-1, 3) @ pose[:3, :3].T
        position = pose[:3, 3] + rays * depth.reshape(-1, 1)
        cover = session.cover()
        return cls(camera, pose, position.reshape(*depth.shape, 3), None if cover is None else cover.numbers)

    def project(self, points: Array) -> Array:
        """Return the pixels, shape (N, 2), at which the camera images points of the world, shape (N, 3)."""
        pose = self.world_from_camera
        return self.camera.project((points - pose[:3, 3]) @ pose[:3, :3])

    @property
    def tissue(self) -> Array:
        """Return `position` with NaN where an instrument is seen."""
        return self.position if self.instrument is None else np.where(self.instrument[..., None], np.nan, self.position)

    def shows(self, points_px: Array) -> Mask:
        """Return which pixel positions, shape (N, 2), lie in view and not on an instrument."""
        with np.errstate(invalid="ignore"):
            shown = self.camera.contains(points_px)
        if self.instrument is not None:
            shown[shown] = _at(self.instrument, points_px[shown]) == 0
        return shown


@dataclass(frozen=True)
class Flow:
    """Flow from one frame to another.

    `flow_px`, shape (H, W, 2), is where the surface point at each pixel's centre lies in the other frame, less that
    centre, also where the other frame does not see it; NaN where there is no surface point or the other camera images
    none. `state`, shape (H, W), is an index in `STATES`.
    """

    flow_px: Array
    state: npt.NDArray[np.uint8]


def flow_between(session: Session, first: SeenSurface, second: SeenSurface, moved: Moved | None = None) -> Flow:
    """Compute the flow from the first frame to the second, in either order of time.

    The session is at a scene whose surface has the form of the second frame's moment, and `moved` leads there from the
    first's (see `Moved`); default: points stay.
    """
    size = first.position.shape[:2]
    points = first.position.reshape(-1, 3)
    state = np.full(len(points), NONE, dtype=np.uint8)
    target = np.full((len(points), 2), np.nan)
    known = np.isfinite(points[:, 0])
    if first.instrument is not None:
        covered = first.instrument.reshape(-1) > 0
        state[covered] = INSTRUMENT
        known &= ~covered
    index = np.flatnonzero(known)
    there = points[index] if moved is None else moved(points[index])
    target[index] = second.project(there)
    # In view, and then not hidden.
    with np.errstate(invalid="ignore"):
        inside = second.camera.contains(target[index])
    state[index[~inside]] = OUT
    candidates = index[inside]
    hidden = hides(session, second.world_from_camera[:3, 3], there[inside])
    if second.instrument is not None:
        hidden |= _at(second.instrument, target[candidates]) > 0
    state[candidates] = np.where(hidden, HIDDEN, SEEN)
    # At the edges of what both see a point may be hidden by less than the slack.
    edge = candidates[_edges(state.reshape(size), first).reshape(-1)[candidates]]
    at = np.searchsorted(index, edge)
    state[edge[_not_shown(session, second.world_from_camera[:3, 3], there[at])]] = HIDDEN
    flow = target.reshape(*size, 2) - first.camera.pixel_centres()
    return Flow(flow, state.reshape(size))


def hides(session: Session, centre: Array, points: Array) -> Mask:
    """Return which points of a session's surface, shape (N, 3), it hides itself from a camera; world frame, mm.

    `centre` is that of one camera, shape (3,), or of each point's, shape (N, 3).
    """
    origins, directions, distance = _rays(centre, points)
    hidden = session.blocked(origins, directions, distance * (1 - SLACK))
    # Grazing rays may meet the mesh where the exact surface is free.
    doubtful = np.flatnonzero(hidden)
    rays = origins[doubtful], directions[doubtful]
    hits = session.exact_hits(*rays)
    close = hits.distance > distance[doubtful] * (1 - NEAR)
    near, rays = doubtful[close], (rays[0][close], rays[1][close])
    if len(near):
        exact = session.exact_distances(*rays)
        with np.errstate(invalid="ignore"):
            # A ray that grazes the mesh and misses the exact surface is free.
            hidden[near] = exact < distance[near] * (1 - SLACK)
    return hidden


def _rays(centre: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return origins, unit directions and lengths of the ways from a centre to points, shape (N, 3)."""
    towards = points - centre
    distance = np.sqrt(np.einsum("ij,ij->i", towards, towards))
    return np.broadcast_to(centre, points.shape), towards / distance[:, None], distance


def _not_shown(session: Session, centre: Array, points: Array) -> Mask:
    """Return which points, world frame, mm, are not the exact surface's points on the rays from a camera centre."""
    origins, directions, distance = _rays(centre, points)
    exact = session.exact_distances(origins, directions)
    # Another point, nearer, or farther where the mesh lets the ray pass; a ray without a solution touches at best.
    return ~(np.abs(exact - distance) < EXACT * distance)


def _edges(state: npt.NDArray[np.uint8], frame: SeenSurface) -> Mask:
    """Return which pixels that both frames see lie beside one that they do not, or at a jump of the distance."""
    seen = state == SEEN
    beside = dilated((state == NONE) | (state == HIDDEN))
    distance = np.linalg.norm(frame.position - frame.world_from_camera[:3, 3], axis=-1).astype(np.float32)
    far = cv2.dilate(np.nan_to_num(distance, nan=0.0), _NEIGHBOURS)
    near = cv2.erode(np.nan_to_num(distance, nan=np.inf), _NEIGHBOURS)
    return np.asarray(seen & (beside | (far / (1 + JUMP) > near)))


def _at(image: npt.NDArray[np.uint8], points_px: Array) -> npt.NDArray[np.uint8]:
    """Return the values of the pixels in which points, shape (N, 2), lie."""
    height, width = image.shape
    columns = np.clip(points_px[:, 0].astype(np.int64), 0, width - 1)
    rows = np.clip(points_px[:, 1].astype(np.int64), 0, height - 1)
    return image[rows, columns]


def flow_picture(flow: Flow, full_px: float | None = None) -> Picture:
    """Return flow as a picture, shape (H, W, 3), uint8, blue first, with a wheel as its key.

    Full colour has the length `full_px`, default the percentile `PERCENTILE` of the flow's own.
    """
    known = np.isfinite(flow.flow_px).all(axis=-1)
    if full_px is None:
        lengths = np.hypot(*flow.flow_px[known].T)
        full_px = float(np.percentile(lengths, PERCENTILE)) if len(lengths) else 1.0
    value = np.where(flow.state == SEEN, 1.0, HIDDEN_VALUE) * known
    picture = _coloured(np.nan_to_num(flow.flow_px), value, full_px)
    _draw_key(picture, full_px)
    return picture


def _coloured(flow_px: Array, value: Array, full_px: float) -> Picture:
    """Return the colours, blue first, of flow, shape (H, W, 2), with a brightness, shape (H, W), in [0, 1]."""
    x, y = flow_px[..., 0], flow_px[..., 1]
    # OpenCV's hue of 8 bits counts 2 deg; right is red, down is yellow-green.
    hue = np.degrees(np.arctan2(y, x)) % 360 / 2
    length = np.minimum(np.hypot(x, y) / max(full_px, 1e-12), 1.0)
    hsv = np.stack([hue, 255 * length, 255 * value], axis=-1).astype(np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR), dtype=np.uint8)


def _draw_key(picture: Picture, full_px: float) -> None:
    """Draw the wheel in the lower right corner: a point's colour is that of the flow from the centre to it."""
    height, width = picture.shape[:2]
    size = min(math.ceil(WHEEL_SHARE * height), width)
    radius = size / 2
    axis = (np.arange(size) + 0.5 - radius) / radius
    pairs = np.stack(np.meshgrid(axis, axis), axis=-1)
    inside = np.hypot(pairs[..., 0], pairs[..., 1]) <= 1
    wheel = _coloured(pairs, np.ones(pairs.shape[:2]), 1.0)
    corner = picture[height - size :, width - size :]
    corner[inside] = wheel[inside]
    label, scale = f"{full_px:.3g} px", max(size / 200, 0.3)
    (text_width, text_height), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    at = (width - text_width - 2, height - size - max(text_height // 2, 2))
    # A dark border: the picture below may have any colour.
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(picture, label, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thickness, cv2.LINE_AA)
