"""Calibrates a core: renders frames of a scope, runs the core on them, and finds how large its errors are by stratum.

The frames are those of `simtest advise`: walls of an organ at drawn distances, forms, poses and reliefs. Detection,
answers and their matching with the truth are those of a run; an answer that matches no true highlight is judged at the
pixel that it looks at. Regions are split conformal with the frame as the unit, as highlights of one frame share its
wall and its light [Dunn, Wasserman and Ramdas, J. Am. Stat. Assoc. 118, 2023, 2491]: see `quantile`.
"""

import hashlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from simtest.advice.plan import DISTANCES, Question, main_experiment
from simtest.dataset.scoring.frames import CaseFrames, RenderedFrame
from simtest.errors import InputError
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.names import ESTIMATORS, absolute_names, close_cores, core_hashes, forgive_cores, short_names
from simtest.estimators.protocol import Target
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction import regions
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.regions import CoreCalibration, Ends, Expected, Feature, Shift, Strata, Stratum
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject, make_folder, read_json, write_json
from simtest.runtime.processes import Engine, OnStep, make_engine
from simtest.runtime.seeds import Stage, generator, integer
from simtest.spec import Experiment
from simtest.spec.recipes import load_dataset
from simtest.validation.cases import expand
from simtest.validation.realisation import answer, score
from simtest.validation.runner import Progress, variant_of

LEAST_BATCHES, MOST_BATCHES = 16, 500
"""Of `DISTANCES` frames each: with few frames a region must be wide, however many answers they hold."""

LEAST_HIGHLIGHTS, LEAST_FRAMES = 200, 50
"""A stratum stands on so many answers in so many frames, or is no stratum of its own."""

ORDER: tuple[Feature, ...] = ("sigma_deg", "score", "flags", "radius_px", "border", "axis_ratio", "kind")
"""In which strata are parted."""

RECIPE = "endoscopy"
"""Dataset recipe whose ranges reach over real frames."""

FOLDS, SETS, RIDGE_FRAMES, SHRINKAGE = 10, 1000, 10.0, 0.3
"""The last two: how many frames the expected error's weights of 0 count for; of the frames' statistics, over 1."""

# Answers to frames ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Batch:
    """Some frames of a scope that a core answers to, and the file where its answers are kept."""

    question: Question
    number: int
    core: str
    detector: str
    every: bool
    path: Path


def make_batch(batch: Batch, on_step: OnStep) -> None:
    """Render the frames of a batch, run the core and keep its answers."""
    # The answers must not depend on the batches before.
    forgive_cores()
    estimators, frames = load_estimators([batch.core]), list[JsonObject]()
    experiment = batch_experiment(batch.question, batch.number)
    cases = expand(experiment)
    variant = variant_of(cases)
    for number, case in enumerate(cases):
        for frame in CaseFrames(experiment, case, number, variant):
            frames.append(kept_frame(frame, estimators, batch.detector, batch.every))
            on_step()
    write_json(batch.path, frames, compact=True)


def kept_frame(frame: RenderedFrame, estimators: Mapping[str, AnyEstimator], detector: str, every: bool) -> JsonObject:
    """Return a frame's realism statistics, and features and error of each answer as either surface's normal."""
    if detector == "peaks":
        spots = [*answer(frame.view, frame.image, estimators, not every)]
    else:
        # A picture of 8 bits, as `simtest reconstruct` takes it.
        picture = np.round(255 * frame.image).astype(np.uint8)
        spots = [*reconstruct(picture, frame.calibration, estimators, isolated=not every, detector=detector)]
    told = []
    for row in score(frame.session, frame.view, spots, estimators, {}, not every).rows:
        if row["status"] == "ok":
            spot, name = spots[int(str(row["specularity"]))], str(row["estimator"])
            given = spot.estimates[name], spot.organ[name]
            told += [(row, spot, each) for each in {e.target: e for e in given if isinstance(e, Estimate)}.values()]
    (height, width), metal = frame.image.shape[:2], frame.view.instruments
    at = frame.session.exact_points(np.array([estimate.look_px for _, _, estimate in told]).reshape(-1, 2))
    answers = list[JsonObject]()
    for i, (row, spot, estimate) in enumerate(told):
        error = row.get(f"error_{estimate.target}_deg")
        if error is None:
            x, y = (min(max(int(v), 0), n - 1) for v, n in zip(estimate.look_px, (width, height), strict=True))
            tissue = at.valid[i] and (metal is None or not metal[y, x])
            normal = (at.normal if estimate.target == "fine" else at.normal_base)[i]
            error = float(angle_deg(estimate.normal, normal)) if tissue else regions.MOST_DEG
        seen: JsonObject = dict(regions.features(spot, estimate, (width, height)))  # type: ignore[arg-type]
        answers.append({"estimator": row["estimator"], "target": estimate.target, "error_deg": error, **seen})
    measured = regions.statistics_of(frame.image)
    numbers = None if measured is None else [v if math.isfinite(v) else None for v in measured.tolist()]
    return {"statistics": numbers, "answers": answers}


