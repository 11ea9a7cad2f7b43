"""Depth maps of other data sets (SimCol3D, C3VD): read them, compute their normals, judge whether these can serve."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.reconstruction.images import read_raw
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.files import check_limit, require_plain

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")

NEAREST_MM, FARTHEST_MM = 1e-3, 1e6
"""Depths that are plausible: those of scenes."""

RADIUS_PX = 2
"""Half the side of the window whose points a normal's plane goes through."""

JUMP_SHARE = 0.05
"""A second difference above this share of the depth is the edge of a fold, where no plane fits."""

FRONTAL_DEG, FRONTAL_SHARE = 1.0, 0.9
"""A map holds no slopes where nine tenths of its normals point this nearly back along the optical axis."""

FLAT_SHARE = 0.5
"""A map is a staircase where half of the neighbouring pixels have exactly the same depth."""

WORST_ERROR_DEG = 1.0
"""Largest error of a normal that the steps of the values may cause: cone_axis errs less on colons and livers."""

WORST_TURN_DEG = 10.0
"""Largest turn of the normal over the width of its own window, at nine tenths of the pixels."""


def read_depth(path: Path, scale_mm: float | None = None) -> Array:
    """Read a depth map.

    Parameters
    ----------
    path : Path
        PNG or TIFF of 8 or 16 bits or float, NPY, or EXR.
    scale_mm : float, optional
        mm of one step, required for integers; for others a factor to mm, default 1.

    Returns
    -------
    ndarray, shape (H, W)
        mm; NaN where the file holds none (0, negative or not finite).
    """
    if scale_mm is not None and not 1e-9 <= scale_mm <= FARTHEST_MM:
        raise InputError(f"--depth-scale {scale_mm:g}: must be 1e-9 to {FARTHEST_MM:g} mm")
    values = read_values(path)
    # A grey map that was saved as RGB is accepted.
    if values.ndim == 3:
        colours = values[:, :, :3]
        if (colours != colours[:, :, :1]).any():
            raise InputError(f"{path}: channels differ; a depth map has one, or equal ones")
        values = values[:, :, 0]
    if values.ndim != 2 or not values.size:
        raise InputError(f"{path}: has shape {values.shape}; must be (H, W)")
    if values.dtype.kind in "iu" and scale_mm is None:
        raise InputError(f"{path}: holds integers; --depth-scale must say how many mm one step is")
    depth = values.astype(float) * (1.0 if scale_mm is None else scale_mm)
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    if np.isnan(depth).all():
        raise InputError(f"{path}: holds no positive depth")
    _check_range(float(np.nanmin(depth)), float(np.nanmax(depth)), path)
    return depth


def read_values(path: Path, wanted: str = "a depth map") -> npt.NDArray[np.generic]:
    """Read a map as it stands in a file of `DEPTH_SUFFIXES`, shape (H, W) or (H, W, C); `wanted` is for messages.

    Channels of PNG and TIFF are in OpenCV's order. Raises `InputError` if the file is missing or of another kind.
    """
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise InputError(f"{path}: unknown suffix {suffix or '(none)'}; allowed: {', '.join(DEPTH_SUFFIXES)}")
    if suffix == ".npy":
        return _read_npy(path, wanted)
    return _read_exr(path, wanted) if suffix == ".exr" else np.asarray(read_raw(path, wanted))


def _check_range(low: float, high: float, where: object) -> None:
    if not (low >= NEAREST_MM and high <= FARTHEST_MM):
        raise InputError(
            f"{where}: depths from {low:.3g} to {high:.3g} mm; must be {NEAREST_MM:g} to {FARTHEST_MM:g} mm"
        )


