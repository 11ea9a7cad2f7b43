"""What one frame of a moving camera shows of the tissue: its highlights, or all light of its highlights, with its pose.

Spots are for the map of fine normals (`fine_map`). For the base's normal (`accumulated.base_normal`) the light is
better: spots melt into one another and small ones are missed, but the light of all of them adds up.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.calibration import Frame
from simtest.estimators.cloud_spots import find_spots, specular_light
from simtest.geometry import Array, Camera, Image
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import IntArray, Mask

BLOCK_PX = 4
"""Light is summed over square blocks of so many pixels."""

MOST_QUANTILE = 0.9
"""Light above this quantile of the bright pixels counts as this quantile: one smooth facet must not outshine all
others, and whether it is clipped does not matter."""


@dataclass(frozen=True)
class Sighting:
    """The highlights of one frame.

    Parameters
    ----------
    world_from_camera : ndarray, shape (4, 4)
        Told pose, mm.
    sightlines : ndarray, shape (N, 3)
        Unit sightlines of its highlights, camera frame; or of the blocks of pixels that hold their light.
    in_view : callable, optional
        Takes unit directions of the camera frame, shape (M, 3), and returns which lie in the frame's view, a mask of
        shape (M,); default all.
    light : ndarray, shape (N,), optional
        Light along each sightline: radiance times solid angle, in a unit of the frame's own. None: each highlight
        counts as one.
    source_mm : ndarray, shape (3,), optional
        Where the light is, camera frame, mm; of several the mean. None: at the camera.
    """

    world_from_camera: Array
    sightlines: Array
    in_view: Callable[[Array], Mask] | None = None
    light: Array | None = None
    source_mm: Array | None = None

    def facing(self, points: Array) -> Array:
        """Return the unit normals that mirror the light to the camera at points, shape (N, 3), world frame, mm."""
        centre = self.world_from_camera[:3, 3]
        towards = _unit(centre - points)
        if self.source_mm is None:
            return towards
        source = centre + self.world_from_camera[:3, :3] @ self.source_mm
        return _unit(towards + _unit(source - points))


@dataclass(frozen=True)
class Plane:
    """What is known of the base beforehand: a plane, from a coarse depth or model.

    Parameters
    ----------
    point, normal : ndarray, shape (3,)
        Of the plane, world frame, mm; the unit normal towards the cameras. Neither need be exact: they place
        highlights on the tissue and are no evidence of the normal.
    """

    point: Array
    normal: Array


@dataclass(frozen=True)
class FineMap:
    """Fine normals on the tissue.

    Parameters
    ----------
    position, normal : ndarray, shape (N, 3)
        World frame, mm; unit normals.
    frame : ndarray of int, shape (N,)
        Frame of each.
    """

    position: Array
    normal: Array
    frame: IntArray

    def raster(self, plane: Plane, radius_mm: float, cell_mm: float) -> Array:
        """Return the map as an image on a plane, shape (S, S, 3): the mean unit normal of each cell, NaN where none is.

        Parameters
        ----------
        plane : Plane
            Its point is the image's middle.
        radius_mm, cell_mm : float
            Half the image's side, and the side of a cell, mm.

        Returns
        -------
        ndarray
            Normals, world frame. Column and row run along the two vectors of ``tangent_basis(plane.normal)``.
        """
        size = max(round(2 * radius_mm / cell_mm), 1)
        across = (self.position - plane.point) @ plane_axes(plane).T
        at = np.floor((across / radius_mm + 1) / 2 * size).astype(np.int64)
        inside = ((at >= 0) & (at < size)).all(axis=1)
        total = np.zeros((size, size, 3))
        np.add.at(total, (at[inside, 1], at[inside, 0]), self.normal[inside])
        with np.errstate(invalid="ignore"):
            return np.asarray(total / np.linalg.norm(total, axis=2, keepdims=True))


def plane_axes(plane: Plane) -> Array:
    """Return two unit vectors along a plane, shape (2, 3)."""
    return np.concatenate(tangent_basis(plane.normal[None]))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def spots_of(frame: Frame, world_from_camera: Array, source_mm: Array | None = None) -> Sighting:
    """Return the bright spots of a frame, as `cloud` finds them.

    Parameters
    ----------
    frame : Frame
        Picture and calibration.
    world_from_camera : ndarray, shape (4, 4)
        Told pose, mm.
    source_mm : ndarray, shape (3,), optional
        See `Sighting`.
    """
    camera = frame.camera
    rays = camera.unproject(find_spots(frame).points_px)
    return Sighting(world_from_camera, rays, _view(camera, frame.seen), None, source_mm)


def light_of(frame: Frame, world_from_camera: Array, source_mm: Array | None = None) -> Sighting:
    """Return the light of all highlights of a frame, without telling them apart.

    Parameters
    ----------
    frame : Frame
        Picture and calibration.
    world_from_camera : ndarray, shape (4, 4)
        Told pose, mm.
    source_mm : ndarray, shape (3,), optional
        See `Sighting`.
    """
    camera, light = frame.camera, specular_light(frame)
    bright = light > 0
    if bright.any():
        # In this unit frames of any exposure weigh alike.
        light = np.minimum(light / np.float32(np.quantile(light[bright], MOST_QUANTILE)), np.float32(1))
    points, sums = _blocks(light)
    corners = [camera.unproject(points + half) for half in ((-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5))]
    solid = np.linalg.norm(np.cross(corners[1] - corners[0], corners[3] - corners[2]), axis=1)
    rays = camera.unproject(points)
    sound = np.isfinite(rays).all(axis=1) & np.isfinite(solid)
    return Sighting(world_from_camera, rays[sound], _view(camera, frame.seen), (sums * solid)[sound], source_mm)


def _blocks(light: Image) -> tuple[Array, Array]:
    """Return the centroids, shape (N, 2), px, and sums, shape (N,), of the light of each block that holds any."""
    height, width = (-size % BLOCK_PX for size in light.shape)
    padded = np.pad(light.astype(float), ((0, height), (0, width)))
    rows, columns = (size // BLOCK_PX for size in padded.shape)
    parts = padded.reshape(rows, BLOCK_PX, columns, BLOCK_PX)
    sums = parts.sum(axis=(1, 3))
    row, column = np.nonzero(sums > 0)
    inner, total = np.arange(BLOCK_PX) + 0.5, sums[row, column]
    x = (parts.sum(axis=1)[row, column] @ inner) / total + BLOCK_PX * column
    y = (parts.sum(axis=3).transpose(0, 2, 1)[row, column] @ inner) / total + BLOCK_PX * row
    return np.stack([x, y], axis=1), total


def _view(camera: Camera, seen: Mask | None) -> Callable[[Array], Mask]:
    def in_view(directions: Array) -> Mask:
        pixels = camera.project(directions)
        with np.errstate(invalid="ignore"):
            inside = camera.contains(pixels)
        if seen is None:
            return np.asarray(inside)
        at = np.where(inside[:, None], pixels, 0.0).astype(np.int64)
        columns, rows = np.minimum(at, [camera.width - 1, camera.height - 1]).T
        return np.asarray(inside & seen[rows, columns])

    return in_view


def fine_map(sightings: Sequence[Sighting], plane: Plane) -> FineMap:
    """Return the fine normals that the highlights of frames show.

    Parameters
    ----------
    sightings : sequence of Sighting
        Highlights of the frames, with told poses.
    plane : Plane
        Where the base lies, coarsely.

    Returns
    -------
    FineMap
        Each normal lies where the sightline meets the plane, and mirrors the light to the camera: with the light at the
        camera it is the reverse of the sightline. Highlights whose sightline does not meet the plane are left out.
    """
    positions, normals, frames = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for number, sighting in enumerate(sightings):
        position, met = meet(sighting, plane)
        positions.append(position[met])
        normals.append(sighting.facing(position[met]))
        frames.append(np.full(int(met.sum()), number))
    return FineMap(np.concatenate(positions), np.concatenate(normals), np.concatenate(frames))


def meet(sighting: Sighting, plane: Plane) -> tuple[Array, Mask]:
    """Return where sightlines meet a plane, shape (N, 3), world frame, and which do meet it."""
    rotation, centre = sighting.world_from_camera[:3, :3], sighting.world_from_camera[:3, 3]
    rays = sighting.sightlines @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((plane.point - centre) @ plane.normal) / (rays @ plane.normal)
        met = np.isfinite(distance) & (distance > 0)
        return centre + distance[:, None] * rays, met
