"""What summary.json says of a run beside how it was made: figures, faults, and what is known of its meshes.

A refusal is an answer of a method; a fault is a mistake in its code, or the end of its process. Results count both as
failures. Faults are told apart here, so that nobody takes a bug for a refusal.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from simtest.errors import FAULTS
from simtest.estimators.names import describe_estimators
from simtest.runtime import provenance
from simtest.runtime.files import Json, JsonObject, write_atomically, write_json
from simtest.spec import Experiment
from simtest.validation.cases import Case
from simtest.validation.mesh_verdicts import mesh_verdicts
from simtest.validation.run_folder import RESULTS
from simtest.validation.runner import RunRecord
from simtest.validation.situations import conditions_of, realism_of
from simtest.validation.statistics import summarise

MOST_TEXTS = 5
"""Different texts of one estimator that are listed; a number within the text may make every one of them new."""

MOST_CHARACTERS = 300
"""Of a text that is listed."""


def faults_of(results: pl.DataFrame) -> list[JsonObject]:
    """List the faults of a run by estimator, reason and text.

    Parameters
    ----------
    results : polars.DataFrame
        Rows of results.parquet.

    Returns
    -------
    list of dict
        Of each distinct text ``estimator``, ``reason``, ``text`` and ``count``, the number of its rows; the most
        frequent first for each estimator. Beyond `MOST_TEXTS` the rest of an estimator's texts is one entry, without a
        reason.
    """
    if not {"estimator", "status"} <= set(results.columns):
        return []
    text = pl.col("flags").cast(pl.String) if "flags" in results.columns else pl.lit(None, pl.String)
    found = results.filter(pl.col("status").is_in(list(map(str, FAULTS)))).with_columns(_one_line(text).alias("_text"))
    counts = found.group_by("estimator", "status", "_text", maintain_order=True).len()
    listed: list[JsonObject] = []
    for (name,), own in counts.group_by("estimator", maintain_order=True):
        ranked = list(own.sort("len", descending=True, maintain_order=True).iter_rows())
        for _, reason, told, count in ranked[:MOST_TEXTS]:
            listed.append({"estimator": name, "reason": reason, "text": told, "count": count})
        if rest := ranked[MOST_TEXTS:]:
            told = f"{len(rest)} other texts; column flags of results.parquet holds them"
            listed.append({"estimator": name, "reason": "", "text": told, "count": sum(each[3] for each in rest)})
    return listed


def _one_line(text: pl.Expr) -> pl.Expr:
    return text.fill_null("").str.replace_all(r"\s+", " ").str.strip_chars().str.slice(0, MOST_CHARACTERS)


def fault_sentence(estimator: str, reason: str, text: str, count: int) -> str:
    """Return an entry of `faults_of` in words: ``moment: ValueError: my bug (my_core.py:11), 29 times``.

    An exception of the estimator names itself; the other reasons stand before their text.
    """
    named = "" if reason in ("", "estimator_error") else reason
    told = ": ".join(part for part in (estimator, named, text or reason) if part)
    return f"{told}, {'once' if count == 1 else f'{count} times'}"


def fault_sentences(faults: Iterable[dict[str, object]]) -> list[str]:
    """Return the faults of summary.json in words."""
    return [
        fault_sentence(str(each["estimator"]), str(each["reason"]), str(each["text"]), int(str(each["count"])))
        for each in faults
    ]


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
