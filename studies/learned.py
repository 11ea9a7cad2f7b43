"""Compare the shipped networks with `bisector`, `cloud` and shading on anatomies that they have not seen.

    simtest dataset highlights --out data/highlights
    python -m studies.learned data/highlights [--spot FILE] [--dense FILE] [--smooth FILE] [--most 2] [--split test]

Files are networks of the tasks `spot_normals` and `dense_normals`, default the shipped ones; `--smooth` names a dense
one that was trained on `highlights_smooth`. `--most` limits the frames of each anatomy: the anatomies are the
independent units. Highlights are those that the detector by colour finds; of maps each fourth pixel along each axis is
judged, against the base.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.measuring import print_markdown
from simtest.calibration import Frame
from simtest.cli.progress import progress_bar
from simtest.dataset.fields import INSTRUMENT
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.scoring.dense.shading import shading_maps
from simtest.dataset.shard import Sample
from simtest.errors import Failure
from simtest.estimators import Estimate, load_estimators
from simtest.estimators.learned import normal_of
from simtest.estimators.learned_dense import LEAST_HIGHLIGHTS, LearnedDense
from simtest.estimators.learned_spot import LearnedSpot
from simtest.geometry.vectors import angle_deg, tangent_basis, tangent_coordinates
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array
from simtest.runtime.resources import data_root
from simtest.runtime.statistics import CONFIDENCE
from studies.networks.examples import DENSE_FIELDS, SPOT_FIELDS, only_glints, sample_frame, truth_at
from studies.resampling import drawn_groups, interval_of_mean

STEP = 4
CHI2_95 = chi_squared.quantile(CONFIDENCE, 2)
SEED, DRAWS = 2026, {"spots": 2000, "maps": 1000}
FAMILIES = ("colon", "stomach", "liver")
SPOT, SPOT_FINE = "learned_spot, base", "learned_spot, fine"
DENSE, SMOOTH, SHADING = "learned_dense", "learned_dense, smooth-trained", "shading"

Row = dict[str, Any]
"""One answer or pixel: its method, where it is, and its errors, deg; null where the truth or the answer is unknown."""


def main() -> None:
    """Estimate on a split and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    weights = data_root("scenes") / "learning" / "weights"
    parser.add_argument("data", type=Path)
    parser.add_argument("--spot", type=Path, default=weights / "learned_spot.onnx")
    parser.add_argument("--dense", type=Path, default=weights / "learned_dense.onnx")
    parser.add_argument("--smooth", type=Path)
    parser.add_argument("--most", type=int, default=sys.maxsize)
    parser.add_argument("--split", default="test")
    options = parser.parse_args()
    dense = {DENSE: LearnedDense(options.dense)} | ({SMOOTH: LearnedDense(options.smooth)} if options.smooth else {})
    spot: dict[str, Any] = {SPOT: LearnedSpot(options.spot, "base"), SPOT_FINE: LearnedSpot(options.spot, "fine")}
    estimators = {**load_estimators(["bisector", "cloud"]), **spot, **dense}
    spots, maps, contradictions = list[Row](), list[pl.DataFrame](), {name: list[float]() for name in dense}
    taken: Counter[tuple[int, int]] = Counter()
    total = len(sample_positions(options.data, options.split))
    fields = tuple(dict.fromkeys((*SPOT_FIELDS, *DENSE_FIELDS)))
    with progress_bar("comparing") as progress:
        for number, sample in enumerate(read_samples(options.data, options.split, fields)):
            family, anatomy = sample.meta["anatomy"]["family"], sample.meta["anatomy"]["number"]
            taken[family, anatomy] += 1
            if taken[family, anatomy] <= options.most:
                place = {"family": family, "anatomy": 10_000 * family + anatomy, "order": len(taken)}
                frame = sample_frame(sample)
                maps += _pixels(sample, frame, place, dense)
                spots += _spots(sample, frame, place, estimators, contradictions)
            progress(number + 1, total + 1, f"{options.split} split: frames")
    print(f"{sum(min(n, options.most) for n in taken.values())} frames of {len(taken)} anatomies\n")
    of_spots, of_maps = pl.DataFrame(spots, infer_schema_length=None), pl.concat(maps)
    print_markdown(_spot_table(of_spots.filter(pl.col("method").is_in(list(dense)).not_())))
    print_markdown(_spot_pairs(of_spots))
    print_markdown(_tilts(of_spots.filter(pl.col("method") == SPOT)))
    print_markdown(_map_table(of_maps))
    print_markdown(_dense_pairs(of_maps, of_spots.filter("known")))
    for name, gaps in contradictions.items():
        shares = ", ".join(f"{share:g} %: {np.percentile(gaps, share):.2f}" for share in (50, 90, 99.5) if gaps)
        print(f"`{name}`: distance from the law of reflection in {len(gaps)} frames: {shares}")


