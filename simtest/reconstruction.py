"""From one frame and its camera to normals: detect the specularities, run the estimators on each."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection import Region, detect, estimate_noise
from simtest.errors import Failure, InputError
from simtest.estimators import Estimate, Estimator, load_estimators
from simtest.estimators.checked import run
from simtest.geometry import Camera, Patch, smooth
from simtest.resources import shown

DEFAULT_ESTIMATORS = ("circle_pose", "brightest_point", "cone_axis")
MAX_SMOOTHING_PX = 50


@dataclass(frozen=True)
class Specularity:
    """One region of interest and what each estimator made of it.

    Parameters
    ----------
    region : Region
        Where it is.
    patch : Patch or Failure
        The smoothed crop.
    estimates : dict
        `Estimate` or `Failure` by estimator name.
    """

    region: Region
    patch: Patch | Failure
    estimates: dict[str, Estimate | Failure]


def reconstruct(
    frame: npt.ArrayLike,
    camera: Camera,
    estimators: Sequence[str] | Mapping[str, Estimator] = DEFAULT_ESTIMATORS,
    roi: tuple[int, int, int, int] | None = None,
    smoothing_px: float = DEFAULT_SMOOTHING_PX,
    isolated: bool = True,
) -> list[Specularity]:
    """Reconstruct the normals at a frame's isolated specularities.

    Parameters
    ----------
    frame : array_like, shape (H, W) or (H, W, C)
        Linear intensities of any scale; channels are averaged.
    camera : Camera
        Calibration of the same size.
    estimators : sequence of str, or mapping
        Names as registered, or the estimators themselves by name.
    roi : tuple of int, optional
        Column, row, width, height of the one region of interest; default: regions detected in the frame.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px, in [0, 50].
    isolated : bool
        Detect only specularities whose isophote at t = 0.5 closes inside the frame.

    Returns
    -------
    list of Specularity
        The brightest first; empty where the frame holds no isolated specularity.

    Raises
    ------
    InputError
        If the frame is no image, differs in size from the camera's calibration, or holds NaN or infinity; if an
        argument is of the wrong kind or out of range.
    """
    intensity = check_frame(frame, camera)
    number = isinstance(smoothing_px, int | float | np.number) and not isinstance(smoothing_px, bool)
    if not number or not 0 <= smoothing_px <= MAX_SMOOTHING_PX:
        raise InputError(f"smoothing_px = {smoothing_px!r}: must be a number in [0, {MAX_SMOOTHING_PX}]")
    roi = None if roi is None else _check_roi(roi)
    chosen = estimators if isinstance(estimators, Mapping) else load_estimators(_check_names(estimators))
    smoothed = smooth(intensity, smoothing_px)
    if roi is not None:
        patch = Patch.cut(smoothed, roi)
        peak = (roi[0], roi[1]) if isinstance(patch, Failure) else tuple(int(v) for v in patch.peak_px)
        found = [(Region(roi, (peak[0], peak[1]), float("nan")), patch)]
    else:
        regions = detect(smoothed, estimate_noise(intensity), isolated)
        found = [(region, Patch.cut(smoothed, region.box, region.peak)) for region in regions]
    return [
        Specularity(region, patch, {name: run(estimator, patch, camera) for name, estimator in chosen.items()})
        for region, patch in found
    ]


def check_frame(frame: npt.ArrayLike, camera: Camera) -> npt.NDArray[np.float32]:
    """Give a frame as float32 intensities, shape (H, W); raise `InputError` where it does not fit the camera."""
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: must be a simtest.Camera")
    try:
        given = np.asarray(frame)
    except (TypeError, ValueError):
        raise InputError(
            "frame: must be an array of numbers; its rows differ in length or hold something else"
        ) from None
    if given.dtype.kind not in "biuf":
        raise InputError(f"frame holds values of type {given.dtype}: must be an array of real numbers")
    # What float32 cannot hold becomes infinite and is refused below.
    with np.errstate(all="ignore"):
        image = _intensity(given.astype(np.float32), camera)
    if not np.isfinite(image).all():
        bad = int(np.count_nonzero(~np.isfinite(image)))
        raise InputError(f"frame holds {bad} values that are NaN, infinite or beyond 3e38: all must be finite")
    return image


def _intensity(image: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.float32]:
    if image.ndim not in (2, 3) or image.size == 0:
        raise InputError(f"frame has shape {image.shape}: must be (H, W) or (H, W, C)")
    if image.ndim == 3:
        image = image.mean(axis=2, dtype=np.float32)
    if image.shape != (camera.height, camera.width):
        raise InputError(
            f"frame is {image.shape[1]} x {image.shape[0]} px: must be {camera.width} x {camera.height}, "
            "the size of the camera's calibration"
        )
    return image


def _check_names(names: Sequence[str]) -> Sequence[str]:
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InputError(f"estimators = {shown(repr(names), 80)}: must be a list of names")
    return names


def _check_roi(roi: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """Give a region as four plain integers; that it lies inside the frame is checked where it is cut."""
    try:
        x, y, width, height = (operator.index(value) for value in roi)
    except (TypeError, ValueError):
        raise InputError(f"roi = {shown(repr(roi), 80)}: must be x, y, width, height: four integers, px") from None
    return x, y, width, height
