"""Rows of results: one for each estimator at each detected or missed specularity."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry.vectors import angle_deg, tangent_coordinates
from simtest.reconstruction.pipeline import Specularity
from simtest.rendering import Session, TrueHighlight
from simtest.rendering.frames import Array
from simtest.simulation.true_highlights import JudgedHighlight
from simtest.spec.scene import Scene
from simtest.validation import laws
from simtest.validation.predicted import EQUAL_KD, axis_ratio_seen, law_deg, look_law_deg

SCHEMA: dict[str, pl.DataType] = {
    "experiment": pl.String(), "label": pl.String(), "surface": pl.String(), "reflectance": pl.String(),
    "setting": pl.String(), "realisation": pl.Int64(), "specularity": pl.Int64(), "true_id": pl.Int64(),
    "seed": pl.Int64(), "estimator": pl.String(), "status": pl.String(), "flags": pl.String(),
    "error_deg": pl.Float64(), "error_oracle_deg": pl.Float64(), "error_look_deg": pl.Float64(),
    "error_law_deg": pl.Float64(), "n_candidates": pl.Int64(), "choice_margin": pl.Float64(),
    "rank_correct": pl.Int64(), "normal_x": pl.Float64(), "normal_y": pl.Float64(), "normal_z": pl.Float64(),
    "truth_x": pl.Float64(), "truth_y": pl.Float64(), "truth_z": pl.Float64(), "bp_x_px": pl.Float64(),
    "bp_y_px": pl.Float64(), "bp_true_x_px": pl.Float64(), "bp_true_y_px": pl.Float64(), "look_x_px": pl.Float64(),
    "look_y_px": pl.Float64(), "cov_11": pl.Float64(), "cov_12": pl.Float64(), "cov_22": pl.Float64(),
    "mahalanobis2": pl.Float64(), "distance_mm": pl.Float64(), "kd_min": pl.Float64(), "kd_max": pl.Float64(),
    "eps_over_d": pl.Float64(), "noise_sigma": pl.Float64(), "peak_snr": pl.Float64(), "isovalue": pl.Float64(),
    "isovalues": pl.String(), "axis_ratio": pl.Float64(), "axis_ratio_law": pl.Float64(), "path_depth": pl.Int64(),
    "n_lights": pl.Int64(), "saturated_share": pl.Float64(), "gain_1": pl.Float64(), "gain_2": pl.Float64(),
    "gain_error": pl.Float64(), "gain_oracle_error": pl.Float64(), "direction_error_deg": pl.Float64(),
    "axis_ratio_seen_law": pl.Float64(), "error_look_law_deg": pl.Float64(), "laws": pl.String(),
}  # fmt: skip
"""Columns that always exist, in order; the swept parameters follow by their own names."""

MISSED = "missed"


@dataclass(frozen=True)
class RowContext:
    """What all rows of one realisation share.

    Parameters
    ----------
    session : Session
        Holds the scene; casts exact rays.
    common : dict
        Values of the columns that name the row's place in the experiment.
    """

    session: Session
    common: dict[str, Any]

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.session.scene


def rows(
    context: RowContext, specularities: list[Specularity], truths: list[JudgedHighlight], matched: dict[int, int],
    estimators: list[str], unfound: str = MISSED,
) -> list[dict[str, Any]]:  # fmt: skip
    """Give the rows of one realisation: of each detection, and of each truth that no detection found.

    Parameters
    ----------
    context : RowContext
        The scene and the shared columns.
    specularities : list of Specularity
        Detections with their estimates.
    truths : list of JudgedHighlight
        The highlights that count as true.
    matched : dict
        Index of the truth by index of the detection.
    estimators : list of str
        Names, for the missed.
    unfound : str
        Status of the rows of truths that no detection found.

    Returns
    -------
    list of dict
    """
    made = []
    for i, specularity in enumerate(specularities):
        truth = truths[matched[i]] if i in matched else None
        for name, result in specularity.estimates.items():
            row = {**_base(context, truth), "specularity": i, "true_id": matched.get(i), "estimator": name}
            row |= _result(context, specularity, result, truth)
            made.append(row)
    for j, truth in enumerate(truths):
        if j not in matched.values():
            missed = {"specularity": None, "true_id": j, "status": unfound}
            made += [{**_base(context, truth), **missed, "estimator": name} for name in estimators]
    return made


def _base(context: RowContext, truth: JudgedHighlight | None) -> dict[str, Any]:
    scene = context.scene
    row = {
        **context.common,
        "surface": scene.surface.label,
        "reflectance": scene.reflectance.type,
        "noise_sigma": scene.sensor.noise_sigma,
        "path_depth": scene.render.path_depth,
        "n_lights": len(scene.rig.lights),
    }
    if truth is None:
        return row
    highlight = truth.highlight
    # Of the light that made the highlight, at its true place.
    light = scene.rig.true_mm()[highlight.light]
    row |= {
        "distance_mm": highlight.distance,
        "kd_min": highlight.kd_min,
        "kd_max": highlight.kd_max,
        "eps_over_d": float(np.linalg.norm(light)) / highlight.distance,
        "peak_snr": truth.peak_snr if np.isfinite(truth.peak_snr) else None,
        "axis_ratio_law": float(laws.axis_ratio(highlight.kd_min, highlight.kd_max)),
        "bp_true_x_px": float(highlight.bp_px[0]),
        "bp_true_y_px": float(highlight.bp_px[1]),
    }
    return row | dict(zip(("truth_x", "truth_y", "truth_z"), highlight.normal.tolist(), strict=True))


def _result(
    context: RowContext, specularity: Specularity, result: Estimate | Failure, truth: JudgedHighlight | None
) -> dict[str, Any]:
    row: dict[str, Any] = {}
    if not isinstance(specularity.patch, Failure):
        row["bp_x_px"], row["bp_y_px"] = (float(v) for v in specularity.patch.peak_px)
        row["saturated_share"] = specularity.patch.saturated_share(HIGHLIGHT_ISOVALUE)
    if isinstance(result, Failure):
        return row | {"status": str(result.reason), "flags": result.detail}
    isovalues = [isophote.isovalue for isophote in result.isophotes]
    row |= {
        "status": "ok",
        "flags": ",".join(result.flags),
        "n_candidates": len(result.candidates),
        "choice_margin": result.choice_margin,
        "look_x_px": float(result.look_px[0]),
        "look_y_px": float(result.look_px[1]),
        "isovalue": isovalues[0] if len(isovalues) == 1 else None,
        "isovalues": ",".join(f"{t:g}" for t in isovalues) or None,
        "axis_ratio": result.axis_ratio,
    }
    row |= dict(zip(("normal_x", "normal_y", "normal_z"), result.normal.tolist(), strict=True))
    if result.covariance is not None:
        row |= {"cov_11": result.covariance[0, 0], "cov_12": result.covariance[0, 1], "cov_22": result.covariance[1, 1]}
    gains = None if result.curvature is None else result.curvature.gains
    if gains is not None:
        row |= {"gain_1": float(gains[0]), "gain_2": float(gains[1])}
    if truth is None:
        return row
    smoothing = 0.0 if isinstance(specularity.patch, Failure) else specularity.patch.smoothing_px
    row["axis_ratio_seen_law"] = axis_ratio_seen(context.scene, result, truth, smoothing)
    return row | _errors(context, result, truth)


def _errors(context: RowContext, estimate: Estimate, truth: JudgedHighlight) -> dict[str, Any]:
    to_truth = angle_deg(estimate.candidates, truth.highlight.normal)
    look = context.session.cast(estimate.look_px[None])[0] if np.isfinite(estimate.look_px).all() else None
    seen = look is not None and bool(look.valid[0])
    return {
        "error_deg": float(angle_deg(estimate.normal, truth.highlight.normal)),
        "error_oracle_deg": float(to_truth.min()),
        "error_look_deg": float(angle_deg(estimate.normal, look.normal[0])) if seen and look is not None else None,
        "error_law_deg": law_deg(context.scene, estimate, truth),
        "error_look_law_deg": look_law_deg(context.scene, estimate, truth),
        "rank_correct": int(to_truth.argmin()),
        "mahalanobis2": mahalanobis2(estimate, truth.highlight.normal),
        **curvature_errors(estimate, truth.highlight),
    }


def curvature_errors(estimate: Estimate, true: TrueHighlight) -> dict[str, float | None]:
    """Give the errors of an estimate's curvature; None where it gives none.

    Parameters
    ----------
    estimate : Estimate
        Its `curvature` is judged.
    true : TrueHighlight
        The truth.

    Returns
    -------
    dict
        `gain_error`: the larger error of 1 + d k over its true value, of the proposed hypothesis; `gain_oracle_error`:
        of the best one; `direction_error_deg`: angle between the estimated and the true direction of the smaller
        abs(1 + d k), in [0, 90], None where the true ones are equal.
    """
    found = estimate.curvature
    errors: dict[str, float | None] = dict.fromkeys(("gain_error", "gain_oracle_error", "direction_error_deg"))
    if found is None:
        return errors
    gains = np.array([1 + true.kd_min, 1 + true.kd_max])
    along_min_first = bool(abs(gains[0]) <= abs(gains[1]))
    gains = gains if along_min_first else gains[::-1]
    if found.hypotheses is not None and np.all(gains != 0):
        off = np.abs(found.hypotheses / gains - 1).max(axis=1)
        errors |= {"gain_error": float(off[0]), "gain_oracle_error": float(off.min())}
    if true.direction_min is not None and abs(true.kd_max - true.kd_min) > EQUAL_KD:
        first = true.direction_min if along_min_first else np.cross(true.normal, true.direction_min)
        angle = float(angle_deg(found.directions[0], first))
        errors["direction_error_deg"] = min(angle, 180 - angle)
    return errors


def mahalanobis2(estimate: Estimate, truth: Array) -> float | None:
    """Give the squared Mahalanobis distance of the true normal, unit, shape (3,), by the region or the covariance.

    Both are chi-squared with two degrees of freedom where the estimate's uncertainty is right; None without either.
    """
    if estimate.region is not None:
        return float(estimate.region.statistic(truth))
    if estimate.covariance is None or np.linalg.eigvalsh(estimate.covariance)[0] <= 0:
        return None
    miss = tangent_coordinates(estimate.normal, truth)
    return float(miss @ np.linalg.solve(estimate.covariance, miss))


def table(made: list[dict[str, Any]], swept: dict[str, Any]) -> pl.DataFrame:
    """Make the table of results from rows; `swept` gives an example value for each swept parameter's column."""
    schema = _schema(swept)
    return pl.DataFrame([{name: row.get(name) for name in schema} for row in made], schema=schema)


def completed(made: pl.DataFrame, swept: dict[str, Any]) -> pl.DataFrame:
    """Give a table of results all columns of `table`, in its order; those that are missing are null."""
    columns = [
        (pl.col(name) if name in made.columns else pl.lit(None)).cast(dtype).alias(name)
        for name, dtype in _schema(swept).items()
    ]
    return made.select(columns)


def _schema(swept: dict[str, Any]) -> dict[str, pl.DataType]:
    return {**SCHEMA, **{name: _dtype(value) for name, value in swept.items() if name not in SCHEMA}}


def _dtype(value: Any) -> pl.DataType:
    if isinstance(value, bool):
        return pl.Boolean()
    return pl.Float64() if isinstance(value, int | float) else pl.String()
