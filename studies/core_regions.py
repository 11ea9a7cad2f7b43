"""Regions of cores by their calibration (`simtest calibrate core`): coverage on fresh and on shifted frames, sharpness.

    python -m studies.core_regions FOLDER [--scope colocated] [--batches 32] [--shifted 6] [--like peaks] [--workers 2]

All cores (`CORES`; the network needs the extra `onnx`, and lights beside the camera as in colonoscope_2) answer to the
same frames of the scope: `--batches` of 8 frames to calibrate on, as many of another seed to judge on, and `--shifted`
batches each of another organ, of a steeper relief, of lights 1 mm from where they are told, and of coarser coding. The
answers stay in FOLDER, and a stopped study goes on. Printed are

1. the coverage of the regions of 68 and 95 %, with the frame as the unit; the strata whose coverage is below 90 %
   beyond chance (Holm, 1 %); the mean interval score over that of one radius for all answers, and over that of errors
   over the reported deviation;
2. the share of shifted frames, and of sets of them, that the check on shift finds, and the coverage there without and
   with it;
3. for estimators that report a covariance, on frames of the calibration, fresh ones and those of another organ, the
   factor between the deviation that the errors show and the reported one: the 95 % quantile of the error over the
   reported deviation, over what that is for a round covariance, 1.73.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.advice import core_calibration
from simtest.advice.core_calibration import batch_experiment, kept_frame, quantile, shift_of, strata_of
from simtest.advice.plan import DISTANCES, Question
from simtest.advice.scope import read_scope
from simtest.dataset.scoring.frames import CaseFrames, RenderedFrame
from simtest.estimators import load_estimators
from simtest.estimators.protocol import Target
from simtest.reconstruction.regions import (
    LEAST_SET,
    LEVELS,
    OF_ANSWER,
    OF_FRAME,
    SET_FRAMES,
    Feature,
    Shift,
    Strata,
    Stratum,
)
from simtest.runtime.arrays import Array
from simtest.runtime.files import write_json
from simtest.runtime.processes import OnStep, make_engine
from simtest.runtime.statistics import share_interval
from simtest.spec import Experiment
from simtest.validation.cases import expand

OWN = ("circle_pose", "brightest_point", "cone_axis", "curved", "bisector", "photometric")
CORES = (*OWN, "learned_spot", "command: python examples/cores/python/core.py")
SEEDS = {"calibration": 1, "fresh": 2}
SHIFTED = ("other organ", "steeper relief", "light moved", "coarser coding")
MOVED_MM, QUALITY = 1.0, 40
SETS = (LEAST_SET, SET_FRAMES)
STEEPER, GROOVES = 1.5, "surface.relief.bands.1.slope_deg"
"""Twice would be a relief that is not allowed to the recipe's longest wavelengths; most of the slope is theirs."""
FACTORS, LEAST_OF_FACTOR = ("calibration", "fresh", "other organ"), 20
ROUND = 1.7308
"""The 95 % quantile of the length of a round normal pair over the root of its covariance's trace."""

TARGETS: tuple[Target, ...] = ("fine", "base")


@dataclass(frozen=True)
class Work:
    """A batch of frames of a kind."""

    kind: str
    number: int
    scope: str
    like: str
    path: Path

    def frames(self) -> list[dict[str, Any]]:
        """Render, and return what all cores answer to each frame."""
        organ = "liver" if self.kind == "other organ" else "colon"
        question = Question(read_scope(self.scope), organ, seed=SEEDS.get(self.kind, 3))
        experiment = self.changed(question)
        estimators, made = load_estimators(CORES), []
        for number, case in enumerate(expand(experiment)):
            for frame in CaseFrames(experiment, case, number, "llvm_ad_rgb"):
                shown = told_wrongly(frame) if self.kind == "light moved" else frame
                made.append(kept_frame(shown, estimators, self.like, True))
        return made

    def changed(self, question: Question) -> Experiment:
        """Return the experiment of the batch with its shift."""
        experiment = batch_experiment(question, self.number)
        (group,) = experiment.groups
        held, pool = dict(group.set), dict(group.pool[0])
        if self.kind == "steeper relief":
            pool[GROOVES] = tuple(STEEPER * each for each in pool[GROOVES])
        if self.kind == "coarser coding":
            pool["sensor.coding.quality"] = (QUALITY,) * DISTANCES
        if self.kind == "light moved":
            lights, each = question.scope._file.rig.nominal_mm().tolist(), held["rig"].get("each", {})
            held["rig"] = {"lights": [
                {"position_mm": [x + MOVED_MM, y, z], "power": 1 / len(lights), **each} for x, y, z in lights
            ]}  # fmt: skip
        return experiment.model_copy(update={"groups": (group.model_copy(update={"set": held, "pool": (pool,)}),)})