# Every pixel ---------------------------------------------------------------------------------------------------------


def _pixels(sample: Sample, frame: Frame, place: Row, dense: Mapping[str, LearnedDense]) -> Iterator[pl.DataFrame]:
    """Yield the errors of each map of a frame at each `STEP`-th pixel."""
    camera = frame.camera
    points = camera.pixel_centres()[STEP // 2 :: STEP, STEP // 2 :: STEP].reshape(-1, 2)
    turn, distance = truth_at(sample, camera, points)
    known = np.isfinite(distance)
    points = points[known]
    normal = normal_of(camera.unproject(points), turn.T[known])

    def rows(name: str, error: Array, inside: Array | None) -> pl.DataFrame:
        numbers = sample.index * camera.width * camera.height + np.arange(len(error))
        known = {"method": name, **place, "point": numbers, "error": error, "inside": inside}
        return pl.DataFrame(known, schema_overrides={"inside": pl.Float64}).filter(pl.col("error").is_finite())

    for name, estimator in dense.items():
        stated = estimator.stated(frame, points)
        if not isinstance(stated, Failure):
            yield rows(name, angle_deg(stated[0], normal), _inside(stated[0], normal, stated[1]))
    shaded, _ = shading_maps(frame.encoded, frame.calibration)
    yield rows(SHADING, angle_deg(shaded[points[:, 1].astype(int), points[:, 0].astype(int)], normal), None)


def _inside(made: Array, normal: Array, covariance: Array) -> Array:
    """Return whether true normals lie inside the 95 % ellipses."""
    across = np.einsum("nij,nj->ni", np.stack(tangent_basis(made), axis=1), normal)
    sine = np.linalg.norm(across, axis=1)
    off = across * (np.arctan2(sine, np.sum(made * normal, axis=1)) / np.maximum(sine, 1e-12))[:, None]
    distance = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return np.asarray(distance <= CHI2_95, dtype=float)


# Highlights ----------------------------------------------------------------------------------------------------------


def _spots(
    sample: Sample, frame: Frame, place: Row, estimators: Mapping[str, Any], contradictions: Mapping[str, list[float]]
) -> Iterator[Row]:
    """Yield the answers at the highlights of a frame, and add how far the dense networks' normals contradict them."""
    found = reconstruct(
        frame.encoded, frame.calibration, estimators, smoothing_px=frame.smoothing_px, detector="colour"
    )
    single = [each for each in found if not isinstance(each.patch, Failure)]
    peaks = np.array([each.patch.peak_px for each in single if not isinstance(each.patch, Failure)]).reshape(-1, 2)
    for name, gaps in contradictions.items() if len(peaks) >= LEAST_HIGHLIGHTS else ():
        told = estimators[name].contradictions(frame, np.array(peaks, dtype=float))
        gaps += [] if isinstance(told, Failure) else [float(told.mean()) / 2]
    glints, answered = dict(only_glints(sample, peaks)), []
    for number, (each, peak) in enumerate(zip(single, peaks, strict=True)):
        fine = np.array(sample.meta["highlights"][glints[number]]["normal"]) if number in glints else None
        base, towards = _base(sample, peak), -frame.camera.unproject(peak[None])[0]
        tilt = None if base is None else float(angle_deg(base, towards))
        for name, result in each.estimates.items():
            yield _row(name, sample.index, number, place, result, {"base": base, "fine": fine}) | {"tilt": tilt}
        if isinstance(each.estimates[SPOT], Estimate):
            answered.append((number, peak))
    for each in found:
        cloud = each.estimates.get("cloud")
        if isinstance(cloud, Estimate) and answered:
            gaps = [float(np.hypot(*(peak - cloud.look_px))) for _, peak in answered]
            near = answered[int(np.argmin(gaps))][0]
            yield _row("cloud", sample.index, near, place, cloud, {"base": _base(sample, cloud.look_px)})


def _base(sample: Sample, point: Array) -> Array | None:
    """Return the base's normal at the pixel of a point; None off the tissue."""
    height, width = sample.images["depth"].shape
    column, row = int(point[0]), int(point[1])
    if not (0 <= column < width and 0 <= row < height) or sample.images[INSTRUMENT][row, column]:
        return None
    normal = sample.images["normal_base"][row, column].astype(float)
    return normal / np.linalg.norm(normal) if np.isfinite(normal).all() else None


def _row(
    name: str, index: int, number: int, place: Row, result: Estimate | Failure, truths: Mapping[str, Array | None]
) -> Row:
    """Return an answer's errors against the base and the fine surface, and whether its ellipse holds its own truth."""
    row = {"method": name, **place, "spot": 100_000 * index + number, "known": truths["base"] is not None,
           "answered": isinstance(result, Estimate), "base": None, "fine": None, "inside": None}  # fmt: skip
    if isinstance(result, Failure):
        return row
    off = {key: tangent_coordinates(result.normal, truth) for key, truth in truths.items() if truth is not None}
    row |= {key: float(np.degrees(np.hypot(*each))) for key, each in off.items()}
    if result.covariance is not None and result.target in off:
        own = off[result.target]
        row["inside"] = float(own @ np.linalg.solve(result.covariance, own) <= CHI2_95)
    return row


# Tables --------------------------------------------------------------------------------------------------------------


def _by_organ(rows: pl.DataFrame) -> Iterator[tuple[str, str, pl.DataFrame]]:
    """Yield method, organ and rows: of all organs, and of each."""
    for (name,), own in rows.group_by("method", maintain_order=True):
        yield str(name), "all", own
        for family, organ in enumerate(FAMILIES):
            yield str(name), organ, own.filter(pl.col("family") == family)


def _spot_table(rows: pl.DataFrame) -> list[list[str]]:
    table = [["estimator", "organ", "detections", "answered", "base: median, deg", "95 % below",
              "fine: median, deg (n)", "95 % below", "inside its 95 % ellipse"]]  # fmt: skip
    for name, organ, own in _by_organ(rows.filter("known")):
        ok = own.filter("answered")
        if ok.height:
            fine = ok["fine"].drop_nulls()
            table.append([f"`{name}`", organ, str(own.height), str(ok.height), _median(ok["base"]), _p95(ok["base"]),
                          f"{_median(fine)} ({len(fine)})", _p95(fine), _mean(ok["inside"])])  # fmt: skip
    return table


def _tilts(rows: pl.DataFrame) -> list[list[str]]:
    """Return the table of a network's answers by the angle of the base's normal with the direction to the camera."""
    table = [["base tilted by, deg", "n", "base: median, deg", "inside its 95 % ellipse"]]
    for low, high in ((0, 10), (10, 20), (20, 90)):
        own = rows.filter(pl.col("tilt") >= low, pl.col("tilt") < high)
        table.append([f"{low} to {high}", str(own.height), _median(own["base"]), _mean(own["inside"])])
    return table


def _map_table(rows: pl.DataFrame) -> list[list[str]]:
    table = [["each pixel: method", "organ", "n", "median, deg", "95 % below", "inside its 95 % ellipse"]]
    for name, organ, own in _by_organ(rows):
        if own.height:
            low, high = _median_interval([part["error"].to_numpy() for part in own.partition_by("order")])
            median = f"{_median(own['error'])} ({low:.2f} to {high:.2f})"
            below = f"{np.percentile(own['error'].to_numpy(), 95):.1f}"
            table.append([f"`{name}`", organ, str(own.height), median, below, _mean(own["inside"])])
    return table


def _spot_pairs(rows: pl.DataFrame) -> list[list[str]]:
    """Return the differences of `learned_spot` from the others where both answered, with intervals over anatomies."""
    table = [["pair", "truth", "n", "anatomies", "mean difference, deg", "95 % interval", "medians, deg"]]
    for one, other, key in ((SPOT, "bisector", "base"), (SPOT, "cloud", "base"), (SPOT_FINE, "bisector", "fine")):
        both = _pair(rows.filter("known"), one, other, "spot", key)
        medians = f"{_median(both[key])} and {_median(both[f'{key}_right'])}"
        figures = _difference(both, key, "anatomy", DRAWS["spots"])
        table.append([f"`{one}` - `{other}`", key, *figures, medians])
    return table


def _dense_pairs(maps: pl.DataFrame, spots: pl.DataFrame) -> list[list[str]]:
    """Return the differences of `learned_dense` from the others."""
    table = [["pair", "n", "anatomies", "mean difference, deg", "95 % interval"]]
    for place, rows, key, column, others in (
        ("each pixel", maps, "point", "error", (SMOOTH, SHADING)),
        ("highlights", spots, "spot", "base", ("bisector", SPOT, SMOOTH)),
    ):
        for other in others:
            both = _pair(rows, DENSE, other, key, column)
            if both.height:
                table.append([f"{place}: {DENSE} - {other}", *_difference(both, column, "order", DRAWS["maps"])])
    return table


def _pair(rows: pl.DataFrame, one: str, other: str, key: str, column: str) -> pl.DataFrame:
    first, second = (rows.filter(pl.col("method") == name, pl.col(column).is_not_null()) for name in (one, other))
    return first.join(second, on=key, maintain_order="right")


def _difference(both: pl.DataFrame, column: str, group: str, draws: int) -> list[str]:
    """Return number, groups, mean difference and its interval."""
    if not both.height:
        return ["0", "0", "none", "none"]
    values = (both[column] - both[f"{column}_right"]).to_numpy()
    low, high = interval_of_mean(values, both[group].to_numpy(), draws, SEED)
    interval = f"{low:+.2f} to {high:+.2f}"
    return [str(len(values)), str(both[group].n_unique()), f"{values.mean():+.2f}", interval]


def _median(values: pl.Series) -> str:
    return f"{values.median():.2f}" if values.count() else "none"


def _p95(values: pl.Series) -> str:
    return f"{np.percentile(values.drop_nulls().to_numpy(), 95):.2f}" if values.count() else "none"


def _mean(values: pl.Series) -> str:
    return f"{values.mean():.3f}" if values.count() else "none"


def _median_interval(groups: list[Array]) -> tuple[float, float]:
    """Return the 95 % interval of the median by bootstrap over groups, from histograms of 2000 bins."""
    edges = np.linspace(0, max(float(group.max()) for group in groups) + 1e-6, 2001)
    counts = np.array([np.histogram(group, edges)[0] for group in groups])
    drawn = counts[drawn_groups(len(counts), DRAWS["maps"], SEED)].sum(axis=1).cumsum(axis=1)
    low, high = np.percentile(edges[(drawn < drawn[:, -1:] / 2).sum(axis=1) + 1], [2.5, 97.5])
    return float(low), float(high)


if __name__ == "__main__":
    main()
