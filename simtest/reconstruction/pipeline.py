"""The pipeline from the values of a picture to normals: linear light, detect, estimate; one for grey and for colour."""

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Frame, Response
from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection import Region
from simtest.detection.blobs import Kind
from simtest.detection.colour import ColourDetection, ColourDetector, detect_colour
from simtest.detection.detector import Detection, Detector, load_detector
from simtest.detection.peaks import PeakDetector
from simtest.detection.view_mask import View, find_view
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.dispatch import run_in_frame
from simtest.geometry import Camera, Patch
from simtest.runtime.arrays import Image, Mask
from simtest.runtime.resources import shown

DEFAULT_ESTIMATORS = ("circle_pose", "brightest_point", "cone_axis")
MAX_SMOOTHING_PX = 50

SMOOTHING_BY_COLOUR_PX = 1.0
"""Highlights of real pictures are small, and 2 px would round them."""

SMALL_RADIUS = 3.0
"""A highlight whose radius at half height is below this many smoothing widths is made rounder by more than a tenth: its
estimates have the flag ``small``."""


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


@dataclass(frozen=True)
class Reconstruction:
    """The normals of a picture, and the detection that they stand on."""

    specularities: list[Specularity]
    detection: Detection


def reconstruct(
    frame: npt.ArrayLike,
    camera: Camera | Calibration,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] = DEFAULT_ESTIMATORS,
    roi: tuple[int, int, int, int] | None = None,
    smoothing_px: float = DEFAULT_SMOOTHING_PX,
    isolated: bool = True,
    detector: str | Detector | None = None,
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
    detector : str or Detector, optional
        Name as registered, or the detector itself; default `peaks`, to which alone `isolated` applies.

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
    finder = PeakDetector(isolated) if detector is None else detector
    return run_pipeline(frame, camera, finder, estimators, roi, smoothing_px).specularities


def reconstruct_colour(
    picture: npt.ArrayLike,
    camera: Camera | Calibration,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] = DEFAULT_ESTIMATORS,
    smoothing_px: float = SMOOTHING_BY_COLOUR_PX,
    isolated: bool = True,
) -> Reconstruction:
    """Reconstruct the normals at the isolated highlights of a colour picture.

    The estimators see the specular light alone: the tissue's part of each pixel is taken off (`split_light`).

    Parameters
    ----------
    picture : array_like, shape (H, W, 3)
        RGB values as encoded, in [0, 1].
    camera : Camera or Calibration
        Of the same size. Where it has no response, sRGB is taken; where it has no view mask, that of the picture.
    isolated : bool
        Leave out highlights of the other kinds.
    estimators, smoothing_px
        As of `reconstruct`, as are the errors raised.

    Returns
    -------
    Reconstruction
        Estimates of highlights that smoothing has made rounder have the flag ``small``.
    """
    return run_pipeline(picture, camera, ColourDetector(isolated), estimators, None, smoothing_px)


@dataclass(frozen=True)
class PictureDetection:
    """What a colour picture shows: the part of it that is tissue, and its highlights."""

    view: View
    detection: ColourDetection


def detect_in_picture(
    picture: Image, response: Response | None = None, level: float = 1.0, seen: Mask | None = None
) -> PictureDetection:
    """Find the highlights of a colour picture, without a camera.

    Parameters
    ----------
    picture : ndarray of float32, shape (H, W, 3)
        RGB values as encoded, in [0, 1], of 16 bits at most.
    response : Response, optional
        How light became values; default sRGB.
    level : float
        Value at and above which a channel is clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default: found in the picture.

    Returns
    -------
    PictureDetection
    """
    # Detection by colour uses no angle, so any field of view serves.
    camera = Camera.from_fov(60.0, picture.shape[1], picture.shape[0])
    calibration = Calibration(camera, response=response or Response("srgb"), saturation_level=level)
    frame = Frame(picture, calibration, SMOOTHING_BY_COLOUR_PX, seen=seen)
    view = find_view(picture) if seen is None else View(seen)
    return PictureDetection(view, detect_colour(frame.channels, frame.clipped, view.seen))


def run_pipeline(
    picture: npt.ArrayLike,
    camera: Camera | Calibration,
    detector: str | Detector,
    estimators: Sequence[str] | Mapping[str, AnyEstimator],
    roi: tuple[int, int, int, int] | None,
    smoothing_px: float,
) -> Reconstruction:
    """Reconstruct the normals of a picture with any detector (see `reconstruct` and `reconstruct_colour`)."""
    calibration = _calibration(camera)
    image = check_frame(picture, calibration.camera)
    number = isinstance(smoothing_px, int | float | np.number) and not isinstance(smoothing_px, bool)
    if not number or not 0 <= smoothing_px <= MAX_SMOOTHING_PX:
        raise InputError(f"smoothing_px = {smoothing_px!r}: must be a number in [0, {MAX_SMOOTHING_PX}]")
    box = None if roi is None else _check_roi(roi)
    chosen = load_estimators(estimators if isinstance(estimators, Mapping) else _check_names(estimators))
    # linear light: a frame computes each step of its correction when it is first asked for
    frame = Frame(image, calibration, smoothing_px)
    # detect
    detection = _detect(load_detector(detector), frame) if box is None else _cut_region(frame, box)
    # estimate
    return _estimate(detection, chosen)


