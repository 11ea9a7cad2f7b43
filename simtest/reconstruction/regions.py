"""Regions of 68 and 95 % for the normals of any core, by what its calibration on rendered frames found.

`simtest calibrate core` writes the file (`simtest.advice.core_calibration`). It parts the answers into strata by what
can be seen without the truth, and states of each how large the errors of 68 and 95 % of the answers were at most, over
the error that is expected of such an answer in such a frame. Frames unlike those of the calibration, by the statistics
that realism is measured by, get the region of the worst stratum, or none.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, JsonValue

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.detection.detector import Kind
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.protocol import CalibratedRegion, Target
from simtest.reconstruction.images import is_coloured
from simtest.reconstruction.options import Choices, Options
from simtest.reconstruction.statistics import LEAST_SIDE, NAMES, measure, summarise
from simtest.runtime.arrays import Array, Image
from simtest.runtime.files import read_json
from simtest.spec.recipes import CoreRegions
from simtest.spec.spec_model import Spec, validate

if TYPE_CHECKING:
    from simtest.reconstruction.records import Specularity

LEVELS = (0.68, 0.95)
SET_FRAMES, LEAST_SET, MOST_OFF = 32, 16, 3.0
"""Frames that are judged together, and the fewest; no frame counts as farther off along a direction."""

MOST_DEG, FAR_PX = 180.0, 50.0
"""No region is larger; highlights that are farther apart are alone."""

Format = Literal["simtest core calibration, version 3"]
OfFrame = Literal["count", "radius", "radius spread", "axis ratio", "clustering", "area", "halo", "vessels", "spectrum"]
Feature = Literal["sigma_deg", "axis_ratio", "score", "radius_px", "border", "flags", "kind", "others", "nearest_px",
                  "clipped_share", OfFrame]  # fmt: skip
Ends = dict[Feature, tuple[float | None, float | None]]
"""What features are at least, and below."""

Positive = Annotated[float, Field(ge=0)]
Radii = tuple[Positive, Positive]
"""At 68 and at 95 %."""

OF_FRAME: tuple[OfFrame, ...] = get_args(OfFrame)
"""The frame's statistics that tell how large errors are: of its highlights, relief and vessels."""

OF_ANSWER: tuple[Feature, ...] = tuple(name for name in get_args(Feature) if name not in OF_FRAME)

REGRESSORS = 14 + len(OF_FRAME)

Statistics = Annotated[tuple[float, ...], Field(min_length=len(NAMES), max_length=len(NAMES))]
Numbers = Annotated[tuple[float, ...], Field(min_length=REGRESSORS, max_length=REGRESSORS)]
Seen = Mapping[Feature, float] | Mapping[Feature, Array]
"""Features of an answer, or of several."""


def features(spot: "Specularity", estimate: Estimate, size: tuple[int, int]) -> dict[Feature, float]:
    """Return what is known of an answer without the truth, but for its frame's statistics (`of_frame`).

    -1 stands for what is not reported; `border` is the peak's distance to the frame's over its width, `flags` their
    number, `kind` the number of the kind, `others` how many more highlights are known.
    """
    patch, (x, y), (width, height) = spot.patch, spot.position_px, size
    area, others, clipped = 0.0, np.empty((0, 2)), 0.0
    if not isinstance(patch, Failure):
        area = float(np.count_nonzero(patch.inside(HIGHLIGHT_ISOVALUE, cut=True)))
        others, clipped = patch.neighbours_px - patch.peak_px, patch.clipped_share
    return {
        "sigma_deg": -1.0 if estimate.deviation_deg is None else estimate.deviation_deg,
        "axis_ratio": -1.0 if estimate.axis_ratio is None else estimate.axis_ratio,
        "score": -1.0 if spot.score is None else spot.score,
        "radius_px": math.sqrt(area / math.pi),
        "border": max(float(min(x, y, width - x, height - y)), 0.0) / width,
        "flags": float(len(estimate.flags)),
        "kind": -1.0 if spot.kind is None else float([*Kind].index(Kind(spot.kind))),
        "others": float(len(others)),
        "nearest_px": float(min(np.linalg.norm(others, axis=1), default=FAR_PX)),
        "clipped_share": clipped,
    }


def of_frame(statistics: Array | None) -> dict[Feature, float]:
    """Return what a frame's realism statistics tell of its answers; NaN where it does not tell one."""
    return {name: math.nan if statistics is None else float(statistics[NAMES.index(name)]) for name in OF_FRAME}


def regressors(seen: Seen) -> Array:
    """Return what the expected error depends on, shape (..., R)."""
    sigma, ratio, score, radius = (np.asarray(seen[each]) for each in ("sigma_deg", "axis_ratio", "score", "radius_px"))
    reported = np.where(sigma > 0, np.log(np.maximum(sigma, 0.01)), 0.0)
    bent = np.stack([reported, score, np.log(np.maximum(radius, 0.5)), ratio], axis=-1)
    rest = [ratio < 0, np.asarray(seen["flags"]), np.minimum(seen["border"], 0.2), np.log1p(seen["others"]),
            np.log(np.clip(seen["nearest_px"], 1.0, FAR_PX)), np.asarray(seen["clipped_share"])]  # fmt: skip
    rest += [np.asarray(seen[name]) for name in OF_FRAME]
    return np.concatenate([bent, bent**2, np.stack(rest, axis=-1)], axis=-1)


