"""Estimate the normal at one highlight, and compare the estimators with the truth.

The light is at the camera, so the normal at the BP points back along the sightline: all that an estimator must do is
find the BP. `cone_axis` and `curved` find it from several isophotes (curves of equal brightness), `brightest_point`
from the peak alone. `circle_pose` takes the isophote's shape for a tilted circle, and this surface is curved.

Picture: the highlight with its isophotes, and each estimator's error beside the uncertainty that it states. Takes 3 s
of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, TRUTH, angle_deg, grey, options, save

import simtest

chosen = options(__doc__)
size = 203 if chosen.quick else 406  # px
camera = {"camera.width": size, "camera.height": size, "camera.fx": float(size), "camera.fy": float(size)}
frame = simtest.render("cylinder", camera | {"surface.tilt_deg": 5.0, "surface.spin_deg": 30.0})
truth = next(highlight for highlight in frame.highlights if highlight.isolated)

# The frame and its camera are all that reconstruction needs; the calibration adds what is known of light and response.
spot = simtest.reconstruct(frame.image, frame.calibration)[0]
errors, stated = {}, {}
for name, result in spot.estimates.items():
    if isinstance(result, simtest.Failure):
        print(f"{name}: no normal ({result})")
        continue
    errors[name] = angle_deg(result.normal, truth.normal)
    if result.covariance is not None:
        stated[name] = np.degrees(np.sqrt(np.trace(result.covariance)))
    uncertainty = f", states {stated[name]:.3f} deg" if name in stated else ""
    print(f"{name}: error {errors[name]:.3f} deg{uncertainty}")

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", width_ratios=(1, 1.4))
left.imshow(grey(frame.image), cmap="gray", extent=(0, size, size, 0))
for number, (_, curve) in enumerate(spot.estimates["cone_axis"].contours(spot.patch)):
    left.plot(*curve.T, color=COLOURS["cone_axis"], linewidth=1.2, label="" if number else "isophotes")
left.plot(*truth.bp_px, "+", color=TRUTH, markersize=12, markeredgewidth=2, label="true BP")
x, y, width, height = spot.region.box
left.set(xlim=(x, x + width), ylim=(y + height, y), xlabel="x, px", ylabel="y, px", title="highlight")
left.legend(loc="lower right")

right.barh(list(errors), list(errors.values()), color=[COLOURS[name] for name in errors])
for name, sigma in stated.items():
    right.plot(sigma, name, "D", color="black", label="" if name != next(iter(stated)) else "stated standard deviation")
for name, error in errors.items():
    beside = max(error, stated.get(name, 0.0))
    right.annotate(f"{error:.2g} deg", (beside, name), (8, 0), textcoords="offset points", va="center")
right.set(xscale="log", xlabel="angle between estimated and true normal, deg", title="error of the normal")
right.set_xlim(2e-3, 500)
right.invert_yaxis()
right.legend(loc="lower right")
save(figure, chosen.out / "02_normal_from_one_highlight.png")
