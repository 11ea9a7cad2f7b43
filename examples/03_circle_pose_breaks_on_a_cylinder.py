"""See where the published method breaks: its error on cylinders of smaller and smaller radius.

`circle_pose` takes an isophote for the picture of a circle on a plane. On a cylinder of radius R, seen from a distance
d, the isophotes are ellipses with axis ratio R/(R + d), and the method turns the normal by acos(R/(R + d)). `cone_axis`
uses the isophotes' centre alone, which carries the normal whatever the curvature.

Picture: error of both against R/d, with the law. Takes 15 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, angle_deg, options, save

import simtest

DISTANCE_MM = 10.0
chosen = options(__doc__)
ratios = (100.0, 3.0, 0.5) if chosen.quick else (100.0, 30.0, 10.0, 5.0, 3.0, 1.0, 0.5)
seeds = range(1 if chosen.quick else 5)  # of the noise, 5 % of the peak

errors = {"circle_pose": [], "cone_axis": []}
for ratio in ratios:
    found = {name: [] for name in errors}
    for seed in seeds:
        frame = simtest.render("cylinder", {"surface.radius_mm": ratio * DISTANCE_MM, "sensor.seed": seed})
        truth = next(highlight for highlight in frame.highlights if highlight.isolated)
        for name, result in simtest.reconstruct(frame.image, frame.camera)[0].estimates.items():
            if name in found and not isinstance(result, simtest.Failure):
                found[name].append(angle_deg(result.normal, truth.normal))
    for name, values in found.items():
        errors[name].append(np.mean(values))
    print(f"R/d = {ratio:g}: " + ", ".join(f"{name} {values[-1]:.3f} deg" for name, values in errors.items()))

figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
smooth = np.geomspace(min(ratios), max(ratios), 200)
axis.plot(smooth, np.degrees(np.arccos(smooth / (smooth + 1))), "--", color="#747981", label="law: acos(R / (R + d))")
for (name, values), marker in zip(errors.items(), "so", strict=True):
    axis.plot(ratios, values, marker, color=COLOURS[name], label=name, markersize=7)
axis.set(xscale="log", yscale="log", xlabel="R/d: radius of the cylinder over its distance")
axis.set(ylabel="mean error of the normal, deg", title="from curved on the left to nearly flat on the right")
axis.set_xticks(ratios, [f"{ratio:g}" for ratio in ratios])
axis.minorticks_off()
axis.grid(color="#E7E7E7")
axis.legend(loc="center right")
save(figure, chosen.out / "03_circle_pose_breaks_on_a_cylinder.png")
