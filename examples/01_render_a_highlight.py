"""Render one specular highlight with its ground truth.

A cylinder of 10 mm radius, 10 mm in front of the camera, with the light at the camera. The frame comes with exact
depth, normals and curvatures at every pixel, and with the true position of the brightest point (BP): the point of the
surface where the normal bisects the directions to the light and to the camera.

Picture: the frame with the BP, the depth, and the tilt of the normals. Takes 3 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
from common import TRUTH, grey, options, save

import simtest

chosen = options(__doc__)
size = 203 if chosen.quick else 406  # px
settings = {
    "camera.width": size, "camera.height": size, "camera.fx": float(size), "camera.fy": float(size),
    "surface.tilt_deg": 10.0, "surface.spin_deg": 30.0, "reflectance.diffuse": 0.3, "sensor.noise_sigma": 0.003,
    "sensor.response": {"type": "srgb"},
}  # fmt: skip
frame = simtest.render("cylinder", settings)

bp = next(highlight for highlight in frame.highlights if highlight.isolated)
print(f"BP at ({bp.bp_px[0]:.2f}, {bp.bp_px[1]:.2f}) px, {bp.distance:.2f} mm from the camera")
print(f"normal there: {bp.normal.round(4)}, camera frame (x right, y down, z forward)")
print(f"distance times curvature: {bp.kd_min:.2f} along the cylinder, {bp.kd_max:.2f} around it")

tilt = np.degrees(np.arccos(np.clip(-frame.truth.normal[..., 2], -1, 1)))
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.4), layout="constrained")
axes[0].imshow(grey(frame.image), cmap="gray", vmin=0, vmax=1)
axes[0].plot(*bp.bp_px, "+", color=TRUTH, markersize=14, markeredgewidth=2, label="true BP")
axes[0].legend(loc="lower right")
axes[0].set_title("frame")
for axis, values, title, unit in (
    (axes[1], frame.truth.depth, "depth", "distance along the ray, mm"),
    (axes[2], tilt, "normals", "angle to the optical axis, deg"),
):
    figure.colorbar(axis.imshow(values, cmap="viridis"), ax=axis, label=unit, shrink=0.85)
    axis.set_title(title)
for axis in axes:
    axis.set_xlabel("x, px")
axes[0].set_ylabel("y, px")
save(figure, chosen.out / "01_render_a_highlight.png")
