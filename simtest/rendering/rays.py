"""Rays through pixels, and the surface points that they hit.

The kernel computes the sightlines of a pinhole and of an equidistant fisheye itself; those of any other camera come
from its `unproject`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.geometry.camera import Camera, ViewMask
from simtest.geometry.lenses import KannalaBrandt
from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import to_kernel
from simtest.rendering.tissue_kernels import KernelJets, ReliefKernel, turned
from simtest.runtime.arrays import Array, Mask
from simtest.surfaces import Shape

Pixels = npt.NDArray[np.uint32]

TILE = 4
"""Pixels along a side of the tiles in which several samples a pixel are traced: neighbours hit the same triangles."""

# The additive recurrence of the plane's generalised golden ratio, as shares of 2^32: any number of first points
# covers the pixel evenly.
_STEP_X, _STEP_Y = 0xC13FA9A9, 0x91E10DA5


def is_pinhole(camera: Camera) -> bool:
    """Return whether a camera's sightlines are those of its matrix K, over the whole frame."""
    x, y = np.meshgrid(np.linspace(0, camera.width, 5), np.linspace(0, camera.height, 5))
    points = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = points @ np.linalg.inv(camera.K).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.allclose(camera.unproject(points[..., :2]), rays, rtol=0, atol=1e-12)


def is_equidistant(camera: Camera) -> bool:
    """Return whether a camera's field angles are the distances from its centre, in focal lengths."""
    return camera.distortion == KannalaBrandt() and type(camera).unproject is Camera.unproject


@dataclass(frozen=True)
class Lanes:
    """The pixels that one launch of a kernel works on."""

    # column, row: The pixels; beyond the frame where it is no multiple of the tile
    column: Any
    row: Any
    # shift_x, shift_y: Random shifts of the pixels' sample points, shares of 2^32
    shift_x: Any
    shift_y: Any


@dataclass(frozen=True)
class Rays:
    """Rays of one launch."""

    traced: Any  # Model frame, mm; unit directions
    # origin, direction: The same in double precision
    origin: Any
    direction: Any
    sightline: Any  # The directions in the camera frame
    active: Any  # False where the camera has no sightline or the pixel lies outside its round field of view


