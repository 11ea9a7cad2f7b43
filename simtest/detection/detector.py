"""What a detector is and returns, and detectors by name through the entry-point group ``simtest.detectors``."""

import contextlib
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np

from simtest.calibration import Frame, Priors
from simtest.detection.view import View
from simtest.errors import Failure, InputError
from simtest.geometry import Camera
from simtest.runtime.arrays import Array, Index, short_repr
from simtest.runtime.resources import EntryPointGroup

DETECTORS = EntryPointGroup("simtest.detectors", "detector")


@dataclass(frozen=True)
class Region:
    """The region of interest of a specularity.

    Parameters
    ----------
    box : tuple of int
        Column, row, width, height, px.
    peak : tuple of int
        Column and row of the brightest smoothed pixel.
    contrast : float or None
        Peak above its surroundings, frame units; None for a region that was given, not detected.
    """

    box: tuple[int, int, int, int]
    peak: tuple[int, int]
    contrast: float | None


class Kind(StrEnum):
    """Kinds of highlights; isolated, clipped and small ones may carry one normal."""

    ISOLATED = "isolated"
    CLIPPED = "clipped"
    SMALL = "small"
    CLUSTER = "cluster"
    ELONGATED = "elongated"
    MERGED = "merged"
    BORDER = "border"
    INTER_REFLECTION = "inter_reflection"
    UNCLEAR = "unclear"


SINGLE = frozenset({Kind.ISOLATED, Kind.CLIPPED, Kind.SMALL})
"""Kinds that may carry one normal."""


@dataclass(frozen=True)
class Highlight:
    """A highlight of a colour frame, or several that touch.

    Parameters
    ----------
    region : Region
        Region of interest; its contrast is the specular light at the peak, share of full scale.
    kind : Kind
        Its kind.
    area_px : int
        Pixels above half of its peak, a cluster's above half of its peaks and the saddles between them.
    axis_ratio, residual, wander : float or None
        Of its ellipse at half height; RMS distance from it, and largest distance between the nested ellipses' centres,
        as shares of its radius; None where no ellipse fits.
    tint : float
        Gain of the weakest channel over the tissue around, over that of the strongest: 1 for grey light.
    clutter : float
        Specular light of the surroundings, over the peak's.
    outline : ndarray, shape (N, 2)
        Its isophote at half height, px, closed; the border of its pixels where that is open or holds other highlights.
    peaks : ndarray of int, shape (P, 2)
        Column and row of each highlight in it, the brightest first; one but for clusters.
    clipped : float
        Share of its pixels that are clipped.
    dim : bool
        Whether it is resolved and darker than clipped highlights of the frame: the normal may only come near the
        bisector there (theory.md 7.1b).
    """

    region: Region
    kind: Kind
    area_px: int
    axis_ratio: float | None
    residual: float | None
    wander: float | None
    tint: float
    clutter: float
    outline: Array
    peaks: Index = field(default_factory=lambda: np.empty((0, 2), dtype=np.intp))
    clipped: float = 0.0
    dim: bool = False

    __repr__ = short_repr

    @property
    def is_isolated(self) -> bool:
        """Whether it may carry one normal."""
        return self.kind in SINGLE


@dataclass(frozen=True)
class Detection:
    """The specularities of a frame.

    Parameters
    ----------
    regions : tuple of Region
        The brightest first.
    frame : Frame
        The frame that their patches are cut from: the given one, or one of its specular light.
    highlights, others : tuple of Highlight
        How each region was judged, and what was left out; empty where the detector judges none.
    view : View
        The part of the picture that shows tissue, where the detector looks for it.
    refusal : Failure, optional
        Why the detector does not answer for this frame; there are no regions then. None: it does.
    """

    regions: tuple[Region, ...]
    frame: Frame
    highlights: tuple[Highlight, ...] = ()
    others: tuple[Highlight, ...] = ()
    view: View = field(default_factory=View)
    refusal: Failure | None = None

    __repr__ = short_repr


@runtime_checkable
class Detector(Protocol):
    """Finds the specularities of a frame; other packages register theirs in the group ``simtest.detectors``."""

    def detect(self, frame: Frame, camera: Camera, priors: Priors, /) -> Detection:
        """Find the specularities of a frame, from the frame alone.

        Parameters
        ----------
        frame : Frame
            Values as encoded, linear light, smoothed light, noise, view and clipped pixels.
        camera : Camera
            The frame's camera.
        priors : Priors
            What is known of lights, distance and lobe.
        """


def load_detector(detector: str | object) -> Detector:
    """Return a detector by its name, "package:name" where two packages register one name, or the given one.

    Raises
    ------
    InputError
        If the name is unknown or ambiguous, its package cannot be imported, or the object is no detector.
    """
    name = detector if isinstance(detector, str) else type(detector).__qualname__
    given = DETECTORS.load(detector) if isinstance(detector, str) else detector
    if isinstance(given, type) or not isinstance(given, Detector):
        raise InputError(f"detector {name!r}: {given!r} is no object with a method detect(frame, camera, priors)")
    return given


def run_detector(detector: Detector, frame: Frame) -> Detection:
    """Run a detector; raise `InputError` with its name where it fails or returns what is no detection of the frame."""
    name, (height, width) = type(detector).__qualname__, frame.encoded.shape[:2]
    try:
        detection = detector.detect(frame, frame.calibration.camera, frame.calibration.priors)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"detector {name}: {type(error).__name__}: {error}") from error
    if not isinstance(detection, Detection):
        raise InputError(f"detector {name}: returned a {type(detection).__name__}; must be a Detection")
    if len(detection.highlights) not in (0, len(detection.regions)):
        raise InputError(
            f"detector {name}: {len(detection.highlights)} highlights for {len(detection.regions)} regions"
        )
    try:
        return replace(detection, regions=tuple(_sound(region, width, height) for region in detection.regions))
    except InputError as error:
        raise InputError(f"detector {name}: {error}") from None


def _sound(region: Region, width: int, height: int) -> Region:
    """Return a region in plain integers; raise `InputError` where it leaves the frame, or its peak the box."""
    x, y, w, h = _integers("box", region.box, "x, y, w, h")
    column, row = _integers("peak", region.peak, "column, row")
    box, peak = (x, y, w, h), (column, row)
    if min(x, y) < 0 or min(w, h) < 1 or x + w > width or y + h > height:
        raise InputError(f"box {box} leaves the frame of {width} x {height} px")
    if not (x <= column < x + w and y <= row < y + h):
        raise InputError(f"peak {peak}: must lie in its box {box}")
    return replace(region, box=box, peak=peak)


def _integers(what: str, given: object, names: str) -> tuple[int, ...]:
    """Return integers of any kind as a tuple of Python's."""
    count = len(names.split())
    if isinstance(given, Sequence | np.ndarray) and len(given) == count:
        with contextlib.suppress(TypeError):
            return tuple(operator.index(each) for each in given)
    raise InputError(f"{what} {given}: must be {count} integers {names}")
