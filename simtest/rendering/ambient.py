"""Light that walls send back to each other: the radiosity of patches around the camera, without shadows between them.

The rig is near the camera, so that what it lights is in the camera's view, all around it. Half of the patches are even
there, as the light that arrives is about, and half on the surface, so that far walls have their own.
"""

import math
from typing import Any

import numpy as np

from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import channels, to_kernel, vectors_from_kernel, vectors_to_kernel
from simtest.rendering.rays import Hit, Rays
from simtest.rendering.trace import Tracer
from simtest.rendering.truth import as_labels
from simtest.runtime.arrays import Array, Image

PATCHES, LEVELS = 512, 6
"""Patches, and the halvings of the sphere into directions around the camera among which they are chosen."""

STRIDE = 4
"""The light that arrives is computed at every so many pixels, and interpolated."""

LEAST_COSINE = 0.03
"""A patch that is seen at a smaller cosine has the area of one of this cosine: its ray says little of all of it."""

SAME_WALL = 0.05
"""Difference of distances, as a share, at which pixels count little for each other."""

BOUNCES = 16


def scattered(tracer: Tracer, hits: list[Image]) -> list[Image]:
    """Return the channels, shape (H, W), of the light that the walls send to the pixels' centres and on to the camera.

    `hits` are the channels of the labels there.
    """
    grid = _arriving(tracer, hits)
    rows, columns = grid.shape[:2]
    values, width = mi.Float(grid.ravel()), grid.shape[2]

    def reflect(preliminary: Any, rays: Rays) -> list[Any]:
        si = preliminary.compute_surface_interaction(rays.traced, +mi.RayFlags.All, rays.active)
        hit, seen = Hit(si, si, si), si.is_valid()
        with tracer.material.painted(hit):
            share = tracer.material.towards(hit, mi.Vector3f(si.sh_frame.n), seen)[1]
        # Between the four nearest of the grid, by place and by distance
        pixel = dr.arange(mi.UInt32, dr.width(preliminary.t))
        row = pixel // tracer.sightlines.camera.width
        x, y = ((mi.Float(at) + 0.5) / STRIDE - 0.5 for at in (pixel - row * tracer.sightlines.camera.width, row))
        left, top = dr.floor(x), dr.floor(y)
        sums = [mi.Float(0)] * width
        for i in (0, 1):
            for j in (0, 1):
                across, down = (dr.clip(first + k, 0, size - 1) for first, k, size in ((left, i, columns), (top, j, rows)))
                index = mi.UInt32(down * columns + across) * width
                cell = [dr.gather(mi.Float, values, index + k) for k in range(width)]
                weight = dr.abs(1 - i - (x - left)) * dr.abs(1 - j - (y - top)) + 1e-3
                weight /= 1 + dr.square((cell[0] / si.t - 1) / SAME_WALL)
                sums = [total + weight * part for total, part in zip(sums, [mi.Float(1), *cell[1:]], strict=True)]
        return [dr.select(seen, part * each / sums[0], 0) for part, each in zip(share, sums[1:], strict=True)]

    return tracer.at_centres(hits, reflect)


