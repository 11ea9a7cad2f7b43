"""What the files hold that a reconstruction and a run write; a test compares the keys with files that were written."""

NORMALS = {
    "image": "name of the picture",
    "camera": "the camera, as a camera file has it",
    "encoding": "kind of the response that was undone",
    "detector": "name of the detector",
    "smoothing_px": "width of the Gaussian, px",
    "inferred": "which of encoding, saturation_level, detector, smoothing_px and estimators were not given, but chosen",
    "view": "`circle` (cx, cy, radius, px) of a round view and `outline` of what is seen; null: the whole picture",
    "warnings": "one line each",
    "assumed": "what is not known exactly: `what`, `distribution`, `how_to_narrow`, `given` (by the calibration)",
    "stated": "what the best estimates state: medians of the parts of their budgets; null where none states anything",
    "stated_of_organ": "the same of the same normals as those of the organ below its relief",
    "frame": "the frame of all vectors, in words",
    "specularities": "a list, the brightest first: the next table",
    "clouds": "clouds of highlights that estimates rest on: specularity, estimator, highlights, points_px, covariance, "
    "axis_ratio, seen, slope_deg (value, low, high), outline",
    "no_cloud": "why no cloud tells the organ's normal, where `cloud` ran by default; else null",
    "other_highlights": "highlights of other kinds, by colour alone: box_px, peak_px, and "
    "the keys from kind to outline of the next table",
    "provenance": "versions and machine",
    "reference": "with `--reference` only: source, problems, compared, missed, and by estimator n, mean_deg, std_deg, "
    "mean_oracle_deg, std_oracle_deg, inside, inside_organ (shares of 95 % regions that hold it), and wrong_and_sure",
}
"""Keys of normals.json."""

SPECULARITY = {
    "id": "number in the picture",
    "box_px": "x, y, width, height of the region, px",
    "peak_px": "brightest point, px; null where the region has none",
    "sightline": "unit vector through the peak, camera frame; null where the lens images none",
    "kind": "`specular`, or another kind of highlight; by colour alone",
    "area_px": "by colour alone", "peaks": "number of its peaks; by colour alone",
    "clipped": "share of clipped pixels; by colour alone",
    "specular_peak": "height over its surroundings; by colour alone",
    "shape": "axis_ratio, residual, wander, tint, clutter; by colour alone", "outline": "px; by colour alone",
    "score": "how much it looks like a highlight, 0 to 1, fitted on rendered foolers: no probability; null for clouds",
    "best": "name of the estimator whose normal is the best; null where all failed, or the score is too small",
    "best_because": "why, in words",
    "estimates": "by estimator: the next table",
    "track": "in folders and videos: number of the same specularity over frames",
    "reference": "with `--reference` only: normal, and error_deg and error_oracle_deg by estimator; null where the "
    "sightline misses the reference",
}  # fmt: skip
"""Keys of an entry of `specularities`."""

ESTIMATE = {
    "status": "`ok`, or the reason of the failure",
    "detail": "of a failure, in words; a failure has no other keys",
    "normal": "proposed unit normal, camera frame, facing the camera",
    "candidates": "all normals that the data allow, the proposed one first",
    "choice_margin": "how clearly the proposed one won, in standard deviations",
    "look_px": "pixel at whose surface point the normal is proposed, px",
    "axis_ratio": "smaller over larger half-axis of the back-projected cone",
    "isovalues": "shares of the peak at which isophotes were fitted",
    "target": "`fine` or `base`: surface whose normal is stated",
    "covariance": "2 x 2, of the normal in its tangent plane, rad^2; null where none is stated",
    "organ_covariance": "the same of the same normal as that of the organ below its relief",
    "budget": "the parts of the covariance by name, rad^2",
    "curvature": "directions, axis_ratio, and gains (1 + d k) by hypothesis; null where not estimated",
    "flags": "warnings",
    "isophotes": "t (share of the peak) and points, px",
    "ellipses": "fitted conics, 3 x 3, px; none where the lens distorts",
    "cones": "3 x 3, of the sightlines through the fitted curves, camera frame",
    "curves": "points of the fitted curves, px",
}
"""Keys of an estimate."""

CONSTRAINTS = {
    "version": ("()", "version of this layout"),
    "id": ("(N,)", "as in normals.json"),
    "pixel": ("(N, 2)", "where the highlight's brightest point is estimated, px; pixel centres at integer + 0.5"),
    "sightline": ("(N, 3)", "unit vector through the pixel, camera frame"),
    "normal": ("(N, 3)", "unit normal, camera frame, facing the camera"),
    "basis": ("(N, 2, 3)", "two unit vectors: the tangent basis that the covariance is in"),
    "covariance": ("(N, 2, 2)", "rad^2, against the surface's normal at that point, wherever it is; NaN where the "
                                "estimator gives none"),
    "covariance_at_pixel": ("(N, 2, 2)", "rad^2, against the surface's normal on the sightline through the pixel; NaN "
                                         "where the lobe's width, and so the curvature, is not known"),
    "candidates": ("(N, 2, 3)", "both normals of circle_pose where it answered, else those of the best estimator; NaN "
                                "where there is no second"),
    "estimator": ("(N,)", "name of the best estimator"),
    "target": ("(N,)", "`fine` or `base`"),
    "K": ("(3, 3)", "calibration matrix, px"),
}  # fmt: skip
"""Arrays of constraints.npz, with their shapes."""