def answers_of(
    frames: Sequence[Mapping[str, Any]], target: Target, core: str | None = None
) -> tuple[dict[Feature, Array], Array, IntArray]:
    """Return features, errors, deg, and numbers of the frames of kept answers, by default of all cores, shape (N,)."""
    own = [(i, each) for i, frame in enumerate(frames) for each in frame["answers"]
           if each["target"] == target and core in (None, each["estimator"])]  # fmt: skip
    told = [regions.of_frame(None if (each := frame["statistics"]) is None else np.array(each, float))
            for frame in frames]  # fmt: skip
    seen = {name: np.array([each[name] for _, each in own], float) for name in regions.OF_ANSWER}
    seen |= {name: np.array([told[i][name] for i, _ in own], float) for name in regions.OF_FRAME}
    return seen, np.array([each["error_deg"] for _, each in own], float), np.array([i for i, _ in own], int)


# Strata ---------------------------------------------------------------------------------------------------------------


def quantile(values: Array, frames: IntArray, level: float) -> float:
    """Return what a share `level` of the answers in a new frame is expected to stay below; inf where few frames tell.

    Of n answers in K frames it is that of rank level n (K + 1) / K: the new frame, which is one of K + 1 that are drawn
    alike, counts as one of mean size whose answers are all above.
    """
    count = len(np.unique(frames))
    rank = math.ceil(len(values) * level * (count + 1) / count - 1e-9)
    return float(np.sort(values)[rank - 1]) if rank <= len(values) else math.inf


def strata_of(seen: Mapping[Feature, Array], error_deg: Array, frames: IntArray) -> Strata:
    """Find what errors are expected, and the quantiles of errors over these in strata; features of shape (N,) each.

    For the quantiles what is expected of an answer comes from other batches' frames.
    """
    fold, others = frames // DISTANCES % FOLDS, np.ones(len(frames))
    for own in (fold == each for each in np.unique(fold)):
        kept, held = ({name: values[which] for name, values in seen.items()} for which in (~own, own))
        others[own] = expected_of(kept, error_deg[~own], frames[~own]).of(held)
    ratios, parts = error_deg / others, []
    for own, ends in _parted(seen, frames, np.arange(len(frames)), {}, ORDER):
        of = frames[own]
        first, last = (tuple(quantile(each[own], of, p) for p in regions.LEVELS) for each in (ratios, error_deg))
        parts.append(Stratum(ends=ends, highlights=len(own), frames=len(np.unique(of)), ratio=first, error_deg=last))
    told = seen["sigma_deg"]
    reported = float(told.min()), float(told.max())
    return Strata(expected=expected_of(seen, error_deg, frames), reported_deg=reported, parts=tuple(parts))


