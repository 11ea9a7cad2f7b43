"""Compare a network of the task `spot_normals` with `bisector` and `cloud` on anatomies that it has not seen.

simtest dataset highlights --out data/highlights
python -m studies.networks learned_spot data/highlights models/spots/model.onnx
python -m studies.learned_spots data/highlights models/spots/model.onnx

A third argument limits the frames of each anatomy: the anatomies are the independent units. A fourth names the split,
default test.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtest.cli.progress import progress_bar
from simtest.dataset.fields import INSTRUMENT
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.shard import Sample
from simtest.errors import Failure
from simtest.estimators import Estimate, load_estimators
from simtest.estimators.learned_spot import LearnedSpot
from simtest.geometry.vectors import angle_deg, tangent_coordinates
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array
from simtest.runtime.statistics import CONFIDENCE, NORMAL_QUANTILE
from studies.networks.examples import NEAR_PX, SPOT_FIELDS, only_glints, sample_frame
from studies.resampling import interval_of_mean

CHI2_95 = chi_squared.quantile(CONFIDENCE, 2)
SEED, DRAWS = 2026, 2000
FAMILIES = ("colon", "stomach", "liver")


@dataclass
class Row:
    """One estimate; NaN where there is no truth.

    Errors and stated deviation, deg; squared Mahalanobis distance; whether the base's axis ratio lies within 1.96
    deviations; where it comes from; whether the detection shows glints or near misses alone; angle between the base's
    normal and the direction to the camera.
    """

    estimator: str
    spot: tuple[int, int]
    family: int
    anatomy: int
    base_deg: float = np.nan
    fine_deg: float = np.nan
    distance2: float = np.nan
    stated_deg: float = np.nan
    ratio_inside: float = np.nan
    status: str = "ok"
    kind: str = ""
    tilt_deg: float = np.nan


def main() -> None:
    """Estimate on the test split, print the tables."""
    folder, model = Path(sys.argv[1]), sys.argv[2]
    most = int(sys.argv[3]) if len(sys.argv) > 3 else sys.maxsize
    split = sys.argv[4] if len(sys.argv) > 4 else "test"
    estimators = {
        **load_estimators(["bisector", "cloud"]),
        "learned_spot, base": LearnedSpot(model, "base"),
        "learned_spot, fine": LearnedSpot(model, "fine"),
    }
    rows: list[Row] = []
    taken: Counter[tuple[int, int]] = Counter()
    total = len(sample_positions(folder, split))
    with progress_bar("comparing") as progress:
        for number, sample in enumerate(read_samples(folder, split, SPOT_FIELDS)):
            anatomy = (sample.meta["anatomy"]["family"], sample.meta["anatomy"]["number"])
            taken[anatomy] += 1
            if taken[anatomy] <= most:
                rows += _rows(sample, estimators)
            progress(number + 1, total + 1, f"{split} split: frames")
    print(f"{sum(min(count, most) for count in taken.values())} frames of {len(taken)} anatomies\n")
    print("\n".join(_table(rows)))
    print()
    print("\n".join(_pairs(rows)))
    print()
    print("\n".join(_fifths([row for row in rows if row.estimator == "learned_spot, base" and row.status == "ok"])))
    ratios = _known([row for row in rows if row.estimator == "learned_spot, base"], lambda row: row.ratio_inside)
    print(f"\naxis ratio of the base within 1.96 stated deviations: {ratios.mean():.3f} of {len(ratios)}")


def _rows(sample: Sample, estimators: dict[str, object]) -> Iterator[Row]:
    """Yield the estimates at the highlights of a sample that the detector by colour finds."""
    frame, anatomy = sample_frame(sample), sample.meta["anatomy"]
    found = reconstruct(  # type: ignore[arg-type]
        frame.encoded, frame.calibration, estimators, smoothing_px=frame.smoothing_px, detector="colour"
    )
    single = [each for each in found if not isinstance(each.patch, Failure)]
    peaks = np.array([each.patch.peak_px for each in single if not isinstance(each.patch, Failure)]).reshape(-1, 2)
    glints, kinds = dict(only_glints(sample, peaks)), _kinds(sample, peaks)
    for number, (each, peak) in enumerate(zip(single, peaks, strict=True)):
        base = _base(sample, peak)
        fine = np.array(sample.meta["highlights"][glints[number]]["normal"]) if number in glints else None
        if base is None:
            continue
        for name, result in each.estimates.items():
            row = Row(name, (sample.index, number), anatomy["family"], anatomy["number"], kind=kinds[number])
            row.tilt_deg = float(angle_deg(base, -frame.camera.unproject(peak[None])[0]))
            if isinstance(result, Estimate) and result.axis_ratio_deviation and result.target == "base":
                off = abs((result.axis_ratio or np.nan) - _base_ratio(sample, peak))
                row.ratio_inside = (
                    float(off <= NORMAL_QUANTILE * result.axis_ratio_deviation) if np.isfinite(off) else np.nan
                )
            yield _scored(row, result, base, fine)
    answered = [
        (n, p) for n, p in enumerate(peaks) if isinstance(single[n].estimates.get("learned_spot, base"), Estimate)
    ]
    for each in found:
        for result in each.estimates.values():
            if isinstance(result, Estimate) and result.cloud is not None and answered:
                base = _base(sample, result.look_px)
                near = min(answered, key=lambda found: float(np.hypot(*(found[1] - result.look_px))))[0]
                if base is not None:
                    yield _scored(
                        Row("cloud", (sample.index, near), anatomy["family"], anatomy["number"]), result, base, None
                    )


def _base(sample: Sample, point: Array) -> Array | None:
    """Return the base's normal at a pixel; None off the tissue."""
    height, width = sample.images["depth"].shape
    column, row = int(point[0]), int(point[1])
    if not (0 <= column < width and 0 <= row < height) or sample.images[INSTRUMENT][row, column]:
        return None
    normal = sample.images["normal_base"][row, column].astype(float)
    return normal / np.linalg.norm(normal) if np.isfinite(normal).all() else None


