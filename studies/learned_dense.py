"""Compare networks of the task `dense_normals` with shading, `bisector` and `learned_spot` on unseen anatomies.

python -m studies.learned_dense data/highlights scenes/learning/weights/learned_dense.onnx [--smooth FILE] [--most 2]

`--smooth` names a second network, trained on `highlights_smooth`. `--most` limits the frames of each anatomy: the
anatomies are the independent units. Errors of each fourth pixel along each axis are against the base surface; those at
highlights are taken where the detector by colour finds one. `--split` takes another split than test. `--networks`
leaves the other methods out.
"""

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from simtest.cli.progress import progress_bar
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.scoring.dense.shading import shading_maps
from simtest.dataset.shard import Sample
from simtest.errors import Failure
from simtest.estimators import Estimate, load_estimators
from simtest.estimators.learned import normal_of
from simtest.estimators.learned_dense import LEAST_HIGHLIGHTS, LearnedDense
from simtest.geometry.vectors import angle_deg, tangent_basis, tangent_coordinates
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array
from simtest.runtime.statistics import CONFIDENCE, NORMAL_QUANTILE
from studies.networks.examples import DENSE_FIELDS, sample_frame, truth_at
from studies.resampling import drawn_groups, interval_of_mean

STEP = 4
"""Each so many pixels along each axis one is scored."""

CHI2_95 = chi_squared.quantile(CONFIDENCE, 2)
SEED, DRAWS = 2026, 1000
FAMILIES = ("colon", "stomach", "liver")
DENSE, SMOOTH, SHADING = "learned_dense", "learned_dense, smooth-trained", "shading"


@dataclass
class Scores:
    """Figures of one method in one place, by anatomy: errors, deg, whether the truth is inside, shares of distance."""

    error: dict[tuple[int, int], list[Array]] = field(default_factory=lambda: defaultdict(list))
    inside: dict[tuple[int, int], list[Array]] = field(default_factory=lambda: defaultdict(list))
    distance: dict[tuple[int, int], list[Array]] = field(default_factory=lambda: defaultdict(list))
    scaled: dict[tuple[int, int], list[Array]] = field(default_factory=lambda: defaultdict(list))
    distance_inside: dict[tuple[int, int], list[Array]] = field(default_factory=lambda: defaultdict(list))
    contradictions: list[float] = field(default_factory=list)
    asked: int = 0
    answered: int = 0


def main() -> None:
    """Estimate on a split and print the tables."""
    options = _options()
    dense = {DENSE: LearnedDense(options.model)}
    if options.smooth:
        dense[SMOOTH] = LearnedDense(options.smooth)
    pixels: dict[str, Scores] = defaultdict(Scores)
    spots: dict[str, Scores] = defaultdict(Scores)
    pairs: dict[str, dict[tuple[int, int], list[Array]]] = defaultdict(lambda: defaultdict(list))
    taken: Counter[tuple[int, int]] = Counter()
    total = len(sample_positions(options.data, options.split))
    with progress_bar("comparing") as progress:
        for number, sample in enumerate(read_samples(options.data, options.split, DENSE_FIELDS)):
            anatomy = (sample.meta["anatomy"]["family"], sample.meta["anatomy"]["number"])
            taken[anatomy] += 1
            if taken[anatomy] <= options.most:
                _score_pixels(sample, anatomy, dense, pixels, pairs, others=not options.networks)
                _score_spots(sample, anatomy, dense, spots, pairs, others=not options.networks)
            progress(number + 1, total + 1, f"{options.split} split: frames")
    print(f"{sum(min(n, options.most) for n in taken.values())} frames of {len(taken)} anatomies\n")
    for place, scores in (("each pixel", pixels), ("highlights", spots)):
        print("\n".join(_table(place, scores)), end="\n\n")
    for name, own in spots.items():
        if own.contradictions:
            told = ", ".join(f"{share:g} %: {np.percentile(own.contradictions, share):.2f}" for share in (50, 90, 99.5))
            print(f"`{name}`: distance from the law of reflection in {len(own.contradictions)} frames: {told}")
    print("\n".join(_distances(pixels)), end="\n\n")
    print("\n".join(_pairs(pairs)))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("--smooth", type=Path)
    parser.add_argument("--most", type=int, default=sys.maxsize)
    parser.add_argument("--split", default="test")
    parser.add_argument("--networks", action="store_true")
    return parser.parse_args()


