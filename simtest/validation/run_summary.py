"""What summary.json says of a run beside how it was made."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from simtest.estimators.names import describe_estimators
from simtest.runtime import provenance
from simtest.runtime.files import Json, write_atomically, write_json
from simtest.spec import Experiment
from simtest.validation.cases import Case
from simtest.validation.faults import faults_of
from simtest.validation.mesh_verdicts import mesh_verdicts
from simtest.validation.run_folder import RESULTS
from simtest.validation.runner import RunRecord
from simtest.validation.situations import conditions_of, realism_of
from simtest.validation.statistics import summarise


def run_summary(
    experiment: Experiment, cases: Sequence[Case], results: pl.DataFrame, estimators: Mapping[str, str] | None = None
) -> dict[str, Json]:
    """Return the content of summary.json under ``experiments``: figures by setting, and what they stand for.

    `estimators` describes what answered, by name, where it is not the experiment's own estimators.
    """
    content: Json = {
        "title": experiment.title or experiment.name,
        "description": experiment.description,
        "meshes": [verdict.to_json() for verdict in mesh_verdicts(experiment)],
        "realism": realism_of(cases),
        "estimators": {**(describe_estimators(experiment.estimators) if estimators is None else estimators)},
        "conditions": {setting: found.to_json() for setting, found in conditions_of(cases).items()},
        "frames": sum(case.realisations for case in cases),
        "faults": faults_of(results),
        "settings": settings_summary(results),
    }
    return {"experiments": {experiment.name: content}}


def settings_summary(results: pl.DataFrame) -> dict[str, Json]:
    """Return the figures of each setting and estimator."""
    return {
        setting: {estimator: figures.to_json() for estimator, figures in by_estimator.items()}
        for setting, by_estimator in summarise(results).items()
    }


def write_results(folder: Path, record: RunRecord, results: pl.DataFrame, summary: Mapping[str, Json]) -> None:
    """Write results.parquet, and summary.json with how the run was made."""
    write_atomically(folder / RESULTS, results.write_parquet)
    record = replace(record, results=provenance.file_hash(folder / RESULTS))
    write_json(folder / "summary.json", {"run": record.to_json(), **summary})