def _read_npy(path: Path, wanted: str) -> npt.NDArray[np.generic]:
    require_plain(path, "picture_bytes", wanted)
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        # NumPy raises whatever the header, which it evaluates as a literal, runs into.
        told = " ".join(str(error).split())[:120] or type(error).__name__
        if "pickle" in told or "Python objects" in told:
            told = "it holds Python objects, which are never loaded"
        raise InputError(f"{path}: no NPY file, or a damaged one ({told})") from None
    if not isinstance(values, np.ndarray):
        values.close()
        raise InputError(f"{path}: holds several arrays, as NPZ files do; must be one, NPY")
    if values.ndim not in (2, 3) or not values.size:
        raise InputError(f"{path}: has shape {values.shape}; must be (H, W) or (H, W, C)")
    if values.dtype.kind not in "iuf":
        raise InputError(f"{path}: {values.dtype} of shape {values.shape}; must be numbers")
    check_limit("picture_pixels", values.size, path, "values")
    return np.array(values)


def _read_exr(path: Path, wanted: str) -> npt.NDArray[np.generic]:
    # Imported here: the renderer's library reads EXR, and is slow to load.
    from simtest.rendering.bitmap import read_bitmap

    require_plain(path, "picture_bytes", wanted)
    return read_bitmap(path)


def depth_points(depth: Array, camera: Camera, kind: Literal["z", "distance"] = "z") -> Array:
    """Return the surface points of a depth map, mm, shape (H, W, 3), camera frame.

    The depth is along the optical axis (`kind` "z"), or along the sightline ("distance"). Raises `InputError` if the
    camera is of another size.
    """
    if depth.shape != (camera.height, camera.width):
        raise InputError(
            f"depth map is {depth.shape[1]} x {depth.shape[0]} px: must be {camera.width} x {camera.height}, "
            "the size of the camera's calibration"
        )
    rays = camera.unproject(camera.pixel_centres())
    along = rays if kind == "distance" else rays / np.where(rays[..., 2:] > 0, rays[..., 2:], np.nan)
    return np.asarray(depth[..., None] * along)


