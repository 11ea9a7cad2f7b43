"""Rows of results for realisations of the published protocol."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from simtest.errors import Failure, InputError
from simtest.estimators import AnyEstimator, Estimate, Estimator, load_estimators
from simtest.estimators.circle_pose import CirclePoseEstimator
from simtest.estimators.photometric import Photometric
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer
from simtest.spec.recipes import PaperSetting
from simtest.validation.columns import Row
from simtest.validation.paper.plane_from_aside import photometric_plane
from simtest.validation.paper.predictions import smoothing_bias
from simtest.validation.paper.protocol import Pipeline
from simtest.validation.scoring import estimate_columns, scored

SURFACE = "published plane"

UNSTATED = ("budget_", "gain_")
"""Columns of an estimate that the protocol's rows do not fill begin so."""


def paper_rows(
    setting: PaperSetting, common: Row, numbers: range, seeds: list[int], estimators: tuple[str, ...]
) -> list[Row]:
    """Make the rows of some realisations of one setting, in their order; runs in any process.

    `common` holds what all rows share; each realisation's seed draws the light, then the noise.
    """
    answers = pipeline_with(setting, estimators).realise(from_integer(seed) for seed in seeds)
    truth_x, truth_y, truth_z = setting.normal.tolist()
    shared = common | {
        "surface": SURFACE, "reflectance": "phong", "noise_sigma": setting.sigma, "n_lights": 1, "truth_x": truth_x,
        "truth_y": truth_y, "truth_z": truth_z, "specularity": 0, "true_id": 0, "target": "fine",
    }  # fmt: skip
    bias = smoothing_bias(setting)
    bias_deg = None if bias is None else float(np.degrees(bias))
    rows = []
    for i, (number, seed) in enumerate(zip(numbers, seeds, strict=True)):
        for name, results in answers.items():
            # The law is that of circle pose.
            law_deg = bias_deg if name == "circle_pose" else None
            row = shared | {"realisation": number, "seed": seed, "estimator": name, "error_law_deg": law_deg}
            rows.append(row | _answer_columns(results[i], setting.normal))
    return rows


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


def _answer_columns(result: Estimate | Failure, normal: Array) -> Row:
    """Return the columns of an estimator's answer; a failure has a status and flags only."""
    if isinstance(result, Failure):
        return {"status": str(result.reason), "flags": result.detail}
    stated = {name: value for name, value in estimate_columns(result).items() if not name.startswith(UNSTATED)}
    # The plane's normal is the same wherever the estimate looks, and has no relief.
    errors = scored(result, normal, normal)
    return stated | errors | dict.fromkeys(("error_fine_deg", "error_base_deg"), errors["error_deg"])
