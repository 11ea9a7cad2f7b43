"""Twins of one picture: reconstruct it, render a bank like it, measure the errors at highlights alike, write them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from simtest.advice.tissue import Tissue, tissue_of
from simtest.advice.twin.bank import BankFrame, Progress, Subject, all_spots, frames_for, make_bank
from simtest.advice.twin.scenes import Look, SceneDraws, look_of
from simtest.advice.twin.scoring import Matcher, ScoredSpot, Spot, SpotKind, Twins, usable_spots
from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.pages.html import environment
from simtest.pages.pixels import jpeg_address
from simtest.reconstruction.assumptions import NEAR_MISSES, Assumption
from simtest.reconstruction.images import is_sequence, read_picture
from simtest.reconstruction.options import Options, calibration_for
from simtest.reconstruction.outputs import write_csv
from simtest.reconstruction.pipeline import run
from simtest.runtime import provenance
from simtest.runtime.arrays import Image, Picture
from simtest.runtime.files import JsonObject, make_folder, write_atomically, write_json, written_together
from simtest.runtime.statistics import root_mean_square

LEAST_TWINS = 20
"""A bank with fewer highlights measures nothing."""

FIXED = "not possible: simtest twin takes no value of it"

DRAWN = (
    Assumption("curvature and tilt of the tissue", "a pool of 16 patches; tilts up to 35 deg", FIXED),
    Assumption("light exits", "discs of 0.5 to 1.3 mm radius; lights of one power", FIXED),
    Assumption("camera chain", "one of three presets, its sharpening, noise and coding drawn", FIXED),
)
"""What no frame shows and no file states of a twin; the ranges are those of `scenes`."""


def _drawn(organ: str | None, tissue: Tissue) -> list[Assumption]:
    """Return what is drawn anew for each frame of the bank; the relief and the film as the organ has them."""
    name, how = ("any tissue", "--organ") if organ is None else (organ, FIXED)
    film = "roughness {:.2g} to {:.2g}, level {:.2g} to {:.2g}".format(*tissue.alpha, *tissue.level)
    relief = Assumption("relief of the tissue", f"{name}: {tissue}", how)
    return [relief, Assumption("liquid film", f"{name}: {film}", how), *DRAWN]


@dataclass(frozen=True)
class SpotTwins:
    """A highlight of the real frame with what its twins measure."""

    spot: Spot
    stated_deg: float | None  # RMS error that its best estimate states
    twins: Twins


@dataclass(frozen=True)
class TwinResult:
    """The twins of a picture."""

    image: str  # the picture's name
    picture: Image  # as encoded, shape (H, W) or (H, W, 3)
    spots: list[SpotTwins]  # its usable highlights
    bank: list[BankFrame]
    look: Look
    assumed: list[Assumption]  # what is not known exactly, and how it was drawn
    warnings: list[str]  # of the calibration
    processor_s: float

    @property
    def bank_spots(self) -> list[tuple[int, ScoredSpot]]:
        """The highlights of the bank, with the number of their frame."""
        return all_spots(self.bank)

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
        return self._mean("coverage")

    @property
    def wrong_and_sure(self) -> float | None:
        """Mean share of the twins that are wrong and sure."""
        return self._mean("wrong_and_sure")

    def _mean(self, share: str) -> float | None:
        told = [value for each in self.spots if (value := getattr(each.twins, share)) is not None]
        return float(np.mean(told)) if told else None


def twin_picture(
    image: Path,
    options: Options,
    frames: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    organ: str | None = None,
) -> TwinResult:
    """Measure the errors at the highlights of a single picture on rendered twins of them, reconstructed alike.

    `frames` are those of the bank, by default as the picture's size has it (`frames_for`); `progress` is called with
    those rendered, all, and what is done. `organ` is one of `simtest.advice.tissue.NAMES`, whose relief and film the
    twins have; default: any tissue's.
    """
    if is_sequence(image):
        raise InputError(f"{image}: is a folder or a film; twin takes one picture")
    # A wrong name is told before minutes of rendering.
    tissue_of(organ)
    picture = read_picture(image)
    calibration, warnings = calibration_for(options, picture)
    result = twins_of(picture, calibration, options, str(image), frames, seed, progress, organ)
    return replace(result, image=image.name, warnings=warnings)


def twins_of(
    picture: Image,
    calibration: Calibration,
    options: Options,
    name: str = "picture",
    frames: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    organ: str | None = None,
) -> TwinResult:
    """Measure twins of the usable highlights of a picture that was read (see `twin_picture`)."""
    started = time.process_time()
    whole = replace(options, roi=None)
    reconstructed = run(picture, calibration, whole)
    spots = usable_spots(reconstructed)
    if not spots:
        raise InputError(f"{name}: no usable highlight: none was found that has a normal of its own; try --all")
    visible = reconstructed.detection.view.seen
    count = frames_for(picture.shape[0] * picture.shape[1]) if frames is None else frames
    tissue = tissue_of(organ)
    look = look_of(picture, visible, tissue)
    draws, peaks = (
        SceneDraws(reconstructed.choices.calibration, look, tissue),
        np.array([spot.peak_px for spot in spots]),
    )
    subject = Subject(draws, peaks, visible, picture.ndim == 2)
    bank = make_bank([subject], lambda values: run(values, calibration, whole), count, seed, progress)
    matched = match_spots(spots, all_spots(bank), name, count)
    # Twins have near misses, so nothing is assumed of them.
    assumed = [each for each in reconstructed.choices.assumed if each != NEAR_MISSES] + _drawn(organ, tissue)
    return TwinResult(name, picture, matched, bank, look, assumed, [], time.process_time() - started)


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


FILES = ("twin.json", "twin.csv", "index.html")

COLUMNS = (
    "specularity", "x_px", "y_px", "radius_px", "estimator", "stated_deg", "twin_rms_deg", "twin_low_deg",
    "twin_high_deg", "twin_p95_deg", "coverage", "wrong_and_sure", "near_misses", "false", "glint_rms_deg",
    "near_rms_deg", "base_rms_deg", "base_low_deg", "base_high_deg", "near_mm", "median_mm", "far_mm", "twins",
    "unlikeness", "covered",
)  # fmt: skip


def write_twins(result: TwinResult, out: Path, command: str = "") -> list[Path]:
    """Write the twins of a picture into a folder, which is made if need be; return the files.

    Raises `InputError` where the folder cannot be written, `SimtestError` where its disk is full.
    """
    make_folder(out)
    html = render_page(result, command)
    with written_together(out, FILES) as new:
        write_json(new / FILES[0], to_json(result, command))
        write_atomically(new / FILES[1], lambda part: write_csv(part, COLUMNS, [_row(each) for each in result.spots]))
        write_atomically(new / FILES[2], lambda part: part.write_text(html, encoding="utf-8"))
    return [out / name for name in FILES]


def to_json(result: TwinResult, command: str = "") -> JsonObject:
    """Return the content of twin.json."""
    return {
        "image": result.image,
        "command": command,
        "warnings": result.warnings,
        "assumed": result.assumed,
        "look": {"organ": result.look.organ, "mean_level": result.look.mean},
        "bank": {
            "frames": len(result.bank),
            "highlights": len(result.bank_spots),
            "near_misses": result.share_of("near_miss"),
            "false": result.share_of("false"),
            "processor_s": round(result.processor_s, 1),
        },
        "twin_rms_deg": result.rms_deg(),
        "twin_base_rms_deg": result.rms_deg("base_rms_deg"),
        "coverage": result.coverage,
        "wrong_and_sure": result.wrong_and_sure,
        "twin_distance_mm": [_finite(each) for each in result.distance_mm],
        "specularities": [_spot_json(each) for each in result.spots],
        "provenance": provenance.environment(),
    }


def _spot_json(each: SpotTwins) -> JsonObject:
    """Return a highlight; a figure that its twins do not have is null."""
    spot, twins = each.spot, each.twins
    figures = {key: _finite(value) for key, value in vars(twins).items() if key != "best"}
    return {
        "id": spot.index,
        "peak_px": spot.peak_px,
        "radius_px": spot.radius_px,
        "estimator": spot.estimator,
        "normal": spot.estimate.normal,
        "target": spot.estimate.target,
        "stated_deg": each.stated_deg,
        "twins": {**figures, "distance_mm": [_finite(value) for value in twins.distance_mm],
                  "covered": twins.is_covered},
    }  # fmt: skip


def _finite(value: Any) -> Any:
    # NaN is the only number that differs from itself.
    return value if value == value else None


def _row(each: SpotTwins) -> tuple[object, ...]:
    spot, twins = each.spot, each.twins
    x, y = spot.peak_px.tolist()
    return (
        spot.index, round(x, 3), round(y, 3), spot.radius_px, spot.estimator, each.stated_deg, twins.rms_deg,
        *twins.interval_deg, twins.p95_deg, twins.coverage, twins.wrong_and_sure, twins.near_misses, twins.false,
        _finite(twins.glint_rms_deg), _finite(twins.near_rms_deg), twins.base_rms_deg, *twins.base_interval_deg,
        *(_finite(each) for each in twins.distance_mm), twins.effective, twins.unlikeness, int(twins.is_covered),
    )  # fmt: skip


SHOWN_SPOTS, SHOWN_TWINS = 6, 6
"""Highlights whose twins are shown, evenly over their sizes, and the likest twins of each."""

PATCH_PX, LEAST_HALF_PX, RADII = 112, 9, 3.5
"""Side of a shown patch; half the side that it shows of the frame, at least and in radii of the real highlight, px."""


def render_page(result: TwinResult, command: str = "") -> str:
    """Return the page: one HTML file that needs nothing else."""
    about = provenance.environment()
    stated = np.array([each.stated_deg for each in result.spots if each.stated_deg is not None])
    # Some highlights, the smallest first.
    ordered = sorted(result.spots, key=lambda each: each.spot.radius_px)
    picked = np.unique(np.linspace(0, len(ordered) - 1, SHOWN_SPOTS).round().astype(int)).tolist()
    picture = np.asarray(np.rint(255 * np.clip(result.picture, 0, 1)), dtype=np.uint8)
    return environment().get_template("twin.html.j2").render(
        result=result, command=command, stated=root_mean_square(stated), rms=result.rms_deg(),
        base=result.rms_deg("base_rms_deg"), uncovered=sum(not each.twins.is_covered for each in result.spots),
        strips=[_strip(result, picture, ordered[i]) for i in picked],
        provenance={"commit": about["commit"] or "–", "simtest": about["version"], "python": about["python"]},
    )  # fmt: skip


def _strip(result: TwinResult, picture: Picture, each: SpotTwins) -> dict[str, Any]:
    """Return a real highlight, its patch as an address, and its likest twins with theirs."""
    half = max(LEAST_HALF_PX, round(RADII * each.spot.radius_px))

    def patch(frame: Picture, spot: Spot) -> str:
        # Beyond the border the frame is repeated.
        padded = cv2.copyMakeBorder(frame, half, half, half, half, cv2.BORDER_REPLICATE)
        x, y = (int(v) for v in spot.peak_px)
        cut = padded[y : y + 2 * half + 1, x : x + 2 * half + 1]
        enlarged = cv2.resize(cut, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_NEAREST)
        return jpeg_address(np.asarray(enlarged, dtype=np.uint8), 90)

    likest = [result.bank_spots[number] for number in each.twins.best[:SHOWN_TWINS].tolist()]
    twins = [(patch(result.bank[frame].picture, scored.spot), scored) for frame, scored in likest]
    return {"each": each, "address": patch(picture, each.spot), "twins": twins}
