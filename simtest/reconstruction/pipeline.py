"""The pipeline from the values of a picture to normals: linear light, detect, estimate; one for grey and for colour."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Frame, Priors
from simtest.calibration.frame import Box
from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection import Region
from simtest.detection.colour import ColourDetector
from simtest.detection.detector import Detection, Detector, Kind, load_detector, run_detector
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.dispatch import prepare, run_in_frame
from simtest.estimators.names import short_names
from simtest.estimators.prior_parts import to_base
from simtest.estimators.protocol import Target
from simtest.estimators.small_spots import UNRESOLVED
from simtest.geometry import Camera, Patch
from simtest.geometry.patch import share_of_noise
from simtest.reconstruction.assumptions import assumptions, calibration_of_view
from simtest.reconstruction.choices import (
    AUTO,
    SMOOTHING_BY_COLOUR_PX,
    Choices,
    check_encoding,
    choose_detector,
    choose_smoothing,
    complete,
    untold,
)
from simtest.reconstruction.found import Reconstruction, Specularities, Specularity
from simtest.reconstruction.picture_values import check_frame, check_roi, check_size, image_size
from simtest.runtime.arrays import Array, Image, Mask
from simtest.runtime.boundary import plain_errors

DEFAULT_ESTIMATORS = ("circle_pose", "brightest_point", "cone_axis", "curved")
MAX_SMOOTHING_PX = 50

LEAST_HEIGHT = 6.0
"""A user's region holds a highlight if its peak is so many standard deviations of the smoothed noise above its median:
noise alone reaches 6 in one of 10^5 regions. What is detected stands out far more."""

SMALL_RADIUS = 3.0
"""A highlight whose radius at half height is below this many smoothing widths is made rounder by more than a tenth: its
estimates have the flag ``small``."""


@plain_errors
def reconstruct(
    frame: npt.ArrayLike,
    camera: Camera | Calibration | float,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] | None = None,
    roi: tuple[int, int, int, int] | None = None,
    smoothing_px: float | None = None,
    isolated: bool = True,
    detector: str | Detector | None = None,
    target: Target = "fine",
    encoding: str | None = None,
) -> Specularities:
    """Reconstruct the normals at a frame's isolated specularities.

    A frame of type uint8 or uint16 is a picture, and is taken as `simtest reconstruct` takes the same file: its values
    are shares of 255 or 65535, sRGB-encoded unless the calibration states the response, and clipped at the largest one
    (or at the calibration's saturation level); specularities are found by colour where it has any. A frame of real
    numbers is linear light of any scale, or values as encoded where the calibration states the response, in which no
    pixel counts as clipped unless the calibration states the level; specularities are found as peaks of the channels'
    mean. What was given and what was inferred stands in the result's `choices`.

    Parameters
    ----------
    frame : array_like, shape (H, W) or (H, W, C)
        Channels are RGB (OpenCV reads BGR: reverse them); of a picture, alpha is left out; of real numbers there may be
        any number of channels.
    camera : Camera, Calibration or float
        Of the same size. What a calibration knows is undone before smoothing: the response, then vignetting and
        emission. A camera alone is taken as exact. A number is the horizontal field of view, deg, where nothing else is
        known: focal length, centre and lens are then guesses, and their spread is in the uncertainty.
    estimators : sequence of str, or mapping
        Names as registered, or the estimators themselves by name; default `DEFAULT_ESTIMATORS`, and in pictures all
        that the calibration states enough for (`default_estimators`).
    roi : tuple of int, optional
        Column, row, width, height of the one region of interest; default: regions detected in the frame.
    smoothing_px : float, optional
        Standard deviation of the Gaussian smoothing, px, in [0, 50]; default 1 where found by colour, else 2.
    isolated : bool
        Detect only specularities whose isophote at t = 0.5 closes inside the frame and the camera's view mask, and
        whose shape is that of one point highlight (`simtest.detection.peak_shape`); by colour, no other kinds.
    detector : str or Detector, optional
        Name as registered, or the detector itself, to which `isolated` applies if it is one of the package; "auto": by
        colour in frames that have colours and are not linear, else peaks. Default "auto" in pictures, else "peaks".
    target : {"fine", "base"}
        Which surface's normals are wanted. Estimates at a single highlight are those of the fine surface; as the base's
        they have the relief's slope in their budget (`simtest.estimators.prior_parts.to_base`).
    encoding : {"srgb", "linear"}, optional
        How the values are encoded, where the calibration does not state the response. Real numbers in [0, 1] are a
        picture too where they are said to be "srgb".

    Returns
    -------
    Specularities
        A list, the brightest first; empty where the frame holds no isolated specularity. Estimates whose isophotes
        enclose clipped pixels have the flag ``saturated``; those that reach to where too little light is left for the
        whole correction, ``vignetted``.

    Raises
    ------
    InputError
        If the frame is no image, differs in size from the camera's calibration, or holds NaN, infinity or integers of
        another type, whose range nobody knows; if an argument is of the wrong kind or out of range.

    Examples
    --------
    >>> import numpy as np, simtest
    >>> y, x = np.mgrid[:120, :160] + 0.5
    >>> frame = np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / 200).astype(np.float32)
    >>> found = simtest.reconstruct(frame, 60.0)
    >>> len(found), found.choices.detector
    (1, 'peaks')
    """
    if isinstance(camera, int | float) and not isinstance(camera, bool):
        height, width = image_size(frame)
        camera = calibration_of_view(camera, width, height)
    known = _calibration(camera)
    check_encoding(encoding, known)
    image, is_picture = check_frame(frame, known.camera, encoding)
    if is_picture:
        finder = AUTO if detector is None else detector
        options = (encoding, finder, estimators, roi, smoothing_px, isolated, target)
        return Specularities(*run_picture(image, known, *options))
    # light of any scale, which has no largest value
    finder = "peaks" if detector is None else detector
    names = DEFAULT_ESTIMATORS if estimators is None else estimators
    made, choices = _choose(image, known, finder, names, roi, smoothing_px, isolated, target)
    inferred = untold(known, encoding=encoding, detector=detector, smoothing_px=smoothing_px, estimators=estimators)
    # Values that nobody called encoded are taken as linear: that is the rule for real numbers, and no guess.
    assumed = assumptions(known, encoding or "linear", target)
    return Specularities(made, replace(choices, inferred=inferred, assumed=tuple(assumed)))


def run_picture(
    picture: Image,
    calibration: Calibration,
    encoding: str | None = None,
    detector: str | Detector = AUTO,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] | None = None,
    roi: tuple[int, int, int, int] | None = None,
    smoothing_px: float | None = None,
    isolated: bool = True,
    target: Target = "fine",
) -> tuple[Reconstruction, Choices]:
    """Reconstruct the normals of a picture, from a file or an array (see `reconstruct`).

    The picture holds encoded values in [0, 1], float32, shape (H, W) or (H, W, 3). Raises `InputError` as
    `reconstruct` does.
    """
    check_size(picture, calibration.camera)
    # what every picture has: an encoding, and a largest value
    known = complete(calibration, encoding)
    names = default_estimators(known) if estimators is None else estimators
    made, choices = _choose(picture, known, detector, names, roi, smoothing_px, isolated, target)
    inferred = untold(
        calibration, encoding=encoding, detector=detector, smoothing_px=smoothing_px, estimators=estimators
    )
    assumed = assumptions(calibration, encoding, target)
    return made, replace(choices, inferred=inferred, assumed=tuple(assumed))


def _choose(
    image: Image,
    known: Calibration,
    detector: str | Detector,
    estimators: Sequence[str] | Mapping[str, AnyEstimator],
    roi: tuple[int, int, int, int] | None,
    smoothing_px: float | None,
    isolated: bool,
    target: Target,
) -> tuple[Reconstruction, Choices]:
    """Choose detector and smoothing, and run the pipeline."""
    name, finder = choose_detector(detector, image, known, roi is not None, isolated)
    smoothing = choose_smoothing(smoothing_px, finder)
    # A region of interest is cut as by peaks; its neighbours are those that would be found without it.
    searching = finder if roi is None else choose_detector(detector, image, known, False, isolated)[1]
    made = _run(image, known, searching, estimators, roi, smoothing, target)
    kind = known.response.kind if known.response else "linear"
    return made, Choices(kind, known.saturation_level, name, smoothing, short_names(estimators), known.priors)


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
        Estimates of highlights that smoothing has made rounder have the flag ``small``; those of highlights too small
        to have a shape ``unresolved``.
    """
    known = complete(_calibration(camera), None)
    return run_pipeline(picture, known, ColourDetector(isolated), estimators, None, smoothing_px)


