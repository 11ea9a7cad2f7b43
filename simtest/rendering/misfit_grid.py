"""The misfit between normal and bisector on a coarse grid over the frame, for all lights in one launch.

It is that of the rendered shape without its relief, and it tells the search for highlight points where to look. Beside
the misfit stands the step to its zero by the derivative of the shape's own normals, so that each pixel judges itself:
no neighbour across an occluding edge disturbs it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.geometry.camera import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.rendering.rays import Sightlines
from simtest.runtime.arrays import Array, Image, IntArray, Mask

MARGIN = 1
"""Grid points beyond the frame on each side, so that a zero next to its border lies between points too."""


@dataclass(frozen=True)
class MisfitGrid:
    """Misfits and Newton's steps at the grid points.

    Parameters
    ----------
    stride : int
        Spacing, px.
    w : ndarray of float32, shape (L, 2, h, w)
        Normal minus bisector across the sightline, for each light; NaN where there is no surface.
    steps : ndarray of float32, shape (L, 2, h, w)
        Turns of the sightline to the zero of the linear misfit along the tangent basis of its reverse in the camera
        frame, rad.
    gain : ndarray of float32, shape (h, w)
        Least abs(1 + d k) of the shape.
    """

    stride: int
    w: Image
    steps: Image
    gain: Image

    def pixels(self, rows: Any, columns: Any) -> Array:
        """Return the pixel positions, shape (N, 2), of rows and columns of the grid, shape (N,), whole or not."""
        first = self.stride // 2 + PIXEL_CENTRE
        return np.stack([(index - MARGIN) * self.stride + first for index in (columns, rows)], axis=1)


def trace_grid(mi: Any, scene: Any, sightlines: Sightlines, lights: Array, stride: int) -> MisfitGrid:
    """Trace the misfits for lights, shape (L, 3), model frame, mm, at the centres of every `stride`-th pixel."""
    import drjit as dr

    camera = sightlines.camera
    height, width = (len(range(stride // 2, size, stride)) + 2 * MARGIN for size in (camera.height, camera.width))
    sources = [mi.Vector3f(*light.tolist()) for light in lights]
    across, spacing = mi.UInt32(width), mi.UInt32(stride)
    dr.make_opaque(sources, across, spacing)
    index = dr.arange(mi.UInt32, height * width)
    row = index // across
    # The grid's first point lies at half a stride, rounded down; the margin is before it.
    half = mi.Float(spacing // 2) + PIXEL_CENTRE
    x, y = ((mi.Float(i) - MARGIN) * mi.Float(spacing) + half for i in (index - row * across, row))
    rays = sightlines.rays(x, y)
    si = scene.ray_intersect_preliminary(rays.traced, True, rays.active).compute_surface_interaction(
        rays.traced, +(mi.RayFlags.All | mi.RayFlags.dNSdUV), rays.active
    )
    # The camera's basis, which is smooth over the frame.
    model_from_camera = sightlines.camera_from_model.T
    basis = tuple(model_from_camera @ axis for axis in mi.coordinate_system(-rays.sightline))
    values = [part for light in sources for part in _misfit_and_step(mi, rays.traced, basis, si, light)]
    values = [dr.select(si.is_valid(), value, dr.nan) for value in (*values, _gain(mi, rays.traced.d, si))]
    # Together: evaluated one by one, each would trace the rays again.
    dr.eval(values)
    channels = np.stack([np.array(value, dtype=np.float32) for value in values])
    maps = channels[:-1].reshape(len(lights), 2, 2, height, width)
    return MisfitGrid(stride, maps[:, 0], maps[:, 1], channels[-1].reshape(height, width))


def _gain(mi: Any, r: Any, si: Any) -> Any:
    """Compute the least abs(1 + d k), with the principal curvatures k of the shape's own normals."""
    import drjit as dr

    facing = dr.select(dr.dot(si.sh_frame.n, r) > 0, mi.Float(-1), mi.Float(1))
    # The change of the normal along two perpendicular tangents.
    first, along = dr.normalize(si.dp_du), si.dn_du / dr.norm(si.dp_du)
    share = dr.dot(first, si.dp_dv)
    across = si.dp_dv - share * first
    second, along_second = dr.normalize(across), (si.dn_dv - share * along) / dr.norm(across)
    a, c = dr.dot(first, along), dr.dot(second, along_second)
    b = (dr.dot(first, along_second) + dr.dot(second, along)) / 2
    mean, half = facing * (a + c) / 2, dr.sqrt(dr.square((a - c) / 2) + dr.square(b))
    return dr.minimum(dr.abs(1 + si.t * (mean - half)), dr.abs(1 + si.t * (mean + half)))


