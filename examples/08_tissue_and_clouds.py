"""Wet tissue shows a cloud of small highlights: estimate the surface's normal from the whole cloud.

Tissue carries a fine relief, here with slopes of 4 deg. Each small highlight tells the normal of the relief at its own
point, not that of the smooth surface below it, the base. The highlights lie around the place where the base faces the
light, so their mean tells the base's normal: estimator `cloud`, with `target="base"`.

Picture: the frame, and the angles of all normals from the base's. Takes 5 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, TRUTH, angle_deg, options, save

import simtest

chosen = options(__doc__)
size = 384 if chosen.quick else 512  # px
settings = {
    "surface.distance_mm": 25.0, "surface.tilt_deg": 15.0,
    "surface.relief": {"seed": 3, "bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]},
    "reflectance": {"type": "tissue", "film": {"index": 1.36, "alpha": 0.03}, "translucency": {},
                    "albedo": {"preset": "colon_mucosa"}},
    "camera": {"width": size, "height": size, "fx": 1.0 * size, "fy": 1.0 * size},
    "sensor": {"noise_sigma": 0.01, "point_spread_px": 0.7, "exposure": {"percentile": 99.0},
               "response": {"type": "srgb"}, "saturation": True, "bits": 8},
    "render.samples_per_pixel": 4,
}  # fmt: skip
frame = simtest.render("plane", settings)
picture = np.round(255 * frame.image).astype(np.uint8)  # 8 bits: taken as a picture, highlights found by colour
base = frame.clouds[0].normal_base
spots = simtest.reconstruct(picture, frame.calibration, ["cone_axis", "cloud"], target="base")

# Axes across the base's normal, in which small angles are drawn.
right = np.cross(base, [0.0, 1.0, 0.0])
right /= np.linalg.norm(right)
across = np.stack([right, np.cross(base, right)])
normals = {"cone_axis": [], "cloud": []}
for spot in spots:
    for name, result in spot.estimates.items():
        if not isinstance(result, simtest.Failure):
            normals[name].append(result.normal)
for name, found in normals.items():
    errors = [angle_deg(normal, base) for normal in found]
    print(f"{name}: {len(found)} normals, mean error against the base {np.mean(errors):.2f} deg")

figure, (left, chart) = plt.subplots(1, 2, figsize=(10, 4.9), layout="constrained")
left.imshow(picture)
left.plot(*frame.clouds[0].bp_px, "+", color=TRUTH, markersize=16, markeredgewidth=2.5, label="BP of the base")
left.set(xlabel="x, px", ylabel="y, px", title="frame")
left.legend(loc="lower right")
for name, marker, label in (("cone_axis", "o", "single highlights (cone_axis)"), ("cloud", "*", "their cloud")):
    angles = np.degrees(np.array(normals[name]) @ across.T)
    chart.plot(*angles.T, marker, color=COLOURS[name], markersize=15 if marker == "*" else 5, label=label)
chart.plot(0, 0, "+", color=TRUTH, markersize=16, markeredgewidth=2.5, label="true normal of the base")
chart.set(xlabel="angle from the base's normal, deg", ylabel="angle across, deg", title="estimated normals")
chart.set_aspect("equal", adjustable="datalim")
chart.grid(color="#E7E7E7")
figure.legend(*chart.get_legend_handles_labels(), loc="outside lower right", ncols=3)
save(figure, chosen.out / "08_tissue_and_clouds.jpg")
