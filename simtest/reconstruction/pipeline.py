"""From one frame and its camera to normals: detect the specularities, run the estimators on each."""

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, CorrectedFrame, Frame
from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection import Region, detect, estimate_noise, flat_pixels, peak_shape
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.dispatch import run_in_frame
from simtest.geometry import Camera, Patch, smooth
from simtest.runtime.resources import shown

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

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
    camera: Camera | Calibration,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] = DEFAULT_ESTIMATORS,
    roi: tuple[int, int, int, int] | None = None,
    smoothing_px: float = DEFAULT_SMOOTHING_PX,
    isolated: bool = True,
) -> list[Specularity]:
    """Reconstruct the normals at a frame's isolated specularities.

    Parameters
    ----------
    frame : array_like, shape (H, W) or (H, W, C)
        Linear intensities of any scale, or values as encoded where the calibration states the response; channels are
        averaged.
    camera : Camera or Calibration
        Of the same size. What a calibration knows is undone before smoothing: the response, then vignetting and
        emission.
    estimators : sequence of str, or mapping
        Names as registered, or the estimators themselves by name.
    roi : tuple of int, optional
        Column, row, width, height of the one region of interest; default: regions detected in the frame.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px, in [0, 50].
    isolated : bool
        Detect only specularities whose isophote at t = 0.5 closes inside the frame and the camera's view mask, and
        whose shape is that of one point highlight (`simtest.detection.peak_shape`).

    Returns
    -------
    list of Specularity
        The brightest first; empty where the frame holds no isolated specularity. Estimates whose isophotes enclose
        clipped pixels have the flag ``saturated``; those that reach to where too little light is left for the whole
        correction, ``vignetted``.

    Raises
    ------
    InputError
        If the frame is no image, differs in size from the camera's calibration, or holds NaN or infinity; if an
        argument is of the wrong kind or out of range.
    """
    calibration = _calibration(camera)
    view = calibration.camera
    image = check_frame(frame, view)
    corrected = calibration.correct(image)
    number = isinstance(smoothing_px, int | float | np.number) and not isinstance(smoothing_px, bool)
    if not number or not 0 <= smoothing_px <= MAX_SMOOTHING_PX:
        raise InputError(f"smoothing_px = {smoothing_px!r}: must be a number in [0, {MAX_SMOOTHING_PX}]")
    roi = None if roi is None else _check_roi(roi)
    chosen = load_estimators(estimators if isinstance(estimators, Mapping) else _check_names(estimators))
    frame_cut = FrameCut.of(corrected, calibration, smoothing_px)
    if roi is not None:
        patch = frame_cut.patch(roi)
        peak = (roi[0], roi[1]) if isinstance(patch, Failure) else tuple(int(v) for v in patch.peak_px)
        found = [(Region(roi, (peak[0], peak[1]), None), patch)]
    else:
        noise = frame_cut.noise
        regions = detect(frame_cut.smoothed, noise, isolated, view.seen)
        found = [(region, frame_cut.patch(region.box, region.peak)) for region in regions]
        if isolated:
            left, flat = _noise_left(smoothing_px), flat_pixels(image)
            found = [(r, patch) for r, patch in found if _is_highlight(r, patch, left * _at(noise, r.peak), flat)]
    return run_estimators(found, chosen, Frame(image, calibration, smoothing_px), corrected.limited)


@dataclass(frozen=True)
class FrameCut:
    """A corrected frame, smoothed, that patches are cut from.

    Parameters
    ----------
    corrected : CorrectedFrame
        The frame.
    smoothed : ndarray of float32, shape (H, W)
        Its intensity, smoothed.
    noise : float, or ndarray of float32, shape (H, W)
        Standard deviation of the intensity's noise before smoothing.
    smoothing_px : float
        Standard deviation of the Gaussian, px.
    seen : ndarray of bool, shape (H, W), or None
        The pixels inside the view mask.
    """

    corrected: CorrectedFrame
    smoothed: Image
    noise: float | Image
    smoothing_px: float
    seen: Mask | None

    @classmethod
    def of(
        cls, corrected: CorrectedFrame, calibration: Calibration, smoothing_px: float, seen: Mask | None = None
    ) -> "FrameCut":
        """Smooth a frame and estimate its noise; `seen` is that of the calibration's camera where it is not given."""
        seen = calibration.camera.seen if seen is None else seen
        smoothed = smooth(corrected.intensity, smoothing_px, seen)
        return cls(corrected, smoothed, _noise(corrected, calibration, smoothing_px, seen), smoothing_px, seen)

    def patch(self, box: tuple[int, int, int, int], peak: tuple[int, int] | None = None) -> Patch | Failure:
        """Cut a region of interest out (see `Patch.cut`)."""
        return Patch.cut(
            self.smoothed, box, peak, saturated=self.corrected.saturated, seen=self.seen, raw=self.corrected.intensity,
            noise=self.noise, smoothing_px=self.smoothing_px,
        )  # fmt: skip