def _score_pixels(
    sample: Sample, anatomy: tuple[int, int], dense: dict[str, LearnedDense], scores: dict[str, Scores],
    pairs: dict[str, dict[tuple[int, int], list[Array]]], others: bool,
) -> None:  # fmt: skip
    """Score maps at each `STEP`-th pixel of a frame."""
    frame = sample_frame(sample)
    camera = frame.camera
    points = camera.pixel_centres()[STEP // 2 :: STEP, STEP // 2 :: STEP].reshape(-1, 2)
    turn, distance = truth_at(sample, camera, points)
    known = np.isfinite(distance)
    points, distance = points[known], distance[known]
    normal = normal_of(camera.unproject(points), turn.T[known])
    rows, columns = points[:, 1].astype(int), points[:, 0].astype(int)
    errors = {}
    for name, estimator in dense.items():
        stated = estimator.stated(frame, points)
        scores[name].asked += 1
        if not isinstance(stated, Failure):
            made, covariance, estimated, deviation = stated
            errors[name] = angle_deg(made, normal)
            inside = _inside(made, normal, covariance)
            _add(scores[name], anatomy, errors[name], inside)
            _add_distance(scores[name], anatomy, estimated / distance, deviation / distance)
    if others:
        made, shaded = shading_maps(frame.encoded, frame.calibration)
        errors[SHADING] = angle_deg(made[rows, columns], normal)
        scores[SHADING].asked += 1
        _add(scores[SHADING], anatomy, errors[SHADING], None)
        _add_distance(scores[SHADING], anatomy, shaded[rows, columns] / distance, None)
    for name, values in errors.items():
        if name != DENSE and DENSE in errors:
            pairs[f"each pixel: {DENSE} - {name}"][anatomy].append(errors[DENSE] - values)


def _score_spots(
    sample: Sample, anatomy: tuple[int, int], dense: dict[str, LearnedDense], scores: dict[str, Scores],
    pairs: dict[str, dict[tuple[int, int], list[Array]]], others: bool,
) -> None:  # fmt: skip
    """Score estimators of the base's normal at the detected highlights of a frame, and pair them."""
    frame = sample_frame(sample)
    estimators = {**(load_estimators(["bisector", "learned_spot"]) if others else {}), **dense}
    found = reconstruct(
        frame.encoded, frame.calibration, estimators, smoothing_px=frame.smoothing_px, detector="colour"
    )
    peaks = [each.patch.peak_px for each in found if not isinstance(each.patch, Failure)]
    if len(peaks) >= LEAST_HIGHLIGHTS:
        for name, estimator in dense.items():
            told = estimator.contradictions(frame, np.array(peaks, dtype=float))
            scores[name].contradictions += [] if isinstance(told, Failure) else [float(told.mean()) / 2]
    errors: dict[str, dict[int, float]] = defaultdict(dict)
    inside: dict[str, list[float]] = defaultdict(list)
    for number, each in enumerate(found):
        if isinstance(each.patch, Failure):
            continue
        point = np.asarray(each.patch.peak_px, dtype=float)[None]
        turn, distance = truth_at(sample, frame.camera, point)
        if not np.isfinite(distance[0]):
            continue
        normal = normal_of(frame.camera.unproject(point), turn.T)[0]
        for name, result in each.estimates.items():
            scores[name].asked += 1
            if isinstance(result, Estimate):
                errors[name][number] = float(angle_deg(result.normal[None], normal[None])[0])
                if result.covariance is not None and result.target == "base":
                    off = tangent_coordinates(result.normal, normal)
                    inside[name].append(float(off @ np.linalg.solve(result.covariance, off) <= CHI2_95))
    for name, own in errors.items():
        _add(scores[name], anatomy, np.array(list(own.values())), np.array(inside[name]) if inside[name] else None)
        both = sorted(own.keys() & errors.get(DENSE, {}).keys())
        if name != DENSE and both:
            pairs[f"highlights: {DENSE} - {name}"][anatomy].append(np.array([errors[DENSE][n] - own[n] for n in both]))


def _inside(made: Array, normal: Array, covariance: Array) -> Array:
    """Return whether true normals lie inside the 95 % ellipses."""
    basis = np.stack(tangent_basis(made), axis=1)
    across = np.einsum("nij,nj->ni", basis, normal)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.sum(made * normal, axis=1))
    off = across * (angle / np.maximum(sine, 1e-12))[:, None]
    distance = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return np.asarray(distance <= CHI2_95, dtype=float)


def _add(scores: Scores, anatomy: tuple[int, int], error: Array, inside: Array | None) -> None:
    answered = np.isfinite(error)
    scores.answered += int(answered.sum())
    scores.error[anatomy].append(error[answered])
    if inside is not None:
        scores.inside[anatomy].append(inside)


