"""Move the light away from the camera, and tell the estimators where it is.

With the light beside the camera the highlight is no longer where the surface faces the camera. An estimator that
reverses the sightline is then off by half the angle between light and camera, seen from the surface. `bisector` is told
the light's position and the working distance, and takes the direction halfway between the two.

Picture: error against the light's offset, with the law. Takes 10 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, angle_deg, options, save

import simtest

DISTANCE_MM = 10.0
chosen = options(__doc__)
offsets_mm = (0.5, 2.0) if chosen.quick else (0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0)
seeds = range(1 if chosen.quick else 3)  # of the noise, 5 % of the peak
names = ("brightest_point", "cone_axis", "bisector")

errors = {name: [] for name in names}
for offset in offsets_mm:
    settings = {"rig.lights.0.offset_mm": offset, "surface.distance_mm": DISTANCE_MM, "surface.tilt_deg": 10.0}
    found = {name: [] for name in names}
    for seed in seeds:
        frame = simtest.render("plane", settings | {"known.distance_mm": DISTANCE_MM, "sensor.seed": seed})
        truth = next(highlight for highlight in frame.highlights if highlight.isolated)
        # The calibration holds the light's position and the distance; frame.camera alone would not.
        spot = simtest.reconstruct(frame.image, frame.calibration, estimators=names)[0]
        for name, result in spot.estimates.items():
            if not isinstance(result, simtest.Failure):
                found[name].append(angle_deg(result.normal, truth.normal))
    for name in names:
        errors[name].append(np.mean(found[name]))
    print(f"offset {offset:g} mm: " + ", ".join(f"{name} {errors[name][-1]:.3f} deg" for name in names))

figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
smooth = np.linspace(min(offsets_mm), max(offsets_mm), 200)
law = np.degrees(np.arctan(smooth / DISTANCE_MM)) / 2
axis.plot(smooth, law, "--", color="#747981", label="law: half the angle between light and camera")
for name, marker in zip(names, "^os", strict=True):
    axis.plot(offsets_mm, errors[name], marker, color=COLOURS[name], label=name, markersize=7)
axis.set(yscale="log", xlabel=f"light beside the camera, mm, at {DISTANCE_MM:g} mm from the surface")
axis.set(ylabel="mean error of the normal, deg", title="plane tilted by 10 deg, noise 5 % of the peak")
axis.grid(color="#E7E7E7")
axis.legend(loc="center right")
save(figure, chosen.out / "04_light_offset.png")
