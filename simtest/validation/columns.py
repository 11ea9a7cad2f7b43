"""What a row of results holds: the columns that always exist, each with its type and its meaning, and their table.

A row is a dictionary of the columns that are known, by name; what it lacks is null. Rows are made by `scoring.rows`,
`scoring.cloud_rows` and, of the published protocol, `paper.rows.paper_rows`. The manual's page of files is made from
`COLUMNS`; docs/howto/experiments.md explains them by topic, as a test checks. Angles of errors are between an
estimate's proposed normal and a true one, in degrees. BP is the highlight's brightest point. "Law" is a closed form of
docs/concepts/theory.md.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import polars as pl

from simtest.estimators.budget import PARTS, STATED

Value = bool | int | float | str | None
"""What a column of results holds."""

Row = dict[str, Value]
"""One estimator at one detected or missed highlight: what is known of it, by column."""

TEXT, WHOLE, NUMBER, YES_NO = pl.String(), pl.Int64(), pl.Float64(), pl.Boolean()


class Column(NamedTuple):
    """A column of results; an empty meaning is that of the column before it, of which it is a further component."""

    dtype: pl.DataType
    meaning: str = ""


BUDGET_COLUMNS = tuple(f"budget_{part}_deg" for part in (*PARTS, STATED))
"""Standard deviations of the parts of an estimate's budget: the square root of each part's trace, deg."""

COLUMNS: dict[str, Column] = {
    "experiment": Column(TEXT, "name of the experiment"),
    "label": Column(TEXT, "label of the group of settings: the name of its curve"),
    "surface": Column(TEXT, "kind of surface"),
    "reflectance": Column(TEXT, "kind of reflectance"),
    "setting": Column(TEXT, "name of the setting: its swept parameters with their values"),
    "realisation": Column(WHOLE, "number of the realisation, from 0"),
    "specularity": Column(
        WHOLE, "number of the detection in the frame, the brightest first; null for a missed highlight"
    ),
    "true_id": Column(WHOLE, "number of the true highlight; null for a detection that matches none"),
    "seed": Column(WHOLE, "seed of the realisation; `--set sensor.seed=SEED` makes its noise again"),
    "estimator": Column(TEXT, "name of the estimator"),
    "status": Column(TEXT, "`ok`, `missed`, or the reason of the failure"),
    "flags": Column(TEXT, "warnings of the estimate; the detail of a failure"),
    "error_deg": Column(
        NUMBER,
        "proposed normal against the true one at the true BP, of a cloud where it looks, of the surface that `target` "
        "names, deg",
    ),
    "error_oracle_deg": Column(NUMBER, "error of the better candidate, deg"),
    "error_look_deg": Column(NUMBER, "error against the true normal at the pixel (`look_x_px`, `look_y_px`), deg"),
    "error_law_deg": Column(NUMBER, "what the law of section 4 predicts for `error_deg`; null where there is none"),
    "n_candidates": Column(WHOLE, "number of normals that the data allow"),
    "choice_margin": Column(NUMBER, "how clearly the proposed candidate won, in standard deviations"),
    "rank_correct": Column(WHOLE, "rank of the better candidate, from 0: 0 where the proposed one is the better"),
    "normal_x": Column(NUMBER, "proposed normal, camera frame"),
    "normal_y": Column(NUMBER),
    "normal_z": Column(NUMBER),
    "truth_x": Column(NUMBER, "true normal, camera frame"),
    "truth_y": Column(NUMBER),
    "truth_z": Column(NUMBER),
    "bp_x_px": Column(NUMBER, "detected peak, px"),
    "bp_y_px": Column(NUMBER),
    "bp_true_x_px": Column(NUMBER, "true BP, px"),
    "bp_true_y_px": Column(NUMBER),
    "look_x_px": Column(NUMBER, "pixel at whose surface point the normal is proposed, px"),
    "look_y_px": Column(NUMBER),
    "cov_11": Column(NUMBER, "covariance of the normal in its tangent plane, rad^2; null where none is stated"),
    "cov_12": Column(NUMBER),
    "cov_22": Column(NUMBER),
    "mahalanobis2": Column(NUMBER, "squared distance of the true normal by that covariance"),
    "distance_mm": Column(NUMBER, "distance of the true BP from the camera, mm"),
    "kd_min": Column(
        NUMBER, "distance times smaller principal curvature of the fine surface at the true BP, convex > 0"
    ),
    "kd_max": Column(NUMBER, "the same of the larger curvature"),
    "eps_over_d": Column(NUMBER, "distance from the camera to the light that made the highlight, over `distance_mm`"),
    "noise_sigma": Column(NUMBER, "white noise, share of full scale"),
    "peak_snr": Column(NUMBER, "peak above its surroundings over the noise at the peak's level"),
    "isovalue": Column(NUMBER, "isovalue of the fitted isophote, share of the peak; null where there are several"),
    "isovalues": Column(TEXT, "all isovalues that were fitted"),
    "axis_ratio": Column(NUMBER, "smaller over larger half-axis of the back-projected cone"),
    "axis_ratio_law": Column(NUMBER, "axis ratio by the leading order (3.2)"),
    "path_depth": Column(WHOLE, "longest light path that was rendered; 2: direct light, more adds inter-reflections"),
    "n_lights": Column(WHOLE, "lights of the rig, in view or not"),
    "saturated_share": Column(
        NUMBER, "share of the isophote's area at half height that is clipped; null without clipping"
    ),
    "gain_1": Column(NUMBER, "1 + d k along the direction of the smaller gain, as proposed"),
    "gain_2": Column(NUMBER, "the same of the larger gain"),
    "gain_error": Column(NUMBER, "larger of the two gains' relative errors, with the proposed signs"),
    "gain_oracle_error": Column(NUMBER, "the same with the best signs"),
    "direction_error_deg": Column(
        NUMBER, "direction of the smaller gain against the true one, 0 to 90 deg; null for equal gains"
    ),
    "axis_ratio_seen_law": Column(
        NUMBER, "axis ratio with its corrections (4.5), where the isophotes are taken as they are"
    ),
    "error_look_law_deg": Column(NUMBER, "what `error_look_deg` should be, from the estimate's own miss, deg"),
    "laws": Column(TEXT, "names of the laws that the page compares with this setting"),
    "target": Column(TEXT, "surface whose normal the estimate states: `fine` or `base`"),
    "error_fine_deg": Column(NUMBER, "error against the normal of the fine surface, with its relief, deg"),
    "error_base_deg": Column(NUMBER, "error against the normal of the base, without the relief, deg"),
    "error_base_law_deg": Column(
        NUMBER, "law of section 7, item 4, for the mean of `error_base_deg` over a cloud, deg"
    ),
    "kd_min_base": Column(NUMBER, "distance times smaller principal curvature of the base"),
    "kd_max_base": Column(NUMBER, "the same of the larger curvature"),
    "visible_id": Column(
        WHOLE, "number of the visible highlight that holds the detection's peak or the missed glint; else null"
    ),
    "visible_snr": Column(NUMBER, "peak of that visible highlight over the noise"),
    "frame_visible": Column(WHOLE, "visible highlights of at least 10 sigma in the frame; null without a relief"),
    "cloud": Column(WHOLE, "number of the cloud; without a relief that of the highlight; null where there is none"),
    "pool": Column(YES_NO, "whether the true highlight lies in a pool of the film"),
    "radius_px": Column(
        NUMBER, "radius of the circle of the visible highlight's area, px; of whole ones that hold one glint"
    ),
    "radius_law_px": Column(NUMBER, "the same by the shape of the fine surface (section 7, item 3), px"),
    "cloud_glints": Column(WHOLE, "glints of the cloud, however faint"),
    "cloud_glints_law": Column(NUMBER, "their expected number (section 7, item 2)"),
    "cloud_visible": Column(WHOLE, "visible highlights of the cloud of at least 10 sigma"),
    "cloud_error_deg": Column(NUMBER, "mean of the glints' fine normals against the base's normal at its own BP, deg"),
    "cloud_error_law_deg": Column(NUMBER, "its expected value if glints were independent (section 7, item 5), deg"),
    "cloud_kd_min": Column(NUMBER, "distance times smaller principal curvature of the base at that point"),
    "cloud_kd_max": Column(NUMBER, "the same of the larger curvature"),
    "cloud_cov_11": Column(
        NUMBER, "mean squares of the glints' positions about that point in its tangent plane (7, item 1), mm^2"
    ),
    "cloud_cov_12": Column(NUMBER),
    "cloud_cov_22": Column(NUMBER),
    **{
        f"budget_{part}_deg": Column(NUMBER, f"root of the trace of the budget's part `{part}`, deg")
        for part in (*PARTS, STATED)
    },
}
"""Columns that always exist, in order; the swept parameters follow by their own names."""

SCHEMA: dict[str, pl.DataType] = {name: column.dtype for name, column in COLUMNS.items()}


def swept_columns(swept: Mapping[str, Value]) -> Row:
    """Return the columns of swept and drawn parameters by key path; one gives way to a column of the same name."""
    return {name: value for name, value in swept.items() if name not in COLUMNS}


def table(rows: Sequence[Row], swept: Mapping[str, Value]) -> pl.DataFrame:
    """Make the table of results; `swept` holds an example value for each swept parameter's column.

    Raises
    ------
    KeyError
        If a row has a column that is not in the table: polars would drop it silently.
    """
    schema = _schema(swept)
    if unknown := set[str]().union(*rows) - schema.keys():
        raise KeyError(f"no such column of results: {', '.join(sorted(unknown))}")
    return pl.DataFrame(rows, schema=schema)


def _schema(swept: Mapping[str, Value]) -> dict[str, pl.DataType]:
    return SCHEMA | {name: _dtype(value) for name, value in swept.items() if name not in SCHEMA}


def _dtype(value: Value) -> pl.DataType:
    if isinstance(value, bool):
        return YES_NO
    return NUMBER if isinstance(value, int | float) else TEXT