def _add_distance(scores: Scores, anatomy: tuple[int, int], share: Array, deviation: Array | None) -> None:
    """Add distances over the true ones: per cent off, as they are and after the frame's best factor."""
    share = share[np.isfinite(share)]
    scores.scaled[anatomy].append(100 * np.abs(share / np.median(share) - 1))
    if deviation is not None:
        scores.distance[anatomy].append(100 * np.abs(share - 1))
        # The deviation is of the logarithm; here it is a share of the true distance.
        logarithm = np.abs(np.log(share)) * share / deviation
        scores.distance_inside[anatomy].append((logarithm <= NORMAL_QUANTILE).astype(float))


def _table(place: str, scores: dict[str, Scores]) -> Iterator[str]:
    """Yield the table of errors of the normal, over all and by organ."""
    yield f"| {place}: method | organ | n | median, deg | 95 % below | inside its 95 % ellipse |"
    yield "|---|---|---|---|---|---|"
    for name, own in scores.items():
        for family in (None, 0, 1, 2):
            error = _of(own.error, family)
            values = _joined(error)
            if not len(values):
                continue
            inside = _joined(_of(own.inside, family))
            held = f"{inside.mean():.3f}" if len(inside) else "none"
            low, high = _median_interval(error)
            organ = "all" if family is None else FAMILIES[family]
            median = f"{np.median(values):.2f} ({low:.2f} to {high:.2f})"
            yield f"| `{name}` | {organ} | {len(values)} | {median} | {np.percentile(values, 95):.1f} | {held} |"
    told = (f"`{name}` {own.answered} of {own.asked}" for name, own in scores.items() if place == "highlights")
    yield f"\nAnswered: {', '.join(told)}" if place == "highlights" else ""


def _distances(scores: dict[str, Scores]) -> Iterator[str]:
    """Yield the table of errors of the distance."""
    yield "| each pixel: method | organ | distance: median error, % | 95 % below | after a factor: median, % | 95 % below | inside its 95 % interval |"  # noqa: E501
    yield "|---|---|---|---|---|---|---|"
    for name, own in scores.items():
        for family in (None, 0, 1, 2):
            raw, scaled, inside = (_of(each, family) for each in (own.distance, own.scaled, own.distance_inside))
            cells = [*_median_and_tail(raw), *_median_and_tail(scaled)]
            held = f"{_joined(inside).mean():.3f}" if inside else "none"
            yield f"| `{name}` | {'all' if family is None else FAMILIES[family]} | {' | '.join([*cells, held])} |"


def _median_and_tail(values: dict[tuple[int, int], list[Array]]) -> tuple[str, str]:
    if not values:
        return "none", "none"
    whole, (low, high) = _joined(values), _median_interval(values)
    return f"{np.median(whole):.1f} ({low:.1f} to {high:.1f})", f"{np.percentile(whole, 95):.1f}"


def _pairs(pairs: dict[str, dict[tuple[int, int], list[Array]]]) -> Iterator[str]:
    """Yield the mean differences of errors where both answered, with intervals over anatomies."""
    yield "| pair | n | anatomies | mean difference, deg | 95 % interval |"
    yield "|---|---|---|---|---|"
    for name, own in pairs.items():
        parts = [np.concatenate(of_anatomy) for of_anatomy in own.values()]
        values, groups = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        values, groups = values[np.isfinite(values)], groups[np.isfinite(values)]
        low, high = interval_of_mean(values, groups, DRAWS, SEED)
        count = len(np.unique(groups))
        yield f"| {name} | {len(values)} | {count} | {values.mean():+.2f} | {low:+.2f} to {high:+.2f} |"


def _of(values: dict[tuple[int, int], list[Array]], family: int | None) -> dict[tuple[int, int], list[Array]]:
    return {anatomy: parts for anatomy, parts in values.items() if family in (None, anatomy[0])}


def _joined(values: dict[tuple[int, int], list[Array]]) -> Array:
    return np.concatenate([part for parts in values.values() for part in parts]) if values else np.empty(0)


def _median_interval(values: dict[tuple[int, int], list[Array]]) -> tuple[float, float]:
    """Return the 95 % interval of the median by bootstrap over anatomies, from histograms of 2000 bins."""
    whole = _joined(values)
    edges = np.linspace(0, float(whole.max()) + 1e-6, 2001)
    counts = np.array([np.histogram(np.concatenate(parts), edges)[0] for parts in values.values()])
    drawn = counts[drawn_groups(len(counts), DRAWS, SEED)].sum(axis=1).cumsum(axis=1)
    at = (drawn < drawn[:, -1:] / 2).sum(axis=1)
    low, high = np.percentile(edges[at + 1], [2.5, 97.5])
    return float(low), float(high)


if __name__ == "__main__":
    main()
