"""The table of results: a record for each row, and the columns that always exist, with their order and types."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from simtest.estimators.budget import PARTS, STATED
from simtest.estimators.protocol import Target

Value = bool | int | float | str | None
"""What a column of results holds."""

BUDGET_COLUMNS = tuple(f"budget_{part}_deg" for part in (*PARTS, STATED))
"""Standard deviations of the parts of an estimate's budget: the square root of each part's trace, deg."""

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
    "target": pl.String(), "error_fine_deg": pl.Float64(), "error_base_deg": pl.Float64(),
    "error_base_law_deg": pl.Float64(), "kd_min_base": pl.Float64(), "kd_max_base": pl.Float64(),
    "visible_id": pl.Int64(), "visible_snr": pl.Float64(), "frame_visible": pl.Int64(),
    "cloud": pl.Int64(), "pool": pl.Boolean(), "radius_px": pl.Float64(),
    "radius_law_px": pl.Float64(), "cloud_glints": pl.Int64(), "cloud_glints_law": pl.Float64(),
    "cloud_visible": pl.Int64(), "cloud_error_deg": pl.Float64(), "cloud_error_law_deg": pl.Float64(),
    "cloud_kd_min": pl.Float64(), "cloud_kd_max": pl.Float64(), "cloud_cov_11": pl.Float64(),
    "cloud_cov_12": pl.Float64(), "cloud_cov_22": pl.Float64(), **{name: pl.Float64() for name in BUDGET_COLUMNS},
}  # fmt: skip
"""Columns that always exist, in order; the swept parameters follow by their own names."""


@dataclass(frozen=True)
class ResultRow:
    """One estimator at one detected or missed highlight.

    Fields are named like the columns and stand in the order in which they become known; None where there is none.
    docs/reference/experiments.md describes them. `swept` holds the swept and drawn parameters by key path, `budget`
    the columns of `BUDGET_COLUMNS` that an estimate has.
    """

    # Realisation.
    experiment: str | None = None
    label: str | None = None
    realisation: int | None = None
    setting: str | None = None
    seed: int | None = None
    laws: str | None = None
    target: Target | None = None
    swept: Mapping[str, Value] = field(default_factory=dict)
    # Scene.
    surface: str | None = None
    reflectance: str | None = None
    noise_sigma: float | None = None
    path_depth: int | None = None
    n_lights: int | None = None
    # True highlight.
    distance_mm: float | None = None
    kd_min: float | None = None
    kd_max: float | None = None
    kd_min_base: float | None = None
    kd_max_base: float | None = None
    visible_id: int | None = None
    visible_snr: float | None = None
    frame_visible: int | None = None
    cloud: int | None = None
    pool: bool | None = None
    radius_px: float | None = None
    radius_law_px: float | None = None
    # Its cloud.
    cloud_glints: int | None = None
    cloud_glints_law: float | None = None
    cloud_visible: int | None = None
    cloud_error_deg: float | None = None
    cloud_error_law_deg: float | None = None
    cloud_kd_min: float | None = None
    cloud_kd_max: float | None = None
    cloud_cov_11: float | None = None
    cloud_cov_12: float | None = None
    cloud_cov_22: float | None = None
    # Light and noise at the true highlight.
    eps_over_d: float | None = None
    peak_snr: float | None = None
    axis_ratio_law: float | None = None
    bp_true_x_px: float | None = None
    bp_true_y_px: float | None = None
    truth_x: float | None = None
    truth_y: float | None = None
    truth_z: float | None = None
    # Detection and estimator.
    specularity: int | None = None
    true_id: int | None = None
    estimator: str | None = None
    bp_x_px: float | None = None
    bp_y_px: float | None = None
    saturated_share: float | None = None
    status: str | None = None
    flags: str | None = None
    # Estimate.
    n_candidates: int | None = None
    choice_margin: float | None = None
    look_x_px: float | None = None
    look_y_px: float | None = None
    isovalue: float | None = None
    isovalues: str | None = None
    axis_ratio: float | None = None
    normal_x: float | None = None
    normal_y: float | None = None
    normal_z: float | None = None
    cov_11: float | None = None
    cov_12: float | None = None
    cov_22: float | None = None
    budget: Mapping[str, float] = field(default_factory=dict)
    gain_1: float | None = None
    gain_2: float | None = None
    # Estimate against truth.
    axis_ratio_seen_law: float | None = None
    error_deg: float | None = None
    error_oracle_deg: float | None = None
    error_look_deg: float | None = None
    error_law_deg: float | None = None
    error_look_law_deg: float | None = None
    error_fine_deg: float | None = None
    error_base_deg: float | None = None
    error_base_law_deg: float | None = None
    rank_correct: int | None = None
    mahalanobis2: float | None = None
    gain_error: float | None = None
    gain_oracle_error: float | None = None
    direction_error_deg: float | None = None

    def to_row(self) -> dict[str, Value]:
        """Return the value of each column; a swept parameter gives way to a column of the same name."""
        row = {**self.swept, **vars(self), **dict.fromkeys(BUDGET_COLUMNS), **self.budget}
        del row["swept"], row["budget"]
        return row

    def having(self, **values: Any) -> "ResultRow":
        """Return the row with other values of some fields.

        A frame on a relief has thousands of rows, each filled in a dozen steps: `dataclasses.replace` takes ten times
        as long, because it sets every field anew.
        """
        if unknown := values.keys() - self.__dataclass_fields__.keys():
            raise TypeError(f"ResultRow has no field {min(unknown)!r}")
        made = object.__new__(ResultRow)
        made.__dict__.update(self.__dict__, **values)
        return made


def table(rows: Sequence[ResultRow], swept: Mapping[str, Value]) -> pl.DataFrame:
    """Make the table of results; `swept` holds an example value for each swept parameter's column."""
    return pl.DataFrame([row.to_row() for row in rows], schema=_schema(swept))


def completed(made: pl.DataFrame, swept: Mapping[str, Value]) -> pl.DataFrame:
    """Return a table of results with all columns of `table`, in its order; those that are missing are null."""
    columns = [
        (pl.col(name) if name in made.columns else pl.lit(None)).cast(dtype).alias(name)
        for name, dtype in _schema(swept).items()
    ]
    return made.select(columns)


def _schema(swept: Mapping[str, Value]) -> dict[str, pl.DataType]:
    return {**SCHEMA, **{name: _dtype(value) for name, value in swept.items() if name not in SCHEMA}}


def _dtype(value: Value) -> pl.DataType:
    if isinstance(value, bool):
        return pl.Boolean()
    return pl.Float64() if isinstance(value, int | float) else pl.String()
