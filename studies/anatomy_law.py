"""Compare circle pose with its law at each highlight of an anatomy: `python -m studies.anatomy_law FOLDER...`.

FOLDER is a run on the scene `anatomy`, such as studies/anatomy_table.py writes. The law (docs/concepts/theory.md,
section 4) has the highlight's own exact curvatures; beside it stands the law of a picture that is smoothed before the
ellipse is fitted, which adds s^2 to the ellipse's second moments (section 3).
"""

import sys
from pathlib import Path

import numpy as np
import polars as pl

from simtest.conventions import CIRCLE_POSE_ISOVALUE, DEFAULT_SMOOTHING_PX
from simtest.spec import load_scene
from simtest.validation import laws

TOLERANCE_DEG, TOLERANCE = 0.3, 0.03


def smoothed_law(rows: pl.DataFrame) -> np.ndarray:
    """Return the law's error, deg, of the smoothed picture at each highlight."""
    scene = load_scene("anatomy")
    camera = scene.camera.model()
    # c = 4 n of the Phong lobe.
    a, b = laws.isophote_half_axes(CIRCLE_POSE_ISOVALUE, 4 * scene.reflectance.exponent, rows["kd_min"], rows["kd_max"])
    x = (rows["bp_true_x_px"].to_numpy() - camera.cx) / camera.fx
    y = (rows["bp_true_y_px"].to_numpy() - camera.cy) / camera.fy
    # Pixels per radian of a direction off the axis: the root of fx fy / cos^3.
    per_radian = np.sqrt(camera.fx * camera.fy) * (1 + x**2 + y**2) ** 0.75
    added = -2 * np.log(CIRCLE_POSE_ISOVALUE) * (DEFAULT_SMOOTHING_PX / per_radian) ** 2
    low, high = np.minimum(a, b), np.maximum(a, b)
    return np.degrees(laws.circle_pose_error(np.sqrt(high**2 + added), np.sqrt(low**2 + added)))


def main() -> None:
    """Print a row for each run and law."""
    for folder in sys.argv[1:]:
        rows = pl.read_parquet(Path(folder) / "results.parquet").filter(
            (pl.col("estimator") == "circle_pose") & (pl.col("status") == "ok") & pl.col("error_law_deg").is_not_null()
        )
        measured = rows["error_oracle_deg"].to_numpy()
        for name, law in (("law", rows["error_law_deg"].to_numpy()), ("smoothed", smoothed_law(rows))):
            gap = np.abs(measured - law)
            met = np.mean(gap <= np.maximum(TOLERANCE_DEG, TOLERANCE * law))
            medians = " | ".join(f"{np.median(v):.2f}" for v in (measured, law, gap))
            print(f"| {rows['surface'][0]} | {name} | {rows.height} | {medians} | {met:.0%} |")


if __name__ == "__main__":
    main()
