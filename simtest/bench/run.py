"""Runs the benchmark: each part by the ordinary runner, or maps on the dense part; then the certificate."""

import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simtest.bench.scores import (
    CAP_DEG,
    CERTIFICATE,
    FORMAT,
    KIND,
    OF_CERTIFICATE,
    UNSTATED,
    PartScore,
    ZoneScore,
    score_part,
)
from simtest.bench.suite import (
    HIGHLIGHTS,
    Layout,
    Suite,
    cases_of,
    digest_of,
    experiment_of,
    layout_of,
    parts_of_overall,
)
from simtest.dataset.export import check_exportable, export_run
from simtest.dataset.scoring.dense.maps import MapOptions, find_maps
from simtest.dataset.scoring.dense.score import DenseScore, score_maps
from simtest.dataset.scoring.dense.truth import ANGLE, NORMAL, depth_source
from simtest.dataset.scoring.frames import read_record
from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.estimators.names import ESTIMATORS, core_hashes, core_records, has_files, short_name
from simtest.estimators.process.core import INTERPRETERS, parse_core
from simtest.runtime import provenance
from simtest.runtime.files import Json, JsonObject, make_folder, write_json
from simtest.runtime.processes import Engine, make_engine
from simtest.runtime.resources import parse_model
from simtest.spec.recipes import CoreRegions
from simtest.validation.runner import Progress, run_experiments

PART = "dense"
RUN, FRAMES, SCORES = "run", "frames", "scores"
"""Folders: of the part's run, of its frames without truth, and of the figures of maps."""

STATED = ("encoding", "frame", "depth", "unit_mm")
"""Options that say how maps are read, in the order of `MapOptions`."""

OF_RUN = "brightest_point"
"""The quickest estimator: the run is there for its frames."""


@dataclass(frozen=True)
class BenchRun:
    """A finished run of the benchmark."""

    certificate: Path
    content: JsonObject  # as in the file, without its hash


def chosen_parts(suite: Suite, wanted: Sequence[str] | None) -> list[str]:
    """Return the parts that are run: those asked for, or all whose unit is the highlight.

    Raises `InputError` for a part that is unknown, named twice, or scored by maps.
    """
    if not wanted:
        return parts_of_overall(suite)
    for name in wanted:
        if suite.part(name).kind != HIGHLIGHTS:
            raise InputError(f"--part {name}: is scored by maps of normals or depths; give --maps in place of --core")
        if list(wanted).count(name) > 1:
            raise InputError(f"--part {name}: named twice")
    return [part.name for part in suite.spec.parts if part.name in wanted]


def run_bench(
    suite: Suite,
    core: str,
    folder: Path,
    parts: Sequence[str] | None = None,
    engine: Engine | None = None,
    progress: Progress | None = None,
    variant: str | None = None,
    regions: CoreRegions | None = None,
) -> BenchRun:
    """Run a core, an installed estimator or a command, on a suite and write its certificate; a stopped run goes on.

    `folder` gets a run's folder for each part, by default all that are scored by highlights, and certificate.json. The
    figures do not depend on the engine. `regions` is the core's calibration. Raises `InputError` if a part or the core
    is unknown, or the folder holds something else.
    """
    if not core.strip():
        raise InputError('--core: is empty; must be an installed estimator, or a command as in "command: ./core"')
    chosen = chosen_parts(suite, parts)
    told = core_record(core)
    if regions is not None:
        files: Json = [provenance.file_hash(Path(file)) for file in regions.files]
        told["regions"] = digest_of({**regions.model_dump(mode="json"), "files": files})
    make_folder(folder)
    scores: dict[str, JsonObject] = {}
    for part in chosen:
        experiment = experiment_of(suite, part, core).model_copy(update={"regions": regions})
        # Part by part: the colours that one part needs are not those that another is rendered in.
        (run,) = run_experiments([(experiment, folder / part)], "", variant, progress, engine)
        scores[part] = score_part(run.results, layout_of(suite, part)).to_json()
    return _certified(suite, folder, told, scores)


