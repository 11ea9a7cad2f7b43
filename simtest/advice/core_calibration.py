"""Calibrates a core: renders frames of a scope, runs the core on them, and finds how large its errors are by stratum.

The frames are those of `simtest advise`: walls of an organ at drawn distances, forms, poses and reliefs. Detection,
answers and their matching with the truth are those of a run; an answer that matches no true highlight is judged at the
pixel that it looks at. Regions are split conformal: of n answers in K frames, drawn as those are that the core will
meet, at least 95 % lie within the error of rank 0.95 n (K + 1) / K. The frame is the unit, as highlights of one frame
share its wall and its light [Dunn, Wasserman and Ramdas, J. Am. Stat. Assoc. 118, 2023, 2491]: the new frame counts as
one whose answers are all farther off.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simtest.advice.plan import DISTANCES, Question, main_experiment
from simtest.dataset.scoring.frames import CaseFrames, RenderedFrame
from simtest.errors import InputError
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.names import absolute_names, close_cores, core_hashes, forgive_cores, short_name
from simtest.estimators.protocol import Target
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.reconstruction.regions import (
    LEVELS,
    MOST_DEG,
    REGRESSORS,
    CoreCalibration,
    Expected,
    Feature,
    Shift,
    Strata,
    Stratum,
    features,
    regressors,
    scales,
    statistics_of,
)
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject, make_folder, read_json, write_json
from simtest.runtime.processes import Engine, OnStep, make_engine
from simtest.runtime.seeds import Stage, integer
from simtest.validation.cases import expand
from simtest.validation.columns import Row
from simtest.validation.realisation import answer, score
from simtest.validation.runner import Progress, variant_of

BATCHES = 16
"""Of `DISTANCES` frames each, at least: with few frames a region must be wide, however many answers they hold."""

MOST_BATCHES = 500

LEAST_HIGHLIGHTS, LEAST_FRAMES = 100, 50
"""A stratum stands on so many answers in so many frames, or is no stratum of its own."""

ORDER: tuple[Feature, ...] = ("sigma_deg", "score", "flags", "radius_px", "border", "axis_ratio", "kind")
"""In which strata are parted."""

FOLDS = 10

RIDGE = 0.05
"""Of the expected error's weights, over the variance of a regressor."""

FALSE_ALARMS = 0.05
SHRINKAGE = 0.1
"""Share of unit covariance in that of the frames' statistics: they are about as many as a tenth of the frames."""


# Answers to frames ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Batch:
    """Some frames of a scope that a core answers to."""

    question: Question
    core: str
    detector: str
    every: bool
    path: Path  # where its answers are kept

    def make(self, on_step: OnStep) -> None:
        """Render the frames, run the core and keep its answers."""
        # The answers must not depend on the batches before.
        forgive_cores()
        estimators, frames = load_estimators([self.core]), list[JsonObject]()
        experiment = main_experiment(self.question)
        cases = expand(experiment)
        variant = variant_of(cases)
        for number, case in enumerate(cases):
            for frame in CaseFrames(experiment, case, number, variant):
                told = statistics_of(frame.image)
                known = None if told is None else [float(v) if np.isfinite(v) else None for v in told]
                frames.append(
                    {"statistics": known, "answers": answers_of(frame, estimators, self.detector, self.every)}
                )
                on_step()
        write_json(self.path, frames, compact=True)


def make_batch(batch: Batch, on_step: OnStep) -> None:
    """Make a batch in a worker."""
    batch.make(on_step)


