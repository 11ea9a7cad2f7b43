"""Runs made up for the tests of the gate."""

import numpy as np
import polars as pl

from simtest.conventions import MOTION, MOTION_COLUMNS
from simtest.nightly.quantities import setting_figures
from simtest.nightly.records import NightlyRun, RunRecord
from simtest.validation.columns import SCHEMA

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
                    "realisation": realisation, "specularity": 0, "true_id": 0,
                    "seed": 10**6 * sum(map(ord, setting)) + 1000 * seed + realisation,
                    "status": "ok", "error_deg": level * (1 + spread * float(rng.uniform(-1, 1))),
                    "mahalanobis2": float(rng.chisquare(2)), "axis_ratio": 0.5 + 0.01 * float(rng.normal()),
                    "axis_ratio_law": 0.5, "error_oracle_deg": 0.0,
                }  # fmt: skip
                made.append(row | columns)
    return pl.DataFrame(made, schema=SCHEMA)


def night(table, **run):
    """Return a run of rows."""
    return NightlyRun(RunRecord(**{**RUN, **run}), table, setting_figures(table))


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


def whole(count=10, settings=tuple("abcdefgh"), estimators=("cone_axis", "curved"), seed=0):
    """Return rows whose columns agree with each other, with a false detection in every other frame."""
    table = rows(count=count, settings=settings, estimators=estimators, seed=seed, level=0.5)
    rng = np.random.default_rng(seed)
    error = np.radians(table["error_deg"].to_numpy())
    truth = np.array([0.1, 0.2, -np.sqrt(1 - 0.05)])
    azimuth = rng.uniform(0, 2 * np.pi, len(error))
    first = np.cross(truth, [1.0, 0, 0]) / np.linalg.norm(np.cross(truth, [1.0, 0, 0]))
    across = np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * np.cross(truth, first)
    normal = np.cos(error)[:, None] * truth + np.sin(error)[:, None] * across
    deviation = np.radians(0.4)
    own = {f"normal_{axis}": normal[:, i] for i, axis in enumerate("xyz")}
    own |= {"mahalanobis2": (error / deviation) ** 2}
    constants = {f"truth_{axis}": truth[i] for i, axis in enumerate("xyz")}
    constants |= {
        "cov_11": deviation**2, "cov_12": 0.0, "cov_22": deviation**2, "budget_noise_deg": 0.4,
        "budget_shape_deg": 0.4, "kd_min": 0.0, "kd_max": 1.0, "gain_1": 1.02, "gain_2": 2.02, "gain_error": 0.02,
        "gain_oracle_error": 0.02, "noise_sigma": 0.05, "target": "fine", "flags": "partial_arc", "eps_over_d": 0.1,
        "peak_snr": 50.0, "distance_mm": 30.0, "error_law_deg": 1.0,
    }  # fmt: skip
    error_columns = ("error_oracle_deg", "error_fine_deg", "error_base_deg", "error_look_deg")
    table = table.with_columns(
        *(pl.Series(name, values) for name, values in own.items()),
        *(pl.lit(value).alias(name) for name, value in constants.items()),
        *(pl.col("error_deg").alias(name) for name in error_columns),
    ).cast(SCHEMA)
    of_truth = {name: None for name in ("true_id", "error_deg", *error_columns, "mahalanobis2", "error_law_deg")}
    false = changed(table.filter(pl.col("realisation") % 2 == 0), True, specularity=1, **of_truth)
    return pl.concat([table, false])


def with_signs(wrong=0.0, told=1.0, seed=0, count=20):
    """Return rows of `motion` with true gains of both signs; a share of the told signs is wrong."""
    table = rows(count=count, settings=tuple("abcdefghijkl"), estimators=("cone_axis", MOTION))
    rng = np.random.default_rng(seed)
    gains = np.random.default_rng(3).choice([-0.5, 1.5], (table.height, 2))
    signs = np.sign(gains) * np.where(rng.random(gains.shape) < wrong, -1, 1)
    signs = np.where(np.random.default_rng(4).random(gains.shape) < told, signs, 0.0)
    values = dict.fromkeys(MOTION_COLUMNS, np.full(table.height, 1.0))
    for i in (0, 1):
        values |= {f"motion_sign_{i + 1}": signs[:, i], f"motion_gain_{i + 1}": gains[:, i]}
    mine = pl.col("estimator") == MOTION
    return table.with_columns(pl.Series(name, value) for name, value in values.items()).with_columns(
        pl.when(mine).then(pl.col(name)) for name in MOTION_COLUMNS
    )