def run_maps(
    suite: Suite,
    maps: str | Path,
    folder: Path,
    options: MapOptions | None = None,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> BenchRun:
    """Score a method's maps on the dense part and write its certificate; see `run_bench`.

    `maps` is a folder of maps, each called as its frame (`export_frames`), or "shading".
    """
    make_folder(folder)
    own = folder / PART
    export_frames(suite, own, engine, progress)

    def tell(done: int, total: int, what: str) -> None:
        if progress:
            progress(done, total, f"scoring {what}")

    score = score_maps(maps, own / RUN, own / SCORES, options, "", tell)
    numbers = {use.frame: use.realisation for use in read_record(own / RUN).uses}
    stated = {key: getattr(options or MapOptions(), key) for key in STATED}
    figures = dense_figures(score, layout_of(suite, PART), numbers) | {"stated": stated}
    return _certified(suite, folder, maps_record(maps, score), {PART: figures})


def export_frames(suite: Suite, folder: Path, engine: Engine | None = None, progress: Progress | None = None) -> Path:
    """Write the frames of the dense part without their truth; return their folder.

    Raises `InputError` if the folder holds something else.
    """
    experiment = experiment_of(suite, PART, OF_RUN)
    check_exportable(experiment)
    chosen = engine or make_engine()
    (run,) = run_experiments([(experiment, folder / RUN)], "", None, progress, chosen)
    export_run(run.folder, experiment, folder / FRAMES, chosen, progress)
    return folder / FRAMES


def dense_figures(score: DenseScore, layout: Layout, numbers: Mapping[str, int]) -> JsonObject:
    """Return a part's figures of the angles at all scored pixels, in the form of other parts, and those by zone.

    They are of normal maps where there are any, else of depth maps after an affine alignment. The score counts 90 deg
    for a pixel without a value.
    """
    sources = sorted({key[0] for key, _ in score.cells})
    if not sources:
        raise InputError(f"maps {score.name}: hold neither normals nor depths")
    source = NORMAL if NORMAL in sources else depth_source("affine")
    zones = {
        label: _zone(score, source, label) for label in ("all", "highlight", "ring_1", "ring_2", "ring_4", "elsewhere")
    }
    every, rows = zones["all"], [_plain(row) for row in score.rows if row["group"] == "zone"]
    refused = {"no_value": every.n_unanswered} if every.n_unanswered else {}
    return PartScore(
        n=every.n, answered=every.n - every.n_unanswered, missed=0, false=0, refused=refused,
        median_deg=every.median_deg, median_interval=every.median_interval, mean_deg=every.mean_deg,
        p95_deg=every.p95_deg, score_deg=every.penalised_deg, score_interval=every.penalised_interval,
        scenes=_scene_sums(score, source, layout, numbers), uncertainty=UNSTATED, results=digest_of(rows),
        source=source, zones=zones,
        conventions=[line for line in score.lines if line.startswith(("normals:", "depths:"))],
    ).to_json()  # fmt: skip


def _scene_sums(
    score: DenseScore, source: str, layout: Layout, numbers: Mapping[str, int]
) -> dict[str, list[tuple[int, float]]]:
    """Return by case, for each scene, its number of pixels and the sum of their errors as the score takes them.

    `numbers` are the frames' realisations by name. A frame without a surface has no row, and equal ones have one name.
    """
    sums = {case: [(0, 0.0)] * scenes for case, (scenes, _) in layout.items()}
    for row in score.rows:
        if (row["source"], row["quantity"], row["surface"], row["group"], row["label"]) == (
            source, ANGLE, "fine", "zone", "all",
        ):  # fmt: skip
            case = row["setting"]
            scene = numbers[row["frame"]] // layout[case][1]
            n, total = sums[case][scene]
            sums[case][scene] = n + row["n"], total + row["n"] * row["mean_penalised"]
    return sums


def _zone(score: DenseScore, source: str, label: str) -> ZoneScore:
    found = score.cell(source, "fine", label)
    intervals = found["ci95"]
    return ZoneScore(
        n=found["n"], n_unanswered=found["n_unanswered"], mean_deg=found["mean"], median_deg=found["median"],
        median_interval=intervals.get("median"), p95_deg=found["p95"], penalised_deg=found["mean_penalised"],
        penalised_interval=intervals.get("mean_penalised"),
    )  # fmt: skip


def _plain(row: JsonObject) -> Json:
    """Return a row as it is hashed: numbers as they are, what is not finite as null."""
    return {key: None if isinstance(value, float) and value != value else value for key, value in row.items()}


def maps_record(maps: str | Path, score: DenseScore) -> JsonObject:
    """Return what a certificate tells of maps: the method's name, and the hash of the maps by their place and name."""
    if not Path(maps).exists():
        return {"name": score.name, "kind": "baseline", "version": f"simtest {provenance.version()}", "sha256": None}
    files = sorted((one.path.relative_to(maps).as_posix(), one.path) for one in find_maps(Path(maps)))
    hashes: Json = [[name, provenance.file_hash(path)] for name, path in files]
    return {"name": score.name, "kind": "maps", "version": None, "sha256": digest_of(hashes)}


def core_record(text: str) -> JsonObject:
    """Return what a certificate tells of a core, without paths; raise `InputError` if it is unknown or cannot start.

    `sha256` is of the core's own files and of the words of its command. An interpreter or another program of the
    machine, such as docker, is no part of it, since it differs from machine to machine: it stands under `program`.
    Modules that a script loads are seen only where the command or the TOML file (`core.files`) names them.
    """
    (name,) = load_estimators([text])
    if not has_files(text):
        ((_, package),) = ESTIMATORS.distributions([text]).items()
        return {"name": name, "kind": "installed", "version": package, "sha256": None}
    if parse_model(text):
        ((_, package),) = ESTIMATORS.distributions([text]).items()
        (digest,) = core_hashes([text])[text].values()
        return {"name": name, "kind": "network", "version": package, "sha256": digest}
    (record,) = core_records([text]).values()
    ((_, hashes),) = core_hashes([text]).items()
    (program, digest), *files = hashes.items()
    own = files if _is_shared(Path(program)) else [(program, digest), *files]
    # Files by name, without folders: the same core lies elsewhere on another machine.
    named: Json = sorted([Path(file).name, of_file] for file, of_file in own)
    version = record.get("version")
    return {
        "name": short_name(text), "kind": "command", "version": None if version is None else str(version),
        "sha256": digest_of({"files": named, "words": _words(parse_core(text).arguments[1:])}),
        "program": {"name": Path(program).name, "sha256": digest},
    }  # fmt: skip


def _words(arguments: Sequence[str]) -> list[str]:
    """Return the words of a command as they are on every machine: paths without their folders."""
    words = []
    for word in arguments:
        option, equals, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
        words.append(f"{option}{equals}{Path(value).name if value.startswith('/') else value}")
    return words


def _is_shared(program: Path) -> bool:
    """Return whether a program belongs to the machine, not to the core: an interpreter, or one that is on PATH."""
    found = shutil.which(program.name)
    return bool(INTERPRETERS.match(program.name)) or (found is not None and os.path.abspath(found) == str(program))


def _certified(suite: Suite, folder: Path, core: JsonObject, scores: dict[str, JsonObject]) -> BenchRun:
    """Write the certificate of a run's figures by part, and what of the machine these may depend on."""
    environment: dict[str, Any] = dict(provenance.environment())
    # The kernel says nothing of the figures, and its text may name the host.
    del environment["system"]
    content: JsonObject = {
        "kind": KIND,
        "format": FORMAT,
        "suite": {"name": suite.spec.name, "version": suite.version, "sha256": suite.digest},
        "cases": cases_of(suite, scores),
        "core": core,
        "environment": environment | {"source_sha256": provenance.source_hash()},
        "parts": scores,
        "overall": overall_of(suite, scores),
    }
    return BenchRun(write_certificate(folder, content), content)


def overall_of(suite: Suite, parts: "dict[str, JsonObject]") -> JsonObject:
    """Return the headline: the mean of the parts' scores, where every part was run.

    Its interval takes the parts as independent. `parts` holds the figures as they stand in a certificate.
    """
    wanted = parts_of_overall(suite)
    told = [parts[part] for part in wanted if part in parts]
    values = [part["score_deg"] for part in told if part["score_deg"] is not None]
    if len(values) < len(wanted):
        return {"complete": False, "score_deg": None, "score_interval": None}
    mean = sum(values) / len(values)
    spans = [part["score_interval"] for part in told if part["score_interval"] is not None]
    if len(spans) < len(wanted):
        return {"complete": True, "score_deg": mean, "score_interval": None}
    below, above = (math.hypot(*(span[i] - value for span, value in zip(spans, values, strict=True))) for i in (0, 1))
    interval = [max(mean - below / len(spans), 0.0), min(mean + above / len(spans), CAP_DEG)]
    return {"complete": True, "score_deg": mean, "score_interval": interval}


def write_certificate(folder: Path, content: JsonObject) -> Path:
    """Write a certificate into a run's folder, with the hash of its content."""
    path = folder / CERTIFICATE
    plain = json.loads(json.dumps(content, allow_nan=False))
    write_json(path, {**plain, OF_CERTIFICATE: digest_of(plain)})
    return path