def answers_of(
    frame: RenderedFrame, estimators: Mapping[str, AnyEstimator], detector: str, every: bool
) -> list[JsonObject]:
    """Return the features and the error of each answer to a frame, as the fine surface's normal and as the base's.

    Found by colour the frame is taken as a picture of 8 bits, as `simtest reconstruct` takes one; by peaks as a run
    takes it.
    """
    spots: Sequence[Specularity]
    if detector == "peaks":
        spots = answer(frame.view, frame.image, estimators, not every)
    else:
        picture = np.round(255 * frame.image).astype(np.uint8)
        spots = reconstruct(picture, frame.calibration, estimators, isolated=not every, detector=detector)
    told: list[tuple[Row, Specularity, Estimate]] = []
    for row in score(frame.session, frame.view, spots, estimators, {}, not every).rows:
        if row["status"] == "ok":
            spot, name = spots[int(str(row["specularity"]))], str(row["estimator"])
            given = spot.estimates[name], spot.organ[name]
            stated = {each.target: each for each in given if isinstance(each, Estimate)}
            told += [(row, spot, each) for each in stated.values()]
    if not told:
        return []
    height, width = frame.image.shape[:2]
    at = frame.session.exact_points(np.array([estimate.look_px for _, _, estimate in told]))
    metal = frame.view.instruments
    made = []
    for i, (row, spot, estimate) in enumerate(told):
        error = row.get(f"error_{estimate.target}_deg")
        if error is None:
            x, y = (min(max(int(v), 0), n - 1) for v, n in zip(estimate.look_px, (width, height), strict=True))
            tissue = at.valid[i] and (metal is None or not metal[y, x])
            normal = (at.normal if estimate.target == "fine" else at.normal_base)[i]
            error = float(angle_deg(estimate.normal, normal)) if tissue else MOST_DEG
        told_of: JsonObject = {"estimator": row["estimator"], "target": estimate.target, "error_deg": error}
        made.append({**told_of, **features(spot, estimate, (width, height))})  # type: ignore[dict-item]
    return made


# Strata ---------------------------------------------------------------------------------------------------------------


def quantile(values: Array, frames: IntArray, level: float) -> float:
    """Return what at least a share `level` of the answers in a new frame stays below; inf where too few frames tell."""
    count = len(np.unique(frames))
    rank = math.ceil(len(values) * level * (count + 1) / count - 1e-9)
    return float(np.sort(values)[rank - 1]) if rank <= len(values) else math.inf


def strata_of(seen: Mapping[Feature, Array], error_deg: Array, frames: IntArray) -> Strata:
    """Find the scale of answers' errors, and the quantiles of these over it in strata; features of shape (N,) each.

    The scale is the one with the least mean interval score in all. What is expected of an answer for that, and for the
    quantiles, comes from the other batches' frames.
    """
    fold = frames // DISTANCES % FOLDS
    others = np.ones(len(frames))
    for each in np.unique(fold):
        own = fold == each
        kept, held = ({name: values[which] for name, values in seen.items()} for which in (~own, own))
        others[own] = expected_of(kept, error_deg[~own], frames[~own]).of(held)
    expected = expected_of(seen, error_deg, frames)
    known = {**scales(seen, expected), "expected": others}

    def mean_score(scale: Array) -> float:
        return float(interval_scores(scale * quantile(error_deg / scale, frames, LEVELS[1]), error_deg).mean())

    usable = [kind for kind, values in known.items() if np.isfinite(values).all()]
    scale = min(usable, key=lambda kind: mean_score(known[kind]))
    ratios, parts = error_deg / known[scale], []
    for own, ends in _parted(seen, frames, np.arange(len(frames)), {}, ORDER):
        of = frames[own]
        first, last = (tuple(quantile(each[own], of, level) for level in LEVELS) for each in (ratios, error_deg))
        parts.append(Stratum(ends=ends, highlights=len(own), frames=len(np.unique(of)), ratio=first, error_deg=last))
    return Strata(scale=scale, expected=expected, parts=tuple(parts))


def interval_scores(radius_deg: Array, error_deg: Array) -> Array:
    """Return what regions of 95 % are judged by, the less the better: the radius, and by how much it is exceeded."""
    return np.asarray(radius_deg + np.maximum(error_deg - radius_deg, 0) / (1 - LEVELS[1]))


