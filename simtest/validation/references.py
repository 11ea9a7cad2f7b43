"""Compare reconstructed normals with a reference: a mesh registered to the camera, or maps of depths or normals.

Units and directions of the maps of public data sets are those that a data set's own files or loaders state. A unit that
they leave open is None, and the user must state it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.estimators import Estimate
from simtest.geometry import Camera
from simtest.geometry.axes import ALL, described, matrix
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.records import SIGHTLINE_RULE, Specularities, Specularity
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import JsonObject
from simtest.runtime.statistics import CONFIDENCE
from simtest.spec.toml_files import read_toml
from simtest.validation.depth_maps import (
    DEPTH_SUFFIXES,
    depth_normals,
    depth_points,
    depth_problems,
    interpolate,
    read_depth,
    read_values,
)
from simtest.validation.statistics import is_wrong_and_sure

ROTATION_TOLERANCE = 1e-3
"""Largest difference of R^T R from the identity, entry by entry: poses are written with a few digits."""


@dataclass(frozen=True)
class ErrorRecord:
    """Angle to a reference, deg: of the proposed normal, and of the better candidate; and whether regions hold it.

    `inside` is of the 95 % region that the estimate states, `inside_organ` of that of the organ's normal; None where
    there is none, as `wrong_and_sure` (`simtest.validation.statistics`) is without a reported deviation.
    """

    error_deg: float
    error_oracle_deg: float
    inside: bool | None
    inside_organ: bool | None
    wrong_and_sure: bool | None


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
    """An estimator's errors against a reference, deg, and the shares of its 95 % regions that hold the reference.

    Beside them stands the share of the answers that are wrong and sure. A single error has no spread, and without a
    region there is no share.
    """

    n: int
    mean_deg: float
    std_deg: float | None
    mean_oracle_deg: float
    std_oracle_deg: float | None
    inside: float | None
    inside_organ: float | None
    wrong_and_sure: float | None


@dataclass(frozen=True)
class ComparisonRecord:
    """How normals compare with a reference: its file, what is wrong with it, and each estimator's errors.

    `sightline_rule` names the estimators that are one rule (`Specularities.sightline_rule`), `of_sightline_rule` has
    the errors of that.
    """

    source: str
    problems: list[str]
    compared: int
    missed: int
    estimators: dict[str, ErrorSummary]
    sightline_rule: tuple[str, ...] = ()
    of_sightline_rule: ErrorSummary | None = None

    @property
    def rows(self) -> dict[str, ErrorSummary]:
        """The errors as a table shows them: a rule that several estimators share has one row."""
        if self.of_sightline_rule is None:
            return self.estimators
        others = {name: each for name, each in self.estimators.items() if name not in self.sightline_rule}
        return {SIGHTLINE_RULE: self.of_sightline_rule, **others}


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
            from simtest.validation.references import load_map_reference

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
    """Compare the normals of a picture with a reference at their brightest points, those of clouds where they look.

    Each specularity that has a peak, or is a cloud, gets the reference's normal and the errors of the estimators, deg:
    of the proposed normal, and of the better candidate, as the article chooses by hand. Their means and standard
    deviations by estimator become the picture's own ``reference``; those of what may be no highlight are left out.
    """
    # Without a peak a cloud alone has a normal.
    looks = [None if spot.peak_px is None and not spot.normals else spot.position_px for spot in spots]
    peaks = np.array([look for look in looks if look is not None], dtype=float)
    normals = iter(reference.normals_at(peaks, spots.camera) if len(peaks) else ())
    spots[:] = [
        spot if look is None else replace(spot, reference=_errors(spot, next(normals)))
        for spot, look in zip(spots, looks, strict=True)
    ]
    # summarise the sightlines that meet the reference
    met = [spot for spot in spots if spot.reference is not None and spot.reference.normal is not None]
    kept = [spot for spot in met if not spot.is_doubtful]
    compared = [spot.reference.errors for spot in kept]
    names, rule = dict.fromkeys(name for errors in compared for name in errors), spots.sightline_rule
    # One normal a highlight: of the best of them, as it is shown.
    of_rule = [spot.reference.errors[spot.best] for spot in kept if spot.best in rule]
    spots.reference = ComparisonRecord(
        source=reference.source,
        problems=[*reference.notes, *([f"left out: {spots.doubts}"] if spots.doubts else [])],
        compared=len(compared),
        missed=len(peaks) - len(met),
        estimators={name: _summary([errors[name] for errors in compared if name in errors]) for name in names},
        sightline_rule=rule,
        of_sightline_rule=_summary(of_rule) if of_rule else None,
    )


def _errors(spot: Specularity, normal: Array) -> ReferenceRecord:
    if not np.isfinite(normal).all():
        return ReferenceRecord(None, {})
    angles = {name: angle_deg(estimate.candidates, normal) for name, estimate in spot.normals.items()}
    errors = {
        name: ErrorRecord(
            float(own[0]),
            float(own.min()),
            _is_inside(spot.normals[name], normal),
            _is_inside(spot.organ.get(name), normal),
            None
            if (deviation := spot.normals[name].deviation_deg) is None
            else bool(is_wrong_and_sure(own[0], deviation)),
        )
        for name, own in angles.items()
    }
    return ReferenceRecord(normal, errors)


def _is_inside(estimate: Estimate | None, normal: Array) -> bool | None:
    """Return whether the 95 % region of an estimate holds a normal; None where none is stated."""
    # Here: a picture without a reference needs no table of results.
    from simtest.validation.scoring import mahalanobis2

    squared = None if estimate is None else mahalanobis2(estimate, normal)
    return None if squared is None else squared <= chi_squared.quantile(CONFIDENCE, 2)


def _summary(errors: Sequence[ErrorRecord]) -> ErrorSummary:
    pairs = np.array([(error.error_deg, error.error_oracle_deg) for error in errors])
    spread = pairs.std(axis=0, ddof=1).tolist() if len(pairs) > 1 else (None, None)
    judged = ("inside", "inside_organ", "wrong_and_sure")
    known = ([v for e in errors if (v := getattr(e, name)) is not None] for name in judged)
    shares = [sum(held) / len(held) if held else None for held in known]
    return ErrorSummary(len(pairs), float(pairs[:, 0].mean()), spread[0], float(pairs[:, 1].mean()), spread[1], *shares)


@dataclass(frozen=True)
class MapFormat:
    """How a data set writes its maps. Depths of all of them are along the optical axis (z).

    Parameters
    ----------
    title : str
        The data set, with the article that describes it.
    depth_type : str
        NumPy's name of the type of a depth's count.
    step_mm : float, optional
        mm of one count; None if the data set does not tell, so that the user must (``--depth-scale``).
    empty : tuple of int
        Counts that stand for no depth.
    size_px : tuple of int
        Width and height of a frame.
    channels : int
        Of a depth map; several are equal in the first three, a fourth is not read.
    normals : str, optional
        End of the file name of a normal map, None where the data set has none. Such a map has three channels of 16
        bits, -1 to 1 over the whole range; all three are 0 where there is no normal. It stands beside the depth map.
    normal_axes : str
        The camera's axes that red, green and blue hold (`simtest.geometry.vectors`).
    depths : str
        End of the file name of a depth map.
    cautions : tuple of str
        What a user must know of the maps.
    """

    title: str
    depth_type: str
    step_mm: float | None
    size_px: tuple[int, int]
    empty: tuple[int, ...] = (0,)
    channels: int = 1
    normals: str | None = None
    normal_axes: str = "x,y,z"
    depths: str = ".png"
    cautions: tuple[str, ...] = ()


FORMATS = {
    "c3vd": MapFormat(
        "C3VD and C3VDv2 (Bobrow et al. 2023): phantoms, registered to a video",
        "uint16",
        100 / (2**16 - 1),
        (1350, 1080),
        empty=(0, 2**16 - 1),
        normals="_normals.tiff",
        depths="_depth.tiff",
        cautions=("the registration is off by 0.3 mm and 0.2 deg in the mean, by its authors' simulation",),
    ),
    "simcol3d": MapFormat(
        "SimCol3D (Rau et al. 2023): rendered colons, 0 to 20 cm",
        "uint16",
        200 / (255 * 256),
        (475, 475),
    ),
    "ucl": MapFormat(
        "UCL synthetic colon (Rau et al. 2019): rendered colons of 8 bits",
        "uint8",
        None,
        (256, 256),
    ),
    "endoslam": MapFormat(
        "EndoSLAM, part UnityCam (Ozyoruk et al. 2021): rendered organs, relative depths of 8 bits",
        "uint8",
        None,
        (320, 320),
        channels=4,
        cautions=("users report that depth maps of UnityCam are shifted against their frames",),
    ),
}


def map_format(name: str) -> MapFormat:
    """Return a format by name; raise `InputError` for one that is not known."""
    if name not in FORMATS:
        raise InputError(
            f"--reference-format {name}: unknown; allowed: {', '.join(FORMATS)}{suggestion(name, list(FORMATS))}"
        )
    return FORMATS[name]


NEAREST_MM, FARTHEST_MM = 1e-3, 1e6
"""Depths that are plausible: those of scenes."""


FRONTAL_DEG, FRONTAL_SHARE = 1.0, 0.9
"""A map holds no slopes where nine tenths of its normals point this nearly back along the optical axis."""


FAR_DEG = 5.0
"""Median angle between a normal map and the normals of its depths above which one of them is not what it should be."""

NEAR_DEG = 1.0
"""Median angle below which they agree. Between the two, depths along the sightline must fit twice as well."""

LEAST_PIXELS = 100
"""With fewer pixels that have both normals nothing is checked."""


def load_map_reference(path: Path, name: str, camera: Camera, scale_mm: float | None = None) -> DepthReference:
    """Read a depth map or normal map of a data set as a reference.

    Parameters
    ----------
    path : Path
        The map. Beside a depth map the data set's normal map of the frame is read too, if there is one, and the other
        way round: each then checks the other.
    name : str
        Of the format (`FORMATS`).
    camera : Camera
        Of the frame.
    scale_mm : float, optional
        mm of one count, where the data set does not tell.

    Returns
    -------
    DepthReference
        Unit normals in the camera frame, and what a user must know of the maps.
    """
    form = map_format(name)
    _check_scale(path, name, form, scale_mm)
    _check_size(path, name, form, camera)
    is_normals = form.normals is not None and path.name.endswith(form.normals)
    depth_path = _beside(path, form.normals, form.depths) if is_normals else path
    normals_path = path if is_normals else _beside(path, form.depths, form.normals)
    notes = list(form.cautions)
    stated = None if normals_path is None else read_normals(normals_path, form)
    found = None
    if depth_path is not None:
        depth = read_depth_counts(depth_path, form, scale_mm)
        found = depth_normals(depth_points(depth, camera))
        if not is_normals:
            notes += depth_problems(depth, found, camera)
        if stated is not None:
            notes += _disagreement(stated, found, depth_normals(depth_points(depth, camera, "distance")), form)
    chosen = stated if is_normals else found
    assert chosen is not None
    return DepthReference(chosen, str(path), tuple(notes))


def read_depth_counts(path: Path, form: MapFormat, scale_mm: float | None = None) -> Array:
    """Read a depth map of a format, mm along the optical axis, shape (H, W); NaN where there is none."""
    values = read_values(path)
    _check_type(path, values, form.depth_type, "a depth map")
    if values.ndim == 3:
        if form.channels == 1 or (values[..., :3] != values[..., :1]).any():
            raise InputError(f"{path}: channels differ; a depth map has one, or equal ones")
        values = values[..., 0]
    step = form.step_mm or scale_mm
    assert step is not None
    known = ~np.isin(values, form.empty)
    if not known.any():
        raise InputError(f"{path}: holds no depth; counts {', '.join(map(str, form.empty))} stand for none")
    return np.where(known, values.astype(float) * step, np.nan)


def read_normals(path: Path, form: MapFormat) -> Array:
    """Read a normal map of a format: unit normals, camera frame, shape (H, W, 3); NaN where there is none."""
    values = read_values(path, "a normal map")
    _check_type(path, values, "uint16", "a normal map")
    if values.ndim != 3 or values.shape[2] < 3:
        raise InputError(f"{path}: has shape {values.shape}; a normal map has three channels")
    # OpenCV's order is blue, green, red.
    counts = values[..., 2::-1].astype(float)
    vectors = (2 * counts / (2**16 - 1) - 1) @ matrix(form.normal_axes).T
    length = np.linalg.norm(vectors, axis=-1)
    known = (counts > 0).any(axis=-1) & (np.abs(length - 1) < 0.01)
    if not known.any():
        raise InputError(f"{path}: holds no unit vector; channels must be -1 to 1 over 16 bits")
    return np.where(known[..., None], vectors / np.where(known, length, 1.0)[..., None], np.nan)


def _beside(path: Path, end: str | None, other: str | None) -> Path | None:
    """Return the other map of a frame, if it stands beside this one."""
    if end is None or other is None or not path.name.endswith(end):
        return None
    found = path.with_name(path.name.removesuffix(end) + other)
    return found if found.is_file() else None


def _disagreement(stated: Array, found: Array, along_rays: Array, form: MapFormat) -> list[str]:
    """Return what is wrong if a normal map and the normals of its depths differ; all have shape (H, W, 3).

    `found` takes the depths along the optical axis, `along_rays` along the sightlines.
    """
    both = np.isfinite(stated) & np.isfinite(found) & np.isfinite(along_rays)
    known = both.all(axis=-1)
    if known.sum() < LEAST_PIXELS:
        return []
    vectors, normals = stated[known], found[known]
    own, rays = _median_deg(vectors, normals), _median_deg(vectors, along_rays[known])
    if own > NEAR_DEG and rays < own / 2 and rays <= FAR_DEG:
        return [f"normal map and depth map differ by {own:.3g} deg in the median; depths along the sightline, in place "
                f"of the optical axis, would fit to {rays:.2g} deg"]  # fmt: skip
    if own <= FAR_DEG:
        return []
    medians = {axes: _median_deg(vectors @ matrix(axes).T, normals) for axes in ALL}
    best = min(medians, key=medians.__getitem__)
    likely = ""
    if medians[best] <= FAR_DEG:
        held = described(_composed(form.normal_axes, best))
        likely = f"; channels that hold {held} would fit to {medians[best]:.2g} deg"
    return [f"normal map and depth map differ by {own:.3g} deg in the median{likely}"]


def _composed(first: str, second: str) -> str:
    """Return the axes that do what two assignments do one after the other."""
    both = matrix(second) @ matrix(first)
    return next(axes for axes in ALL if np.array_equal(matrix(axes), both))


def _median_deg(first: Array, second: Array) -> float:
    cosine = np.clip(np.einsum("ni,ni->n", first, second), -1, 1)
    return float(np.degrees(np.arccos(np.median(cosine))))


def _check_scale(path: Path, name: str, form: MapFormat, scale_mm: float | None) -> None:
    if form.step_mm is None and scale_mm is None:
        raise InputError(f"{path}: {name} does not tell its unit; --depth-scale must say how many mm a count is")
    if form.step_mm is not None and scale_mm is not None:
        raise InputError(f"--depth-scale {scale_mm:g}: {name} has its own, {form.step_mm:.6g} mm a count; leave it out")
    if scale_mm is not None and not 1e-9 <= scale_mm <= FARTHEST_MM:
        raise InputError(f"--depth-scale {scale_mm:g}: must be 1e-9 to {FARTHEST_MM:g} mm")


def _check_size(path: Path, name: str, form: MapFormat, camera: Camera) -> None:
    """Raise `InputError` where the map is missing, or the camera has neither the frames' size nor that of a copy."""
    width, height = form.size_px
    if not path.exists():
        raise InputError(f"{path}: no such file; must be a map of {name}")
    if abs(camera.width * height - camera.height * width) > max(width, height):
        raise InputError(
            f"{path}: the camera is of {camera.width} x {camera.height} px; frames of {name} are of "
            f"{width} x {height} px"
        )


def _check_type(path: Path, values: npt.NDArray[np.generic], wanted: str, what: str) -> None:
    if values.dtype != np.dtype(wanted):
        raise InputError(f"{path}: holds {values.dtype}; {what} of this format holds {wanted}")