def expected_of(seen: Mapping[Feature, Array], error_deg: Array, frames: IntArray) -> Expected:
    """Fit the error that is expected of an answer by its features (ridge regression).

    The median is added to errors before the logarithm, as errors near 0 are chance. Frames weigh by the root of the
    number of their answers.
    """
    rows, (_, which, counts) = regions.regressors(seen), np.unique(frames, return_inverse=True, return_counts=True)
    weights = 1 / np.sqrt(counts[which])
    weights /= weights.sum()
    target, told = np.log(error_deg + np.median(error_deg)), np.isfinite(rows)
    start, known = float(weights @ target), np.maximum(weights @ told, 1e-9)
    centre = weights @ np.where(told, rows, 0.0) / known
    off = np.where(told, rows - centre, 0.0)
    spread = np.sqrt((off**2).sum(axis=0) / np.maximum(told.sum(axis=0), 1)) + 1e-9
    found = Expected(centre=tuple(centre), spread=tuple(spread), weights=(0.0,) * len(centre), start=start)
    scaled = found.scaled(rows)
    normal = (scaled.T * weights) @ scaled + RIDGE_FRAMES / len(counts) * np.eye(regions.REGRESSORS)
    slopes = np.linalg.solve(normal, (scaled.T * weights) @ (target - start))
    return found.model_copy(update={"weights": tuple(slopes)})


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
        low, high = own[values < cut], own[values >= cut]
        if all(len(each) >= LEAST_HIGHLIGHTS and len(np.unique(frames[each])) >= LEAST_FRAMES for each in (low, high)):
            first = _parted(seen, frames, low, {**ends, name: (None, cut)}, order[i + 1 :])
            return first + _parted(seen, frames, high, {**ends, name: (cut, None)}, order[i + 1 :])
    return [(own, ends)]


def shift_of(statistics: Array) -> Shift:
    """Find how far off frames of the calibration are, by their statistics, shape (frames, S), NaN where not told.

    The centre and covariance are those of one half of the frames, the limit is the conformal quantile of the other's;
    of several frames together that of sets drawn from these.
    """
    first, second = statistics[::2], statistics[1::2]
    told = np.isfinite(first)
    centre = np.where(told, first, 0.0).sum(axis=0) / np.maximum(told.sum(axis=0), 1)
    off = np.where(told, first - centre, 0.0)
    spread = np.sqrt((off**2).sum(axis=0) / np.maximum(told.sum(axis=0), 1)) + 1e-9
    scaled = off / spread
    values, vectors = np.linalg.eigh((1 - SHRINKAGE) * np.cov(scaled.T) + SHRINKAGE * np.eye(len(centre)))
    whitening = (vectors / np.sqrt(values)).T / spread
    found = Shift(centre=tuple(centre), whitening=tuple(map(tuple, whitening)), limit=0.0, set_limit=0.0)
    off, rng = np.array([found.distance(each) for each in second]), np.random.default_rng(0)
    sets = [found.set_distance(second[rng.integers(len(second), size=regions.SET_FRAMES)]) for _ in range(SETS)]
    limit = quantile(off, np.arange(len(off)), regions.LEVELS[1])
    return found.model_copy(update={"limit": limit, "set_limit": float(np.quantile(sets, regions.LEVELS[1]))})


# The whole ------------------------------------------------------------------------------------------------------------