def _arriving(tracer: Tracer, hits: list[Image]) -> Image:
    """Return distances and the light that arrives there, shape (h, w, 1 + C), at the middles of blocks of pixels."""
    labels, pose = as_labels(hits), tracer.sightlines.pose
    some = np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    depth = labels.depth[some]
    points, normals, areas, sent = _patches(tracer)
    table = np.hstack([(points - pose[:3, 3]) @ pose[:3, :3], normals @ pose[:3, :3], areas[:, None], areas[:, None] * sent])
    numbers, count, width = mi.Float(table.astype(np.float32).ravel()), mi.UInt32(len(table)), table.shape[1]
    dr.make_opaque(count)
    place, normal = (
        vectors_to_kernel(mi.Vector3f, mi.Float, np.nan_to_num(part[some].reshape(-1, 3)), np.float32)
        for part in (labels.position, labels.normal_base)
    )

    def add(i: Any, whole: Any, *sums: Any) -> tuple[Any, ...]:
        x, y, z, nx, ny, nz, area, *flux = (dr.gather(mi.Float, numbers, i * width + k) for k in range(width))
        way = mi.Vector3f(x, y, z) - place
        squared = dr.squared_norm(way)
        cosines = dr.maximum(dr.dot(way, normal), 0) * dr.maximum(-dr.dot(way, mi.Vector3f(nx, ny, nz)), 0)
        # A patch is a disc, which sends less to what is near than its centre would.
        weight = cosines / dr.maximum(squared * (squared + area / math.pi), 1e-12)
        return i + 1, whole + weight * area, *(total + weight * f for total, f in zip(sums, flux, strict=True))

    start = (mi.UInt32(0), mi.Float(0), *[mi.Float(0) for _ in range(channels())])
    _, whole, *sums = dr.while_loop(start, lambda i, *_: i < count, add)
    # Where patches fill more than the half space they hide each other.
    arriving = [total / dr.maximum(whole / math.pi, 1) for total in sums]
    dr.eval(arriving)
    return np.stack([np.nan_to_num(depth), *(np.array(part).reshape(depth.shape) for part in arriving)], axis=-1)


def _patches(tracer: Tracer) -> tuple[Array, Array, Array, Array]:
    """Return positions and normals, (M, 3), areas, mm^2, (M,), and the radiance that patches send, (M, C)."""
    # Cells of equal solid angle, in Morton's order: what is chosen evenly along it is even over the sphere too.
    number, side = np.arange(4**LEVELS), 2**LEVELS
    i, j = (sum((number >> 2 * bit + odd & 1) << bit for bit in range(LEVELS)) for odd in (0, 1))
    z, turn = 1 - (2 * i + 1) / side, 2 * math.pi * (j + 0.5) / side
    across = np.sqrt(1 - z**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    eye = mi.Point3f(*tracer.sightlines.pose[:3, 3].tolist())
    dr.make_opaque(eye)

    def seen(chosen: Array) -> Any:
        towards = vectors_to_kernel(mi.Vector3f, mi.Float, chosen, np.float32)
        return tracer.scene.ray_intersect(mi.Ray3f(eye, towards))

    si = seen(directions)
    cosine = dr.maximum(dr.abs(dr.dot(si.sh_frame.n, si.to_world(si.wi))), LEAST_COSINE)
    area = np.array(dr.select(si.is_valid(), dr.square(si.t) / cosine, 0), dtype=float) * (4 * math.pi / side**2)
    found = area > 0
    if not found.any():
        return np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty((0, channels()))
    chance = (found / found.sum() + area / area.sum()) / 2
    chosen = np.searchsorted(np.cumsum(chance), (np.arange(PATCHES) + 0.5) / PATCHES)
    areas = area[chosen] / (PATCHES * chance[chosen])
    si = seen(directions[chosen])
    hit, normal = Hit(si, si, si), mi.Vector3f(si.sh_frame.n)
    with tracer.material.painted(hit):
        first = tracer.light.radiance(tracer.blockers, tracer.material, hit, tracer.light.fixed_points())[1]
        share = tracer.material.towards(hit, normal, si.is_valid())[1]
    place = mi.Vector3f(si.p)
    dr.eval(place, normal, first, share)
    points, normals, first, share = (vectors_from_kernel(part, np.float32) for part in (place, normal, first, share))
    # What each patch gets of the others, and sends on
    way = points[None] - points[:, None]
    squared = (way**2).sum(axis=2)
    cosines = np.maximum(np.einsum("nmi,ni->nm", way, normals), 0) * np.maximum(-np.einsum("nmi,mi->nm", way, normals), 0)
    kernel = cosines / np.maximum(squared * (squared + areas / math.pi), 1e-12) * areas
    kernel /= np.maximum(kernel.sum(axis=1, keepdims=True) / math.pi, 1)
    sent = first
    for _ in range(BOUNCES):
        sent = first + share * (kernel @ sent)
    return points, normals, areas, sent
