"""The dense part: its frames for methods that run elsewhere, and the figures of their maps."""

from collections.abc import Mapping
from pathlib import Path

from simtest.bench.draws import experiment_of
from simtest.bench.suite import Layout, Suite, digest_of, layout_of
from simtest.bench.uncertainty import UNTESTED, UncertaintyScore
from simtest.dataset.export import check_exportable, export_run
from simtest.dataset.scoring.dense.conventions import MapOptions
from simtest.dataset.scoring.dense.map_files import find_maps
from simtest.dataset.scoring.dense.score import DenseScore, score_maps
from simtest.dataset.scoring.dense.scorer import ANGLE, NORMAL, depth_source
from simtest.dataset.scoring.record import read_record
from simtest.errors import InputError
from simtest.runtime import provenance
from simtest.runtime.files import Json, JsonObject
from simtest.runtime.processes import Engine, make_engine
from simtest.validation.runner import Progress, run_experiments

PART = "dense"
RUN, FRAMES, SCORES = "run", "frames", "scores"
"""Folders: of the part's run, of its frames without truth, and of the figures of maps."""

SHADING = "shading"
"""The method that needs no maps from elsewhere."""

MAPS, BASELINE = "maps", "baseline"
"""Kinds of cores: a folder of maps, and the method above."""

STATED = ("encoding", "frame", "depth", "unit_mm")
"""Options that say how maps are read, in the order of `MapOptions`."""

OF_RUN = "brightest_point"
"""The quickest estimator: the run is there for its frames."""


def export_frames(suite: Suite, folder: Path, engine: Engine | None = None, progress: Progress | None = None) -> Path:
    """Write the frames of the dense part without their truth; return their folder."""
    experiment = experiment_of(suite, PART, OF_RUN)
    check_exportable(experiment)
    chosen = engine or make_engine()
    (run,) = run_experiments([(experiment, folder / RUN)], "", None, progress, chosen)
    export_run(run.folder, experiment, folder / FRAMES, chosen, progress)
    return folder / FRAMES


def score_dense(
    suite: Suite, maps: str | Path, folder: Path, options: MapOptions | None = None,
    engine: Engine | None = None, progress: Progress | None = None,
) -> tuple[DenseScore, JsonObject]:  # fmt: skip
    """Score maps on the frames of the dense part; return the whole score, and the part's figures for a certificate.

    Parameters
    ----------
    suite, engine, progress
        As of `simtest.bench.run.run_bench`.
    maps : str or Path
        Folder of the maps, each called as its frame, or "shading".
    folder : Path
        Gets the run, the frames and the scores, a folder each.
    options : MapOptions, optional
        What is stated of the maps.
    """
    export_frames(suite, folder, engine, progress)

    def tell(done: int, total: int, what: str) -> None:
        if progress:
            progress(done, total, f"scoring {what}")

    score = score_maps(maps, folder / RUN, folder / SCORES, options, "", tell)
    numbers = {use.frame: use.realisation for use in read_record(folder / RUN).uses}
    return score, dense_figures(score, layout_of(suite, PART), numbers) | {"stated": stated_record(options)}


def dense_figures(score: DenseScore, layout: Layout, numbers: Mapping[str, int]) -> JsonObject:
    """Return a part's figures of the angles at all scored pixels, in the form of other parts, and those by zone.

    They are of normal maps where there are any, else of depth maps after an affine alignment. The score counts 90 deg
    for a pixel without a value.
    """
    sources = sorted({key[0] for key, _ in score.scorer.cells()})
    if not sources:
        raise InputError(f"maps {score.name}: hold neither normals nor depths")
    source = NORMAL if NORMAL in sources else depth_source("affine")
    zones = {
        label: _zone(score, source, label) for label in ("all", "highlight", "ring_1", "ring_2", "ring_4", "elsewhere")
    }
    every, rows = zones["all"], [_plain(row) for row in score.scorer.rows if row["group"] == "zone"]
    told = [line for line in score.lines if line.startswith(("normals:", "depths:"))]
    nothing = UncertaintyScore(0, None, None, UNTESTED, None, None, None)
    return {
        "n": every["n"], "answered": every["n"] - every["n_unanswered"], "missed": 0, "false": 0,
        "refused": {"no_value": every["n_unanswered"]} if every["n_unanswered"] else {},
        "median_deg": every["median_deg"], "median_interval": every["median_interval"], "mean_deg": every["mean_deg"],
        "p95_deg": every["p95_deg"], "score_deg": every["penalised_deg"],
        "score_interval": every["penalised_interval"], "scenes": _scene_sums(score, source, layout, numbers),
        "uncertainty": nothing.to_json(),
        "results": digest_of(rows), "source": source, "zones": zones, "conventions": told,
    }  # fmt: skip


def _scene_sums(score: DenseScore, source: str, layout: Layout, numbers: Mapping[str, int]) -> JsonObject:
    """Return by case, for each scene, its number of pixels and the sum of their errors as the score takes them.

    `numbers` are the frames' realisations by name. A frame without a surface has no row, and equal ones have one name.
    """
    sums = {case: [[0, 0.0] for _ in range(scenes)] for case, (scenes, _) in layout.items()}
    for row in score.scorer.rows:
        if (row["source"], row["quantity"], row["surface"], row["group"], row["label"]) == (
            source, ANGLE, "fine", "zone", "all",
        ):  # fmt: skip
            case = row["setting"]
            scene = sums[case][numbers[row["frame"]] // layout[case][1]]
            scene[0] += row["n"]
            scene[1] += row["n"] * row["mean_penalised"]
    held: JsonObject = dict(sums)
    return held


def stated_record(options: MapOptions | None) -> JsonObject:
    """Return what was stated of the maps, null where it was found out."""
    stated = vars(options or MapOptions())
    return {key: stated[key] for key in STATED}


def _zone(score: DenseScore, source: str, label: str) -> JsonObject:
    found = score.cell(source, "fine", label)
    intervals = found["ci95"]
    return {
        "n": found["n"], "n_unanswered": found["n_unanswered"], "mean_deg": found["mean"],
        "median_deg": found["median"], "median_interval": intervals.get("median"), "p95_deg": found["p95"],
        "penalised_deg": found["mean_penalised"], "penalised_interval": intervals.get("mean_penalised"),
    }  # fmt: skip


def _plain(row: JsonObject) -> Json:
    """Return a row as it is hashed: numbers as they are, what is not finite as null."""
    return {key: None if isinstance(value, float) and value != value else value for key, value in row.items()}


def maps_record(maps: str | Path, score: DenseScore) -> JsonObject:
    """Return what a certificate tells of maps: the method's name, and the hash of the maps by their place and name."""
    if not Path(maps).exists():
        return {"name": score.name, "kind": BASELINE, "version": f"simtest {provenance.version()}", "sha256": None}
    files = sorted((one.path.relative_to(maps).as_posix(), one.path) for one in find_maps(Path(maps)))
    hashes: Json = [[name, provenance.file_hash(path)] for name, path in files]
    return {"name": score.name, "kind": MAPS, "version": None, "sha256": digest_of(hashes)}