def calibrate_core(
    core: str, question: Question, out: Path, highlights: int = 2400, detector: str = "colour", every: bool = False,
    engine: Engine | None = None, progress: Progress | None = None,
) -> CoreCalibration:  # fmt: skip
    """Calibrate a core, an estimator as `simtest validate` takes it, on so many answers to frames of a scope at least.

    The calibration is written into the file `out`; the answers are kept in a folder beside it, and used again. Raises
    `InputError` if the core is unknown or answers too seldom.
    """
    (name,), (absolute,) = short_names([core]), absolute_names([core])
    load_estimators([core])
    scope = question.scope
    made = {
        "core": core, "files": core_hashes([core]).get(core, {}), "scope": scope.tables, "organ": question.organ,
        "relief": None if scope.relief is None else scope.relief.model_dump(mode="json"),
        "distances_mm": [*question.distances_mm], "seed": question.seed, "detector": detector, "every": every,
        "version": provenance.version(), "source": provenance.source_hash(),
        "packages": provenance.versions() | ESTIMATORS.distributions([core]),
    }  # fmt: skip
    digest = hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()
    folder = out.with_suffix(".frames") / digest[:12]
    make_folder(folder)
    chosen, frames, wanted, have = engine or make_engine(), list[JsonObject](), LEAST_BATCHES, 0
    try:
        while wanted * DISTANCES > len(frames):
            batches = [Batch(question, n, absolute, detector, every, folder / f"{n:04d}.json")
                       for n in range(wanted)]  # fmt: skip
            missing, total = [batch for batch in batches if not batch.path.exists()], DISTANCES * wanted
            done = itertools.count(total - DISTANCES * len(missing) + 1)
            for _ in chosen.run(make_batch, missing, partial(_tell, progress, done, total)):
                pass
            frames = [frame for batch in batches for frame in read_json(batch.path)]
            answers = Counter(each["target"] for frame in frames for each in frame["answers"])
            have = max(answers.values(), default=0)
            if have < highlights:
                # A twentieth more than the frames so far ask for.
                wanted = max(wanted + 1, math.ceil(1.05 * wanted * highlights / max(have, 1)))
            if wanted > MOST_BATCHES:
                raise InputError(f"{name}: {have} answers in {len(frames)} frames; {highlights} take too many")
    finally:
        close_cores()
    strata = dict[Target, Strata]()
    for target in ("fine", "base"):
        seen, error_deg, of = answers_of(frames, target)
        if len(np.unique(of)) >= LEAST_FRAMES:
            strata[target] = strata_of(seen, error_deg, of)
    if not strata:
        raise InputError(f"{name}: answers in fewer than {LEAST_FRAMES} of {len(frames)} frames")
    told = [frame["statistics"] for frame in frames]
    calibration = CoreCalibration(
        core=name, scope=scope.name, size=scope.size, detector=detector, every=every, strata=strata,
        frames=len(frames), highlights=have, shift=None if None in told else shift_of(np.array(told, float)),
        made=made | {"environment": provenance.environment()},
    )  # fmt: skip
    write_json(out, calibration.model_dump(mode="json"))
    return calibration


def batch_experiment(question: Question, number: int) -> Experiment:
    """Return the frames of a batch: those of an advice, one at each distance, and what is not known as `RECIPE` has it.

    That is the organ's colours, vessels, film and relief, and what the scope leaves to its sensor's preset.
    """
    seed = integer(question.seed, "calibrate core", "batch", number, Stage.SWEEP)
    experiment = main_experiment(replace(question, frames=DISTANCES, seed=seed))
    (group,), families = experiment.groups, load_dataset(RECIPE).families
    held, pool = dict(group.set), dict(group.pool[0])
    # An advice's walls have no vessels.
    del held["reflectance.albedo"]
    kinds = ["reflectance.albedo."]
    if "relief" in held["surface"]:
        kinds += ["reflectance.film."] + ["surface.relief.bands."] * (question.scope.relief is None)
    tissue = next(each for each in families if each.scene == group.scene)
    chain = next((each for each in families if each.set["sensor"]["preset"] == held["sensor"].get("preset")), None)
    known = {f"sensor.{key}" for key in question.scope.tables.get("sensor", {})} | {"sensor.overlay"}
    rng = generator(seed, "calibrate core", "unknown", 0, Stage.SWEEP)
    for family, own in ((tissue, tuple(kinds)), (chain, ("sensor.",))):
        if family is not None:
            held |= {key: value for key, value in family.set.items() if key.startswith(own)}
            for key, drawn in {**family.per_anatomy, **family.per_sample}.items():
                if key.startswith(own) and ".".join(key.split(".")[:2]) not in known:
                    pool[key] = tuple(drawn.draw(rng) for _ in range(DISTANCES))
    if chain is not None:
        held["sensor"] = {**chain.set["sensor"], **held["sensor"]}
    return experiment.model_copy(update={"groups": (group.model_copy(update={"set": held, "pool": (pool,)}),)})


def _tell(progress: Progress | None, done: Iterator[int], total: int) -> None:
    if progress:
        progress(next(done), total, "rendering and answering")
