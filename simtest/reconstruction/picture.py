"""One picture: its camera, how it is to be reconstructed, and the record of its normals."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from simtest.calibration import Calibration
from simtest.detection.detector import load_detector
from simtest.detection.view import find_view
from simtest.errors import InputError
from simtest.estimators.protocol import Target
from simtest.reconstruction.assumptions import Extent, calibration_of_round_view, calibration_of_view
from simtest.reconstruction.borders import border_note
from simtest.reconstruction.choices import AUTO
from simtest.reconstruction.description import PictureRecord, describe
from simtest.reconstruction.picture_values import check_size
from simtest.reconstruction.pipeline import run_picture
from simtest.runtime.arrays import Image

TARGETS = ("fine", "base")

NOTHING = "no specularity found that stands out of the noise and has the shape of a highlight; try --all or --roi"

REFUSED = "the detector does not answer for this picture"
"""Begins the warning of a picture that the detector refuses."""


@dataclass(frozen=True)
class Options:
    """How pictures are reconstructed.

    Parameters
    ----------
    camera : Path, optional
        Calibration or camera file; this or `fov_deg` must be given, not both.
    fov_deg : float, optional
        Field of view, deg, across the whole picture, black borders included.
    estimators : tuple of str, optional
        Names; default those of the package that need no more than the calibration states.
    roi : tuple of int, optional
        Column, row, width, height; default: detected.
    encoding : {"srgb", "linear"}, optional
        How the values are encoded, where the calibration does not state the response; default sRGB. Isophotes are
        those of linear values.
    every : bool
        Take highlights of every kind, and peaks that the border cuts or whose shape is not that of one point highlight.
    detector : str
        How highlights are found: colour (by the tissue's colour), peaks (of the mean of the channels), or the name of
        another package's detector. auto: by colour in pictures that have any and are not linear.
    smoothing_px : float, optional
        Standard deviation of the Gaussian smoothing; default 1 px by colour, else 2 px.
    target : {"fine", "base"}
        Which surface's normals are stated: those of the fine one, or of the base without its relief, whose slope is
        then in the uncertainty.
    fov_of : {"width", "height", "diagonal", "view"}
        What the field of view spans; "view": the round view in the picture, whose centre is then the principal point.
    poses : Path, optional
        Of the camera over the frames of a sequence: tells convex from concave (`simtest.reconstruction.motion`).
    """

    camera: Path | None = None
    fov_deg: float | None = None
    estimators: tuple[str, ...] | None = None
    roi: tuple[int, int, int, int] | None = None
    encoding: str | None = None
    every: bool = False
    detector: str = AUTO
    smoothing_px: float | None = None
    target: Target = "fine"
    fov_of: Extent = "width"
    poses: Path | None = None

    def __post_init__(self) -> None:
        if self.detector != AUTO:
            try:
                load_detector(self.detector)
            except InputError as error:
                known = str(error).startswith("detector ")
                how = f"--{error}; auto chooses among those of simtest" if known else f"--detector: {error}"
                raise InputError(how) from None
        if self.target not in TARGETS:
            raise InputError(f"--target {self.target}: must be one of {', '.join(TARGETS)}")
        if (self.camera is None) == (self.fov_deg is None):
            raise InputError("--camera or --fov: exactly one of them must be given")


def parse_roi(text: str) -> tuple[int, int, int, int]:
    """Return the region of interest "x,y,w,h"."""
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--roi {text!s:.60}: must be x,y,w,h, four integers in px") from None
    return x, y, width, height


def read_calibration(options: Options, picture: Image) -> tuple[Calibration, list[str]]:
    """Return the calibration of pictures of this size, and warnings about it.

    What every picture has, an encoding and a largest value, is added where it is reconstructed. Raises `InputError` if
    the camera's file is malformed, or states the response and the options do too.
    """
    if options.camera is not None:
        # Imported here: the models of files are slow to load, and a field of view needs none.
        from simtest.spec.calibration_file import load_calibration

        calibration, cautions = load_calibration(options.camera), []
    else:
        assert options.fov_deg is not None
        calibration = _calibration_of_view(options, options.fov_deg, picture)
        extent = "round view" if options.fov_of == "view" else options.fov_of
        told = f"the field of view of {options.fov_deg:g} deg across the picture's {extent}"
        cautions = [f"no calibration: all angles depend on {told} being right"]
    if calibration.response is not None and options.encoding is not None:
        raise InputError(f"--encoding {options.encoding}: the calibration states the response; give one of them")
    return calibration, cautions


def _calibration_of_view(options: Options, fov_deg: float, picture: Image) -> Calibration:
    """Return the calibration that follows from the stated field of view."""
    height, width = picture.shape[:2]
    if options.fov_of != "view":
        return calibration_of_view(fov_deg, width, height, options.fov_of)
    circle = find_view(picture).circle
    if circle is None:
        raise InputError("--fov-of view: no round view was found in the picture; give width, height or diagonal")
    return calibration_of_round_view(fov_deg, width, height, circle)


def reconstruct_values(
    name: str, picture: Image, calibration: Calibration, options: Options, cautions: Sequence[str] = ()
) -> PictureRecord:
    """Reconstruct a picture, shape (H, W) or (H, W, 3), as encoded in [0, 1], and describe the result.

    Raises `InputError` if the picture's size is not the camera's, an estimator is unknown, or the detector does not fit
    the picture.
    """
    try:
        check_size(picture, calibration.camera)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    # linear light, detect, estimate
    made, choices = run_picture(
        picture, calibration, options.encoding, options.detector, options.estimators, options.roi, options.smoothing_px,
        not options.every, options.target,
    )  # fmt: skip
    view = made.detection.view
    # Any other extent is that of the whole picture, borders included.
    across_all = options.fov_deg is not None and options.fov_of != "view"
    bordered = border_note(picture, view) if across_all else ""
    refusal = made.detection.refusal
    refused = f"{REFUSED} ({choices.detector}): {refusal.detail}" if refusal else ""
    # describe
    return PictureRecord(
        image=name,
        camera=calibration.camera,
        encoding=choices.encoding,
        detector=choices.detector,
        view=view,
        warnings=[*cautions, *filter(None, (bordered, refused))],
        specularities=describe(made, calibration.camera, options.target),
        other_highlights=made.detection.others,
        assumed=choices.assumed,
        smoothing_px=choices.smoothing_px,
        inferred=choices.inferred,
    )