def expected_of(seen: Mapping[Feature, Array], error_deg: Array, frames: IntArray) -> Expected:
    """Fit the error that is expected of an answer by its features (ridge regression).

    The logarithm is that of the error and the median error, as errors near 0 are chance. Frames weigh by the root of
    the number of their answers.
    """
    rows = regressors(seen)
    _, which, counts = np.unique(frames, return_inverse=True, return_counts=True)
    weights = 1 / np.sqrt(counts[which])
    weights /= weights.sum()
    target = np.log(error_deg + np.median(error_deg))
    centre, spread, start = weights @ rows, rows.std(axis=0) + 1e-9, weights @ target
    scaled = np.clip((rows - centre) / spread, -3, 3)
    normal = (scaled * weights[:, None]).T @ scaled + RIDGE * np.eye(REGRESSORS)
    found = np.linalg.solve(normal, (scaled * weights[:, None]).T @ (target - start))
    return Expected(centre=tuple(centre), spread=tuple(spread), weights=tuple(found), start=float(start))


Ends = dict[Feature, tuple[float | None, float | None]]


def _parted(
    seen: Mapping[Feature, Array], frames: IntArray, own: IntArray, ends: Ends, order: Sequence[Feature]
) -> list[tuple[IntArray, Ends]]:
    """Part answers, given by their indices, at the median of each feature in turn where both halves are large enough.

    The cuts do not depend on the errors.
    """
    for i, name in enumerate(order):
        values = seen[name][own]
        cut = float(np.median(values))
        if cut == values.min():
            # Half and more are alike: these, and the others.
            cut = float(min(values[values > cut], default=cut))
        halves = own[values < cut], own[values >= cut]
        if all(len(half) >= LEAST_HIGHLIGHTS and len(np.unique(frames[half])) >= LEAST_FRAMES for half in halves):
            low, high = ends.get(name, (None, None))
            first = _parted(seen, frames, halves[0], {**ends, name: (low, cut)}, order[i + 1 :])
            return first + _parted(seen, frames, halves[1], {**ends, name: (cut, high)}, order[i + 1 :])
    return [(own, ends)]


def shift_of(statistics: Array) -> Shift:
    """Find how far off frames of the calibration are, by their statistics, shape (frames, S), NaN where not told.

    The centre and covariance are those of one half of the frames, the limit is the conformal quantile of the other's.
    """
    first, second = statistics[::2], statistics[1::2]
    centre = np.nanmean(first, axis=0)
    spread = np.nanstd(first, axis=0) + 1e-9
    scaled = np.nan_to_num((first - centre) / spread, nan=0.0)
    covariance = (1 - SHRINKAGE) * np.cov(scaled.T) + SHRINKAGE * np.eye(len(centre))
    values, vectors = np.linalg.eigh(covariance)
    whitening = (vectors / np.sqrt(values)).T / spread
    found = Shift(centre=tuple(centre.tolist()), whitening=tuple(map(tuple, whitening.tolist())), limit=0.0)
    off = np.array([found.distance(each) for each in second])
    limit = quantile(off, np.arange(len(off)), 1 - FALSE_ALARMS)
    return found.model_copy(update={"limit": limit})


# The whole ------------------------------------------------------------------------------------------------------------


def calibrate_core(
    core: str, question: Question, out: Path, highlights: int = 2400, detector: str = "colour", every: bool = False,
    engine: Engine | None = None, progress: Progress | None = None,
) -> CoreCalibration:  # fmt: skip
    """Calibrate a core on frames of a scope, and write the calibration; a stopped one goes on.

    Parameters
    ----------
    core : str
        An installed estimator, or a command or file as `simtest validate` takes it.
    question : Question
        Scope, organ, distances and seed.
    out : Path
        File of the calibration; the answers to the frames are kept in a folder beside it, and used again.
    highlights : int
        Answers at least.
    detector : {"colour", "peaks"}
        How highlights are found: as `simtest reconstruct` finds them in pictures, or as `simtest validate` does.
    every : bool
        Take highlights that are not isolated too.
    engine : Engine, optional
        Runs the batches; the result does not depend on it.
    progress : callable, optional
        Called with frames done, frames in all, and what is being done.

    Raises
    ------
    InputError
        If the core is unknown, answers too seldom, or the folder holds answers of something else.
    """
    name = short_name(core)
    load_estimators([core])
    folder = out.with_suffix(".frames")
    make_folder(folder)
    settings = _settings(core, question, detector, every)
    _check(folder / "settings.json", settings)
    chosen, frames = engine or make_engine(), list[JsonObject]()
    (absolute,) = absolute_names([core])
    try:
        while (wanted := _batches(frames, highlights, name)) * DISTANCES > len(frames):
            batches = [
                Batch(batch_question(question, number), absolute, detector, every, folder / f"{number:04d}.json")
                for number in range(wanted)
            ]
            _make(batches, chosen, progress)
            frames = [frame for batch in batches for frame in read_json(batch.path)]
    finally:
        close_cores()
    calibration = calibration_of(name, frames, question, detector, every, settings)
    write_json(out, calibration.model_dump(mode="json"))
    return calibration


