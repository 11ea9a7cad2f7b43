"""The verdict without the page: JSON and Markdown (docs/howto/run_in_ci.md)."""

import math
from pathlib import Path
from typing import Any

import polars as pl

from simtest.nightly.outputs.summary import summary
from simtest.nightly.phrases import headline
from simtest.nightly.records import JudgedRun
from simtest.runtime.files import write_atomically, write_json

SCHEMA_VERSION = 3

FILES = VERDICT, SUMMARY = "verdict.json", "summary.md"
"""Names of the files, which lie beside the page."""


def write_outputs(folder: Path, judged: JudgedRun) -> None:
    """Write the `FILES` into a folder; the same run gives the same bytes."""
    write_json(folder / VERDICT, _verdict_json(judged))
    text = summary(judged)
    write_atomically(folder / SUMMARY, lambda part: part.write_text(text, encoding="utf-8"))


def _verdict_json(judged: JudgedRun) -> dict[str, Any]:
    run, verdict = judged.run, judged.verdict
    return {
        "schema": SCHEMA_VERSION,
        "profile": run.record.profile,
        "state": verdict.state,
        "exit_code": verdict.exit_code,
        "headline": headline(verdict),
        "bit_equal": verdict.bit_equal,
        "causes": list(verdict.causes),
        "notes": list(verdict.notes),
        "run": run.record.to_json(),
        "baseline": None if verdict.baseline is None else verdict.baseline.to_json(),
        "counts": verdict.counts,
        "reports": list(judged.reports),
        "comparisons": _rows_json(verdict.comparisons.filter(pl.col("outcome") != "same")),
    }


def _rows_json(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Return a table's rows as JSON can hold them: nulls are left out, numbers that are not finite are text."""
    return [
        {key: str(value) if isinstance(value, float) and not math.isfinite(value) else value
         for key, value in row.items() if value is not None}
        for row in table.iter_rows(named=True)
    ]  # fmt: skip
