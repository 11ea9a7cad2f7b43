"""Reads a reference in the format of a public data set, and checks that its maps are what the format says."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.axes import ALL, described, matrix
from simtest.runtime.arrays import Array
from simtest.validation.depth_maps import (
    FARTHEST_MM,
    depth_normals,
    depth_points,
    depth_problems,
    read_values,
)
from simtest.validation.reference_surface import DepthReference
from simtest.validation.references.formats import MapFormat, map_format

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
