"""The verdict for machines and for those who read no page: JSON, JUnit XML, Markdown, a badge."""

import math
from pathlib import Path
from typing import Any

import polars as pl

from simtest.nightly.badge import badge
from simtest.nightly.gate.records import OUTCOMES, Night, Verdict
from simtest.nightly.junit import junit
from simtest.nightly.overview import failed_canaries, headline
from simtest.nightly.summary import summary
from simtest.runtime.files import write_atomically, write_json

SCHEMA_VERSION = 1

FILES = VERDICT, JUNIT, SUMMARY, BADGE = "verdict.json", "junit.xml", "summary.md", "badge.svg"
"""What lies beside the page."""


def write_outputs(folder: Path, night: Night, verdict: Verdict) -> None:
    """Write verdict.json, junit.xml, summary.md and badge.svg; the same night gives the same bytes."""
    write_json(folder / VERDICT, verdict_data(night, verdict))
    for name, text in {
        JUNIT: junit(night, verdict), SUMMARY: summary(night, verdict), BADGE: badge(night, verdict),
    }.items():  # fmt: skip
        data = text.encode()
        write_atomically(folder / name, lambda part, data=data: part.write_bytes(data))  # type: ignore[misc]


def verdict_data(night: Night, verdict: Verdict) -> dict[str, Any]:
    """Give the content of verdict.json (docs/nightly.md)."""
    outcomes = dict(verdict.comparisons["outcome"].value_counts().iter_rows())
    canaries = night.figures.filter(pl.col("kind") == "canary")
    return {
        "schema": SCHEMA_VERSION,
        "profile": night.run["profile"],
        "state": verdict.state,
        "exit_code": 1 if verdict.state == "regression" else 0,
        "headline": headline(verdict),
        "bit_equal": verdict.bit_equal,
        "notes": list(verdict.notes),
        "run": night.run,
        "baseline": verdict.baseline,
        "counts": {outcome: outcomes.get(outcome, 0) for outcome in OUTCOMES},
        "canaries": {"n": canaries.height, "failed": _records(failed_canaries(night))},
        "costs": _records(night.figures.filter(pl.col("kind") == "cost")),
        "comparisons": _records(verdict.comparisons.filter(pl.col("outcome") != "same")),
    }


def _records(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Give a table's rows as JSON can hold them: what is empty is left out, what is not finite is text."""
    return [
        {key: _finite(value) for key, value in row.items() if value is not None} for row in table.iter_rows(named=True)
    ]


def _finite(value: Any) -> Any:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
