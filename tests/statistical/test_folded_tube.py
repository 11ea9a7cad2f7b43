"""Curvature that changes inside a highlight: the best of the default estimators follows the lobe to its peak."""

import numpy as np
import pytest

from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.options import DEFAULT_ESTIMATORS
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import load_scene
from simtest.validation.scoring import match

TUBE = {
    "surface.path": "colon", "surface.recipe.length_mm": 120.0, "surface.recipe.radius_mm": 20.0,
    "surface.recipe.bend_deg": 0.0, "surface.recipe.sway_deg": 0.0, "surface.recipe.taenia_mm": 0.0,
    "surface.recipe.fold_depth_mm": 6.0, "surface.recipe.fold_edge_mm": 3.0, "surface.recipe.fold_spacing_mm": 15.0,
    "reflectance.exponent": 20.0, "sensor.noise_sigma": 0.01,
}  # fmt: skip
"""A straight tube with folds, under a lobe so wide that the curvature changes inside its highlights."""


@pytest.mark.slow
def test_the_best_of_the_defaults_in_a_folded_tube():
    session, best, mean_axis = None, [], []
    for viewpoint in range(2000, 2030):
        scene = load_scene("anatomy", {**TUBE, "surface.viewpoint": viewpoint, "sensor.seed": viewpoint})
        session = session or Session(scene)
        view = render_view(session, scene)
        true = [highlight for highlight in view.highlights if highlight.isolated]
        found = reconstruct(view.frame(viewpoint), scene.calibration(None), DEFAULT_ESTIMATORS, least_score=0)
        for i, j in match(found, [highlight.bp_px for highlight in true]).items():
            for errors, estimate in ((best, found[i].best_estimate), (mean_axis, found[i].normals.get("cone_axis"))):
                if estimate is not None:
                    errors.append(float(angle_deg(estimate.normal, true[j].normal)))
    assert len(best) >= 8
    assert np.median(best) <= 0.1
    # what the mean of the cones' axes misses
    assert np.median(mean_axis) > 2 * np.median(best)
