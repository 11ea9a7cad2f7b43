"""The pipeline from the values of a picture to normals: linear light, detect, estimate; one for grey and for colour."""

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection import Region
from simtest.errors import Failure, InputError
from simtest.estimators import Estimate, Estimator, load_estimators
from simtest.estimators.execution_guard import run_each
from simtest.geometry import Camera, Patch
from simtest.reconstruction.detectors import DETECTORS, Found, cut_region
from simtest.reconstruction.linear_light import check_frame, linear_picture
from simtest.runtime.resources import shown

Mask = npt.NDArray[np.bool_]

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
    """The normals of a picture, and what they were made of: the view, and highlights of all kinds."""

    specularities: list[Specularity]
    found: Found


def reconstruct(
    frame: npt.ArrayLike,
    camera: Camera | Calibration,
    estimators: Sequence[str] | Mapping[str, Estimator] = DEFAULT_ESTIMATORS,
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
    return run_pipeline(frame, camera, "peaks", estimators, roi, smoothing_px, isolated).specularities


def reconstruct_colour(
    picture: npt.ArrayLike,
    camera: Camera | Calibration,
    estimators: Sequence[str] | Mapping[str, Estimator] = DEFAULT_ESTIMATORS,
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
    return run_pipeline(picture, camera, "colour", estimators, None, smoothing_px, isolated)


def run_pipeline(
    picture: npt.ArrayLike,
    camera: Camera | Calibration,
    detector: str,
    estimators: Sequence[str] | Mapping[str, Estimator],
    roi: tuple[int, int, int, int] | None,
    smoothing_px: float,
    isolated: bool,
) -> Reconstruction:
    """Reconstruct the normals of a picture with the detector of a name (see `reconstruct`, `reconstruct_colour`)."""
    calibration = _calibration(camera)
    image = check_frame(picture, calibration.camera)
    number = isinstance(smoothing_px, int | float | np.number) and not isinstance(smoothing_px, bool)
    if not number or not 0 <= smoothing_px <= MAX_SMOOTHING_PX:
        raise InputError(f"smoothing_px = {smoothing_px!r}: must be a number in [0, {MAX_SMOOTHING_PX}]")
    box = None if roi is None else _check_roi(roi)
    chosen = estimators if isinstance(estimators, Mapping) else load_estimators(_check_names(estimators))
    # linear light
    light = linear_picture(image, calibration, in_colour=detector == "colour")
    # detect
    if box is not None:
        found = cut_region(light, calibration, smoothing_px, box)
    else:
        found = DETECTORS[detector](light, calibration, smoothing_px, isolated)
    # estimate
    return Reconstruction(_estimate(found, chosen, calibration), found)


def _estimate(found: Found, estimators: Mapping[str, Estimator], calibration: Calibration) -> list[Specularity]:
    """Run each estimator on all patches of a picture."""
    # Each patch holds the peaks of the others: `bisector` assigns lights to highlights by their arrangement.
    peaks = [(region.peak[0] + PIXEL_CENTRE, region.peak[1] + PIXEL_CENTRE) for region in found.regions]
    patches = [
        patch
        if isinstance(patch, Failure) or len(peaks) == 1
        else replace(patch, others_px=(*peaks[:i], *peaks[i + 1 :]))
        for i, patch in enumerate(found.patches)
    ]
    made = {name: run_each(each, patches, calibration.camera, calibration.priors) for name, each in estimators.items()}
    # Flags that depend on the frame are added behind those of the estimators.
    limited, rounded_px = found.frame.corrected.limited, SMALL_RADIUS * found.frame.smoothing_px
    small = [math.sqrt(h.area_px / math.pi) < rounded_px for h in found.highlights] or [False] * len(patches)
    return [
        Specularity(
            region, patch, {name: _flagged(results[i], patch, limited, small[i]) for name, results in made.items()}
        )
        for i, (region, patch) in enumerate(zip(found.regions, patches, strict=True))
    ]


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
