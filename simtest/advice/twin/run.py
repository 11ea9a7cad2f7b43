"""Twins of one picture: reconstruct it, render a bank of frames like it, and measure the errors at highlights alike."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simtest.advice.twin.bank import BankFrame, Progress, Subject, all_spots, frames_for, make_bank
from simtest.advice.twin.matching import Matcher, Twins
from simtest.advice.twin.scenes import Look, SceneDraws, look_of
from simtest.advice.twin.scoring import ScoredSpot, Spot, SpotKind, usable_spots
from simtest.advice.twin.tissue import Tissue, tissue_of
from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.reconstruction.assumptions import NEAR_MISSES, Assumption
from simtest.reconstruction.images import is_sequence, read_picture
from simtest.reconstruction.options import Options, calibration_for
from simtest.reconstruction.pipeline import run
from simtest.runtime.arrays import Array, Image

LEAST_TWINS = 20
"""A bank with fewer highlights measures nothing."""

FIXED = "not possible: simtest twin takes no value of it"

DRAWN = (
    Assumption("curvature and tilt of the tissue", "a pool of 16 patches; tilts up to 35 deg", FIXED),
    Assumption("light exits", "discs of 0.5 to 1.3 mm radius; lights of one power", FIXED),
    Assumption("camera chain", "one of three presets, its sharpening, noise and coding drawn", FIXED),
)
"""What no frame shows and no file states of a twin; the ranges are those of `patches` and `scenes`."""


def _drawn(organ: str | None, tissue: Tissue) -> list[Assumption]:
    """Return what is drawn anew for each frame of the bank; the relief and the film as the organ has them."""
    name, how = ("any tissue", "--organ") if organ is None else (organ, FIXED)
    film = "roughness {:.2g} to {:.2g}, level {:.2g} to {:.2g}".format(*tissue.alpha, *tissue.level)
    relief = Assumption("relief of the tissue", f"{name}: {tissue}", how)
    return [relief, Assumption("liquid film", f"{name}: {film}", how), *DRAWN]


@dataclass(frozen=True)
class SpotTwins:
    """A highlight of the real frame with what its twins measure.

    Parameters
    ----------
    spot : Spot
        The highlight.
    stated_deg : float or None
        RMS error that its best estimate states, deg.
    twins : Twins
        What the twins measure.
    """

    spot: Spot
    stated_deg: float | None
    twins: Twins


@dataclass(frozen=True)
class TwinResult:
    """The twins of a picture.

    Parameters
    ----------
    image : str
        The picture's name.
    picture : ndarray of float32, shape (H, W) or (H, W, 3)
        As encoded.
    spots : list of SpotTwins
        Its usable highlights.
    bank : list of BankFrame
        The rendered frames.
    bank_spots : list of (int, ScoredSpot)
        The highlights in them, with the number of their frame.
    look : Look
        What the picture shows of tissue and exposure.
    assumed : list of Assumption
        What is not known exactly, and how it was drawn.
    warnings : list of str
        Of the calibration.
    processor_s : float
        Processor time of this process, s.
    """

    image: str
    picture: Image
    spots: list[SpotTwins]
    bank: list[BankFrame]
    bank_spots: list[tuple[int, ScoredSpot]]
    look: Look
    assumed: list[Assumption]
    warnings: list[str]
    processor_s: float

    def share_of(self, kind: SpotKind) -> float:
        """Return the share of one kind among all highlights of the bank."""
        return float(np.mean([spot.kind == kind for _, spot in self.bank_spots]))

    def rms_deg(self, of: str = "rms_deg") -> float:
        """Return the root mean square over the highlights of one of their twins' RMS errors, deg."""
        return float(np.sqrt(np.mean([getattr(each.twins, of) ** 2 for each in self.spots])))

    @property
    def distance_mm(self) -> tuple[float, float, float]:
        """Medians over the highlights of the distances below which 10, 50 and 90 % of their twins stand, mm."""
        near, middle, far = np.nanmedian([each.twins.distance_mm for each in self.spots], axis=0).tolist()
        return near, middle, far

    @property
    def coverage(self) -> float | None:
        """Mean share of the twins' stated 95 % regions that hold the truth."""
        told = [each.twins.coverage for each in self.spots if each.twins.coverage is not None]
        return float(np.mean(told)) if told else None


def twin_picture(
    image: Path,
    options: Options,
    frames: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    organ: str | None = None,
) -> TwinResult:
    """Measure the errors at a picture's highlights on rendered twins of them.

    Parameters
    ----------
    image : Path
        A single picture.
    options : Options
        As of `simtest reconstruct`; the twins are reconstructed alike.
    frames : int, optional
        Frames of the bank; default by the picture's size (`frames_for`).
    seed : int
        Of what is drawn.
    progress : callable, optional
        Called with frames rendered, frames in all, and what is done.
    organ : str, optional
        Whose relief and film the twins have (`simtest.advice.twin.tissue.NAMES`); default: any tissue's.
    """
    started = time.process_time()
    if is_sequence(image):
        raise InputError(f"{image}: is a folder or a film; twin takes one picture")
    # A wrong name is told before minutes of rendering.
    tissue_of(organ)
    picture = read_picture(image)
    calibration, warnings = calibration_for(options, picture)
    found, bank, look, assumed = twins_of(picture, calibration, options, str(image), frames, seed, progress, organ)
    spots = all_spots(bank)
    return TwinResult(
        image.name, picture, found, bank, spots, look, assumed, warnings, time.process_time() - started
    )  # fmt: skip


def twins_of(
    picture: Image,
    calibration: Calibration,
    options: Options,
    name: str = "picture",
    frames: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    organ: str | None = None,
) -> tuple[list[SpotTwins], list[BankFrame], Look, list[Assumption]]:
    """Measure twins of a picture's usable highlights (see `twin_picture`); return them, the bank, look and priors."""
    whole = replace(options, roi=None)
    made = run(picture, calibration, whole)
    spots = usable_spots(made)
    if not spots:
        raise InputError(f"{name}: no usable highlight: none was found that has a normal of its own; try --all")
    view = made.detection.view
    peaks: Array = np.array([spot.peak_px for spot in spots])
    count = frames_for(picture.shape[0] * picture.shape[1]) if frames is None else frames
    tissue = tissue_of(organ)
    look = look_of(picture, view.seen, tissue)
    subject = Subject(SceneDraws(made.choices.calibration, look, tissue), peaks, view.seen, picture.ndim == 2)
    bank = make_bank([subject], lambda values: run(values, calibration, whole), count, seed, progress)
    matched = match_spots(spots, all_spots(bank), name, count)
    # Twins have near misses, so nothing is assumed of them.
    assumed = [each for each in made.choices.assumed if each is not NEAR_MISSES]
    return matched, bank, look, [*assumed, *_drawn(organ, tissue)]


def match_spots(
    spots: Sequence[Spot], twins: Sequence[tuple[int, ScoredSpot]], name: str, frames: int
) -> list[SpotTwins]:
    """Return what the twins of each highlight measure; raise `InputError` where the bank is too small."""
    known = sum(spot.kind != "false" for _, spot in twins)
    if known < LEAST_TWINS:
        raise InputError(
            f"{name}: {known} usable highlights in {frames} rendered frames; needs {LEAST_TWINS} or more: "
            "give more with --frames, or a calibration that is nearer to the scope"
        )
    matcher = Matcher(twins)
    return [SpotTwins(spot, spot.estimate.deviation_deg, matcher.find(spot)) for spot in spots]