def _base_ratio(sample: Sample, point: Array) -> float:
    """Return abs(1 + d k) of the smaller over that of the larger, of the base at a pixel."""
    column, row = int(point[0]), int(point[1])
    gains = np.abs(1 + sample.images["depth"][row, column] * sample.images["curvature_base"][row, column].astype(float))
    return float(gains.min() / gains.max()) if gains.max() > 0 else np.nan


def _kinds(sample: Sample, peaks: Array) -> list[str]:
    """Return for each detection whether the visible highlight that it shows holds glints or near misses alone."""
    visible = sample.meta.get("visible_highlights", [])
    positions = np.array([spot["peak_px"] for spot in visible], dtype=float).reshape(-1, 2)
    kinds = []
    for peak in peaks:
        gaps = np.hypot(*(positions - peak).T)
        near = len(gaps) and gaps.min() <= NEAR_PX
        kinds.append(("glints" if visible[int(gaps.argmin())]["glints"] else "near misses") if near else "none near")
    return kinds


def _scored(row: Row, result: Estimate | Failure, base: Array, fine: Array | None) -> Row:
    if isinstance(result, Failure):
        row.status = result.reason.value
        return row
    off = {"base": tangent_coordinates(result.normal, base)}
    if fine is not None:
        off["fine"] = tangent_coordinates(result.normal, fine)
        row.fine_deg = float(np.degrees(np.hypot(*off["fine"])))
    row.stated_deg = result.deviation_deg or np.nan
    row.base_deg = float(np.degrees(np.hypot(*off["base"])))
    if result.covariance is not None and result.target in off:
        own = off[result.target]
        row.distance2 = float(own @ np.linalg.solve(result.covariance, own))
    return row


