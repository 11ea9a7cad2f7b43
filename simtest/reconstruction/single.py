"""One picture: which detector, which estimators, and what is said of the result."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Response
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection.blobs import Highlight
from simtest.detection.view_mask import View
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.reconstruction.colour_pipeline import SMOOTHING_PX, reconstruct_colour
from simtest.reconstruction.description import describe, describe_highlight
from simtest.reconstruction.image_io import is_coloured
from simtest.reconstruction.pipeline import DEFAULT_ESTIMATORS, reconstruct
from simtest.spec import load_calibration

Image = npt.NDArray[np.float32]

DETECTORS = ("auto", "colour", "peaks")


@dataclass(frozen=True)
class Options:
    """How pictures are reconstructed.

    Parameters
    ----------
    estimators : tuple of str, optional
        Names; default those of the package that need no more than the calibration states.
    roi : tuple of int, optional
        Column, row, width, height; default: detected.
    encoding : {"srgb", "linear"}, optional
        Where the calibration does not state the response; default sRGB.
    every : bool
        Take highlights of every kind.
    detector : {"auto", "colour", "peaks"}
        How highlights are found: by the tissue's colour, or as peaks of the mean of the channels. auto: by colour in
        pictures that have any and are not linear.
    smoothing_px : float, optional
        Default 1 px by colour, else 2 px.
    """

    estimators: tuple[str, ...] | None = None
    roi: tuple[int, int, int, int] | None = None
    encoding: str | None = None
    every: bool = False
    detector: str = "auto"
    smoothing_px: float | None = None

    def __post_init__(self) -> None:
        if self.detector not in DETECTORS:
            raise InputError(f"--detector {self.detector}: must be one of {', '.join(DETECTORS)}")


@dataclass(frozen=True)
class PictureResult:
    """What was reconstructed in a picture.

    Parameters
    ----------
    spots : list of dict
        Specularities as in normals.json.
    others : list of dict
        Highlights of other kinds, by colour only.
    view : dict or None
        The view's border, where one was found.
    detector : str
        Which was used.
    """

    spots: list[dict[str, Any]]
    others: list[dict[str, Any]]
    view: dict[str, Any] | None
    detector: str


def read_camera(
    camera_file: Path | None, fov_deg: float | None, size: tuple[int, int]
) -> tuple[Calibration, list[str]]:
    """Give the calibration of pictures of a size (width, height), from a file or a field of view, and what to mind.

    Raises
    ------
    InputError
        If neither or both are given, or the file is malformed.
    """
    check_camera_given(camera_file, fov_deg)
    if camera_file is not None:
        return load_calibration(camera_file), []
    assert fov_deg is not None
    caution = f"no calibration: all angles depend on the field of view of {fov_deg:g} deg being right"
    return Calibration(Camera.from_fov(fov_deg, *size)), [caution]


def check_camera_given(camera_file: Path | None, fov_deg: float | None) -> None:
    """Raise `InputError` where neither a camera's file nor a field of view is given, or both."""
    if (camera_file is None) == (fov_deg is None):
        raise InputError("--camera or --fov: exactly one of them must be given")


def completed(calibration: Calibration, encoding: str | None) -> Calibration:
    """Add what every picture has: an encoding, and a largest value, at which it is clipped."""
    if calibration.response is not None and encoding is not None:
        raise InputError(f"--encoding {encoding}: the calibration states the response; give one of them")
    response = calibration.response or (Response() if encoding == "linear" else Response("srgb"))
    level = 1.0 if calibration.saturation_level is None else calibration.saturation_level
    return replace(calibration, response=response, saturation_level=level)


def default_estimators(calibration: Calibration) -> tuple[str, ...]:
    """Give the estimators that the calibration tells enough for."""
    known = calibration.priors
    lights = len(known.lights) > 0 and known.distance_mm is not None
    return (*DEFAULT_ESTIMATORS, *(("bisector",) if lights else ()))


def reconstruct_values(picture: Image, calibration: Calibration, options: Options) -> PictureResult:
    """Reconstruct a picture.

    Parameters
    ----------
    picture : ndarray of float32, shape (H, W) or (H, W, 3)
        Values as encoded, in [0, 1].
    calibration : Calibration
        Complete (see `completed`).
    options : Options
        How.

    Returns
    -------
    PictureResult

    Raises
    ------
    InputError
        If the picture's size is not the camera's, an estimator is unknown, or the detector does not fit the picture.
    """
    names = list(options.estimators or default_estimators(calibration))
    detector = _detector(picture, calibration, options)
    camera = calibration.camera
    if detector == "peaks":
        smoothing = DEFAULT_SMOOTHING_PX if options.smoothing_px is None else options.smoothing_px
        found = reconstruct(picture, calibration, names, options.roi, smoothing, isolated=not options.every)
        spots = [describe(i, spot, camera) for i, spot in enumerate(found)]
        return PictureResult(spots, [], None, detector)
    smoothing = SMOOTHING_PX if options.smoothing_px is None else options.smoothing_px
    made = reconstruct_colour(picture, calibration, names, smoothing, isolated=not options.every)
    pairs = zip(made.specularities, made.highlights, strict=True)
    spots = [describe(i, spot, camera, highlight) for i, (spot, highlight) in enumerate(pairs)]
    taken = {id(highlight) for highlight in made.highlights}
    others = [_other(h) for h in made.found.detection.highlights if id(h) not in taken]
    return PictureResult(spots, others, describe_view(made.found.view), detector)


def _other(highlight: Highlight) -> dict[str, Any]:
    return {"box_px": list(highlight.region.box), "peak_px": [v + 0.5 for v in highlight.region.peak],
            **describe_highlight(highlight)}  # fmt: skip


def _detector(picture: Image, calibration: Calibration, options: Options) -> str:
    if options.detector == "colour" and (picture.ndim != 3 or options.roi is not None):
        what = "--roi names the region" if picture.ndim == 3 else "the picture is grey"
        raise InputError(f"--detector colour: {what}; must be peaks")
    if options.roi is not None:
        return "peaks"
    linear = calibration.response is not None and calibration.response.kind == "linear"
    if options.detector == "auto":
        return "colour" if is_coloured(picture) and not linear else "peaks"
    return options.detector


def describe_view(view: View) -> dict[str, Any] | None:
    """Describe the view's border: its circle where it is round, else the outline of what is seen."""
    if view.seen is None:
        return None
    contours, _ = cv2.findContours(view.seen.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    polygon = cv2.approxPolyDP(max(contours, key=len), 1.0, True)[:, 0] if contours else np.empty((0, 2))
    circle = view.circle and {"cx": view.circle.cx, "cy": view.circle.cy, "radius": view.circle.radius}
    return {"circle": circle, "outline": [[float(x) + 0.5, float(y) + 0.5] for x, y in polygon]}
