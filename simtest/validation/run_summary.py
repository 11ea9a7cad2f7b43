"""What summary.json says of a run beside how it was made."""

from collections.abc import Sequence

import polars as pl

from simtest.estimators.descriptions import describe_estimators
from simtest.runtime.files import Json
from simtest.spec import Experiment
from simtest.validation.cases import Case
from simtest.validation.conditions import conditions_of
from simtest.validation.mesh_verdicts import mesh_verdicts
from simtest.validation.realism import realism_of
from simtest.validation.statistics import summarise


def run_summary(experiment: Experiment, cases: Sequence[Case], results: pl.DataFrame) -> dict[str, Json]:
    """Return the content of summary.json under ``experiments``: figures by setting, and what they stand for."""
    settings: dict[str, Json] = {
        setting: {estimator: figures.to_json() for estimator, figures in by_estimator.items()}
        for setting, by_estimator in summarise(results).items()
    }
    content: Json = {
        "title": experiment.title or experiment.name,
        "description": experiment.description,
        "meshes": [verdict.to_json() for verdict in mesh_verdicts(experiment)],
        "realism": realism_of(cases),
        "estimators": {**describe_estimators(experiment.estimators)},
        "conditions": {setting: found.to_json() for setting, found in conditions_of(cases).items()},
        "settings": settings,
    }
    return {"experiments": {experiment.name: content}}