def default_estimators(calibration: Calibration) -> tuple[str, ...]:
    """Return the names of the estimators that the calibration states enough for."""
    return (*DEFAULT_ESTIMATORS, *(("bisector",) if calibration.priors.lights_mm else ()))


def run_pipeline(
    picture: npt.ArrayLike,
    camera: Camera | Calibration,
    detector: str | Detector,
    estimators: Sequence[str] | Mapping[str, AnyEstimator],
    roi: tuple[int, int, int, int] | None,
    smoothing_px: float,
    target: Target = "fine",
) -> Reconstruction:
    """Reconstruct the normals of a frame with any detector; nothing is inferred (see `reconstruct`)."""
    calibration = _calibration(camera)
    image, _ = check_frame(picture, calibration.camera)
    return _run(image, calibration, load_detector(detector), estimators, roi, smoothing_px, target)


def _run(
    image: Image,
    calibration: Calibration,
    detector: Detector,
    estimators: Sequence[str] | Mapping[str, AnyEstimator],
    roi: tuple[int, int, int, int] | None,
    smoothing_px: float,
    target: Target,
) -> Reconstruction:
    """Run detector and estimators on a frame that has been checked."""
    number = isinstance(smoothing_px, int | float | np.number) and not isinstance(smoothing_px, bool)
    if not number or not 0 <= smoothing_px <= MAX_SMOOTHING_PX:
        raise InputError(f"smoothing_px = {smoothing_px!r}: must be a number in [0, {MAX_SMOOTHING_PX}]")
    box = None if roi is None else check_roi(roi)
    chosen = load_estimators(estimators if isinstance(estimators, Mapping) else _check_names(estimators))
    # linear light: a frame computes each step of its correction when it is first asked for
    frame = Frame(image, calibration, smoothing_px)
    # detect
    detection, beside = run_detector(detector, frame), tuple[Region, ...]()
    if box is not None:
        detection, beside = _cut_region(frame, box, detection)
    # estimate
    made = _estimate(detection, chosen, beside, box)
    return made if target == "fine" else _at_base(made, calibration.priors)


