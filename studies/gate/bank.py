"""A bank of realisations that runs are drawn from: shipped experiments with seeds of their own, rendered once."""

from pathlib import Path

import polars as pl

from simtest.runtime.files import write_atomically
from simtest.runtime.processes import make_engine
from simtest.spec import Experiment, load_experiment
from simtest.validation.columns import SCHEMA
from simtest.validation.runner import run_experiment
from studies.kept import of_this_code

CONTENT = {"paper": 320, "curvature": 60, "light_offset": 60, "compare": 40, "anatomy": 2}
"""Realisations of each setting, by shipped experiment: 20,400 in all; an anatomy's are of each of 20 views."""

SLOW = "inverse_rendering"
"""Left out: a second a realisation."""

SEED = 20_000
WORKERS = 2
COLUMNS = tuple(SCHEMA)
"""All columns of results: the gate holds them against each other."""


def experiment(name: str, realisations: int) -> Experiment:
    """Return a shipped experiment with the bank's seed and number of realisations."""
    found = load_experiment(name, {"realisations": realisations, "seed": SEED})
    return found.model_copy(update={"estimators": tuple(e for e in found.estimators if e != SLOW)})


def load_bank(folder: Path) -> pl.DataFrame:
    """Read the bank's rows; first make a bank that is missing, or not whole, which takes minutes.

    `folder`: holds the bank of each version of the code, and while it is made a run of each experiment. Returns
    `COLUMNS`.
    """
    folder = of_this_code(folder)
    file = folder / "bank.parquet"
    if not file.is_file():
        engine = make_engine("local", WORKERS)
        tables = [
            run_experiment(experiment(name, count), folder / name, engine=engine).results.select(COLUMNS)
            for name, count in CONTENT.items()
        ]
        write_atomically(file, pl.concat(tables).write_parquet)
    return pl.read_parquet(file)


def frames_of(rows: pl.DataFrame) -> int:
    """Count realisations."""
    return rows.select("experiment", "setting", "realisation").n_unique()