# The file -------------------------------------------------------------------------------------------------------------


class Expected(Spec):
    """The error that is expected of an answer by its features: the exponential of a linear form of `regressors`.

    What a frame does not tell counts as the mean.
    """

    centre: Numbers
    spread: Numbers
    weights: Numbers = Field(description="of the regressors less the centre, over the spread, within 3 of them")
    start: float

    def of(self, seen: Seen) -> Array:
        """Return it for answers with these features, deg."""
        return np.asarray(np.exp(self.start + self.scaled(regressors(seen)) @ np.array(self.weights)))

    def scaled(self, rows: Array) -> Array:
        """Return regressors as the weights take them."""
        return np.nan_to_num(np.clip((rows - np.array(self.centre)) / np.array(self.spread), -3, 3), nan=0.0)


class Stratum(Spec):
    """Answers that are alike by what can be seen, and how large the errors of 68 and 95 % of them are at most."""

    ends: Ends
    highlights: int = Field(ge=1, description="it stands on")
    frames: int = Field(ge=1, description="that these are of")
    ratio: Radii = Field(description="errors over those that are expected")
    error_deg: Radii

    def holds(self, seen: Mapping[Feature, float]) -> bool:
        """Return whether an answer with these features belongs to it."""
        return all(
            (low is None or seen[name] >= low) and (high is None or seen[name] < high)
            for name, (low, high) in self.ends.items()
        )


class Strata(Spec):
    """What was found of the normals of one surface."""

    expected: Expected
    reported_deg: tuple[float, float] = Field(description="least and largest reported deviation; -1: none reported")
    parts: tuple[Stratum, ...] = Field(min_length=1)

    def region(self, seen: Mapping[Feature, float], outside: bool) -> Radii:
        """Return the region of an answer, deg.

        Outside of the calibration it is that of the worst part, and one of twice what the answer itself reports.
        """
        scale, sigma, (least, most) = float(self.expected.of(seen)), seen["sigma_deg"], self.reported_deg
        # Where no answer reported a deviation none is expected to.
        outside |= most > 0 and not least <= sigma <= most
        own = [] if outside else [each for each in self.parts if each.holds(seen)]
        held = [(scale * each.ratio[0], scale * each.ratio[1]) for each in own or self.parts]
        if not own:
            held += [*(each.error_deg for each in self.parts), (max(sigma, 0.0), max(2 * sigma, 0.0))]
        return min(max(each for each, _ in held), MOST_DEG), min(max(each for _, each in held), MOST_DEG)


class Shift(Spec):
    """Where the frames' statistics lie, what takes them to unit covariance, and how far off 95 % are at most."""

    centre: Statistics
    whitening: Annotated[tuple[Statistics, ...], Field(min_length=len(NAMES), max_length=len(NAMES))]
    limit: Positive
    set_limit: Positive = Field(description="the same of `SET_FRAMES` frames together")

    def off(self, statistics: Array) -> Array:
        """Return how far off frames are, shape (..., S), in standard deviations; what one does not tell is 0."""
        return np.nan_to_num(statistics - np.array(self.centre), nan=0.0) @ np.array(self.whitening).T

    def distance(self, statistics: Array) -> float:
        """Return how far off a frame is, in standard deviations."""
        return float(np.linalg.norm(self.off(statistics)))

    def set_distance(self, statistics: Array) -> float:
        """Return how far off the mean of frames is, shape (F, S), in standard deviations of it."""
        mean = np.clip(self.off(statistics), -MOST_OFF, MOST_OFF).mean(axis=0)
        return float(math.sqrt(len(statistics)) * np.linalg.norm(mean))


class CoreCalibration(Spec):
    """What was found of a core on frames of a scope."""

    format: Format = "simtest core calibration, version 3"
    core: str = Field(min_length=1, description="its name in results")
    scope: str
    size: tuple[int, int] = Field(description="of the frames, px")
    detector: Literal["colour", "peaks"]
    every: bool = Field(description="whether highlights were taken that are not isolated")
    highlights: int = Field(ge=1, description="answers in all")
    frames: int = Field(ge=1, description="that these are of")
    strata: dict[Target, Strata] = Field(min_length=1, description="by the surface whose normal is stated")
    shift: Shift | None = Field(description="None where the frames are grey")
    made: dict[str, JsonValue] = Field(description="of what, and with which versions")

    def outside(self, size: tuple[int, int], statistics: Array | None, choices: Choices, options: Options) -> str:
        """Return in what a frame, or the search in it, is unlike those of the calibration; empty where it is like."""
        if size != self.size:
            return f"of {size[0]} x {size[1]} px, not {self.size[0]} x {self.size[1]}"
        if options.roi is not None or options.keep_overlays or options.smoothing_px is not None:
            return "searched in a region, with overlays kept or with another smoothing, as those were not"
        if (choices.detector, options.every) != (self.detector, self.every):
            kind = "all" if options.every else "isolated"
            return f"searched for {kind} highlights by {choices.detector}, which those were not"
        if self.shift is None:
            return ""
        distance = math.inf if statistics is None else self.shift.distance(statistics)
        return f"{distance:.3g} standard deviations off" if distance > self.shift.limit else ""


