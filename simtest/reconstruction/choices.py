"""How a picture is taken where nobody says it: encoding, detector, smoothing; one rule for files and for arrays.

Values of 8 or 16 bits are those of a picture: encoded, and clipped at the largest one. Real values are linear light of
any scale, unless an encoding is given: then they are those of a picture, in [0, 1].
"""

from dataclasses import dataclass, replace

from simtest.calibration import Calibration, Priors, Response
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection.colour import ColourDetector
from simtest.detection.detector import Detector, load_detector
from simtest.detection.peaks import PeakDetector
from simtest.errors import InputError
from simtest.reconstruction.assumptions import Assumption
from simtest.reconstruction.picture_values import is_coloured
from simtest.runtime.arrays import Image, short_repr

AUTO = "auto"
ENCODINGS = ("srgb", "linear")

SMOOTHING_BY_COLOUR_PX = 1.0
"""Highlights of real pictures are small, and 2 px would round them."""


@dataclass(frozen=True)
class Choices:
    """How a picture was taken.

    Parameters
    ----------
    encoding : str
        Kind of the response that was undone: linear, srgb, gamma or table.
    saturation_level : float, optional
        Encoded value at and above which a pixel counts as clipped; None: none does.
    detector : str
        Name of the detector; where a region of interest was named it finds the peak in it.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px.
    estimators : tuple of str
        Their names.
    priors : Priors
        What the estimators are given of lights, distance, lobe, camera and relief.
    inferred : tuple of str
        Those of `encoding`, `saturation_level`, `detector`, `smoothing_px` and `estimators` that nobody gave.
    assumed : tuple of Assumption
        What else nobody gave, with the distribution that stands for it in the budgets, and how to narrow it.
    """

    encoding: str
    saturation_level: float | None
    detector: str
    smoothing_px: float
    estimators: tuple[str, ...]
    priors: Priors
    inferred: tuple[str, ...] = ()
    assumed: tuple[Assumption, ...] = ()

    __repr__ = short_repr

    def __str__(self) -> str:
        """Return the choices on one line; those that nobody gave are marked."""
        level = "none" if self.saturation_level is None else f"at {self.saturation_level:g}"
        said = {
            "encoding": f"encoding {self.encoding}", "saturation_level": f"clipped {level}",
            "detector": f"detector {self.detector}", "smoothing_px": f"smoothing {self.smoothing_px:g} px",
            "estimators": f"estimators {' '.join(self.estimators)}",
        }  # fmt: skip
        return ", ".join(text + " (inferred)" * (name in self.inferred) for name, text in said.items())


def check_encoding(encoding: str | None, calibration: Calibration) -> None:
    """Raise `InputError` for an unknown encoding, and for one beside a calibration that states the response."""
    if encoding is None:
        return
    if encoding not in ENCODINGS:
        raise InputError(f"encoding = {encoding!r:.80}: must be one of {', '.join(ENCODINGS)}, or None")
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


def choose_detector(
    told: str | Detector, picture: Image, calibration: Calibration, has_roi: bool, isolated: bool
) -> tuple[str, Detector]:
    """Return the name of a picture's detector, and the detector; the package's own find isolated highlights, or all.

    "auto" is `colour` in pictures that have colours and are not linear, else `peaks`. Where a region of interest is
    named nothing is detected. Raises `InputError` where the name is unknown or ambiguous, or the detector does not fit.
    """
    if told == AUTO:
        linear = calibration.response is not None and calibration.response.kind == "linear"
        by_colour = is_coloured(picture) and not linear and not has_roi
        return ("colour", ColourDetector(isolated)) if by_colour else ("peaks", PeakDetector(isolated))
    name, found = told if isinstance(told, str) else type(told).__qualname__, load_detector(told)
    if has_roi and not isinstance(found, PeakDetector):
        raise InputError(f"detector {name}: the region of interest is named; must be peaks")
    if isinstance(found, ColourDetector) and (picture.ndim != 3 or picture.shape[2] != 3):
        raise InputError(f"detector {name}: the picture is grey; must be peaks")
    # A detector that is given, or another package's, decides by itself what it takes.
    if isinstance(told, str) and isinstance(found, ColourDetector | PeakDetector):
        found = replace(found, isolated=isolated)
    return name, found


def choose_smoothing(told: float | None, finder: Detector) -> float:
    """Return the smoothing, px: the given one, or else 1 px by colour and 2 px by other detectors."""
    if told is not None:
        return told
    return SMOOTHING_BY_COLOUR_PX if isinstance(finder, ColourDetector) else DEFAULT_SMOOTHING_PX


def untold(calibration: Calibration, **told: object) -> tuple[str, ...]:
    """Return which of the choices neither a calibration nor an argument tells; None and "auto" tell nothing."""
    stated = {**told, "saturation_level": calibration.saturation_level}
    stated["encoding"] = calibration.response or stated.get("encoding")
    names = ("encoding", "saturation_level", "detector", "smoothing_px", "estimators")
    return tuple(name for name in names if stated.get(name) is None or stated[name] == AUTO)
