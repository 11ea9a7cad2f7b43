"""Which method should I use? Run a small grid of situations, and find the best one in each.

The surface is a patch of curvature k at the distance d = 10 mm; d k = -0.5 is a wall seen from inside, 2 a fold. The light
is at the camera or 1 mm beside it, and the estimators are told where. Noise is 2 or 10 % of the peak.

Picture: a table of mean errors, the best of each situation framed. Takes 25 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
import polars as pl
from common import options, save
from matplotlib.colors import LogNorm

import simtest

NAMES = ["circle_pose", "brightest_point", "cone_axis", "bisector", "photometric"]
EXPERIMENT = f"""
realisations = REALISATIONS
seed = 7
estimators = {NAMES}
[[groups]]
scene = "saddle"
isolated = false
set = {{ "surface.k2_per_mm" = 0.0, "known.distance_mm" = 10.0 }}
sweep = [
    {{ "surface.k1_per_mm" = [-0.05, 0.0, 0.2] }},
    {{ "rig.lights.0.offset_mm" = [0.0, 1.0] }},
    {{ "sensor.noise_sigma" = [0.02, 0.1] }},
]
"""
SITUATION = ["surface.k1_per_mm", "rig.lights.0.offset_mm", "sensor.noise_sigma"]

chosen = options(__doc__)
experiment = chosen.out / "10_situations.toml"
experiment.write_text(EXPERIMENT.replace("REALISATIONS", "1" if chosen.quick else "10"))
simtest.validate(experiment, chosen.out / "10_run")  # also writes 10_run/index.html, the page

rows = pl.read_parquet(chosen.out / "10_run" / "results.parquet").filter(pl.col("true_id").is_not_null())
# A highlight without an answer counts as 90 deg, so that refusing is no way to a small mean.
error = pl.when(pl.col("status") == "ok").then(pl.col("error_deg")).otherwise(90.0).mean()
means = rows.group_by(*SITUATION, "estimator").agg(error.alias("error_deg"))
table = means.pivot("estimator", index=SITUATION, values="error_deg").sort(SITUATION)
values = table.select(NAMES).to_numpy()

labels = [f"d k {10 * k:g}, light {offset:g} mm aside, noise {100 * noise:g} %" for k, offset, noise in table[SITUATION].rows()]
figure, axis = plt.subplots(figsize=(9, 5), layout="constrained")
drawn = axis.imshow(values, norm=LogNorm(0.005, 90), cmap="cividis", aspect="auto")
for row, errors in enumerate(values):
    best = int(np.nanargmin(errors))
    print(f"{labels[row]}: {NAMES[best]}, {errors[best]:.3f} deg")
    axis.add_patch(plt.Rectangle((best - 0.46, row - 0.44), 0.92, 0.88, fill=False, edgecolor="#D55E00", linewidth=2.5))
    for column, value in enumerate(errors):
        axis.text(column, row, f"{value:.2g}", ha="center", va="center", color="white" if value < 1 else "black")
axis.set_xticks(range(len(NAMES)), NAMES)
axis.set_yticks(range(len(labels)), labels)
axis.set_title("mean error of the normal, deg; the best is framed")
figure.colorbar(drawn, label="deg")
save(figure, chosen.out / "10_which_method.png")
