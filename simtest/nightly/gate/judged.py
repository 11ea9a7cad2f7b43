"""What of the published numbers the gate judges, by which quantity and limit, and what not, and why.

Every column of results.parquet and every figure of summary.json stands in one of these tables; a test fails where a new
one stands in none.
"""

from typing import NamedTuple

from simtest.estimators.budget import PARTS, STATED
from simtest.nightly.gate.limits import Limits

_LIMITS = Limits()
_SHARE = f"{_LIMITS.relative:.0%}".replace("%", " %")
_ERROR = f"{_SHARE}, at least {_LIMITS.absolute_deg:g} deg"
_RATIO = f"{_SHARE}, at least {_LIMITS.absolute_ratio:g}"
_RATE = f"{_LIMITS.rate:g}"
_SAME_SEEDS = "no single result of the same seeds may move"
_EXACT = "exact to rounding"


class Judged(NamedTuple):
    """A number that is judged: the quantity of the comparisons, and its limit."""

    quantity: str
    limit: str


class NotJudged(NamedTuple):
    """A number that is not judged, and the reason."""

    reason: str


_CELL = Judged("n", "no cell may be missing")
_NORMAL = Judged("check: errors", "the errors are those of the normals, " + _EXACT)
_PIXEL = NotJudged("Where the peak was sought: what is wrong with it shows in the errors and in `look_deg`.")
_CLOUD = NotJudged("The truth of a relief's clouds is held to its laws by the tests; estimators do not see it.")
_PART = Judged("check: budget", "the parts add up to the covariance, " + _EXACT)

COLUMNS: dict[str, Judged | NotJudged] = {
    # Where the row belongs
    "experiment": _CELL,
    "label": _CELL,
    "surface": _CELL,
    "setting": _CELL,
    "estimator": _CELL,
    "reflectance": NotJudged("A name of the setting; the experiment's definition is compared."),
    "realisation": Judged("check: repeated answers", "no noisy answer repeats another"),
    "specularity": Judged("single false", "the number of detections of a frame stays, of the same seeds"),
    "true_id": Judged("n, check: highlights", "no true highlight may be missing; all estimators have the same"),
    "seed": Judged("check: seeds", "each frame has a seed of its own"),
    "status": Judged("unanswered, missed, single answers", f"{_RATE}; {_SAME_SEEDS}"),
    "flags": Judged("flagged, single flags", f"{_RATE}; {_SAME_SEEDS}"),
    "target": Judged("check: errors", "error_deg is that of the stated surface, " + _EXACT),
    "laws": NotJudged("Names of laws, for the page; part of the experiment's definition."),
    # Errors
    "error_deg": Judged("mean_deg, mean_penalised_deg, single error, check: zero errors", _ERROR),
    "error_oracle_deg": Judged("oracle_deg, single better error", _ERROR),
    "error_look_deg": Judged("look_deg", _ERROR),
    "error_law_deg": Judged("law_deg, no_law, single law", _ERROR),
    "error_look_law_deg": NotJudged("Follows from the miss, which `look_deg` judges, and the truth's curvature."),
    "error_fine_deg": _NORMAL,
    "error_base_deg": Judged("base_deg", _ERROR),
    "error_base_law_deg": NotJudged("A constant of the relief's slope, part of the experiment's definition."),
    "rank_correct": NotJudged("The place of the better candidate: `oracle_deg` beside `mean_deg` judges the choice."),
    "n_candidates": NotJudged("How many there are is the estimator's affair; the better one's error is judged."),
    "choice_margin": NotJudged("Of no stated scale; what a wrong choice costs is judged by `mean_deg`."),
    # Normals
    **dict.fromkeys(("normal_x", "normal_y", "normal_z", "truth_x", "truth_y", "truth_z"), _NORMAL),
    **dict.fromkeys(("bp_x_px", "bp_y_px", "look_x_px", "look_y_px"), _PIXEL),
    "bp_true_x_px": NotJudged("The truth's point; the canaries `truth` and `sightlines` hold it."),
    "bp_true_y_px": NotJudged("The truth's point; the canaries `truth` and `sightlines` hold it."),
    # Uncertainty
    "cov_11": Judged("region_deg, single region, check: regions", _ERROR),
    "cov_12": Judged("check: regions", "mahalanobis2 is that of normal, truth and covariance, " + _EXACT),
    "cov_22": Judged("region_deg, single region, check: regions", _ERROR),
    "mahalanobis2": Judged(
        "coverage95, truth_in_region, no_region, check: regions", f"{_LIMITS.coverage:g}, either way"
    ),
    "budget_noise_deg": Judged("noise_part_deg, single noise part, check: budget", _ERROR),
    **{f"budget_{name}_deg": _PART for name in (*PARTS, STATED) if name != "noise"},
    # Scene
    "distance_mm": Judged("single distance", _SAME_SEEDS),
    "kd_min": Judged("single curvature, check: axis ratio law", _SAME_SEEDS),
    "kd_max": Judged("single larger curvature, check: axis ratio law", _SAME_SEEDS),
    "kd_min_base": NotJudged("That of the base; `base_deg` judges what is made of it."),
    "kd_max_base": NotJudged("That of the base; `base_deg` judges what is made of it."),
    "eps_over_d": Judged("eps_over_d, single light", f"{_SHARE}, at least {_LIMITS.absolute_eps:g}"),
    "noise_sigma": NotJudged("What was asked for, part of the definition; the canary `noise` measures what came."),
    "peak_snr": Judged("peak_snr, single peak", f"{_SHARE}, at least {_LIMITS.absolute_snr:g}"),
    "path_depth": NotJudged("What was asked for, part of the experiment's definition."),
    "n_lights": NotJudged("What was asked for, part of the experiment's definition."),
    "saturated_share": NotJudged("A property of the frame; what clipping does shows in the errors and in `flagged`."),
    # Isophotes and curvature
    "isovalue": NotJudged("What was asked for, part of the experiment's definition."),
    "isovalues": NotJudged("Which isophotes closed: `flagged` and `unanswered` judge it."),
    "axis_ratio": Judged("axis_ratio, axis_ratio_level, no_axis_ratio, single axis ratio, check: axis ratios", _RATIO),
    "axis_ratio_law": Judged("axis_ratio, check: axis ratio law", "that of the curvatures, " + _EXACT),
    "axis_ratio_seen_law": NotJudged("A law of the curvatures, which are judged; tests hold it to its formula."),
    "gain_1": Judged("check: gains", "gain_error is that of gains and curvatures, " + _EXACT),
    "gain_2": Judged("check: gains", "gain_error is that of gains and curvatures, " + _EXACT),
    "gain_error": Judged("gain_error, single gain error", _RATIO),
    "gain_oracle_error": Judged("gain_oracle_error, check: gains", _RATIO),
    "direction_error_deg": Judged("direction_deg, single direction", _ERROR),
    # Reliefs
    "visible_id": Judged("false", "which detections are false"),
    "visible_snr": NotJudged("`peak_snr` judges the same light and noise."),
    "frame_visible": NotJudged("A count of the truth; the definition and the seeds fix it."),
    "pool": NotJudged("A property of the drawn film; the definition and the seeds fix it."),
    "radius_px": _CLOUD,
    "radius_law_px": _CLOUD,
    **dict.fromkeys(
        ("cloud", "cloud_glints", "cloud_glints_law", "cloud_visible", "cloud_error_deg", "cloud_error_law_deg",
         "cloud_kd_min", "cloud_kd_max", "cloud_cov_11", "cloud_cov_12", "cloud_cov_22"), _CLOUD,
    ),
}  # fmt: skip
"""Columns of results.parquet that always exist; swept parameters are part of the setting. All numbers are hashed, and
any change of one is told as "not bit-equal"."""