def _table(rows: list[Row]) -> Iterator[str]:
    """Yield the table of each estimator over each organ."""
    heads = ("estimator", "organ", "detections", "answered", "base: median, deg", "95 % below",
             "fine: median, deg (n)", "95 % below", "inside its 95 % ellipse")  # fmt: skip
    yield f"| {' | '.join(heads)} |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for name in dict.fromkeys(row.estimator for row in rows):
        for family in (None, 0, 1, 2):
            own = [row for row in rows if row.estimator == name and family in (None, row.family)]
            ok = [row for row in own if row.status == "ok"]
            if not ok:
                continue
            base, fine, distance = (
                _known(ok, lambda row, key=key: getattr(row, key)) for key in ("base_deg", "fine_deg", "distance2")
            )
            organ = "all" if family is None else FAMILIES[family]
            inside = f"{np.mean(distance <= CHI2_95):.3f}" if len(distance) else "none"
            cells = (name, organ, len(own), len(ok), _median(base), _p95(base), f"{_median(fine)} ({len(fine)})",
                     _p95(fine), inside)  # fmt: skip
            yield f"| {' | '.join(map(str, cells))} |"


def _fifths(rows: list[Row]) -> Iterator[str]:
    """Yield the base's errors in five groups by stated deviation, by what the detection shows, by tilt."""
    yield "| answers | n | reported deviation, deg | base: median, deg | 95 % below | inside its 95 % ellipse |"
    yield "|---|---|---|---|---|---|"
    order = np.argsort([row.stated_deg for row in rows], kind="stable")
    names = ("surest fifth", "second", "third", "fourth", "least sure fifth")
    groups = [(name, [rows[k] for k in part]) for name, part in zip(names, np.array_split(order, 5), strict=True)]
    groups += [(kind, [row for row in rows if row.kind == kind]) for kind in ("glints", "near misses", "none near")]
    for low, high in ((0, 10), (10, 20), (20, 90)):
        groups.append((f"base tilted by {low} to {high} deg", [row for row in rows if low <= row.tilt_deg < high]))
    for name, own in groups:
        base = _known(own, lambda row: row.base_deg)
        if len(base):
            stated, inside = (np.mean(_known(own, value)) for value in (lambda r: r.stated_deg, _is_inside))
            yield f"| {name} | {len(base)} | {stated:.1f} | {_median(base)} | {_p95(base)} | {inside:.3f} |"


def _is_inside(row: Row) -> float:
    return float(row.distance2 <= CHI2_95) if np.isfinite(row.distance2) else np.nan


def _known(rows: list[Row], value: Callable[[Row], float]) -> Array:
    values = np.array([value(row) for row in rows], dtype=float)
    return values[np.isfinite(values)]


def _median(values: Array) -> str:
    return f"{np.median(values):.2f}" if len(values) else "none"


def _p95(values: Array) -> str:
    return f"{np.percentile(values, 95):.2f}" if len(values) else "none"


def _pairs(rows: list[Row]) -> Iterator[str]:
    """Yield the differences of the network from the others where both answered, with intervals over anatomies."""
    yield "| pair | truth | n | anatomies | mean difference, deg | 95 % interval | median of both, deg |"
    yield "|---|---|---|---|---|---|---|"
    for one, other, key in (
        ("learned_spot, base", "bisector", "base_deg"),
        ("learned_spot, base", "cloud", "base_deg"),
        ("learned_spot, fine", "bisector", "fine_deg"),
    ):
        first = {row.spot: row for row in rows if row.estimator == one and np.isfinite(getattr(row, key))}
        pairs = [(first[row.spot], row) for row in rows if row.estimator == other and row.spot in first
                 and np.isfinite(getattr(row, key))]  # fmt: skip
        if not pairs:
            yield f"| {one} - {other} | {key[:4]} | 0 | 0 | none | none | none |"
            continue
        values = np.array([[getattr(row, key) for row in pair] for pair in pairs])
        groups = np.array([10_000 * pair[1].family + pair[1].anatomy for pair in pairs])
        low, high = interval_of_mean(values[:, 0] - values[:, 1], groups, DRAWS, SEED)
        medians = " and ".join(f"{value:.2f}" for value in np.median(values, axis=0))
        yield (
            f"| {one} - {other} | {key[:4]} | {len(pairs)} | {len(set(groups.tolist()))} | "
            f"{np.mean(values[:, 0] - values[:, 1]):+.2f} | {low:+.2f} to {high:+.2f} | {medians} |"
        )


if __name__ == "__main__":
    main()
