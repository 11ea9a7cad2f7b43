"""How a picture is taken: what its user says of camera and method, and what is chosen where nobody says it.

Values of 8 or 16 bits are those of a picture: encoded, and clipped at the largest one. Real values are linear light of
any scale, unless an encoding is given: then they are those of a picture, in [0, 1].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from simtest.calibration import Calibration, Priors, Response
from simtest.calibration.priors import OF_PICTURES
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection.colour import ColourDetector
from simtest.detection.detector import Detector, load_detector
from simtest.detection.peaks import PeakDetector
from simtest.detection.view import find_view
from simtest.errors import InputError
from simtest.estimators import AnyEstimator
from simtest.estimators.names import short_names
from simtest.estimators.protocol import Target
from simtest.reconstruction.assumptions import (
    Assumption,
    Extent,
    assumptions,
    calibration_of_round_view,
    calibration_of_view,
    fov_question,
)
from simtest.reconstruction.images import check_roi, is_coloured
from simtest.runtime.arrays import Image, short_repr
from simtest.runtime.boundary import shown

if TYPE_CHECKING:
    from simtest.spec.recipes import CoreRegions

AUTO = "auto"
ENCODINGS = ("srgb", "linear")
TARGETS = ("fine", "base")
CLOUD = "cloud"
"""Name of the estimator of the organ's normal, which runs by default on a whole picture."""

DEFAULT_ESTIMATORS = ("circle_pose", "brightest_point", "cone_axis", "curved")
MAX_SMOOTHING_PX = 50

SMOOTHING_BY_COLOUR_PX = 1.0
"""Highlights of real pictures are small, and 2 px would round them."""


@dataclass(frozen=True)
class Options:
    """How pictures are reconstructed.

    Parameters
    ----------
    camera : Path, optional
        Calibration or camera file; where no calibration is at hand, this or `fov_deg` must be given, not both.
    fov_deg : float, optional
        Field of view, deg, across the whole picture, black borders included.
    estimators : sequence of str, or mapping, optional
        Names, or the estimators themselves by name; default those of the package that need no more than the calibration
        states.
    roi : tuple of int, optional
        Column, row, width, height; default: detected.
    encoding : {"srgb", "linear"}, optional
        How the values are encoded, where the calibration does not state the response; default sRGB. Isophotes are
        those of linear values.
    every : bool
        Take highlights of every kind, and peaks that the border cuts or whose shape is not that of one point highlight.
    detector : str or Detector, optional
        How highlights are found: colour (by the tissue's colour), peaks (of the mean of the channels), or the name of
        another package's detector. auto: by colour in pictures that have any and are not linear. None: auto in
        pictures, peaks in light of any scale.
    smoothing_px : float, optional
        Standard deviation of the Gaussian smoothing; default 1 px by colour, else 2 px.
    target : {"fine", "base"}
        Which surface's normals are stated: those of the fine one, or of the base without its relief, whose slope is
        then in the uncertainty.
    fov_of : {"width", "height", "diagonal", "view"}
        What the field of view spans; "view": the round view in the picture, whose centre is then the principal point.
    poses : Path, optional
        Of the camera over the frames of a sequence: tells convex from concave (`simtest.reconstruction.motion`).
    keep_overlays : bool
        Found by colour, take text and squares that are drawn on the picture for tissue.
    least_score : float, optional
        Highlights with a smaller score have no best normal; 0 keeps all. Default `LEAST_SCORE`.
    regions : CoreRegions, optional
        Calibrations of cores (`simtest calibrate core`), whose answers then have regions of 68 and 95 %.
    """

    camera: Path | None = None
    fov_deg: float | None = None
    estimators: Sequence[str] | Mapping[str, AnyEstimator] | None = None
    roi: tuple[int, int, int, int] | None = None
    encoding: str | None = None
    every: bool = False
    detector: str | Detector | None = AUTO
    smoothing_px: float | None = None
    target: Target = "fine"
    fov_of: Extent = "width"
    poses: Path | None = None
    keep_overlays: bool = False
    least_score: float | None = None
    regions: "CoreRegions | None" = None

    def __post_init__(self) -> None:
        if isinstance(self.detector, str) and self.detector != AUTO:
            try:
                load_detector(self.detector)
            except InputError as error:
                raise InputError(f"{error}; {AUTO} chooses among those of simtest") from error
        if not isinstance(self.target, str) or self.target not in TARGETS:
            raise InputError(f"target = {shown(self.target)}: must be one of {', '.join(TARGETS)}")
        for key, most in (("smoothing_px", MAX_SMOOTHING_PX), ("least_score", 1)):
            value = getattr(self, key)
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if value is not None and not (number and 0 <= value <= most):
                raise InputError(f"{key} = {value!r}: must be a number in [0, {most}]")
        names = () if self.estimators is None or isinstance(self.estimators, Mapping) else self.estimators
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise InputError(f"estimators = {shown(names)}: must be a list of names")
        if self.roi is not None:
            object.__setattr__(self, "roi", check_roi(self.roi))

    def require_camera(self) -> None:
        """Raise `InputError` unless either a camera's file or a field of view is given."""
        if (self.camera is None) == (self.fov_deg is None):
            raise InputError("--camera or --fov: exactly one of them must be given")