_ROWS = "that of the rows, computed anew, to 1e-9"
_COUNT = Judged("published", _ROWS)
_WITH_TESTS = "published"

SUMMARY: dict[str, Judged | NotJudged] = {
    "n": Judged(f"n, {_WITH_TESTS}", f"no highlight may be missing; {_ROWS}"),
    "n_ok": Judged(f"unanswered, {_WITH_TESTS}", f"{_RATE}; {_ROWS}"),
    "n_failed_by_reason": Judged("single answers, published failed", f"{_SAME_SEEDS}; their sum is {_ROWS}"),
    "n_missed": Judged(f"missed, {_WITH_TESTS}", f"{_RATE}; {_ROWS}"),
    "n_false": Judged(f"false, single false, {_WITH_TESTS}", f"{_RATE} a frame; {_ROWS}"),
    "n_instrument": NotJudged("Detections on an instrument count nowhere else; the definition and the seeds fix them."),
    "mean_deg": Judged(f"mean_deg, {_WITH_TESTS}", f"{_ERROR}; {_ROWS}"),
    "mean_base_deg": Judged(f"base_deg, {_WITH_TESTS}", f"{_ERROR}; {_ROWS}"),
    "mean_oracle_deg": Judged(f"oracle_deg, {_WITH_TESTS}", f"{_ERROR}; {_ROWS}"),
    "rms_deg": _COUNT,
    "std_deg": _COUNT,
    "median_deg": _COUNT,
    "p95_deg": _COUNT,
    "max_deg": _COUNT,
    "mean_penalised_deg": Judged(f"mean_penalised_deg, {_WITH_TESTS}", f"{_ERROR}; {_ROWS}"),
    "ci95_deg": Judged("mean_deg", _ROWS),
    "coverage95": Judged(f"coverage95, truth_in_region, {_WITH_TESTS}", f"{_LIMITS.coverage:g}, either way; {_ROWS}"),
}
"""Figures of a setting and estimator in summary.json."""