def depth_normals(points: Array, radius_px: int = RADIUS_PX) -> Array:
    """Compute the normals of a map of points, shape (H, W, 3): unit, facing the camera, NaN where there is none.

    The normal is perpendicular to the two mean differences of the points of a window of 2 `radius_px` + 1: exact on
    planes, through any lens.
    """
    window = np.arange(-radius_px, radius_px + 1, dtype=float)
    slope, mean = window / (window**2).sum(), np.full(len(window), 1 / len(window))
    known = np.asarray(np.isfinite(points).all(axis=-1))
    values = np.where(known[..., None], points, 0.0)
    # mean differences along rows and columns
    along_x = cv2.sepFilter2D(values, cv2.CV_64F, slope, mean, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.sepFilter2D(values, cv2.CV_64F, mean, slope, borderType=cv2.BORDER_REPLICATE)
    normal = np.cross(along_x, along_y)
    length = np.linalg.norm(normal, axis=-1)
    # reject windows that leave the map, or hold a hole or a jump
    clear = (known & ~_jumps(values[..., 2])).astype(np.uint8)
    sound = (cv2.erode(clear, np.ones((len(window),) * 2, np.uint8), borderValue=0) > 0) & (length > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= length[..., None]
    normal[np.einsum("hwi,hwi->hw", normal, values) > 0] *= -1
    normal[~sound] = np.nan
    return np.asarray(normal)


def _jumps(depth: Array) -> Mask:
    """Mark the pixels where the depth jumps."""
    # the second difference along rows and columns
    bend = np.zeros(depth.shape)
    bend[:, 1:-1] = np.abs(depth[:, 2:] + depth[:, :-2] - 2 * depth[:, 1:-1])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(depth[2:] + depth[:-2] - 2 * depth[1:-1]))
    return np.asarray(bend > JUMP_SHARE * np.abs(depth))


def depth_problems(depth: Array, normals: Array, camera: Camera) -> tuple[str, ...]:
    """Return why a depth map, mm, with its normals, shape (H, W, 3), is degenerate or too coarse for highlights."""
    sound = np.isfinite(normals).all(axis=-1)
    if not sound.any():
        return ("no pixel has a normal",)
    problems = []
    # degenerate: no slopes, or a staircase
    frontal = float(np.mean(-normals[sound][:, 2] > math.cos(math.radians(FRONTAL_DEG))))
    pairs = np.isfinite(depth[:, 1:]) & np.isfinite(depth[:, :-1])
    flat = float(np.mean((depth[:, 1:] == depth[:, :-1])[pairs])) if pairs.any() else math.nan
    if frontal > FRONTAL_SHARE:
        problems.append(f"degenerate: {100 * frontal:.0f} % of the normals point straight back along the optical axis")
    elif flat > FLAT_SHARE:
        problems.append(f"degenerate: {100 * flat:.0f} % of neighbouring pixels have the same depth, a staircase")
    # too coarse: its values are quantised, so that they repeat
    values = np.unique(depth[np.isfinite(depth)])
    step = float(np.median(np.diff(values))) if len(values) < depth.size / 50 and len(values) > 1 else 0.0
    # Quantisation is noise of step / sqrt(12); the least-squares slope over the window keeps this share of it.
    side = 2 * RADIUS_PX + 1
    left = step / math.sqrt(12) / math.sqrt(side * sum(k * k for k in range(-RADIUS_PX, RADIUS_PX + 1)))
    error = math.degrees(math.atan(left * camera.fx / float(np.nanmedian(depth))))
    if error > WORST_ERROR_DEG:
        problems.append(f"too coarse for highlights: steps of {step:.3g} mm cost a normal {error:.2g} deg")
    # too coarse: the normal turns within its own window
    cosine = np.einsum("hwi,hwi->hw", normals[:, side:], normals[:, :-side])
    cosine = cosine[np.isfinite(cosine)]
    turn = math.degrees(math.acos(float(np.clip(np.quantile(cosine, 0.1), -1, 1)))) if cosine.size else 0.0
    if turn > WORST_TURN_DEG:
        problems.append(f"too coarse for highlights: normals turn by {turn:.2g} deg over {side} px")
    return tuple(problems)


def interpolate(values: Array, points_px: Array) -> Array:
    """Interpolate a map, shape (H, W, ...), bilinearly at pixel positions, shape (N, 2); NaN next to unknown pixels."""
    height, width = values.shape[:2]
    # Beyond the outermost pixel centres their values go on.
    positions = np.asarray(points_px, dtype=float).reshape(-1, 2) - PIXEL_CENTRE
    corner = np.clip(np.floor(positions).astype(int), 0, [max(width - 2, 0), max(height - 2, 0)])
    fx, fy = np.clip(positions - corner, 0, 1).T
    x, y = corner.T
    x1, y1 = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    parts = ((x, y, (1 - fx) * (1 - fy)), (x1, y, fx * (1 - fy)), (x, y1, (1 - fx) * fy), (x1, y1, fx * fy))
    shape = (-1, *([1] * (values.ndim - 2)))
    return np.asarray(sum(weight.reshape(shape) * values[row, column] for column, row, weight in parts))


def depths_at(
    option: str, points_px: Sequence[npt.ArrayLike | None], size: tuple[int, int], scale_mm: float | None
) -> list[float]:
    """Return the depth at pixel positions, mm: one number for all, or that of a depth map; NaN where there is none."""
    try:
        depth = float(option)
    except ValueError:
        if not Path(option).suffix:
            raise InputError(f"--depth {option}: must be a number of mm, or a depth map") from None
        values = read_depth(Path(option), scale_mm)
        if values.shape != (size[1], size[0]):
            raise InputError(
                f"--depth {option}: is {values.shape[1]} x {values.shape[0]} px; must be {size[0]} x {size[1]}"
            ) from None
        return [float(interpolate(values, np.array([p]))[0]) if p is not None else math.nan for p in points_px]
    if not NEAREST_MM <= depth <= FARTHEST_MM:
        raise InputError(f"--depth {option}: must be {NEAREST_MM:g} to {FARTHEST_MM:g} mm, or a depth map")
    return [depth] * len(points_px)
