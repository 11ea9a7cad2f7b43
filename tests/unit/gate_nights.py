"""Runs made up for the tests of the gate."""

import numpy as np
import polars as pl

from simtest.nightly.gate.figures import setting_figures
from simtest.nightly.records import FIGURES, NightlyRun, RunRecord
from simtest.validation.results_table import SCHEMA

RUN = {"id": "x", "versions": {"numpy": "2.4", "simtest": "0.1"}, "processor": "one"}


def rows(count=20, level=1.0, seed=0, estimators=("cone_axis",), settings=("a",), spread=0.5, **columns):
    """Return rows of one highlight a realisation, with Rayleigh-like errors about a level."""
    made = []
    for setting in settings:
        for estimator in estimators:
            rng = np.random.default_rng([seed, sum(map(ord, setting + estimator))])
            for realisation in range(count):
                row = dict.fromkeys(SCHEMA)
                row |= {
                    "experiment": "e", "label": "l", "surface": "plane", "setting": setting, "estimator": estimator,
                    "realisation": realisation, "specularity": 0, "true_id": 0, "seed": 1000 * seed + realisation,
                    "status": "ok", "error_deg": level * (1 + spread * float(rng.uniform(-1, 1))),
                    "mahalanobis2": float(rng.chisquare(2)), "axis_ratio": 0.5 + 0.01 * float(rng.normal()),
                    "axis_ratio_law": 0.5, "error_oracle_deg": 0.0,
                }  # fmt: skip
                made.append(row | columns)
    return pl.DataFrame(made, schema=SCHEMA)


def night(table, canaries=(), costs=(), **run):
    """Return a run of rows; canaries as (name, value, high), costs as (name, quantity, value, low, high)."""
    extra = [
        {"kind": "canary", "experiment": name, "label": "", "surface": "", "setting": "", "estimator": "",
         "quantity": "off", "unit": "", "value": value, "low": 0.0, "high": high, "n": 1,
         "passed": value is not None and value <= high}
        for name, value, high in canaries
    ] + [
        {"kind": "cost", "experiment": name, "label": "", "surface": "", "setting": "", "estimator": "",
         "quantity": quantity, "unit": "x", "value": value, "low": low, "high": high, "n": 9}
        for name, quantity, value, low, high in costs
    ]  # fmt: skip
    figures = pl.concat([setting_figures(table), pl.DataFrame(extra, schema=FIGURES)])
    return NightlyRun(RunRecord(**{**RUN, **run}), table, figures)


def changed(table, condition, **values):
    """Return rows with values replaced where a condition holds."""
    return table.with_columns(
        pl.when(condition).then(pl.lit(value)).otherwise(pl.col(name)).cast(SCHEMA[name]).alias(name)
        for name, value in values.items()
    )


def raised(table, factor, estimator="cone_axis"):
    """Return rows with one estimator's errors times a factor."""
    own = pl.when(pl.col("estimator") == estimator).then(pl.col("error_deg") * factor)
    return table.with_columns(error_deg=own.otherwise(pl.col("error_deg")))
