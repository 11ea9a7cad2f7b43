"""Compare reconstructed normals with a reference: a mesh registered to the camera, or a depth map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.records import Specularities, Specularity
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject
from simtest.spec.toml_files import read_toml
from simtest.validation.reference_maps import (
    DEPTH_SUFFIXES,
    FARTHEST_MM,
    depth_normals,
    depth_points,
    depth_problems,
    interpolate,
    read_depth,
)

ROTATION_TOLERANCE = 1e-3
"""Largest difference of R^T R from the identity, entry by entry: poses are written with a few digits."""


@dataclass(frozen=True)
class ErrorRecord:
    """Angle to a reference, deg: of the proposed normal, and of the better candidate."""

    error_deg: float
    error_oracle_deg: float


@dataclass(frozen=True)
class ReferenceRecord:
    """The reference's normal at a specularity, and each estimator's error; None where the sightline misses it."""

    normal: Array | None
    errors: dict[str, ErrorRecord]

    def to_json(self) -> JsonObject | None:
        """Return the entry ``reference`` of a specularity."""
        return None if self.normal is None else vars(self)


@dataclass(frozen=True)
class ErrorSummary:
    """An estimator's errors against a reference, deg; a single one has no spread."""

    n: int
    mean_deg: float
    std_deg: float | None
    mean_oracle_deg: float
    std_oracle_deg: float | None


@dataclass(frozen=True)
class ComparisonRecord:
    """How normals compare with a reference: its file, what is wrong with it, and each estimator's errors."""

    source: str
    problems: list[str]
    compared: int
    missed: int
    estimators: dict[str, ErrorSummary]


@dataclass(frozen=True)
class Model:
    """A mesh that rays are cast on: vertices, mm, and unit normals, shape (V, 3); faces, shape (F, 3)."""

    vertices: Array
    normals: Array
    faces: npt.NDArray[np.integer]

    @cached_property
    def _tree(self) -> tuple[Any, Array, IntArray]:
        import igl

        vertices, faces = np.ascontiguousarray(self.vertices), np.ascontiguousarray(self.faces, dtype=np.int64)
        tree = igl.AABB()
        tree.init(vertices, faces)
        return tree, vertices, faces

    def cast(self, origin: Array, directions: Array) -> Array:
        """Return the normals, facing the rays, where rays from a point, shape (3,), along (N, 3), first meet the mesh.

        NaN for rays that miss it, and for directions that are not finite.
        """
        # The tree takes finite rays alone; others are sent anywhere and marked as misses.
        tree, vertices, faces = self._tree
        known = np.asarray(np.isfinite(directions).all(axis=1))
        rays = np.ascontiguousarray(np.where(known[:, None], directions, 1.0))
        origins = np.ascontiguousarray(np.broadcast_to(origin, rays.shape))
        face, _, weights = tree.intersect_ray_first(vertices, faces, origins, rays)
        hit = known & (face >= 0)
        # For rays that miss, the tree leaves the weights unset.
        u, v = np.where(hit[:, None], np.asarray(weights, dtype=float).reshape(len(rays), -1)[:, -2:], 0.0).T
        # interpolate the normals of the corners
        corners = self.normals[faces[np.where(hit, face, 0)]]
        normal = np.einsum("nc,nci->ni", np.stack([1 - u - v, u, v], axis=1), corners)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal[np.einsum("ni,ni->n", normal, rays) > 0] *= -1
        normal[~hit] = np.nan
        return np.asarray(normal)


@dataclass(frozen=True)
class MeshReference:
    """A model with its rigid pose, shape (4, 4), lengths in mm, and the file it came from."""

    model: Model
    camera_from_model: Array
    source: str = ""
    notes: tuple[str, ...] = ()

    def normals_at(self, pixels: Array, camera: Camera) -> Array:
        """Return the normals where sightlines of pixels, shape (N, 2), first meet the model; NaN where they miss it."""
        # In the model's frame the camera stands at -R^T t.
        R, t = self.camera_from_model[:3, :3], self.camera_from_model[:3, 3]
        return self.model.cast(-R.T @ t, camera.unproject(pixels) @ R) @ R.T


@dataclass(frozen=True)
class DepthReference:
    """The normals of a depth map: unit, camera frame, shape (H, W, 3), NaN where there is none; and what is wrong."""

    map: Array
    source: str
    notes: tuple[str, ...] = ()

    def normals_at(self, pixels: Array, camera: Camera) -> Array:
        """Return the normals at pixels, shape (N, 2); NaN where there is none."""
        del camera
        normal = interpolate(self.map, pixels)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


Reference = MeshReference | DepthReference


def load_reference(
    path: Path | None, pose: Path | None, camera: Camera, depth_scale_mm: float | None = None,
    map_format: str | None = None,
) -> Reference | None:  # fmt: skip
    """Read a reference: a mesh with its pose, or a map in the camera frame; None where no file is named.

    `map_format` names the data set whose map it is (`simtest.validation.references`); None: a plain depth map.
    """
    if path is None:
        if pose is not None:
            raise InputError("--camera-from-model: needs --reference, the mesh that it places")
        if map_format is not None:
            raise InputError(f"--reference-format {map_format}: needs --reference, the map of that format")
        return None
    if path.suffix.lower() in DEPTH_SUFFIXES:
        if pose is not None:
            raise InputError("--camera-from-model: a depth map is in the camera frame; leave it out")
        if map_format is not None:
            from simtest.validation.reference_maps import load_map_reference

            return load_map_reference(path, map_format, camera, depth_scale_mm)
        depth = read_depth(path, depth_scale_mm)
        points = depth_points(depth, camera)
        normals = depth_normals(points)
        return DepthReference(normals, str(path), depth_problems(points[..., 2], normals, camera))
    if map_format is not None:
        raise InputError(f"--reference-format {map_format}: is for maps; --reference {path} is a mesh")
    if pose is None:
        raise InputError(f"--reference {path}: needs --camera-from-model, the pose of the mesh")
    from simtest.surfaces.mesh_surface import prepare

    camera_from_model = read_pose(pose)
    mesh = prepare(path, 0).mesh
    return MeshReference(Model(mesh.vertices, mesh.normals, mesh.faces), camera_from_model, str(path))


