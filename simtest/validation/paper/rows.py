"""Rows of results for realisations of the published protocol."""

from typing import Any

import numpy as np

from simtest.errors import Failure
from simtest.estimators import Estimate, load_estimators
from simtest.estimators.circle_pose import circle_pose
from simtest.seeds import from_integer
from simtest.spec.paper import PaperSetting
from simtest.validation.metrics import angle_deg
from simtest.validation.paper.pipeline import Pipeline
from simtest.validation.paper.smoothing import smoothing_bias

SURFACE = "published plane"


def paper_rows(
    setting: PaperSetting, common: dict[str, Any], numbers: range, seeds: list[int], estimators: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Make the rows of some realisations of one setting; runs in any process.

    Parameters
    ----------
    setting : PaperSetting
        The setting.
    common : dict
        Values of the columns that all rows share.
    numbers : range
        Numbers of the realisations.
    seeds : list of int
        A seed for each of them: it gives the light, then the noise.
    estimators : tuple of str
        Names; circle_pose is run at the setting's isovalue.

    Returns
    -------
    list of dict
        In the order of the realisations.
    """
    pipeline = pipeline_with(setting, estimators)
    bias = smoothing_bias(setting)
    law_deg = {"circle_pose": None if bias is None else float(np.degrees(bias))}
    shared = {**common, "surface": SURFACE, "reflectance": "phong", "noise_sigma": setting.sigma, "n_lights": 1}
    shared |= dict(zip(("truth_x", "truth_y", "truth_z"), setting.normal.tolist(), strict=True))
    rows = []
    for number, seed in zip(numbers, seeds, strict=True):
        for name, result in pipeline.realise(from_integer(seed)).items():
            row = {**shared, "realisation": number, "specularity": 0, "true_id": 0, "seed": seed, "estimator": name}
            rows.append(row | {"error_law_deg": law_deg.get(name)} | _result(setting, result))
    return rows


def pipeline_with(setting: PaperSetting, estimators: tuple[str, ...]) -> Pipeline:
    """Give the pipeline with estimators by name, circle_pose at the setting's isovalue."""
    loaded = load_estimators(estimators)
    if "circle_pose" in loaded:
        loaded["circle_pose"] = lambda patch, camera: circle_pose(patch, camera, setting.isovalue)
    return Pipeline(setting, loaded)


def _result(setting: PaperSetting, result: Estimate | Failure) -> dict[str, Any]:
    if isinstance(result, Failure):
        return {"status": str(result.reason), "flags": result.detail}
    to_truth = angle_deg(result.candidates, setting.normal)
    isovalues = [isophote.isovalue for isophote in result.isophotes]
    proposed = float(angle_deg(result.normal, setting.normal))
    return {
        "status": "ok",
        "flags": ",".join(result.flags),
        "error_deg": proposed,
        "error_oracle_deg": float(to_truth.min()),
        # The plane's normal is the same wherever the estimate looks.
        "error_look_deg": proposed,
        "rank_correct": int(to_truth.argmin()),
        "n_candidates": len(result.candidates),
        "look_x_px": float(result.look_px[0]),
        "look_y_px": float(result.look_px[1]),
        "isovalue": isovalues[0] if len(isovalues) == 1 else None,
        "isovalues": ",".join(f"{t:g}" for t in isovalues) or None,
        "axis_ratio": result.axis_ratio,
        **dict(zip(("normal_x", "normal_y", "normal_z"), result.normal.tolist(), strict=True)),
    }