def told_wrongly(frame: RenderedFrame) -> RenderedFrame:
    """Return a frame whose lights are told to lie where they were before they moved."""
    calibration = frame.view.calibration
    lights = tuple((x - MOVED_MM, y, z) for x, y, z in calibration.priors.lights_mm)
    told = replace(calibration, priors=replace(calibration.priors, lights_mm=lights))
    return replace(frame, view=replace(frame.view, calibration=told), calibration=told)


def make(work: Work, on_step: OnStep) -> None:
    """Make a batch in a worker."""
    write_json(work.path, work.frames(), compact=True)
    on_step()


# Judging --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Judged:
    """A core's answers on frames of a kind, with their regions."""

    error_deg: Array
    sigma_deg: Array
    frames: Array
    radii_deg: Array  # of 68 and 95 %, shape (2, N)
    stratum: Array


def answers(frames: Sequence[Mapping[str, Any]], core: str, target: Target) -> dict[str, Array]:
    """Return a core's answers, by feature, with their errors and the number of the frame."""
    seen, error_deg, of = core_calibration.answers_of(frames, target, core)
    return {**seen, "error_deg": error_deg, "frame": of}


def features(held: Mapping[str, Array]) -> dict[Feature, Array]:
    """Return the features alone."""
    return {name: held[name] for name in (*OF_ANSWER, *OF_FRAME)}


def judged(strata: Strata, held: Mapping[str, Array], outside: Array | None = None) -> Judged:
    """Return the regions of answers; `outside`: by frame, whether the check on shift finds it."""
    count = len(held["error_deg"])
    seen = [{name: float(values[i]) for name, values in features(held).items()} for i in range(count)]
    away = np.zeros(count, bool) if outside is None else outside[held["frame"]]
    radii = np.array([strata.region(each, bool(off)) for each, off in zip(seen, away, strict=True)]).T
    stratum = np.array([next(n for n, part in enumerate(strata.parts) if part.holds(each)) for each in seen])
    return Judged(held["error_deg"], held["sigma_deg"], held["frame"], radii.reshape(2, -1), stratum)


def interval_scores(radius_deg: Array, error_deg: Array) -> Array:
    """Return what regions of 95 % are judged by, the less the better: the radius, and by how much it is exceeded."""
    return np.asarray(radius_deg + np.maximum(error_deg - radius_deg, 0) / (1 - LEVELS[1]))


def text_of(part: Stratum) -> str:
    """Return a stratum's ends in words."""
    told = []
    for name, (low, high) in part.ends.items():
        told += [] if low is None else [f"{name} >= {low:.3g}"]
        told += [] if high is None else [f"{name} < {high:.3g}"]
    return ", ".join(told) or "all"


def below(hits: Array, frames: Array, share: float) -> float:
    """Return how likely it is that so few hits come by chance where their share is this one; frames are the units."""
    off = hits - share
    sums = np.array([off[frames == each].sum() for each in np.unique(frames)])
    deviation = float(np.sqrt(len(sums) * sums.var(ddof=1))) if len(sums) > 1 else 0.0
    return NormalDist().cdf(float(off.sum()) / deviation) if deviation else float(off.sum() >= 0)


def covered(held: Judged, level: int) -> str:
    """Return the coverage with its 95 % interval, %."""
    hits = (held.error_deg <= held.radii_deg[level]).astype(float)
    low, high = share_interval(hits, held.frames.astype(int))
    return f"{100 * hits.mean():.1f} ({100 * low:.0f} to {100 * high:.0f})"


