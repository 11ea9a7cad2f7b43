"""Add an estimator of your own and validate it beside the others.

`simtest.reconstruct` takes the object itself; `simtest.validate` and the commands find it by name, once its package has
in pyproject.toml, under [project.entry-points."simtest.estimators"]: centroid = "my_package.my_module:centroid"

Picture: error against the distance times curvature of cylinders. Takes 5 s of processor time.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import polars as pl
from common import COLOURS, options, save

import simtest


class Centroid:
    """The sightline through the centroid of the isophote at half the peak's value. It never sees the truth."""

    def estimate(self, patch, camera, priors):
        """Return the normal at a highlight."""
        contour = patch.isophote(0.5)  # closed polygon, shape (N, 2), px; or the reason why there is none
        if isinstance(contour, simtest.Failure):
            return contour
        centre = contour[:-1].mean(axis=0)
        normal = -camera.unproject(centre)
        return simtest.Estimate(normal=normal, candidates=normal[None], look_px=centre)


centroid = Centroid()

EXPERIMENT = """
estimators = ["cone_axis", "brightest_point", "centroid"]
[[groups]]
scene = "cylinder"
sweep = [{ "surface.radius_mm" = [100.0, 30.0, 10.0, 5.0, 3.0] }]
"""

if __name__ == "__main__":
    chosen = options(__doc__)
    # In place of `pip install my_package`: what it would write, in a folder that Python searches.
    package = chosen.out / "06_site" / "my_package-1.0.dist-info"
    package.mkdir(parents=True, exist_ok=True)
    (package / "METADATA").write_text("Name: my_package\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(f"[simtest.estimators]\ncentroid = {Path(__file__).stem}:centroid\n")
    sys.path.insert(0, str(package.parent))
    experiment = chosen.out / "06_cylinders.toml"  # noise 5 % of the peak
    experiment.write_text(f"realisations = {1 if chosen.quick else 10}\n{EXPERIMENT}")
    simtest.validate(experiment, chosen.out / "06_run")  # also writes 06_run/index.html, the page
    rows = pl.read_parquet(chosen.out / "06_run" / "results.parquet").filter(pl.col("status") == "ok")
    means = rows.group_by("estimator", "kd_max").agg(pl.col("error_deg").mean()).sort("kd_max")
    figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for (name,), curve in sorted(means.group_by("estimator")):
        axis.plot(curve["kd_max"], curve["error_deg"], "o-", color=COLOURS[name], label=name)
    axis.set(yscale="log", xlabel="d k: distance times curvature of the cylinder", ylabel="mean error, deg")
    axis.grid(color="#E7E7E7")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save(figure, chosen.out / "06_own_estimator.png")