def run_estimators(
    found: Sequence[tuple[Region, Patch | Failure]],
    estimators: Mapping[str, AnyEstimator],
    frame: Frame,
    limited: Mask | None = None,
) -> list[Specularity]:
    """Run estimators on regions of interest.

    Parameters
    ----------
    found : sequence of tuple
        Regions with their patches.
    estimators : mapping
        Estimator by name.
    frame : Frame
        The frame that the patches are cut from, with its calibration.
    limited : ndarray of bool, shape (H, W), optional
        Where too little light is left for the whole correction (`CorrectedFrame.limited`).

    Returns
    -------
    list of Specularity
        In the same order; then one for each estimate of a `FrameEstimator` that no patch takes.
    """
    peaks = [(r.peak[0] + PIXEL_CENTRE, r.peak[1] + PIXEL_CENTRE) for r, _ in found]
    # A user's region may overlap detected peaks, so it gets no list of neighbours.
    known = [region.contrast is not None for region, _ in found]
    patches = [
        _beside(patch, (*peaks[:i], *peaks[i + 1 :])) if known[i] else patch for i, (_, patch) in enumerate(found)
    ]
    made = {name: run_in_frame(each, frame, patches, frame.calibration.priors) for name, each in estimators.items()}
    detected = [
        Specularity(region, patch, {name: _flagged(made[name].of_patches[i], patch, limited) for name in made})
        for i, ((region, _), patch) in enumerate(zip(found, patches, strict=True))
    ]
    return detected + [_undetected(name, each, frame) for name in made for each in made[name].elsewhere]


def _undetected(name: str, estimate: Estimate, frame: Frame) -> Specularity:
    """Return the specularity of an estimate that no patch takes: one pixel, and no patch."""
    height, width = frame.encoded.shape[:2]
    x, y = min(int(estimate.look_px[0]), width - 1), min(int(estimate.look_px[1]), height - 1)
    no_patch = Failure(Reason.NO_PEAK, "no region was detected here")
    return Specularity(Region((x, y, 1, 1), (x, y), None), no_patch, {name: estimate})


def _beside(patch: Patch | Failure, others: tuple[tuple[float, float], ...]) -> Patch | Failure:
    return patch if isinstance(patch, Failure) or not others else replace(patch, others_px=others)


def _noise(
    corrected: CorrectedFrame, calibration: Calibration, smoothing_px: float, seen: Mask | None
) -> float | Image:
    """Give the noise of a corrected frame before smoothing: estimated where it is white, then amplified with it."""
    # A sensor that clips at full scale clips at 0 as well.
    clipped = None if corrected.saturated is None else corrected.saturated | (corrected.linear <= 0)
    white = estimate_noise(corrected.linear, seen, clipped)
    if calibration.noise.is_silent and corrected.gain is None:
        return white
    known = calibration.noise.at(smooth(corrected.linear, smoothing_px, seen), corrected.channels)
    noise = np.maximum(white, known)
    return np.asarray(noise if corrected.gain is None else noise * corrected.gain, dtype=np.float32)


def _at(noise: float | Image, pixel: tuple[int, int]) -> float:
    return float(noise) if isinstance(noise, float) else float(noise[pixel[1], pixel[0]])


def _noise_left(smoothing_px: float) -> float:
    """Give the share of white noise that a Gaussian of this width leaves: 1 / (2 sqrt(pi) s) where it is wide."""
    return 1 / math.sqrt(1 + 4 * math.pi * smoothing_px**2)


def _is_highlight(region: Region, patch: Patch | Failure, noise: float, flat: Mask | None) -> bool:
    """Tell whether nothing in a peak's shape speaks against one point highlight."""
    shape = patch if isinstance(patch, Failure) else peak_shape(patch, region, noise, flat)
    return isinstance(shape, Failure) or shape.is_highlight


def _flagged(result: Estimate | Failure, patch: Patch | Failure, limited: Mask | None) -> Estimate | Failure:
    """Add the flags that hang on the frame, not on the estimator."""
    if isinstance(result, Failure) or isinstance(patch, Failure):
        return result
    masks = {"saturated": patch.saturated}
    if limited is not None:
        (x, y), (height, width) = patch.origin_px, patch.values.shape
        masks["vignetted"] = limited[y : y + height, x : x + width]
    touched = {name: mask for name, mask in masks.items() if mask is not None and mask.any()}
    if not touched:
        return result
    isovalues = [i.isovalue for i in result.isophotes if 0 < i.isovalue < 1]
    used = patch.inside(min(isovalues, default=HIGHLIGHT_ISOVALUE))
    flags = tuple(name for name, mask in touched.items() if (mask & used).any())
    return replace(result, flags=(*result.flags, *flags))


def check_frame(frame: npt.ArrayLike, camera: Camera) -> Image:
    """Give a frame as float32 values, shape (H, W) or (H, W, C); raise `InputError` where it does not fit."""
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
        image = given.astype(np.float32)
    if image.ndim not in (2, 3) or image.size == 0:
        raise InputError(f"frame has shape {image.shape}: must be (H, W) or (H, W, C)")
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"frame is {image.shape[1]} x {image.shape[0]} px: must be {camera.width} x {camera.height}, "
            "the size of the camera's calibration"
        )
    # The channels' mean may be beyond what float32 holds.
    with np.errstate(all="ignore"):
        finite = np.isfinite(image if image.ndim == 2 else image.mean(axis=2, dtype=np.float32))
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        raise InputError(f"frame holds {bad} values that are NaN, infinite or beyond 3e38: all must be finite")
    return image


def _calibration(camera: Camera | Calibration) -> Calibration:
    if isinstance(camera, Calibration):
        return camera
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: must be a simtest.Camera or simtest.Calibration")
    return Calibration(camera)


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
