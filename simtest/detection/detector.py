"""Detector protocol, and detectors by name through the entry-point group ``simtest.detectors``."""

import contextlib
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from simtest.calibration import Frame, Priors
from simtest.detection.blobs import Highlight
from simtest.detection.regions import Region
from simtest.detection.view_mask import WHOLE, View
from simtest.errors import Failure, InputError
from simtest.geometry import Camera
from simtest.runtime.arrays import short_repr
from simtest.runtime.resources import EntryPointGroup

DETECTORS = EntryPointGroup("simtest.detectors", "detector")


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
    view: View = WHOLE
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
        found = detector.detect(frame, frame.calibration.camera, frame.calibration.priors)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"detector {name}: {type(error).__name__}: {error}") from error
    if not isinstance(found, Detection):
        raise InputError(f"detector {name}: returned a {type(found).__name__}; must be a Detection")
    if len(found.highlights) not in (0, len(found.regions)):
        raise InputError(f"detector {name}: {len(found.highlights)} highlights for {len(found.regions)} regions")
    try:
        return replace(found, regions=tuple(_sound(region, width, height) for region in found.regions))
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