def _cut_region(frame: Frame, box: Box, found: Detection) -> tuple[Detection, tuple[Region, ...]]:
    """Take a user's region of interest for the one specularity, and return it with the frame's other regions.

    Raises `InputError` where it leaves the frame.
    """
    detected = found.regions
    # The frame's own light, in the view that the detector found.
    if found.view.seen is not None and found.view.seen is not frame.seen:
        frame = replace(frame, seen=found.view.seen)
    patch = frame.patch(box)
    if isinstance(patch, Failure):
        return Detection((Region(box, box[:2], None),), frame, view=found.view), detected
    x, y = (int(v) for v in patch.peak_px)
    # Of the detected regions the nearest one inside its isophote is the same highlight.
    inside = np.argwhere(patch.inside(HIGHLIGHT_ISOVALUE, cut=True))[:, ::-1] + box[:2]
    own = min(
        (region for region in detected if (inside == region.peak).all(axis=1).any()),
        key=lambda region: math.dist(region.peak, (x, y)),
        default=None,
    )
    own_detection = Detection((Region(box, (x, y), None),), frame, view=found.view)
    return own_detection, tuple(each for each in detected if each is not own)


def _above_noise(patch: Patch | Failure) -> Patch | Failure:
    """Return the patch of a user's region, or a Failure where its peak may be noise alone."""
    if isinstance(patch, Failure):
        return patch
    noise = (patch.noise_at_peak or 0.0) * share_of_noise(patch.smoothing_px)
    height = patch.peak_value - float(np.median(patch.values if patch.seen is None else patch.values[patch.seen]))
    if height > LEAST_HEIGHT * noise:
        return patch
    return Failure(Reason.NO_PEAK, f"the peak is {height:.3g} above the region's median, {noise:.3g} is noise")