def parse_roi(text: str) -> tuple[int, int, int, int]:
    """Return the region of interest "x,y,w,h"."""
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--roi {text!s:.60}: must be x,y,w,h, four integers in px") from None
    return x, y, width, height


def stated_calibration(options: Options) -> Calibration | None:
    """Read the camera's file; None where a field of view stands in its place.

    Raises `InputError` if the file is malformed, or states the response and the options do too.
    """
    options.require_camera()
    if options.camera is None:
        return None
    # Imported here: the models of files are slow to load, and a field of view needs none.
    from simtest.spec.calibration_file import load_calibration

    calibration = load_calibration(options.camera)
    if calibration.response is not None and options.encoding is not None:
        raise InputError(f"--encoding {options.encoding}: the calibration states the response; give one of them")
    return calibration


def calibration_for(options: Options, picture: Image) -> tuple[Calibration, list[str]]:
    """Return the calibration of pictures of this size, and warnings about it.

    What every picture has, an encoding and a largest value, is added where it is reconstructed.
    """
    if (stated := stated_calibration(options)) is not None:
        return stated, []
    assert options.fov_deg is not None
    (height, width), extent = picture.shape[:2], str(options.fov_of)
    if options.fov_of != "view":
        calibration = calibration_of_view(options.fov_deg, width, height, options.fov_of)
    elif (circle := find_view(picture).circle) is not None:
        calibration, extent = calibration_of_round_view(options.fov_deg, width, height, circle), "round view"
    else:
        raise InputError("--fov-of view: no round view was found in the picture; give width, height or diagonal")
    angle = f"the field of view of {options.fov_deg:g} deg across the picture's {extent}"
    return calibration, [f"no calibration: all angles depend on {angle} being right", *fov_question(options.fov_deg)]


@dataclass(frozen=True)
class Choices:
    """How a picture was taken.

    Parameters
    ----------
    calibration : Calibration
        With the response that was undone, and the level at which pixels count as clipped.
    detector : str
        Name of the detector; where a region of interest was named it finds the peak in it.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px.
    estimators : tuple of str
        Their names.
    inferred : tuple of str
        Those of `encoding`, `saturation_level`, `detector`, `smoothing_px` and `estimators` that nobody gave.
    assumed : tuple of Assumption
        What else nobody gave, with the distribution that stands for it in the budgets, and how to narrow it.
    """

    calibration: Calibration
    detector: str
    smoothing_px: float
    estimators: tuple[str, ...]
    inferred: tuple[str, ...] = ()
    assumed: tuple[Assumption, ...] = ()

    __repr__ = short_repr

    @property
    def encoding(self) -> str:
        """Kind of the response that was undone: linear, srgb, gamma or table."""
        return self.calibration.response.kind if self.calibration.response else "linear"

    @property
    def saturation_level(self) -> float | None:
        """Encoded value at and above which a pixel counts as clipped; None: none does."""
        return self.calibration.saturation_level

    @property
    def priors(self) -> Priors:
        """What the estimators are given of lights, distance, lobe, camera and relief."""
        return self.calibration.priors

    def __str__(self) -> str:
        """Return the choices on one line; those that nobody gave are marked."""
        level = "none" if self.saturation_level is None else f"at {self.saturation_level:g}"
        texts = {
            "encoding": f"encoding {self.encoding}", "saturation_level": f"clipped {level}",
            "detector": f"detector {self.detector}", "smoothing_px": f"smoothing {self.smoothing_px:g} px",
            "estimators": f"estimators {' '.join(self.estimators)}",
        }  # fmt: skip
        return ", ".join(text + " (inferred)" * (name in self.inferred) for name, text in texts.items())