def print_study(frames: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Print the tables."""
    known, fresh = frames["calibration"], frames["fresh"]
    shift = shift_of(np.array([frame["statistics"] for frame in known], float))
    away = {kind: np.array([shift.distance(np.array(frame["statistics"], float)) > shift.limit for frame in own])
            for kind, own in frames.items()}  # fmt: skip
    first, shifted, factors, chances = [], [], [], []
    for core in dict.fromkeys(each["estimator"] for frame in known for each in frame["answers"]):
        for target in TARGETS:
            held = answers(known, core, target)
            if not len(held["error_deg"]) or len(np.unique(held["frame"])) < 40:
                continue
            error, sigma, of = held["error_deg"], held["sigma_deg"], held["frame"].astype(int)
            strata = strata_of(features(held), error, of)
            met = judged(strata, answers(fresh, core, target))
            one = interval_scores(np.array(quantile(error, of, 0.95)), met.error_deg).mean()
            score = interval_scores(met.radii_deg[1], met.error_deg).mean() / one
            ratio = "–"
            if np.all(sigma > 0):
                by = interval_scores(met.sigma_deg * quantile(error / sigma, of, 0.95), met.error_deg).mean() / one
                ratio = f"{by:.2f}"
            hits = (met.error_deg <= met.radii_deg[1]).astype(float)
            shares = []
            for n in range(len(strata.parts)):
                own = met.stratum == n
                if own.sum() and len(np.unique(met.frames[own])) > 4:
                    chances.append((below(hits[own], met.frames[own], 0.9), core, target, text_of(strata.parts[n])))
                    shares.append(100 * hits[own].mean())
            first.append((core, target, f"{len(error)} / {len(met.error_deg)}", str(len(strata.parts)),
                          covered(met, 0), covered(met, 1), f"{min(shares):.0f}" if shares else "–",
                          f"{np.median(met.radii_deg[1]):.3g}", f"{score:.2f}", ratio))  # fmt: skip
            for kind in SHIFTED:
                moved = answers(frames.get(kind, ()), core, target)
                if len(moved["error_deg"]):
                    without, with_it = (covered(judged(strata, moved, off), 1) for off in (None, away[kind]))
                    shifted.append((core, target, kind, str(len(moved["error_deg"])), without, with_it))
            if np.all(sigma > 0):
                on = [held, *(answers(frames.get(kind, ()), core, target) for kind in FACTORS[1:])]
                factors += [(core, target, text_of(part), str(part.highlights), *(factor(each, part) for each in on))
                            for part in strata.parts]  # fmt: skip
    heads = ("core", "normal", "answers, calibration / fresh", "strata", "68 %", "95 %", "least of a stratum",
             "median radius (deg)", "score / one radius", "error / deviation alone")  # fmt: skip
    print_markdown([heads, *first])
    print(holm(chances))
    found = [(kind, str(len(own)), f"{100 * own.mean():.0f}", *(together(shift, frames[kind], n) for n in SETS))
             for kind, own in away.items() if kind != "calibration"]  # fmt: skip
    print_markdown([("frames", "in all", "found by the check (%)", *(f"{n} together (%)" for n in SETS)), *found])
    print_markdown([("core", "normal", "shift", "answers", "95 % without the check", "with it"), *shifted])
    print_markdown([("core", "normal", "stratum", "answers", *(f"factor, {kind}" for kind in FACTORS)), *factors])


def together(shift: Shift, frames: Sequence[Mapping[str, Any]], count: int) -> str:
    """Return which share of sets of so many frames is found to be unlike the calibration's, %."""
    values, rng = np.array([frame["statistics"] for frame in frames], float), np.random.default_rng(0)
    if len(values) < count:
        return "–"
    sets = [values[rng.permutation(len(values))[:count]] for _ in range(500)]
    return f"{100 * np.mean([shift.set_distance(each) > shift.set_limit for each in sets]):.0f}"


def factor(held: Mapping[str, Array], part: Stratum) -> str:
    """Return by what reported deviations in a stratum are too small; nothing of fewer than `LEAST_OF_FACTOR` frames."""
    own = np.ones(len(held["error_deg"]), bool)
    for name, (low, high) in part.ends.items():
        own &= (held[name] >= (-np.inf if low is None else low)) & (held[name] < (np.inf if high is None else high))
    ratios, of = held["error_deg"][own] / held["sigma_deg"][own], held["frame"][own].astype(int)
    return f"{quantile(ratios, of, 0.95) / ROUND:.2f}" if len(np.unique(of)) >= LEAST_OF_FACTOR else "–"


def holm(chances: Sequence[tuple[float, str, str, str]], level: float = 0.01) -> str:
    """Return which strata cover less than 90 % beyond chance."""
    found = []
    for i, (chance, *what) in enumerate(sorted(chances)):
        if chance > level / (len(chances) - i):
            break
        found.append(f"{' '.join(what)} (p = {chance:.1e})")
    return f"\n{len(chances)} strata, of which below 90 % (Holm, {level:.0%}): {'; '.join(found) or 'none'}\n"


def main() -> None:
    """Render what is missing, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scope", default="colocated")
    parser.add_argument("--batches", type=int, default=32)
    parser.add_argument("--shifted", type=int, default=6)
    parser.add_argument("--like", choices=("peaks", "colour"), default="peaks")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    counts = dict.fromkeys(SEEDS, given.batches) | dict.fromkeys(SHIFTED, given.shifted)
    work = [Work(kind, n, given.scope, given.like, given.folder / f"{kind.replace(' ', '_')}_{n:03d}.json")
            for kind, count in counts.items() for n in range(count)]  # fmt: skip
    for _ in make_engine(workers=given.workers).run(
        make, [each for each in work if not each.path.exists()], lambda: None
    ):
        pass
    frames: dict[str, list[Any]] = {}
    for each in work:
        frames.setdefault(each.kind, []).extend(json.loads(each.path.read_text()))
    print_study(frames)


if __name__ == "__main__":
    main()
