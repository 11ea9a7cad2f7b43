"""Runs the benchmark: each part by the ordinary runner, then the figures and the certificate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from simtest.bench.certificate import FORMAT, KIND, cases_of, environment, suite_record, write_certificate
from simtest.bench.cores import check_core, core_record
from simtest.bench.draws import experiment_of
from simtest.bench.ranking import CAP_DEG
from simtest.bench.scores import score_part
from simtest.bench.suite import Suite, layout_of
from simtest.errors import InputError
from simtest.runtime.files import JsonObject, make_folder
from simtest.runtime.processes import Engine
from simtest.validation.runner import Progress, run_experiments

if TYPE_CHECKING:
    from simtest.dataset.scoring.dense.conventions import MapOptions

HIGHLIGHTS = "highlights"


@dataclass(frozen=True)
class BenchRun:
    """A finished run of the benchmark.

    Parameters
    ----------
    certificate : Path
        Its file.
    content : dict
        As in the file, without its hash.
    """

    certificate: Path
    content: JsonObject


def parts_of_overall(suite: Suite) -> list[str]:
    """Return the parts whose scores make the headline: those whose unit is the highlight."""
    return [part.name for part in suite.spec.parts if part.kind == HIGHLIGHTS]


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
) -> BenchRun:
    """Run a core on a suite and write its certificate; a stopped run goes on.

    Parameters
    ----------
    suite : Suite
        What to run.
    core : str
        An installed estimator, or a command.
    folder : Path
        Gets a run's folder for each part, and certificate.json.
    parts : sequence of str, optional
        Default all that are scored by highlights.
    engine, progress, variant
        See `simtest.validate`. The figures do not depend on the engine.
    """
    check_core(core)
    chosen = chosen_parts(suite, parts)
    told = core_record(core)
    make_folder(folder)
    scores: dict[str, JsonObject] = {}
    for part in chosen:
        experiment = experiment_of(suite, part, core)
        # Part by part: the colours that one part needs are not those that another is rendered in.
        (run,) = run_experiments([(experiment, folder / part)], "", variant, progress, engine)
        scores[part] = score_part(run.results, layout_of(suite, part)).to_json()
    return _certified(suite, folder, told, scores)


def run_maps(
    suite: Suite,
    maps: str | Path,
    folder: Path,
    options: "MapOptions | None" = None,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> BenchRun:
    """Score a method's maps on the dense part and write its certificate; see `run_bench`.

    `maps` is a folder of maps, each called as its frame (`simtest.bench.maps.export_frames`), or "shading".
    """
    from simtest.bench.maps import PART, maps_record, score_dense

    make_folder(folder)
    score, figures = score_dense(suite, maps, folder / PART, options, engine, progress)
    return _certified(suite, folder, maps_record(maps, score), {PART: figures})


def _certified(suite: Suite, folder: Path, core: JsonObject, scores: dict[str, JsonObject]) -> BenchRun:
    """Write the certificate of a run's figures by part."""
    content: JsonObject = {
        "kind": KIND,
        "format": FORMAT,
        "suite": suite_record(suite),
        "cases": cases_of(suite, scores),
        "core": core,
        "environment": environment(),
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