def choose(
    image: Image, calibration: Calibration, options: Options, is_picture: bool
) -> tuple[Choices, Detector, Mapping[str, AnyEstimator] | Sequence[str]]:
    """Choose what the options leave open; return the choices, the detector and the estimators.

    A picture has an encoding and a largest value; light of any scale, where `is_picture` is false, has neither.
    """
    if is_picture and calibration.priors.floors is None:
        calibration = replace(calibration, priors=replace(calibration.priors, floors=OF_PICTURES))
    known = complete(calibration, options.encoding) if is_picture else calibration
    given = options.detector
    if given is None:
        given = AUTO if is_picture else "peaks"
    name, finder = _choose_detector(given, image, known, options.roi is not None, options)
    smoothing = options.smoothing_px
    if smoothing is None:
        smoothing = SMOOTHING_BY_COLOUR_PX if isinstance(finder, ColourDetector) else DEFAULT_SMOOTHING_PX
    if options.roi is not None:
        # A region of interest is cut as by peaks; its neighbours are those that would be found without it.
        _, finder = _choose_detector(given, image, known, False, options)
    estimators = options.estimators
    if estimators is None:
        estimators = default_estimators(known) if is_picture else DEFAULT_ESTIMATORS
        # A part of a picture holds no cloud that could be told.
        if is_picture and options.roi is None:
            estimators = (*estimators, CLOUD)
    # Values that nobody called encoded are taken as linear: that is the rule for real numbers, and no guess.
    encoding = options.encoding if is_picture else options.encoding or "linear"
    stated = {
        "encoding": calibration.response or options.encoding, "saturation_level": calibration.saturation_level,
        "detector": None if options.detector == AUTO else options.detector, "smoothing_px": options.smoothing_px,
        "estimators": options.estimators,
    }  # fmt: skip
    inferred = tuple(key for key, value in stated.items() if value is None)
    assumed = tuple(assumptions(calibration, encoding))
    return Choices(known, name, smoothing, short_names(estimators), inferred, assumed), finder, estimators


def default_estimators(calibration: Calibration) -> tuple[str, ...]:
    """Return the names of the estimators that the calibration states enough for."""
    return (*DEFAULT_ESTIMATORS, *(("bisector",) if calibration.priors.lights_mm else ()))


def check_encoding(encoding: str | None, calibration: Calibration) -> None:
    """Raise `InputError` for an unknown encoding, and for one beside a calibration that states the response."""
    if encoding is None:
        return
    if not isinstance(encoding, str) or encoding not in ENCODINGS:
        raise InputError(f"encoding = {shown(encoding)}: must be one of {', '.join(ENCODINGS)}, or None")
    if calibration.response is not None:
        raise InputError(f"encoding = {encoding!r}: the calibration states the response; give one of them")


def complete(calibration: Calibration, encoding: str | None) -> Calibration:
    """Add what every picture has: an encoding, by default sRGB, and a largest value, at which it is clipped."""
    level = 1.0 if calibration.saturation_level is None else calibration.saturation_level
    if calibration.response is not None:
        return replace(calibration, saturation_level=level)
    response = Response("linear" if encoding == "linear" else "srgb")
    # The response also sets the steps of light between neighbouring values.
    noise = replace(calibration.noise, response=response)
    return replace(calibration, response=response, noise=noise, saturation_level=level)


def _choose_detector(
    given: str | Detector, picture: Image, calibration: Calibration, has_roi: bool, options: Options
) -> tuple[str, Detector]:
    """Return the name of a picture's detector, and the detector; the package's own find isolated highlights, or all.

    Where a region of interest is named nothing is detected. Raises `InputError` where the detector does not fit.
    """
    isolated, keep = not options.every, options.keep_overlays
    if isinstance(given, str) and given == AUTO:
        linear = calibration.response is not None and calibration.response.kind == "linear"
        by_colour = is_coloured(picture) and not linear and not has_roi
        return ("colour", ColourDetector(isolated, keep)) if by_colour else ("peaks", PeakDetector(isolated))
    name, finder = given if isinstance(given, str) else type(given).__qualname__, load_detector(given)
    if has_roi and not isinstance(finder, PeakDetector):
        raise InputError(f"detector {name}: the region of interest is named; must be peaks")
    if isinstance(finder, ColourDetector) and (picture.ndim != 3 or picture.shape[2] != 3):
        raise InputError(f"detector {name}: the picture is grey; must be peaks")
    # A detector that is given, or another package's, decides by itself what it takes.
    if isinstance(given, str) and isinstance(finder, ColourDetector):
        finder = replace(finder, isolated=isolated, keep_overlays=keep)
    elif isinstance(given, str) and isinstance(finder, PeakDetector):
        finder = replace(finder, isolated=isolated)
    return name, finder
