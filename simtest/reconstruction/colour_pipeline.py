"""From a colour picture to normals: its own view mask, its specular light, its isolated highlights, the estimators."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Frame, Response
from simtest.detection.blobs import Highlight
from simtest.detection.colour import ColourDetection, detect_colour
from simtest.detection.view_mask import View, find_view
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.reconstruction.pipeline import DEFAULT_ESTIMATORS, FrameCut, Specularity, check_frame, run_estimators

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

SMOOTHING_PX = 1.0
"""Highlights of real pictures are small, and 2 px would round them."""

SMALL_RADIUS = 3.0
"""A highlight whose radius at half height is below this many smoothing widths is made rounder by more than a tenth: its
estimates have the flag ``small``."""

_LEVELS = 2**16
"""As many values as a picture can have; its response is looked up in a table of them."""


@dataclass(frozen=True)
class PictureDetection:
    """What a picture shows.

    Parameters
    ----------
    view : View
        The part of the picture that shows tissue.
    linear : ndarray of float32, shape (H, W, 3)
        Linear values.
    clipped : ndarray of bool, shape (H, W)
        Where a channel is clipped.
    detection : ColourDetection
        Highlights.
    """

    view: View
    linear: Image
    clipped: Mask
    detection: ColourDetection


@dataclass(frozen=True)
class ColourReconstruction:
    """Normals of a colour picture.

    Parameters
    ----------
    specularities : list of Specularity
        Those reconstructed, the brightest first.
    highlights : list of Highlight or None
        The detected highlight of each; None for an estimate that looks elsewhere.
    found : PictureDetection
        All that was detected.
    """

    specularities: list[Specularity]
    highlights: list[Highlight | None]
    found: PictureDetection


def detect_in_picture(
    picture: Image, response: Response | None = None, level: float = 1.0, seen: Mask | None = None
) -> PictureDetection:
    """Find the highlights of a picture.

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
    linear = _linear(picture, response or Response("srgb"))
    red, green, blue = cv2.split(picture)
    clipped = cv2.max(cv2.max(red, green), blue) >= np.float32(level)
    view = find_view(picture) if seen is None else View(seen)
    return PictureDetection(view, linear, clipped, detect_colour(linear, clipped, view.seen))


def _linear(picture: Image, response: Response) -> Image:
    if response.kind == "linear":
        return picture
    table = response.decode(np.linspace(0, 1, _LEVELS)).astype(np.float32)
    steps = cv2.multiply(picture, (_LEVELS - 1,) * 4, dtype=cv2.CV_16U)
    return np.asarray(table[steps])


def reconstruct_colour(
    picture: npt.ArrayLike,
    calibration: Calibration,
    estimators: Sequence[str] | Mapping[str, AnyEstimator] = DEFAULT_ESTIMATORS,
    smoothing_px: float = SMOOTHING_PX,
    isolated: bool = True,
) -> ColourReconstruction:
    """Reconstruct the normals at the isolated highlights of a colour picture.

    The estimators see the specular light alone: the tissue's part of each pixel is taken off (`split_light`).

    Parameters
    ----------
    picture : array_like, shape (H, W, 3)
        RGB values as encoded, in [0, 1].
    calibration : Calibration
        Of the same size. Where it has no response, sRGB is taken; where its camera has no view mask, that of the
        picture.
    estimators : sequence of str, or mapping
        Names as registered, or the estimators themselves by name.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px.
    isolated : bool
        Leave out highlights of the other kinds.

    Returns
    -------
    ColourReconstruction

    Raises
    ------
    InputError
        If the picture differs in size from the camera's calibration, or holds NaN or infinity; if an estimator is
        unknown.
    """
    camera = calibration.camera
    image = check_frame(picture, camera)
    chosen = load_estimators(estimators)
    level = 1.0 if calibration.saturation_level is None else calibration.saturation_level
    found = detect_in_picture(image, calibration.response, level, camera.seen)
    # Light is split in linear values, which have no response of their own; falloff is divided away afterwards.
    plain = replace(calibration, response=None, saturation_level=None)
    corrected = replace(plain.correct(found.detection.light.specular), saturated=found.clipped, channels=3)
    cut = FrameCut.of(corrected, plain, smoothing_px, found.view.seen)
    highlights = found.detection.isolated if isolated else found.detection.highlights
    patches = [(h.region, cut.patch(h.region.box, h.region.peak)) for h in highlights]
    frame = Frame(image, calibration, smoothing_px, found.view.seen, found.detection.light.specular)
    made = run_estimators(patches, chosen, frame, corrected.limited)
    specularities = [
        _flagged_small(spot) if _radius_px(highlight) < SMALL_RADIUS * smoothing_px else spot
        for spot, highlight in zip(made[: len(highlights)], highlights, strict=True)
    ]
    # Estimates of a `FrameEstimator` that no patch takes have no highlight.
    undetected = made[len(highlights) :]
    return ColourReconstruction(specularities + undetected, [*highlights, *[None] * len(undetected)], found)


def _radius_px(highlight: Highlight) -> float:
    return math.sqrt(highlight.area_px / math.pi)


def _flagged_small(spot: Specularity) -> Specularity:
    estimates = {
        name: replace(result, flags=(*result.flags, "small")) if isinstance(result, Estimate) else result
        for name, result in spot.estimates.items()
    }
    return replace(spot, estimates=estimates)