def _misfit_and_step(mi: Any, ray: Any, basis: tuple[Any, Any], si: Any, light: Any) -> list[Any]:
    """Compute the misfit along a basis (see `exact_misfit.exact_misfit`) and the sightline's turn to its zero."""
    import drjit as dr

    r = ray.d
    facing = dr.select(dr.dot(si.sh_frame.n, r) > 0, mi.Float(-1), mi.Float(1))
    normal = mi.Vector3f(si.sh_frame.n) * facing
    # Not si.p, which is off by 1e-3 mm on a plane.
    towards = light - (ray.o + r * si.t)
    reach = dr.norm(towards)
    towards /= reach
    both = towards - r
    size = dr.norm(both)
    bisector = both / size
    gap = normal - bisector
    # A tangent as dp_du a + dp_dv b.
    aa, ab, bb = dr.dot(si.dp_du, si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.dot(si.dp_dv, si.dp_dv)
    area = dr.rcp(aa * bb - ab * ab)
    slope, columns = dr.rcp(dr.dot(si.n, r)), []
    for turn in basis:
        moved = si.t * (turn - r * (dr.dot(si.n, turn) * slope))
        p, q = dr.dot(si.dp_du, moved), dr.dot(si.dp_dv, moved)
        bent = facing * area * (si.dn_du * (bb * p - ab * q) + si.dn_dv * (aa * q - ab * p))
        swing = -(moved - towards * dr.dot(towards, moved)) / reach - turn
        change = bent - (swing - bisector * dr.dot(bisector, swing)) / size
        columns.append((dr.dot(basis[0], change), dr.dot(basis[1], change)))
    u, v = dr.dot(basis[0], gap), dr.dot(basis[1], gap)
    (a, c), (b, d) = columns
    determinant = dr.rcp(a * d - b * c)
    return [u, v, (b * v - d * u) * determinant, (c * u - a * v) * determinant]


def turned_pixels(camera: Camera, pixels: Array, turns: Array) -> Array:
    """Return the pixels, shape (N, 2), where sightlines lead that are turned by `turns`, shape (N, 2), rad."""
    directions = camera.unproject(pixels)
    first, second = tangent_basis(-directions)
    return camera.project(directions + turns[:, :1] * first + turns[:, 1:] * second)


def crossed(w: Image) -> tuple[IntArray, ...]:
    """Return the indices of the cells of grids in which the linear misfit of a triangle half has its zero.

    The misfit is of shape (2, ..., h, w); a cell is named by its first corner: (grid,) row and column.
    """
    corners = [w[..., :-1, :-1], w[..., :-1, 1:], w[..., 1:, :-1], w[..., 1:, 1:]]
    with np.errstate(invalid="ignore"):
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        cells = np.nonzero(((low <= 0) & (high >= 0)).all(axis=0))
    a, b, c, d = (np.stack([part[cells] for part in corner]) for corner in corners)

    def inside(*triangle: Image) -> Mask:
        p, q, r = triangle
        signs = np.stack([u[0] * v[1] - u[1] * v[0] for u, v in ((p, q), (q, r), (r, p))])
        return np.asarray((signs >= 0).all(axis=0) | (signs <= 0).all(axis=0))

    held = inside(a, b, c) | inside(b, d, c)
    return tuple(index[held] for index in cells)
