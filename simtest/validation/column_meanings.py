"""What each column of results.parquet means; the manual's page of files is made from it.

Angles of errors are between an estimate's proposed normal and a true one, in degrees. BP is the highlight's brightest
point. "Law" is a closed form of docs/concepts/theory.md.
"""

from simtest.estimators.budget import PARTS, STATED

_BUDGET = {
    f"budget_{part}_deg": f"standard deviation of the budget's part `{part}`, deg: the root of its trace"
    for part in (*PARTS, STATED)
}

MEANINGS: dict[str, str] = {
    "experiment": "name of the experiment",
    "label": "label of the group of settings: the name of its curve",
    "surface": "kind of surface",
    "reflectance": "kind of reflectance",
    "setting": "name of the setting: its swept parameters with their values",
    "realisation": "number of the realisation, from 0",
    "specularity": "number of the detection in the frame, the brightest first; null where the highlight was missed",
    "true_id": "number of the true highlight; null for a detection that matches none",
    "seed": "seed of the realisation; `--set sensor.seed=SEED` makes its noise again",
    "estimator": "name of the estimator",
    "status": "`ok`, `missed`, or the reason of the failure",
    "flags": "warnings of the estimate; the detail of a failure",
    "error_deg": "error of the proposed normal against the true normal at the true BP, deg; of the surface that "
    "`target` names",
    "error_oracle_deg": "error of the better candidate, deg",
    "error_look_deg": "error against the true normal of the surface at the pixel (`look_x_px`, `look_y_px`), deg",
    "error_law_deg": "what the law of section 4 predicts for `error_deg`; null where it predicts nothing",
    "n_candidates": "number of normals that the data allow",
    "choice_margin": "how clearly the proposed candidate won, in standard deviations",
    "rank_correct": "rank of the better candidate, from 0: 0 where the proposed one is the better",
    "normal_x": "proposed normal, camera frame", "normal_y": "", "normal_z": "",
    "truth_x": "true normal, camera frame", "truth_y": "", "truth_z": "",
    "bp_x_px": "detected peak, px", "bp_y_px": "",
    "bp_true_x_px": "true BP, px", "bp_true_y_px": "",
    "look_x_px": "pixel at whose surface point the normal is proposed, px", "look_y_px": "",
    "cov_11": "covariance of the normal in its tangent plane, rad^2; null where the estimator states none",
    "cov_12": "", "cov_22": "",
    "mahalanobis2": "squared distance of the true normal by that covariance",
    "distance_mm": "distance of the true BP from the camera, mm",
    "kd_min": "distance times smaller principal curvature of the fine surface at the true BP, convex positive",
    "kd_max": "the same of the larger curvature",
    "eps_over_d": "distance from the camera to the light that made the highlight, over `distance_mm`",
    "noise_sigma": "white noise, share of full scale",
    "peak_snr": "peak above its surroundings over the noise at the peak's level",
    "isovalue": "isovalue of the fitted isophote, share of the peak; null where there are several",
    "isovalues": "all isovalues that were fitted",
    "axis_ratio": "smaller over larger half-axis of the back-projected cone",
    "axis_ratio_law": "axis ratio by the leading order (3.2)",
    "path_depth": "longest light path that was rendered; 2: direct light, more adds inter-reflections",
    "n_lights": "lights of the rig, in view or not",
    "saturated_share": "share of the isophote's area at half height that is clipped; null where the sensor does not "
    "clip",
    "gain_1": "1 + d k along the direction of the smaller gain, as proposed",
    "gain_2": "the same of the larger gain",
    "gain_error": "larger of the two gains' relative errors, with the proposed signs",
    "gain_oracle_error": "the same with the best signs",
    "direction_error_deg": "direction of the smaller gain against the true one, 0 to 90 deg; null where the true gains "
    "are equal",
    "axis_ratio_seen_law": "axis ratio with its corrections (4.5), for estimates that take the isophotes as they are",
    "error_look_law_deg": "what `error_look_deg` should be, from the estimate's own miss, deg",
    "laws": "names of the laws that the page compares with this setting",
    "target": "surface whose normal the estimate states: `fine` or `base`",
    "error_fine_deg": "error against the normal of the fine surface, with its relief, deg",
    "error_base_deg": "error against the normal of the base, without the relief, deg",
    "error_base_law_deg": "law of section 7, item 4, for the mean of `error_base_deg` over the glints of a cloud, deg",
    "kd_min_base": "distance times smaller principal curvature of the base",
    "kd_max_base": "the same of the larger curvature",
    "visible_id": "number of the visible highlight in which the detection's peak, or the missed glint, lies; null "
    "where none is near, and without a relief",
    "visible_snr": "peak of that visible highlight over the noise",
    "frame_visible": "visible highlights of at least 10 sigma in the frame; null without a relief",
    "cloud": "number of the cloud; without a relief that of the highlight; null where there is none",
    "pool": "whether the true highlight lies in a pool of the film",
    "radius_px": "radius of the circle of the visible highlight's area, px, where it is whole and holds one glint",
    "radius_law_px": "the same by the shape of the fine surface (section 7, item 3), px",
    "cloud_glints": "glints of the cloud, however faint",
    "cloud_glints_law": "their expected number (section 7, item 2)",
    "cloud_visible": "visible highlights of the cloud of at least 10 sigma",
    "cloud_error_deg": "mean of the glints' fine normals against the base's normal at its own highlight point, deg",
    "cloud_error_law_deg": "its expected value if glints were independent (section 7, item 5), deg",
    "cloud_kd_min": "distance times smaller principal curvature of the base at that point",
    "cloud_kd_max": "the same of the larger curvature",
    "cloud_cov_11": "mean squares of the glints' positions about that point in its tangent plane, mm^2 (section 7, "
    "item 1)",
    "cloud_cov_12": "", "cloud_cov_22": "",
    **_BUDGET,
}  # fmt: skip
"""Meaning by column; an empty one is that of the column before it, of which it is a further component."""
