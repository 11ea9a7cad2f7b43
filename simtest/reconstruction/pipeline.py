"""The pipeline from the values of a picture to normals: linear light, detect, estimate; one for grey and for colour."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Frame, Response
from simtest.calibration.frame import Box
from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection import Region
from simtest.detection.colour import ColourDetection, detect_colour
from simtest.detection.detector import Detection, Detector, Kind, run_detector
from simtest.detection.score import LEAST_SCORE, highlight_scores
from simtest.detection.view import View, find_view
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.dispatch import prepare, run_in_frame
from simtest.estimators.family import MIN_CLIPPED_PX
from simtest.estimators.prior_parts import relief_part, to_base
from simtest.estimators.protocol import Target
from simtest.estimators.small_spots import UNRESOLVED
from simtest.geometry import Camera, Patch
from simtest.geometry.patch import share_of_noise
from simtest.reconstruction.assumptions import border_note, calibration_of_view, fov_question
from simtest.reconstruction.images import check_frame, check_size, image_size, read_picture
from simtest.reconstruction.options import CLOUD, SMOOTHING_BY_COLOUR_PX, Options, check_encoding, choose
from simtest.reconstruction.records import Specularities, Specularity
from simtest.runtime.arrays import Array, Image
from simtest.runtime.boundary import plain_errors
from simtest.runtime.messages import LOGGER

if TYPE_CHECKING:
    from simtest.spec.recipes import CoreRegions

LEAST_HEIGHT = 6.0
"""A user's region holds a highlight if its peak is so many standard deviations of the smoothed noise above its median:
noise alone reaches 6 in one of 10^5 regions. What is detected stands out far more."""

SMALL_RADIUS = 3.0
"""A highlight whose radius at half height is below this many smoothing widths is made rounder by more than a tenth: its
estimates have the flag ``small``."""

NOTHING = "no specularity found that stands out of the noise and has the shape of a highlight; try --all or --roi"

REFUSED = "the detector does not answer for this picture"
"""Begins the warning of a picture that the detector refuses."""


@plain_errors
def reconstruct(
    frame: npt.ArrayLike | Path,
    camera: Camera | Calibration | float,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] | None = None,
    roi: tuple[int, int, int, int] | None = None,
    smoothing_px: float | None = None,
    isolated: bool = True,
    detector: str | Detector | None = None,
    target: Target = "fine",
    encoding: str | None = None,
    keep_overlays: bool = False,
    least_score: float | None = None,
    regions: "CoreRegions | str | Path | Sequence[str | Path] | None" = None,
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
    frame : array_like, shape (H, W) or (H, W, C), or path
        A path, or a text, names a picture's file. Channels are RGB (OpenCV reads BGR: reverse them); of a picture,
        alpha is left out; of real numbers there may be any number of channels.
    camera : Camera, Calibration or float
        Of the same size. What a calibration knows is undone before smoothing: the response, then vignetting and
        emission. A camera alone is taken as exact. A number is the horizontal field of view, deg, where nothing else is
        known: focal length, centre and lens are then guesses, and their spread is in the uncertainty.
    estimators : sequence of str, or mapping
        Names as registered, or the estimators themselves by name; default `DEFAULT_ESTIMATORS`, and in pictures all
        that the calibration states enough for (`default_estimators`), and `cloud` on the whole of it.
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
        they have the relief's slope in their budget. Either way `Specularity.organ` holds the latter.
    encoding : {"srgb", "linear"}, optional
        How the values are encoded, where the calibration does not state the response. Real numbers in [0, 1] are a
        picture too where they are said to be "srgb".
    keep_overlays : bool
        Found by colour, take text and squares that are drawn on the picture for tissue; default: they are masked.
    least_score : float, optional
        Highlights with a smaller score, which may be none, have no best normal; 0 keeps all. Default `LEAST_SCORE`.
    regions : path, sequence of paths or CoreRegions, optional
        Cores' calibrations (`simtest calibrate core`): their answers have regions of 68 and 95 % (`calibrated`).

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
    name, cautions = "", list[str]()
    if isinstance(frame, str | Path):
        name, frame = str(frame), read_picture(Path(frame))
    if isinstance(camera, int | float) and not isinstance(camera, bool):
        height, width = image_size(frame)
        cautions = fov_question(camera)
        camera = calibration_of_view(camera, width, height)
    elif isinstance(camera, Camera):
        camera = Calibration(camera)
    elif not isinstance(camera, Calibration):
        raise InputError(f"camera is a {type(camera).__name__}: must be a simtest.Camera or simtest.Calibration")
    check_encoding(encoding, camera)
    for key, value in (("isolated", isolated), ("keep_overlays", keep_overlays)):
        if not isinstance(value, bool | np.bool_):
            raise InputError(f"{key} is a {type(value).__name__}: must be True or False")
    if name:
        image, is_picture = np.asarray(frame), True
        check_size(image, camera.camera)
    else:
        image, is_picture = check_frame(frame, camera.camera, encoding)
    if regions is not None:
        from simtest.spec.recipes import CoreRegions
        from simtest.spec.spec_model import validate

        if not isinstance(regions, CoreRegions):
            files = [regions] if isinstance(regions, str | Path) else regions
            if not isinstance(files, Sequence) or not all(isinstance(file, str | Path) for file in files):
                raise InputError(f"regions is a {type(regions).__name__}: must be a path, several, or CoreRegions")
            regions = validate(CoreRegions, {"files": [str(file) for file in files]}, "regions")
    options = Options(
        estimators=estimators, roi=roi, encoding=encoding, every=not isolated, detector=detector,
        smoothing_px=smoothing_px, target=target, keep_overlays=bool(keep_overlays), least_score=least_score,
        regions=regions,
    )  # fmt: skip
    spots = run(image, camera, options, is_picture)
    spots.image, spots.warnings = name, cautions
    return spots


def reconstruct_values(
    name: str, picture: Image, calibration: Calibration, options: Options, cautions: Sequence[str] = ()
) -> Specularities:
    """Reconstruct a named picture, shape (H, W) or (H, W, 3), as encoded in [0, 1], and say what its user should know.

    Raises `InputError` if the picture's size is not the camera's, an estimator is unknown, or the detector does not fit
    the picture.
    """
    try:
        check_size(picture, calibration.camera)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    spots = run(picture, calibration, options)
    LOGGER.debug("%s: %s, %d other highlights; %s", name, spots.counted, len(spots.detection.others), spots.choices)
    spots.image = name
    # Any other extent is that of the whole picture, borders included.
    across_all = options.fov_deg is not None and options.fov_of != "view"
    bordered = border_note(picture, spots.detection.view) if across_all else ""
    refusal = spots.detection.refusal
    refused = f"{REFUSED} ({spots.choices.detector}): {refusal.detail}" if refusal else ""
    spots.warnings = [*cautions, *filter(None, (bordered, refused))]
    return spots


def run(image: Image, calibration: Calibration, options: Options, is_picture: bool = True) -> Specularities:
    """Reconstruct the normals of a frame that has been checked: encoded values in [0, 1], or light of any scale."""
    choices, finder, estimators = choose(image, calibration, options, is_picture)
    chosen = load_estimators(estimators)
    # linear light: a frame computes each step of its correction when it is first asked for
    frame = Frame(image, choices.calibration, choices.smoothing_px)
    # detect
    detection, beside = run_detector(finder, frame), tuple[Region, ...]()
    if options.roi is not None:
        detection, beside = _cut_region(frame, options.roi, detection)
    # estimate
    spots, no_cloud = _estimate(detection, chosen, beside, options)
    numbered = [replace(spot, id=i) for i, spot in enumerate(spots)]
    if options.regions is not None:
        from simtest.reconstruction.regions import with_regions

        numbered = with_regions(numbered, image, choices, options)
    return Specularities(numbered, detection, choices, no_cloud=no_cloud)


@dataclass(frozen=True)
class PictureDetection:
    """What a colour picture shows: the part of it that is tissue, and its highlights."""

    view: View
    detection: ColourDetection


def detect_in_picture(picture: Image) -> PictureDetection:
    """Find the highlights of a colour picture, sRGB values in [0, 1], shape (H, W, 3), without a camera."""
    # Detection by colour uses no angle, so any field of view serves.
    camera = Camera.from_fov(60.0, picture.shape[1], picture.shape[0])
    calibration = Calibration(camera, response=Response("srgb"), saturation_level=1.0)
    frame, view = Frame(picture, calibration, SMOOTHING_BY_COLOUR_PX), find_view(picture)
    return PictureDetection(view, detect_colour(frame.channels, frame.clipped, view.seen))


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
    detection: Detection, estimators: Mapping[str, AnyEstimator], beside: Sequence[Region], options: Options
) -> tuple[list[Specularity], Failure | None]:
    """Run each estimator on all patches of a picture, or on the whole frame; and say why no cloud has an answer.

    `beside` are further specularities of the frame, which are only neighbours; answers outside the region that a user
    named are not asked for. Where nobody asked for clouds, that they have no answer is no result of each highlight.
    """
    frame, regions = detection.frame, detection.regions
    highlights = detection.highlights or (None,) * len(regions)
    # Each patch holds the peaks of the others: `bisector` assigns lights to highlights by their arrangement, and a dim
    # highlight among brighter ones may be a near miss.
    known = [*regions, *beside]
    peaks = [(region.peak[0] + PIXEL_CENTRE, region.peak[1] + PIXEL_CENTRE) for region in known]
    cut = [_above_noise(frame.patch(r.box)) if r.contrast is None else frame.patch(r.box, r.peak) for r in known]
    # Highlights that touch have no isophotes of their own, so no estimator answers for them.
    for i, highlight in enumerate(highlights):
        if highlight is not None and highlight.kind is Kind.CLUSTER:
            cut[i] = Failure(Reason.CLUSTER, f"{len(highlight.peaks)} highlights touch, and carry no single normal")
    values = [0.0 if isinstance(patch, Failure) else patch.peak_value for patch in cut]
    masks = [patch.saturated for patch in cut if not isinstance(patch, Failure)]
    clipped = sum(mask is not None and np.count_nonzero(mask) >= MIN_CLIPPED_PX for mask in masks) / max(len(masks), 1)
    scores = [score and round(score, 4) for score in highlight_scores(cut[: len(regions)], frame)]
    patches = [
        patch
        if isinstance(patch, Failure)
        else replace(
            patch, others_px=(*peaks[:i], *peaks[i + 1 :]), others_value=(*values[:i], *values[i + 1 :]),
            clipped_share=clipped, score=score,
        )
        for i, (patch, score) in enumerate(zip(cut, scores, strict=False))
    ]  # fmt: skip
    camera, priors = frame.calibration.camera, frame.calibration.priors
    prepare(list(estimators.values()), patches, camera)
    relief = relief_part(priors)
    answers = {name: run_in_frame(each, frame, patches, priors) for name, each in estimators.items()}
    no_cloud = None
    if options.estimators is None and CLOUD in answers and not answers[CLOUD].elsewhere:
        of_patches = zip(answers.pop(CLOUD).of_patches, patches, strict=True)
        failures = [each for each, patch in of_patches if isinstance(each, Failure) and each is not patch]
        no_cloud = failures[0] if failures else Failure(Reason.NO_ESTIMATE, "no highlight was found")
    least = LEAST_SCORE if options.least_score is None else options.least_score
    spots = []
    for i, (region, patch, highlight, score) in enumerate(zip(regions, patches, highlights, scores, strict=True)):
        given = {name: each.of_patches[i] for name, each in answers.items()}
        results = {name: result for name, result in given.items() if result is not None}
        if not isinstance(patch, Failure):
            small = highlight is not None and math.sqrt(highlight.area_px / math.pi) < SMALL_RADIUS * frame.smoothing_px
            dim = highlight is not None and highlight.dim
            results = {name: _flagged(each, patch, frame, small, dim) for name, each in results.items()}
        organ = {name: to_base(each, relief) for name, each in results.items() if isinstance(each, Estimate)}
        spots.append(Specularity(region, patch, results, highlight, camera, options.target, organ, score, least))
    box = options.roi
    undetected = [
        _undetected(name, estimate, frame, options.target, relief)
        for name, each in answers.items()
        for estimate in each.elsewhere
        if box is None or _is_inside(estimate.look_px, box)
    ]
    # Clouds stand last.
    spots.extend(sorted(undetected, key=lambda spot: spot.cloud is not None))
    if options.target == "base":
        spots = [replace(spot, estimates={**spot.estimates, **spot.organ}) for spot in spots]
    return spots, no_cloud


def _is_inside(point_px: Array, box: Box) -> bool:
    return bool((np.array(box[:2]) <= point_px).all() and (point_px < np.add(box[:2], box[2:])).all())


def _undetected(name: str, estimate: Estimate, frame: Frame, target: Target, relief: Array) -> Specularity:
    """Return the specularity of a frame estimator's result that no patch takes: at a pixel, or around a cloud."""
    height, width = frame.encoded.shape[:2]
    x, y = (min(max(int(v), 0), size - 1) for v, size in zip(estimate.look_px, (width, height), strict=True))
    box, why = (x, y, 1, 1), "no region was detected here"
    if estimate.cloud is not None:
        low, high = (end(estimate.cloud.points_px, axis=0).astype(int).tolist() for end in (np.min, np.max))
        box = (low[0], low[1], min(high[0] + 1, width) - low[0], min(high[1] + 1, height) - low[1])
        why = f"a cloud of {len(estimate.cloud.points_px)} highlights, no single one"
    region, no_patch = Region(box, (x, y), None), Failure(Reason.NO_PEAK, why)
    organ = {name: to_base(estimate, relief)}
    return Specularity(region, no_patch, {name: estimate}, None, frame.calibration.camera, target, organ)


def _flagged(result: Estimate | Failure, patch: Patch, frame: Frame, small: bool, dim: bool) -> Estimate | Failure:
    """Add the flags that depend on the frame, behind those of the estimator."""
    if isinstance(result, Failure):
        return result
    limited = frame.corrected.limited
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
