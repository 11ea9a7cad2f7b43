"""Rows of results for realisations of the published protocol, column by column: they are many and alike."""

import itertools
from dataclasses import replace
from functools import lru_cache

import numpy as np
import polars as pl

from simtest.errors import Failure, InputError
from simtest.estimators import AnyEstimator, Estimate, Estimator, load_estimators
from simtest.estimators.circle_pose import CirclePoseEstimator
from simtest.estimators.photometric import Photometric
from simtest.geometry.vectors import angle_deg
from simtest.runtime.seeds import from_integer
from simtest.spec.recipes import PaperSetting
from simtest.validation.columns import SCHEMA, Row, Value
from simtest.validation.paper.plane_from_aside import photometric_plane
from simtest.validation.paper.predictions import smoothing_bias
from simtest.validation.paper.protocol import Pipeline
from simtest.validation.scoring import mahalanobis2

SURFACE = "published plane"

Columns = dict[str, list[Value]]


def paper_rows(
    setting: PaperSetting, common: Row, numbers: range, seeds: list[int], estimators: tuple[str, ...]
) -> pl.DataFrame:
    """Make the rows of some realisations of one setting, in their order; runs in any process.

    `common` holds what all rows share; each realisation's seed draws the light, then the noise. The table has the
    columns of `SCHEMA` and of the swept parameters that are not null.
    """
    pipeline = pipeline_with(setting, estimators)
    made = pipeline.realise(from_integer(seed) for seed in seeds)
    truth_x, truth_y, truth_z = setting.normal.tolist()
    shared = common | {
        "surface": SURFACE, "reflectance": "phong", "noise_sigma": setting.sigma, "n_lights": 1, "truth_x": truth_x,
        "truth_y": truth_y, "truth_z": truth_z, "specularity": 0, "true_id": 0, "target": "fine",
    }  # fmt: skip
    bias = smoothing_bias(setting)
    tables = []
    for name, results in made.items():
        # The law is that of circle pose.
        law_deg = float(np.degrees(bias)) if name == "circle_pose" and bias is not None else None
        own = shared | {"estimator": name, "error_law_deg": law_deg}
        columns = {"realisation": list(numbers), "seed": seeds, **_columns(setting, results)}
        table = pl.DataFrame(columns, schema_overrides=SCHEMA)
        constant = {key: pl.lit(value) for key, value in own.items() if value is not None}
        tables.append(table.with_columns(**constant))
    return pl.concat(tables, how="diagonal_relaxed").sort("realisation", maintain_order=True)


@lru_cache(maxsize=2)
def pipeline_with(setting: PaperSetting, estimators: tuple[str, ...]) -> Pipeline:
    """Make the pipeline with estimators by name, circle_pose at the setting's isovalue; the last two are cached."""
    loaded = load_estimators(estimators)
    return Pipeline(setting, {name: _of_protocol(name, each, setting) for name, each in loaded.items()})


def _of_protocol(name: str, estimator: AnyEstimator, setting: PaperSetting) -> Estimator:
    """Return the estimator as the published protocol runs it."""
    if not isinstance(estimator, Estimator):
        raise InputError(f"estimator {name!r}: needs a whole frame; the published protocol has one region of interest")
    if isinstance(estimator, CirclePoseEstimator):
        return replace(estimator, isovalue=setting.isovalue, with_region=False)
    # The camera is not at the light: the model is another one.
    return photometric_plane if isinstance(estimator, Photometric) else estimator


def _columns(setting: PaperSetting, results: list[Estimate | Failure]) -> Columns:
    """Compute the columns that differ between the rows of one estimator; null where it failed."""
    ok = [result for result in results if isinstance(result, Estimate)]
    # All candidates of all estimates in one go; an estimator may give more of them here and fewer there.
    ends = np.cumsum([0, *(len(estimate.candidates) for estimate in ok)]).tolist()
    every = angle_deg(np.concatenate([e.candidates for e in ok] or [np.empty((0, 3))]), setting.normal).tolist()
    errors = [every[first:end] for first, end in itertools.pairwise(ends)]
    proposed = angle_deg(np.array([e.normal for e in ok]).reshape(-1, 3), setting.normal).tolist()
    isovalues = [[isophote.isovalue for isophote in estimate.isophotes] for estimate in ok]
    columns: Columns = {
        "error_deg": proposed,
        "error_oracle_deg": [min(own) for own in errors],
        # The plane's normal is the same wherever the estimate looks.
        "error_look_deg": proposed,
        # ... and has no relief.
        "error_fine_deg": proposed,
        "error_base_deg": proposed,
        "rank_correct": [own.index(min(own)) for own in errors],
        "n_candidates": [len(own) for own in errors],
        "look_x_px": [float(e.look_px[0]) for e in ok],
        "look_y_px": [float(e.look_px[1]) for e in ok],
        "isovalue": [t[0] if len(t) == 1 else None for t in isovalues],
        "isovalues": [",".join(f"{value:g}" for value in t) or None for t in isovalues],
        "axis_ratio": [e.axis_ratio for e in ok],
        "choice_margin": [e.choice_margin for e in ok],
        "mahalanobis2": [mahalanobis2(e, setting.normal) for e in ok],
    }
    for name, index in (("cov_11", (0, 0)), ("cov_12", (0, 1)), ("cov_22", (1, 1))):
        columns[name] = [None if e.covariance is None else float(e.covariance[index]) for e in ok]
    columns |= {f"normal_{axis}": [float(e.normal[i]) for e in ok] for i, axis in enumerate("xyz")}
    # Failures have a status and flags only.
    status: list[Value] = ["ok" if isinstance(r, Estimate) else str(r.reason) for r in results]
    flags: list[Value] = [",".join(r.flags) if isinstance(r, Estimate) else r.detail for r in results]
    answered = [isinstance(result, Estimate) for result in results]
    return {"status": status, "flags": flags} | {name: _spread(answered, v) for name, v in columns.items()}


def _spread(answered: list[bool], values: list[Value]) -> list[Value]:
    """Spread the values of the answered rows over all rows."""
    given = iter(values)
    return [next(given) if present else None for present in answered]
