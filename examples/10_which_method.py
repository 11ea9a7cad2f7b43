"""Which method should I use? Run a small grid of situations, and find the best one in each.

Three surfaces at 10 mm: flat, a fold of 5 mm radius, and a tube of 20 mm radius seen from inside. The light is at the
camera or 1 mm beside it, and the estimators are told where. Noise is 2 or 5 % of the peak.

Picture: a table of mean errors, the best of each situation framed. Takes 15 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
import polars as pl
from common import TRUTH, options, save
from matplotlib.colors import LogNorm

import simtest

NAMES = ["circle_pose", "brightest_point", "cone_axis", "bisector", "photometric"]
SURFACES = {
    "flat": '"surface.radius_mm" = 1e5',
    "fold": '"surface.radius_mm" = 5.0',
    "tube": '"surface.radius_mm" = 20.0, "surface.side" = "inside"',
}
GROUP = """
[[groups]]
label = "{name}, noise {percent} %"
scene = "cylinder"
set = {{ {surface}, "sensor.noise_sigma" = {percent}e-2, "known.distance_mm" = 10.0 }}
sweep = [{{ "rig.lights.0.offset_mm" = [0.0, 1.0] }}]
"""
OFFSET = "rig.lights.0.offset_mm"

chosen = options(__doc__)
head = f"realisations = {1 if chosen.quick else 10}\nseed = 7\nestimators = {NAMES}\n"
groups = [
    GROUP.format(name=n, surface=s, percent=p) for n, s in SURFACES.items() for p in ((5,) if chosen.quick else (2, 5))
]
experiment = chosen.out / "10_situations.toml"
experiment.write_text(head + "".join(groups))
simtest.validate(experiment, chosen.out / "10_run")  # also writes 10_run/index.html, the page
rows = pl.read_parquet(chosen.out / "10_run" / "results.parquet").filter(pl.col("true_id").is_not_null())
# A highlight without an answer counts as 90 deg, so that refusing is no way to a small mean.
error = pl.when(pl.col("status") == "ok").then(pl.col("error_deg")).otherwise(90.0).mean()
means = rows.group_by("label", OFFSET, "estimator").agg(error.alias("error_deg"))
table = means.pivot("estimator", index=["label", OFFSET], values="error_deg").sort("label", OFFSET)

labels = [f"{name}, light offset {offset:g} mm" for name, offset in table.select("label", OFFSET).rows()]
values = table.select(NAMES).to_numpy()
figure, axis = plt.subplots(figsize=(9, 5), layout="constrained")
drawn = axis.imshow(values, norm=LogNorm(0.002, 90), cmap="cividis", aspect="auto")
for row, errors in enumerate(values):
    best = int(np.nanargmin(errors))
    print(f"{labels[row]}: {NAMES[best]}, {errors[best]:.3f} deg")
    axis.add_patch(plt.Rectangle((best - 0.46, row - 0.44), 0.92, 0.88, fill=False, edgecolor=TRUTH, linewidth=2.5))
    for column, value in enumerate(errors):
        axis.text(column, row, f"{value:.2g}", ha="center", va="center", color="white" if value < 1 else "black")
axis.set_xticks(range(len(NAMES)), NAMES)
axis.set_yticks(range(len(labels)), labels)
axis.set_title("mean error of the normal, deg; the best is framed")
figure.colorbar(drawn, label="deg")
save(figure, chosen.out / "10_which_method.png")
