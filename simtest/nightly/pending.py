"""The gate's and the page's entrances, until both are merged: with either missing, a night is measured all the same."""

import hashlib
import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import polars as pl

from simtest.gate.records import COMPARISONS, FIGURES, PLACE, Night, Verdict
from simtest.spec import Experiment


def _module(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and name.startswith(error.name):
            return None
        raise


def setting_figures(rows: pl.DataFrame) -> pl.DataFrame:
    """Give what estimators did in each setting."""
    if module := _module("simtest.gate.figures"):
        return module.setting_figures(rows)
    made = []
    for key, group in rows.group_by(*PLACE, maintain_order=True):
        errors = group["error_deg"].drop_nulls()
        digest = hashlib.sha256(group.hash_rows().to_numpy().tobytes()).hexdigest()[:16]
        place = dict(zip(PLACE, map(str, key), strict=True))
        value = errors.mean() if len(errors) else None
        made.append({"kind": "setting", **place, "quantity": "mean_deg", "unit": "deg", "value": value,
                     "n": len(errors), "digest": digest})  # fmt: skip
    return pl.DataFrame(made, schema=FIGURES)


def run_canaries(rows: pl.DataFrame, variant: str | None) -> pl.DataFrame:
    """Run the canaries."""
    if module := _module("simtest.nightly.canaries"):
        return module.run_canaries(rows, variant)
    return pl.DataFrame(schema=FIGURES)


def ladder_figures() -> pl.DataFrame:
    """Compute the error ladder."""
    if module := _module("simtest.nightly.ladder"):
        return module.ladder_figures()
    return pl.DataFrame(schema=FIGURES)


def worst_cases(
    rows: pl.DataFrame, worse: pl.DataFrame, experiments: Sequence[Experiment], folder: Path, variant: str | None
) -> tuple[Path, ...]:
    """Make the worst cases again; gives their files."""
    if module := _module("simtest.validation.worst"):
        return module.save_worst(module.worst_cases(rows, worse), experiments, folder, variant)
    return ()


def compare(tonight: Night, baseline: Night | None) -> Verdict:
    """Hold a night against another."""
    if module := _module("simtest.gate.compare"):
        return module.compare(tonight, baseline)
    state = "fine" if baseline else "no baseline"
    if not night_passed(tonight):
        state = "regression"
    return Verdict(state, None, pl.DataFrame(schema=COMPARISONS), ("No gate.",), baseline.run if baseline else None)


def night_passed(night: Night) -> bool:
    """Whether all canaries passed."""
    return bool(night.figures.filter(pl.col("kind") == "canary")["passed"].all())


def write_page(folder: Path, night: Night, verdict: Verdict, history: pl.DataFrame, **extras: Any) -> Path:
    """Write the page."""
    if module := _module("simtest.report.nightly"):
        return module.write_nightly_page(folder, night, verdict, history, module.Extras(**extras))
    page = folder / "index.html"
    page.write_text(f"<!doctype html><title>{verdict.state}</title>")
    return page