def batch_question(question: Question, number: int) -> Question:
    """Return the question of a batch: a frame at each distance, of a seed of its own."""
    seed = integer(question.seed, "calibrate core", "batch", number, Stage.SWEEP)
    return replace(question, frames=DISTANCES, seed=seed)


def _batches(frames: Sequence[JsonObject], wanted: int, core: str) -> int:
    """Return how many batches hold enough answers, by those that are there."""
    if not frames:
        return BATCHES
    count = len(frames) // DISTANCES
    have = max(sum(each["target"] == of for frame in frames for each in frame["answers"]) for of in ("fine", "base"))
    if have >= wanted:
        return count
    needed = math.ceil(wanted * count / have) if have else MOST_BATCHES + 1
    if needed > MOST_BATCHES:
        raise InputError(
            f"{core}: {have} answers in {len(frames)} frames; {wanted} take more than {MOST_BATCHES * DISTANCES}"
        )
    return max(needed, count + 1)


def _make(batches: Sequence[Batch], engine: Engine, progress: Progress | None) -> None:
    """Make the batches that are not there yet."""
    missing = [batch for batch in batches if not batch.path.exists()]
    total, done = DISTANCES * len(batches), DISTANCES * (len(batches) - len(missing))

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total, "rendering and answering")

    for _ in engine.run(make_batch, missing, step):
        pass


def _settings(core: str, question: Question, detector: str, every: bool) -> JsonObject:
    """Return all that the answers depend on."""
    scope = question.scope
    return {
        "core": core, "files": core_hashes([core]).get(core, {}), "scope": scope.tables,
        "relief": None if scope.relief is None else scope.relief.model_dump(mode="json"), "organ": question.organ,
        "distances_mm": [*question.distances_mm], "seed": question.seed, "detector": detector, "every": every,
        "version": provenance.version(), "source": provenance.source_hash(),
    }  # fmt: skip


def _check(path: Path, settings: JsonObject) -> None:
    """Keep the settings; raise `InputError` where answers of others stand."""
    if path.exists():
        before = read_json(path)
        if changed := [key for key in settings if before.get(key) != settings[key]]:
            raise InputError(
                f"{path.parent}: holds answers with another {', '.join(changed)}; remove it, or give another --out"
            )
    else:
        write_json(path, settings)


def calibration_of(
    name: str, frames: Sequence[JsonObject], question: Question, detector: str, every: bool, settings: JsonObject
) -> CoreCalibration:
    """Return the calibration by the answers to frames."""
    strata: dict[Target, Strata] = {}
    numbered = [(i, each) for i, frame in enumerate(frames) for each in frame["answers"]]
    for target in ("fine", "base"):
        own = [(i, each) for i, each in numbered if each["target"] == target]
        if own:
            seen: dict[Feature, Array] = {key: np.array([each[key] for _, each in own], float) for key in ORDER}
            errors, of = np.array([each["error_deg"] for _, each in own]), np.array([i for i, _ in own])
            strata[target] = strata_of(seen, errors, of)
    told = [frame["statistics"] for frame in frames]
    scope = question.scope
    return CoreCalibration(
        core=name, scope=scope.name, organ=question.organ, size=scope.size, detector=detector, every=every,
        highlights=max(sum(each.highlights for each in own.parts) for own in strata.values()), frames=len(frames),
        strata=strata, shift=None if None in told else shift_of(np.array(told, float)),
        made={**settings, **provenance.environment()},
    )  # fmt: skip
