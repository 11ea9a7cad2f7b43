"""Light that walls send back to each other: the radiosity of patches around the camera, without shadows between them.

The rig is near the camera, so that the camera sees what it lights. Half of the patches are spread evenly over the
directions from the camera, as the light is about, and half over the surface, so that far walls have their own.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import channels, vectors_from_kernel, vectors_to_kernel
from simtest.rendering.rays import Hit, Rays
from simtest.rendering.trace import Tracer
from simtest.rendering.truth import as_labels
from simtest.runtime.arrays import Array, Image

PATCHES, LEVELS, BOUNCES = 512, 6, 12
"""Patches, halvings of the sphere into the directions among which they are chosen, and bounces between them."""

STRIDE, SAME_WALL = 4, 0.05
"""Pixels between those where the light that arrives is computed, and a share of the distance by which others differ."""


def scattered(tracer: Tracer, hits: list[Image]) -> list[Image]:
    """Return the channels, shape (H, W), of the base's light of more bounces, from the labels' channels `hits`."""
    labels, pose = as_labels(hits), tracer.sightlines.pose
    some = tuple(slice(min(STRIDE // 2, size - 1), None, STRIDE) for size in labels.depth.shape)
    depth = np.nan_to_num(labels.depth[some])
    places, normals = (
        np.nan_to_num(part[some].reshape(-1, 3)) @ pose[:3, :3].T for part in (labels.position, labels.normal_base)
    )
    light = _arriving(_patches(tracer), places + pose[:3, 3], normals)
    values, (rows, columns) = mi.Float(np.hstack([depth.reshape(-1, 1), light]).ravel()), depth.shape
    width = channels() + 1

    def reflect(preliminary: Any, hit: Hit, rays: Rays, first: int) -> list[Any]:
        si, start = hit.base, mi.UInt32(first)
        dr.make_opaque(start)
        with tracer.material.painted(hit):
            share = tracer.material.towards(hit, mi.Vector3f(si.sh_frame.n), si.is_valid())[1]
        # Between the four nearest of the grid
        pixel = start + dr.arange(mi.UInt32, dr.width(preliminary.t))
        row = pixel // tracer.sightlines.camera.width
        x, y = ((mi.Float(at) + 0.5) / STRIDE - 0.5 for at in (pixel - row * tracer.sightlines.camera.width, row))
        sums = [mi.Float(0) for _ in range(width)]
        for column, line in ((dr.floor(x) + i, dr.floor(y) + j) for i in (0, 1) for j in (0, 1)):
            index = mi.UInt32(dr.clip(line, 0, rows - 1) * columns + dr.clip(column, 0, columns - 1)) * width
            distance, *parts = (dr.gather(mi.Float, values, index + k) for k in range(width))
            weight = (1 - dr.abs(x - column)) * (1 - dr.abs(y - line)) + 1e-3
            weight /= 1 + dr.square((distance / si.t - 1) / SAME_WALL)
            sums = [total + weight * part for total, part in zip(sums, (1, *parts), strict=True)]
        return [dr.select(si.is_valid(), f * part / sums[0], 0) for f, part in zip(share, sums[1:], strict=True)]

    # The base alone: light from all around hardly sees the relief.
    return replace(tracer, relief=None).at_centres(hits, reflect)


def _patches(tracer: Tracer) -> Array:
    """Return the rows, shape (M, 7 + C), of patches: position, normal, area, mm^2, and radiance."""
    # Cells of equal solid angle in Morton's order: what is even along it is even over the sphere.
    number, side = np.arange(4**LEVELS), 2**LEVELS
    i, j = (sum((number >> 2 * bit + odd & 1) << bit for bit in range(LEVELS)) for odd in (0, 1))
    z, turn = 1 - (2 * i + 1) / side, 2 * math.pi * (j + 0.5) / side
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    eye = mi.Point3f(*tracer.sightlines.pose[:3, 3].tolist())
    dr.make_opaque(eye)

    def seen(chosen: Array) -> Any:
        return tracer.scene.ray_intersect(mi.Ray3f(eye, vectors_to_kernel(mi.Vector3f, mi.Float, chosen, np.float32)))

    si = seen(directions)
    cosine = dr.maximum(dr.abs(si.wi.z), 0.03)  # a ray along the wall says little of its area
    area = np.array(dr.select(si.is_valid(), dr.square(si.t) / cosine, 0), dtype=float) * (4 * math.pi / side**2)
    # Of no surface at all the patches send nothing.
    chance = ((area > 0) / max(np.count_nonzero(area), 1) + area / max(area.sum(), 1e-12)) / 2
    chosen = np.searchsorted(np.cumsum(chance), (np.arange(PATCHES) + 0.5) / PATCHES * chance.sum())
    si = seen(directions[chosen])
    hit, light, place, normal = Hit(si, si, si), tracer.light, mi.Vector3f(si.p), mi.Vector3f(si.sh_frame.n)
    with tracer.material.painted(hit):
        first = light.radiance(tracer.blockers, tracer.material, hit, light.fixed_points())[1]
        share = tracer.material.towards(hit, normal, si.is_valid())[1]
    dr.eval(place, normal, first, share)
    places, normals, sent, share = (vectors_from_kernel(part, float) for part in (place, normal, first, share))
    areas, first = area[chosen, None] / (PATCHES * chance[chosen, None].clip(1e-12)), sent
    for _ in range(BOUNCES):
        sent = first + share * _arriving(np.hstack([places, normals, areas, sent]), places, normals)
    return np.hstack([places, normals, areas, sent])


def _arriving(patches: Array, places: Array, normals: Array) -> Image:
    """Return the irradiance, shape (N, C), at places with normals, each of shape (N, 3), of patches."""
    table, count, width = mi.Float(patches.astype(np.float32).ravel()), mi.UInt32(len(patches)), patches.shape[1]
    dr.make_opaque(count)
    place, normal = (vectors_to_kernel(mi.Vector3f, mi.Float, rows, np.float32) for rows in (places, normals))

    def add(i: Any, whole: Any, *sums: Any) -> tuple[Any, ...]:
        x, y, z, nx, ny, nz, area, *sent = (dr.gather(mi.Float, table, i * width + k) for k in range(width))
        way = mi.Vector3f(x, y, z) - place
        squared = dr.squared_norm(way)
        cosines = dr.maximum(dr.dot(way, normal), 0) * dr.maximum(-dr.dot(way, mi.Vector3f(nx, ny, nz)), 0)
        # A patch is a disc, which sends less to what is near than its centre would.
        weight = area * cosines / dr.maximum(squared * (squared + area / math.pi), 1e-12)
        return i + 1, whole + weight, *(total + weight * part for total, part in zip(sums, sent, strict=True))

    start = (mi.UInt32(0), *[mi.Float(0) for _ in range(width - 6)])
    _, whole, *sums = dr.while_loop(start, lambda i, *_: i < count, add)
    # Patches that fill more than the half space hide each other.
    parts = [part / dr.maximum(whole / math.pi, 1) for part in sums]
    dr.eval(parts)
    return np.stack([np.array(part) for part in parts], axis=1)