def _detect(detector: Detector, frame: Frame) -> Detection:
    """Run a detector; raise `InputError` with its name where it fails or returns what is no detection of the frame."""
    name, (height, width) = type(detector).__qualname__, frame.encoded.shape[:2]
    try:
        found = detector.detect(frame, frame.calibration.camera, frame.calibration.priors)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"detector {name}: {type(error).__name__}: {error}") from error
    if not isinstance(found, Detection):
        raise InputError(f"detector {name}: returned a {type(found).__name__}; must be a Detection")
    if len(found.highlights) not in (0, len(found.regions)):
        raise InputError(f"detector {name}: {len(found.highlights)} highlights for {len(found.regions)} regions")
    for box in (region.box for region in found.regions):
        if not (isinstance(box, tuple) and len(box) == 4 and all(isinstance(v, int) for v in box)):
            raise InputError(f"detector {name}: box {shown(box, 80)}: must be a tuple of four integers x, y, w, h")
        x, y, w, h = box
        if min(x, y) < 0 or min(w, h) < 1 or x + w > width or y + h > height:
            raise InputError(f"detector {name}: box {box} leaves the frame of {width} x {height} px")
    return found


def _cut_region(frame: Frame, box: tuple[int, int, int, int]) -> Detection:
    """Take a user's region of interest for the one specularity; raise `InputError` where it leaves the frame."""
    patch = frame.patch(box)
    # A user's region may overlap detected peaks, so it gets no contrast and no list of neighbours.
    x, y = box[:2] if isinstance(patch, Failure) else (int(v) for v in patch.peak_px)
    return Detection((Region(box, (x, y), None),), frame)


def _estimate(detection: Detection, estimators: Mapping[str, AnyEstimator]) -> Reconstruction:
    """Run each estimator on all patches of a picture, or on the whole frame."""
    frame, regions = detection.frame, detection.regions
    # Each patch holds the peaks of the others: `bisector` assigns lights to highlights by their arrangement.
    peaks = [(region.peak[0] + PIXEL_CENTRE, region.peak[1] + PIXEL_CENTRE) for region in regions]
    cut = [frame.patch(r.box) if r.contrast is None else frame.patch(r.box, r.peak) for r in regions]
    # Highlights that touch have no isophotes of their own, so no estimator answers for them.
    for i, highlight in enumerate(detection.highlights):
        if highlight.kind is Kind.CLUSTER:
            cut[i] = Failure(Reason.CLUSTER, f"{len(highlight.peaks)} highlights touch, and carry no single normal")
    patches = [
        patch
        if isinstance(patch, Failure) or len(cut) == 1
        else replace(patch, others_px=(*peaks[:i], *peaks[i + 1 :]))
        for i, patch in enumerate(cut)
    ]
    made = {name: run_in_frame(each, frame, patches, frame.calibration.priors) for name, each in estimators.items()}
    # Flags that depend on the frame are added behind those of the estimators.
    limited = frame.corrected.limited
    result = Reconstruction([], detection)
    rounded_px = SMALL_RADIUS * frame.smoothing_px
    small = [math.sqrt(h.area_px / math.pi) < rounded_px for h in detection.highlights] or [False] * len(patches)
    for i, (region, patch) in enumerate(zip(regions, patches, strict=True)):
        estimates = {name: _flagged(each.of_patches[i], patch, limited, small[i]) for name, each in made.items()}
        result.specularities.append(Specularity(region, patch, estimates))
    undetected = [_undetected(name, estimate, frame) for name, each in made.items() for estimate in each.elsewhere]
    result.specularities.extend(undetected)
    return result


def _undetected(name: str, estimate: Estimate, frame: Frame) -> Specularity:
    """Return the specularity of a frame estimator's result that no patch takes: one pixel, and no patch."""
    height, width = frame.encoded.shape[:2]
    x, y = min(int(estimate.look_px[0]), width - 1), min(int(estimate.look_px[1]), height - 1)
    no_patch = Failure(Reason.NO_PEAK, "no region was detected here")
    return Specularity(Region((x, y, 1, 1), (x, y), None), no_patch, {name: estimate})


def _flagged(
    result: Estimate | Failure, patch: Patch | Failure, limited: Mask | None, small: bool
) -> Estimate | Failure:
    """Add the flags that depend on the frame, not on the estimator."""
    if isinstance(result, Failure) or isinstance(patch, Failure):
        return result
    # What an estimate used is what its lowest isophote encloses.
    masks = {"saturated": patch.saturated}
    if limited is not None:
        (x, y), (height, width) = patch.origin_px, patch.values.shape
        masks["vignetted"] = limited[y : y + height, x : x + width]
    touched = {name: mask for name, mask in masks.items() if mask is not None and mask.any()}
    flags = ("small",) if small else ()
    if touched:
        isovalues = [i.isovalue for i in result.isophotes if 0 < i.isovalue < 1]
        used = patch.inside(min(isovalues, default=HIGHLIGHT_ISOVALUE))
        flags = (*(name for name, mask in touched.items() if (mask & used).any()), *flags)
    return replace(result, flags=(*result.flags, *flags)) if flags else result


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
    """Return a region as four plain integers; that it lies inside the frame is checked where it is cut."""
    try:
        x, y, width, height = (operator.index(value) for value in roi)
    except (TypeError, ValueError):
        raise InputError(f"roi = {shown(repr(roi), 80)}: must be x, y, width, height: four integers, px") from None
    return x, y, width, height


def check_frame(frame: npt.ArrayLike, camera: Camera) -> Image:
    """Return a frame as float32 values, shape (H, W) or (H, W, C); raise `InputError` where it does not fit."""
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
