"""What summary.json says of a run beside how it was made: figures, faults, and what is known of its meshes.

A refusal is an answer of a method; a fault is a mistake in its code, or the end of its process. Results count both as
failures. Faults are told apart here, so that nobody takes a bug for a refusal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
from pydantic import BaseModel, ValidationError

from simtest.errors import FAULTS, InputError
from simtest.estimators.names import describe_estimators
from simtest.runtime import provenance
from simtest.runtime.files import write_json, write_parquet
from simtest.spec import Experiment
from simtest.validation.cases import Case
from simtest.validation.mesh_verdicts import MeshVerdict, mesh_verdicts
from simtest.validation.run_folder import RESULTS, SUMMARY
from simtest.validation.runner import RunRecord
from simtest.validation.situations import SceneRealism, conditions_of, realism_of
from simtest.validation.statistics import Figures, summarise

MOST_TEXTS = 5
"""Different texts of one estimator that are listed; a number within the text may make every one of them new."""

MOST_CHARACTERS = 300
"""Of a text that is listed."""


class Fault(BaseModel):
    """An error of an estimator or a core: its text, and the number of its rows."""

    estimator: str
    reason: str
    text: str
    count: int

    def __str__(self) -> str:
        """Return it in words: ``moment: ValueError: my bug (my_core.py:11), 29 times``.

        An exception of the estimator names itself; the other reasons stand before their text.
        """
        named = "" if self.reason in ("", "estimator_error") else self.reason
        told = ": ".join(part for part in (self.estimator, named, self.text or self.reason) if part)
        return f"{told}, {'once' if self.count == 1 else f'{self.count} times'}"


def faults_of(results: pl.DataFrame) -> list[Fault]:
    """List the faults of a run by estimator, reason and text, from the rows of results.parquet.

    The most frequent text comes first for each estimator. Beyond `MOST_TEXTS` the rest of an estimator's texts is one
    entry, without a reason.
    """
    if not {"estimator", "status"} <= set(results.columns):
        return []
    text = pl.col("flags").cast(pl.String) if "flags" in results.columns else pl.lit(None, pl.String)
    found = results.filter(pl.col("status").is_in(list(map(str, FAULTS)))).with_columns(text=_one_line(text))
    counts = found.group_by("estimator", reason="status", text="text", maintain_order=True).agg(count=pl.len())
    listed: list[Fault] = []
    for (name,), own in counts.group_by("estimator", maintain_order=True):
        ranked = own.sort("count", descending=True, maintain_order=True)
        listed += [Fault(**each) for each in ranked.head(MOST_TEXTS).iter_rows(named=True)]
        if rest := ranked[MOST_TEXTS:].height:
            told = f"{rest} other texts; column flags of results.parquet holds them"
            listed.append(Fault(estimator=str(name), reason="", text=told, count=ranked[MOST_TEXTS:]["count"].sum()))
    return listed


def _one_line(text: pl.Expr) -> pl.Expr:
    return text.fill_null("").str.replace_all(r"\s+", " ").str.strip_chars().str.slice(0, MOST_CHARACTERS)


class ExperimentSummary(BaseModel):
    """What summary.json says of an experiment, or of a scored dataset: figures, and what they stand for."""

    title: str = ""
    description: str = ""
    meshes: tuple[MeshVerdict, ...] = ()
    realism: tuple[SceneRealism, ...] = ()
    estimators: dict[str, str] = {}  # what each does, in one line
    conditions: dict[str, dict[str, Any]] = {}  # by setting
    frames: int | None = None  # of all settings, with or without a highlight
    faults: tuple[Fault, ...] = ()
    settings: dict[str, dict[str, Figures]] = {}  # by setting and estimator

    @property
    def rows(self) -> list[tuple[str, str, Figures]]:
        """Setting, estimator and figures."""
        return [
            (setting, estimator, figures)
            for setting, by_estimator in self.settings.items()
            for estimator, figures in by_estimator.items()
        ]


class RunSummary(BaseModel):
    """The content of summary.json; `run` says how the run was made."""

    run: dict[str, Any]
    experiments: dict[str, ExperimentSummary]


def summarise_run(
    experiment: Experiment, cases: Sequence[Case], results: pl.DataFrame, estimators: Mapping[str, str] | None = None
) -> ExperimentSummary:
    """Sum up a run; `estimators` describes what answered, where it is not the experiment's own estimators."""
    return ExperimentSummary(
        title=experiment.title or experiment.name,
        description=experiment.description,
        meshes=tuple(mesh_verdicts(experiment)),
        realism=tuple(realism_of(cases)),
        estimators={**(describe_estimators(experiment.estimators) if estimators is None else estimators)},
        conditions={setting: found.to_json() for setting, found in conditions_of(cases).items()},
        frames=sum(case.realisations for case in cases),
        faults=tuple(faults_of(results)),
        settings=summarise(results),
    )


def write_results(
    folder: Path, record: RunRecord, results: pl.DataFrame, name: str, summary: ExperimentSummary
) -> None:
    """Write results.parquet, and summary.json with how the run was made; `name` is the experiment's."""
    write_parquet(folder / RESULTS, results)
    record = replace(record, results=provenance.file_hash(folder / RESULTS))
    content = RunSummary(run=record.to_json(), experiments={name: summary})
    # What a scored dataset does not state is left out.
    write_json(folder / SUMMARY, content.model_dump(mode="json", exclude_unset=True))


def read_summary(folder: Path) -> RunSummary:
    """Read summary.json of a run folder; raises `InputError` where it is missing or malformed."""
    path = folder / SUMMARY
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run directory has {RESULTS} and {SUMMARY}")
    try:
        return RunSummary.model_validate_json(path.read_bytes())
    except ValidationError as error:
        what = error.errors()[0]
        where = ".".join(str(part) for part in what["loc"])
        raise InputError(
            f"{path}: not readable JSON of a run ({where + ': ' if where else ''}{what['msg']})"
        ) from error
