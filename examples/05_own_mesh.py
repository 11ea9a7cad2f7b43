"""Validate the estimators on a mesh of your own.

    python examples/05_own_mesh.py my_organ.ply

takes a PLY, OBJ, STL or VTK file with lengths in mm; without one, the example makes a bumpy organ of 80 mm. The camera
looks at it from outside (from inside where the mesh is a tube), and `surface.viewpoint` numbers the views. The command
`simtest mesh check my_organ.ply` tells whether a mesh is sound and fine enough for highlights;
`surface.edge_mm` refines it.

Picture: three views with the true highlights, and the errors of all views. Takes 16 s of processor time.
"""

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from common import COLOURS, angle_deg, grey, options, save

import simtest

chosen = options(__doc__, "mesh")
if chosen.mesh is None:
    organ = trimesh.creation.icosphere(subdivisions=4 if chosen.quick else 6, radius=40.0)
    x, y, z = organ.vertices.T / 40.0
    organ.vertices *= (1 + 0.03 * np.sin(9 * x + 1) * np.cos(8 * y) + 0.02 * np.sin(11 * z + 4 * x))[:, None]
    chosen.mesh = chosen.out / "05_bumpy_organ.ply"
    organ.export(chosen.mesh)

figure, axes = plt.subplots(2, 2, figsize=(9, 6.3), layout="constrained")
*views, chart = axes.flat
errors: dict[str, list[float]] = {}
for viewpoint in range(2 if chosen.quick else 8):
    seen = {"sensor.response": {"type": "srgb"}, "sensor.noise_sigma": 0.003, "camera.fx": 640.0, "camera.fy": 640.0}
    frame = simtest.render("anatomy", seen | {"surface.path": str(chosen.mesh), "surface.viewpoint": viewpoint})
    found = simtest.reconstruct(frame.image, frame.calibration)
    truths = [highlight for highlight in frame.highlights if highlight.isolated]
    for truth in truths:
        # Detections come from the frame alone; the one within 10 px is that of this highlight.
        near = [spot for spot in found if np.hypot(*(np.array(spot.region.peak) - truth.bp_px)) < 10]
        for name, result in (near[0].estimates if near else {}).items():
            if not isinstance(result, simtest.Failure):
                errors.setdefault(name, []).append(angle_deg(result.normal, truth.normal))
    print(f"view {viewpoint}: {len(truths)} true isolated highlights, {len(found)} found")
    if viewpoint < len(views):
        views[viewpoint].imshow(grey(frame.image), cmap="gray", vmin=0, vmax=1)
        for truth in truths:
            views[viewpoint].plot(*truth.bp_px, "o", color="#F5D90A", markersize=18, fillstyle="none", label="true BP")
        views[viewpoint].legend(*(each[:1] for each in views[viewpoint].get_legend_handles_labels()), loc="lower right")
        views[viewpoint].set(title=f"view {viewpoint}", xlabel="x, px", ylabel="y, px")

for row, (name, values) in enumerate(errors.items()):
    chart.plot(values, [row] * len(values), "o", color=COLOURS[name], alpha=0.6)
    chart.plot(np.median(values), row, "|", color="black", markersize=26, label="" if row else "median")
    print(f"{name}: median error {np.median(values):.3f} deg at {len(values)} highlights")
chart.set_yticks(range(len(errors)), list(errors))
chart.set(xscale="log", xlabel="error of the normal, deg", title="all views", ylim=(-0.6, len(errors) - 0.4))
chart.grid(color="#E7E7E7")
chart.legend(loc="upper right")
save(figure, chosen.out / "05_own_mesh.jpg")