@lru_cache(maxsize=8)
def _read(path: Path, _: float) -> CoreCalibration:
    return validate(CoreCalibration, read_json(path, "a calibration of simtest calibrate core"), str(path))


def read_calibrations(files: Sequence[str]) -> dict[str, CoreCalibration]:
    """Read the calibrations of cores, by the cores' names in results."""
    paths = [Path(file) for file in files]
    made = {own.core: own for own in (_read(each, each.stat().st_mtime if each.is_file() else 0.0) for each in paths)}
    if len(made) < len(paths):
        raise InputError(f"{', '.join(files)}: several files of one core; one must be given")
    return made


def check_frames(own: CoreCalibration, pictures: Sequence[tuple[str, Callable[[], Image]]]) -> dict[str, Any]:
    """Return whether frames are like those of a calibration, one by one and all together; raise `InputError` if few.

    Each is its name and what reads it. Of many, `SET_FRAMES` that are evenly spaced are judged together.
    """
    if own.shift is None:
        raise InputError(f"the calibration of {own.core} is of grey frames, of which none is unlike another")
    told = {name: statistics for name, read in pictures if (statistics := statistics_of(read())) is not None}
    if len(told) < LEAST_SET:
        raise InputError(f"{len(told)} frames in colour of {LEAST_SIDE} px and more; at least {LEAST_SET} are needed")
    values = np.array([*told.values()])
    off = own.shift.set_distance(
        values[np.linspace(0, len(values) - 1, min(len(values), SET_FRAMES)).round().astype(int)]
    )
    alone = [name for name, each in told.items() if own.shift.distance(each) > own.shift.limit]
    return {
        "frames": len(told), "unlike": off > own.shift.set_limit, "distance": off, "limit": own.shift.set_limit,
        "unlike_alone": alone,
    }  # fmt: skip


# What a frame's answers get -------------------------------------------------------------------------------------------


def calibrations_of(given: CoreRegions, estimators: Sequence[str]) -> dict[str, CoreCalibration]:
    """Read the calibrations; raise `InputError` where none is of one of the estimators, by their names in results."""
    files = read_calibrations(given.files)
    if not files.keys() & {*estimators}:
        run = ", ".join(estimators)
        raise InputError(f"{', '.join(given.files)}: of {', '.join(files)}; must be of an estimator that runs: {run}")
    return files


def with_regions(
    spots: "Sequence[Specularity]", image: Image, choices: Choices, options: Options
) -> "list[Specularity]":
    """Return the specularities of a frame with the regions of the calibrated cores' answers, or with their refusals."""
    given = options.regions
    assert given is not None
    files = calibrations_of(given, choices.estimators)
    size, most = (image.shape[1], image.shape[0]), given.refuse_above_deg or MOST_DEG
    statistics = statistics_of(image)
    shared = of_frame(statistics)
    outside = {name: own.outside(size, statistics, choices, options) for name, own in files.items()}

    def judged(spot: "Specularity", name: str, estimate: Estimate | Failure) -> Estimate | Failure:
        if isinstance(estimate, Failure) or name not in files or estimate.target not in files[name].strata:
            return estimate
        own, unlike = files[name], outside[name]
        if unlike and given.shifted == "refuse":
            return Failure(Reason.REFUSED, f"the frame is unlike those of the calibration: it is {unlike}")
        first, last = own.strata[estimate.target].region(features(spot, estimate, size) | shared, bool(unlike))
        if last > most:
            return Failure(Reason.REFUSED, f"its calibrated 95 % radius is {last:.3g} deg, above {most:g}")
        source = f"calibrated on {own.highlights} highlights of {own.scope}"
        worst = f"; the worst of them, as the frame is {unlike}" if unlike else ""
        return replace(estimate, calibrated=CalibratedRegion(first, last, source + worst))

    made = []
    for spot in spots:
        results = {name: judged(spot, name, each) for name, each in spot.estimates.items()}
        organ = {name: judged(spot, name, each) for name, each in spot.organ.items()}
        # An organ's normal is no failure: a refused one stays without a region.
        kept = {name: each for name, each in organ.items() if isinstance(each, Estimate)}
        made.append(replace(spot, estimates=results, organ={**spot.organ, **kept}))
    return made


def statistics_of(image: Image) -> Array | None:
    """Return a frame's realism statistics, NaN where it does not tell one; None of a grey or a very small frame."""
    if min(image.shape[:2]) < LEAST_SIDE or not is_coloured(image):
        return None
    return summarise(measure(np.asarray(image, np.float32)))
