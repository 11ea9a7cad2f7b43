"""Mutants in a process of their own: `python -m studies.mutants.child STAGE FOLDER PROFILE NAME...`, a line each.

Stages: canaries; night, which also wants a profile and the folder of the unchanged night, which "unchanged" makes.
"""

import functools
import gc
import json
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import polars as pl
from simtest.nightly.canaries import measures
from simtest.nightly.canaries.canary import or_failed_canary

from simtest.nightly.measure import measured_ladder
from simtest.nightly.records import CELL, FIGURES, NightlyRun, RunRecord
from studies.gate.faults import planted
from studies.mutants.catalogue import BY_NAME, UNCHANGED
from studies.mutants.kinds import measures_of, naming
from studies.mutants.mutant import Mutant

LADDER = "error_ladder"
"""What measures the ladder and its canaries, beside `simtest.nightly.canaries.measures`."""

REGISTERED = "register"
"""Caches of this name say which plugins the renderer has; it refuses to be told twice."""


def canaries_of(mutant: Mutant) -> dict[str, Any]:
    """Return the canaries that fail under a mutant, as [name, quantity, value].

    Those that should name it are asked first; where they do the others are left out.
    """
    first = measures_of(mutant.kind)
    failed: list[list[Any]] = []
    with planted(*mutant.mutations()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        all_measures = {**measures(), LADDER: measured_ladder}
        for some in (first, [name for name in all_measures if name not in first]):
            failed += _failed([or_failed_canary(name, all_measures[name]) for name in some])
            if naming(mutant.kind, [name for name, *_ in failed]):
                break
    return {"failed": failed}


def control_of(mutants: list[Mutant]) -> list[list[Any]]:
    """Return the canaries, of those that mutants were asked about, that fail on unchanged code."""
    some = dict.fromkeys(name for mutant in mutants for name in measures_of(mutant.kind))
    all_measures = {**measures(), LADDER: measured_ladder}
    return _failed([or_failed_canary(name, all_measures[name]) for name in some])


def forget_everything() -> None:
    """Empty the package's caches, so that nothing that a mutant made is there for the next one."""
    for found in gc.get_objects():
        ours = isinstance(found, functools._lru_cache_wrapper) and str(found.__module__).startswith("simtest.")
        if ours and found.__name__ != REGISTERED:
            found.cache_clear()


def _failed(figures: list[pl.DataFrame]) -> list[list[Any]]:
    dead = pl.concat([pl.DataFrame(schema=FIGURES), *figures]).filter(
        pl.col("kind") == "canary", ~pl.col("passed").fill_null(False)
    )
    return [list(row) for row in dead.select("experiment", "quantity", "value").iter_rows()]


def night_of(mutant: Mutant, folder: Path, profile_name: str) -> dict[str, Any]:
    """Make a profile's night under a mutant, and return what the gate calls worse against the unchanged one.

    The night runs in this one process, since others would not have the fault.
    """
    from simtest.errors import SimtestError
    from simtest.nightly.gate.compare import compare
    from simtest.nightly.measure import RunOptions, measure_run
    from simtest.spec import load_profile

    profile = load_profile(profile_name).model_copy(update={"costs": False})
    try:
        with tempfile.TemporaryDirectory() as scratch, planted(*mutant.mutations()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            night = measure_run(profile, Path(scratch), mutant.name, RunOptions(workers=1))
    except SimtestError as error:
        return {"worse": [["the night stops", str(error)]]}
    if mutant is UNCHANGED:
        _write(night, folder)
    verdict = compare(night, _read(folder))
    # Worse, or changed without a reason.
    told = pl.concat([verdict.regressions, verdict.unexplained])
    found = told.select("experiment", "quantity").unique(maintain_order=True)
    return {"worse": [list(row) for row in found.iter_rows()], "cells": night.rows.select(CELL).n_unique()}


def _write(night: NightlyRun, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    night.rows.write_parquet(folder / "rows.parquet")
    night.figures.write_parquet(folder / "figures.parquet")
    (folder / "record.json").write_text(json.dumps(night.record.to_json()), encoding="utf-8")


def _read(folder: Path) -> NightlyRun:
    record = RunRecord.model_validate(json.loads((folder / "record.json").read_text(encoding="utf-8")))
    figures = pl.read_parquet(folder / "figures.parquet").select(*FIGURES)
    return NightlyRun(record, pl.read_parquet(folder / "rows.parquet"), figures)


def main(stage: str, folder: str, profile: str, *names: str) -> int:
    """Run a stage of mutants one after the other, and print what each found as a line of JSON.

    Several mutants share a process only for canaries; these are then asked once more, without a fault.
    """
    mutants = [BY_NAME[name] for name in names]
    for mutant in mutants:
        started = time.process_time()
        forget_everything()
        found = canaries_of(mutant) if stage == "canaries" else night_of(mutant, Path(folder), profile)
        line = {"name": mutant.name, "stage": stage, **found, "processor_s": round(time.process_time() - started, 1)}
        print(json.dumps(line), flush=True)
    if len(mutants) > 1:
        forget_everything()
        print(json.dumps({"control": control_of(mutants)}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