def _estimate(
    detection: Detection, estimators: Mapping[str, AnyEstimator], beside: Sequence[Region], box: Box | None
) -> Reconstruction:
    """Run each estimator on all patches of a picture, or on the whole frame.

    `beside` are further specularities of the frame, which are only neighbours; answers outside `box`, the region that a
    user named, are not asked for.
    """
    frame, regions = detection.frame, detection.regions
    # Each patch holds the peaks of the others: `bisector` assigns lights to highlights by their arrangement, and a dim
    # highlight among brighter ones may be a near miss.
    known = [*regions, *beside]
    peaks = [(region.peak[0] + PIXEL_CENTRE, region.peak[1] + PIXEL_CENTRE) for region in known]
    cut = [_above_noise(frame.patch(r.box)) if r.contrast is None else frame.patch(r.box, r.peak) for r in known]
    # Highlights that touch have no isophotes of their own, so no estimator answers for them.
    for i, highlight in enumerate(detection.highlights):
        if highlight.kind is Kind.CLUSTER:
            cut[i] = Failure(Reason.CLUSTER, f"{len(highlight.peaks)} highlights touch, and carry no single normal")
    values = [0.0 if isinstance(patch, Failure) else patch.peak_value for patch in cut]
    patches = [
        patch
        if isinstance(patch, Failure)
        else replace(patch, others_px=(*peaks[:i], *peaks[i + 1 :]), others_value=(*values[:i], *values[i + 1 :]))
        for i, patch in enumerate(cut[: len(regions)])
    ]
    prepare(list(estimators.values()), patches, frame.calibration.camera)
    made = {name: run_in_frame(each, frame, patches, frame.calibration.priors) for name, each in estimators.items()}
    # Flags that depend on the frame are added behind those of the estimators.
    limited = frame.corrected.limited
    result = Reconstruction([], detection)
    rounded_px = SMALL_RADIUS * frame.smoothing_px
    small = [math.sqrt(h.area_px / math.pi) < rounded_px for h in detection.highlights] or [False] * len(patches)
    dim = [h.dim for h in detection.highlights] or [False] * len(patches)
    for i, (region, patch) in enumerate(zip(regions, patches, strict=True)):
        own = {name: each.of_patches[i] for name, each in made.items()}
        estimates = {
            name: _flagged(result, patch, limited, small[i], dim[i])
            for name, result in own.items()
            if result is not None
        }
        result.specularities.append(Specularity(region, patch, estimates))
    undetected = [
        _undetected(name, estimate, frame)
        for name, each in made.items()
        for estimate in each.elsewhere
        if box is None or _is_inside(estimate.look_px, box)
    ]
    # Clouds stand last.
    result.specularities.extend(sorted(undetected, key=_is_of_cloud))
    return result


def _at_base(made: Reconstruction, priors: Priors) -> Reconstruction:
    """Return a reconstruction whose estimates state the base's normals."""
    based = [
        replace(
            each,
            estimates={
                name: result if isinstance(result, Failure) else to_base(result, priors)
                for name, result in each.estimates.items()
            },
        )
        for each in made.specularities
    ]
    return replace(made, specularities=based)


def _is_of_cloud(specularity: Specularity) -> bool:
    return any(isinstance(e, Estimate) and e.cloud is not None for e in specularity.estimates.values())


def _is_inside(point_px: Array, box: Box) -> bool:
    return bool((np.array(box[:2]) <= point_px).all() and (point_px < np.add(box[:2], box[2:])).all())


def _undetected(name: str, estimate: Estimate, frame: Frame) -> Specularity:
    """Return the specularity of a frame estimator's result that no patch takes: it has none.

    Its region is one pixel, or the box around a cloud's highlights.
    """
    height, width = frame.encoded.shape[:2]
    x, y = (min(max(int(v), 0), size - 1) for v, size in zip(estimate.look_px, (width, height), strict=True))
    if estimate.cloud is None:
        no_patch = Failure(Reason.NO_PEAK, "no region was detected here")
        return Specularity(Region((x, y, 1, 1), (x, y), None), no_patch, {name: estimate})
    low, high = (end(estimate.cloud.points_px, axis=0).astype(int).tolist() for end in (np.min, np.max))
    box = (low[0], low[1], min(high[0] + 1, width) - low[0], min(high[1] + 1, height) - low[1])
    no_patch = Failure(Reason.NO_PEAK, f"a cloud of {len(estimate.cloud.points_px)} highlights, no single one")
    return Specularity(Region(box, (x, y), None), no_patch, {name: estimate})


def _flagged(
    result: Estimate | Failure, patch: Patch | Failure, limited: Mask | None, small: bool, dim: bool
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
    # An unresolved highlight states no shape that smoothing could have changed.
    flags = ("small",) if small and UNRESOLVED not in result.flags else ()
    flags = (*flags, "dim") if dim else flags
    if touched:
        isovalues = [i.isovalue for i in result.isophotes if 0 < i.isovalue < 1]
        used = patch.inside(min(isovalues, default=HIGHLIGHT_ISOVALUE), cut=True)
        flags = (*(name for name, mask in touched.items() if (mask & used).any()), *flags)
    # Answers made elsewhere may state them already.
    new = [flag for flag in flags if flag not in result.flags]
    return replace(result, flags=(*result.flags, *new)) if new else result


def _calibration(camera: object) -> Calibration:
    if isinstance(camera, Calibration):
        return camera
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: must be a simtest.Camera or simtest.Calibration")
    return Calibration(camera)


def _check_names(names: Sequence[str]) -> Sequence[str]:
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InputError(f"estimators = {names!r:.80}: must be a list of names")
    return names