class Sightlines:
    """The rays of a camera at its pose, model_from_camera, shape (4, 4), mm."""

    def __init__(self, camera: Camera, model_from_camera: Array) -> None:
        self.camera = camera
        self._bends = is_equidistant(camera)
        self.in_kernel = self._bends or is_pinhole(camera)
        self.pose = model_from_camera
        # Opaque, so that another camera or pose compiles no new kernel.
        self._origin = mi.Vector3d(*model_from_camera[:3, 3].tolist())
        self._rotation = mi.Matrix3d(model_from_camera[:3, :3].tolist())
        self.camera_from_model = mi.Matrix3f(model_from_camera[:3, :3].T.tolist())
        numbers = {"fx": 1 / camera.fx, "fy": 1 / camera.fy, "cx": camera.cx, "cy": camera.cy, "skew": camera.skew}
        self._numbers = {name: mi.Float64(value) for name, value in numbers.items()}
        mask = camera.view_mask
        # In double precision, to decide as `Camera.seen` does.
        self._mask = None if mask is None else _mask_numbers(mask)
        self._width, self._tiles = mi.UInt32(camera.width), mi.UInt32(-(-camera.width // TILE))
        dr.make_opaque(self._origin, self._rotation, self.camera_from_model, self._numbers)
        dr.make_opaque(self._mask, self._width, self._tiles)

    def lanes(self, first: int, count: int, tiled: bool, seed: int) -> Lanes:
        """Return `count` pixels from `first` on, in tiles or rows; samples depend on seed and pixel alone."""
        start, salt = mi.UInt32(first), mi.UInt32(seed)
        dr.make_opaque(start, salt)
        index = dr.arange(mi.UInt32, count) + start
        # Lane -> pixel: tile by tile, within a tile row by row.
        if tiled:
            cell, tile = index & (TILE * TILE - 1), index // (TILE * TILE)
            tile_row = tile // self._tiles
            column = (tile - tile_row * self._tiles) * TILE + (cell & (TILE - 1))
            row = tile_row * TILE + cell // TILE
        else:
            row = index // self._width
            column = index - row * self._width
        return Lanes(column, row, *mi.sample_tea_32(row * self._width + column, salt))

    def lanes_of(self, pixels: Pixels, seed: int) -> Lanes:
        """Return the lanes of pixels by their numbers, row after row; their sample points are those of `lanes`."""
        index, salt = to_kernel(mi.UInt32, pixels, np.uint32), mi.UInt32(seed)
        dr.make_opaque(salt)
        row = index // self._width
        return Lanes(index - row * self._width, row, *mi.sample_tea_32(index, salt))

    def sample(self, lanes: Lanes, number: Any) -> tuple[Any, Any]:
        """Return the position, px, of a pixel's sample by its number: uniform, and evenly spread over the numbers."""
        x, y = lanes.shift_x + number * mi.UInt32(_STEP_X), lanes.shift_y + number * mi.UInt32(_STEP_Y)
        # Single precision holds 24 bits.
        share = 2.0**-24
        return mi.Float(lanes.column) + mi.Float(x >> 8) * share, mi.Float(lanes.row) + mi.Float(y >> 8) * share

    def centre(self, lanes: Lanes) -> tuple[Any, Any]:
        """Return the centres of the pixels, px."""
        return mi.Float(lanes.column) + PIXEL_CENTRE, mi.Float(lanes.row) + PIXEL_CENTRE

    def rays(self, x: Any, y: Any) -> Rays:
        """Return the rays through pixel positions x and y, mitsuba.Float, px."""
        active = mi.Bool(True)
        # Sightlines, camera frame.
        if self.in_kernel:
            # K^-1 (x, y, 1).
            n = self._numbers
            b = (mi.Float64(y) - n["cy"]) * n["fy"]
            a = (mi.Float64(x) - n["cx"] - n["skew"] * b) * n["fx"]
            if self._bends:
                angle = dr.sqrt(a * a + b * b)
                sine, cosine = dr.sincos(angle)
                share = dr.select(angle > 0, sine / angle, 1)
                sightline, active = mi.Vector3d(a * share, b * share, cosine), angle < dr.pi
            else:
                sightline = mi.Vector3d(a, b, 1) / dr.sqrt(a * a + b * b + 1)
        else:
            directions = self.camera.unproject(np.stack([np.array(x), np.array(y)], axis=-1).astype(np.float64))
            imaged = np.asarray(np.isfinite(directions).all(axis=-1))
            # No NaN may enter the renderer.
            directions = np.where(imaged[:, None], directions, [0.0, 0.0, 1.0])
            sightline, active = mi.Vector3d(np.ascontiguousarray(directions.T)), mi.Bool(imaged)
        # Field of view.
        if self._mask is not None:
            column, row = (mi.Float64(dr.floor(v)) + PIXEL_CENTRE for v in (x, y))
            active &= _is_seen(self._mask, column, row)
        direction = self._rotation @ sightline
        traced = mi.Ray3f(mi.Point3f(self._origin), mi.Vector3f(direction))
        return Rays(traced, self._origin, direction, mi.Vector3f(sightline), active)

    def in_model(self, points_px: Array) -> tuple[Array, Array]:
        """Return origins and unit directions, model frame, of pixel positions; NaN where there is no sightline."""
        directions = self.camera.unproject(points_px) @ self.pose[:3, :3].T
        return np.broadcast_to(self.pose[:3, 3], directions.shape), directions

    def in_view(self, points_px: Array) -> tuple[Array, Array]:
        """Return origins and directions as `in_model` does; NaN outside the field of view."""
        origins, directions = self.in_model(points_px)
        mask = self.camera.view_mask
        return origins, directions if mask is None else np.where(mask.contains(points_px)[:, None], directions, np.nan)


def in_tiles(chosen: Mask) -> Pixels:
    """Return the numbers of the pixels where a map, shape (H, W), is true, tile by tile."""
    height, width = chosen.shape
    down, across = -(-height // TILE), -(-width // TILE)
    whole = np.zeros((down * TILE, across * TILE), dtype=bool)
    whole[:height, :width] = chosen
    tile, cell = np.nonzero(whole.reshape(down, TILE, across, TILE).swapaxes(1, 2).reshape(-1, TILE * TILE))
    row, column = tile // across * TILE + cell // TILE, tile % across * TILE + cell % TILE
    return (row * width + column).astype(np.uint32)


def _mask_numbers(mask: ViewMask) -> list[Any]:
    """Return a view mask's centre and limits for the kernel: the circle's square, or those of sides and cuts."""
    limits = [mask.radius**2]
    if mask.corner is not None:
        height = mask.half_height or mask.radius
        limits = [mask.radius, height, mask.radius + height - mask.corner]
    return [mi.Float64(value) for value in (mask.cx, mask.cy, *limits)]


def _is_seen(numbers: list[Any], column: Any, row: Any) -> Any:
    """Return which pixels lie inside a view mask (see `_mask_numbers`), with the terms of `ViewMask.contains`."""
    cx, cy, *limits = numbers
    x, y = column - cx, row - cy
    if len(limits) == 1:
        return dr.square(x) + dr.square(y) <= limits[0]
    across, down = dr.abs(x), dr.abs(y)
    return (across <= limits[0]) & (down <= limits[1]) & (across + down <= limits[2])


def untile(values: Any, size: tuple[int, int]) -> Any:
    """Sort channels, shape (..., N), from tiles into rows, shape (..., height, width); the size is of whole tiles."""
    height, width = size
    lead = values.shape[:-1]
    cells = values.reshape(*lead, height // TILE, width // TILE, TILE, TILE)
    return np.swapaxes(cells, -3, -2).reshape(*lead, height, width)


@dataclass(frozen=True)
class Hit:
    """Surface points, mitsuba.SurfaceInteraction3f, with three normals; without a relief they are one object."""

    base: Any  # Of the smooth surface
    fine: Any  # Of the relief: what light off the lobe sees
    diffuse: Any  # Of the smoothed relief: what light sees that has travelled below the surface
    jets: KernelJets | None = None  # Of the relief


def make_hit(si: Any, relief: ReliefKernel | None, bent: bool = False) -> Hit:
    """Make a hit of the base's surface points; with the relief's second derivatives if `bent`."""
    if relief is None:
        return Hit(si, si, si)
    jets = relief.jets_at(si, bent)
    return Hit(si, turned(si, jets.gradient), turned(si, jets.diffused), jets)


def tangents_and_turns(si: Any) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Return two perpendicular tangents of surface points, and the change of the shape's normal along each."""
    first, along = dr.normalize(si.dp_du), si.dn_du / dr.norm(si.dp_du)
    share = dr.dot(first, si.dp_dv)
    across = si.dp_dv - share * first
    return (first, dr.normalize(across)), (along, (si.dn_dv - share * along) / dr.norm(across))


_ROUND = {"sphere": (1.0, 1.0, 1.0), "cylinder": (1.0, 1.0, 0.0)}
"""Weights of the squared coordinates, whose sum is 1 on Mitsuba's unit shape."""

SAME_HIT = 1e-2
"""A solution farther than this from Mitsuba's hit, relative to the distance, is another point: Mitsuba's is kept."""


class HitRefinement:
    """Solves the hits on one shape again in double precision; hits on a mesh are left as they are.

    Mitsuba's rays are single precision. At a silhouette the hit moves by the ray's rounding over the cosine of view,
    and the cosine of the light is small there too: together a relative error of the radiance of 1e-4 and more, although
    the light is direct and the surface has a formula. So the hit is solved again from the camera's own ray.
    """

    def __init__(self, shape: Shape) -> None:
        self.shape = shape
        if shape.mesh is None:
            local_from_model = np.linalg.inv(shape.to_model)
            # Opaque, so that a moved or larger shape compiles no new kernel.
            self._turn = mi.Matrix3d(local_from_model[:3, :3].tolist())
            self._shift = mi.Vector3d(local_from_model[:3, 3].tolist())
            self._normals = mi.Matrix3d(local_from_model[:3, :3].T.tolist())
            dr.make_opaque(self._turn, self._shift, self._normals)

    def apply(self, origin: Any, direction: Any, si: Any) -> None:
        """Replace position, normals and local view direction of what Mitsuba found on rays, mitsuba.Vector3d, unit."""
        if self.shape.mesh is not None:
            return
        # Solve on the unit shape.
        o, d = self._turn @ origin + self._shift, self._turn @ direction
        if self.shape.kind == "plane":
            t = -o.z / d.z
            gradient = mi.Vector3d(0, 0, 1)
        else:
            weights = mi.Vector3d(*_ROUND[self.shape.kind])
            t = self._root(weights, o, d, mi.Float64(si.t))
            gradient = weights * (o + t * d)
        # Normals transform by the inverse transpose.
        normal = dr.normalize(self._normals @ gradient) * (-1.0 if self.shape.flip else 1.0)
        # Replace Mitsuba's values where the solution is the same hit.
        same = si.is_valid() & dr.isfinite(t) & (dr.abs(mi.Float(t) - si.t) < SAME_HIT * si.t)
        position = origin + t * direction
        si.p = dr.select(same, mi.Point3f(position), si.p)
        si.n = dr.select(same, mi.Normal3f(normal), si.n)
        si.sh_frame = mi.Frame3f(dr.select(same, mi.Normal3f(normal), si.sh_frame.n))
        si.wi = si.to_local(-mi.Vector3f(direction))

    def _root(self, weights: Any, o: Any, d: Any, near: Any) -> Any:
        """Solve |o + t d|^2 = 1, in the weighted norm, for the t nearest to a distance; NaN where there is none."""
        a, b, c = (dr.sum(weights * p * q) for p, q in ((d, d), (o, d), (o, o)))
        c -= 1
        # Without cancellation: one root is q/a, the other c/q.
        q = -(b + dr.copysign(dr.sqrt(b * b - a * c), b))
        first, second = q / a, c / q
        return dr.select(dr.abs(first - near) < dr.abs(second - near), first, second)