def read_pose(path: Path) -> Array:
    """Read camera_from_model, shape (4, 4): lengths in mm.

    Parameters
    ----------
    path : Path
        TOML with ``matrix``, 4 x 4 or 3 x 4, or with ``rotation``, 3 x 3, and ``translation_mm``.
    """
    data = read_toml(path)
    where = str(path)
    allowed = {"matrix", "rotation", "translation_mm"}
    if unknown := sorted(set(data) - allowed):
        raise InputError(f"{where}: {unknown[0]}: unknown key; allowed: {', '.join(sorted(allowed))}")
    pose = np.eye(4)
    if "matrix" in data:
        if len(data) > 1:
            raise InputError(f"{where}: matrix excludes rotation and translation_mm; give one or the other")
        matrix = _numbers(data, "matrix", ((4, 4), (3, 4)), where)
        if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise InputError(f"{where}: matrix: last row is {matrix[3].tolist()}; must be [0, 0, 0, 1]")
        pose[:3] = matrix[:3]
    else:
        pose[:3, :3] = _numbers(data, "rotation", ((3, 3),), where)
        pose[:3, 3] = _numbers(data, "translation_mm", ((3,),), where)
    if (far := float(np.abs(pose[:3, 3]).max())) > FARTHEST_MM:
        raise InputError(f"{where}: the pose moves the mesh by {far:.3g} mm; at most {FARTHEST_MM:g} mm are allowed")
    R = pose[:3, :3]
    # A pose must be rigid: no scale, no shear, no mirror image.
    off = float(np.abs(R.T @ R - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        what = "a mirror image" if off <= ROTATION_TOLERANCE else f"R^T R differs from the identity by {off:.2g}"
        raise InputError(f"{where}: the pose's 3 x 3 part is no rotation ({what}); it must be one, lengths in mm")
    # A file's digits are rounded: take the nearest rotation.
    u, _, vt = np.linalg.svd(R)
    pose[:3, :3] = u @ vt
    return pose


def _holds_bool(value: Any) -> bool:
    return any(map(_holds_bool, value)) if isinstance(value, list) else isinstance(value, bool)


def _numbers(data: Mapping[str, Any], key: str, shapes: Sequence[tuple[int, ...]], where: str) -> Array:
    if key not in data:
        raise InputError(f"{where}: {key}: missing; a pose has matrix, or rotation and translation_mm")
    try:
        raw = np.array(data[key])
        # Truth values and text are no numbers, though NumPy takes them for such.
        values = raw.astype(float) if raw.dtype.kind in "iuf" and not _holds_bool(data[key]) else np.empty(0)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape not in shapes or not np.isfinite(values).all():
        wanted = " or ".join(" x ".join(str(n) for n in shape) for shape in shapes)
        raise InputError(f"{where}: {key} = {data[key]!s}: must be {wanted} finite numbers")
    return values


def compare(spots: Specularities, reference: Reference) -> None:
    """Compare the normals of a picture with a reference at their brightest points.

    Each specularity that has a peak gets the reference's normal and the errors of the estimators, deg: of the proposed
    normal, and of the better candidate, as the article chooses by hand. Their means and standard deviations by
    estimator become the picture's own ``reference``.
    """
    peaks = np.array([spot.peak_px for spot in spots if spot.peak_px is not None], dtype=float)
    normals = iter(reference.normals_at(peaks, spots.camera) if len(peaks) else ())
    spots[:] = [
        spot if spot.peak_px is None else replace(spot, reference=_errors(spot, next(normals))) for spot in spots
    ]
    # summarise the sightlines that meet the reference
    met = [spot.reference.errors for spot in spots if spot.reference is not None and spot.reference.normal is not None]
    names = dict.fromkeys(name for errors in met for name in errors)
    spots.reference = ComparisonRecord(
        source=reference.source,
        problems=list(reference.notes),
        compared=len(met),
        missed=len(peaks) - len(met),
        estimators={name: _summary([errors[name] for errors in met if name in errors]) for name in names},
    )


def _errors(spot: Specularity, normal: Array) -> ReferenceRecord:
    if not np.isfinite(normal).all():
        return ReferenceRecord(None, {})
    angles = {name: angle_deg(estimate.candidates, normal) for name, estimate in spot.normals.items()}
    errors = {name: ErrorRecord(float(own[0]), float(own.min())) for name, own in angles.items()}
    return ReferenceRecord(normal, errors)


def _summary(errors: Sequence[ErrorRecord]) -> ErrorSummary:
    pairs = np.array([(error.error_deg, error.error_oracle_deg) for error in errors])
    spread = pairs.std(axis=0, ddof=1).tolist() if len(pairs) > 1 else (None, None)
    return ErrorSummary(len(pairs), float(pairs[:, 0].mean()), spread[0], float(pairs[:, 1].mean()), spread[1])
