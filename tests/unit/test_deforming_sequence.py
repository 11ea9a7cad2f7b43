"""Sequences of deforming surfaces: flow follows the tissue."""

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.simulation.flow import SEEN, SeenSurface, flow_between, moved_between
from simtest.spec import scene_from_dict

PRESS = {"type": "dent", "amplitude_mm": -1.5, "period_s": 2.0, "direction": [0.2, 0, 1], "radius_mm": 6.0,
         "centre_mm": [2, 1, 0]}  # fmt: skip
WARP = {"type": "breathing", "amplitude_mm": 1.5, "period_s": 4.0, "direction": [0, 0.3, 1], "along": [1, 0.5, 0],
        "wavelength_mm": 40.0, "turn_deg": 2.0, "axis": [1, 0, 0]}  # fmt: skip


def scene(time_s, across_mm):
    surface = {"type": "quadric", "distance_mm": 20.0, "k1_per_mm": 0.03, "k2_per_mm": -0.02}
    camera = {"width": 96, "height": 72, "fx": 84.0, "fy": 84.0, "cx": 48.0, "cy": 36.0}
    moved = {"translation_mm": [across_mm, 0.0, 0.0]}
    return scene_from_dict(
        {"surface": surface, "camera": {**camera, "moved": moved}, "deformation": [WARP, PRESS], "time_s": time_s}
    )


@pytest.mark.ci  # meanwhile: test_flow for tissue at rest, test_deformed_render for tissue that moves
def test_flow_is_that_of_the_tissue():
    """Forward and back is no way at all; and the flow is the motion of material points."""
    times = 0.1, 0.3
    scenes = [scene(t, 2 * t) for t in times]
    session = Session(scenes[0])
    seen = []
    for now in scenes:
        session.update(now)
        seen.append(SeenSurface.of(session))
    there, back = moved_between(session, *times), moved_between(session, *times[::-1])
    forward = flow_between(session, *seen, there)
    session.update(scenes[0])
    assert (forward.state == SEEN).mean() > 0.7
    # To the next frame's pixels: cast the rays there, move back, project.
    where = forward.state == SEEN
    pixels = (session.camera.pixel_centres() + forward.flow_px)[where][::50]
    session.update(scenes[1])
    world = session.to_model(session.exact_points(pixels).position)
    returned = seen[0].project(back(world))
    assert np.abs(returned - session.camera.pixel_centres()[where][::50]).max() < 1e-6
    # Control: as if the tissue stood still.
    rigid = flow_between(session, *seen)
    assert np.nanmedian(np.linalg.norm(rigid.flow_px - forward.flow_px, axis=-1)) > 0.1


@pytest.mark.slow
def test_a_film_of_a_deforming_colon(tmp_path):
    """`simtest views --along --fps` moves the scene's time, and writes the flow of the tissue."""
    from simtest import api

    camera = {"width": 80, "height": 60, "fx": 60.0, "fy": 60.0, "cx": 40.0, "cy": 30.0}
    surface = {"type": "anatomy", "path": "colon", "view": "wall", "path_share": 0.3}
    still = Session(scene_from_dict({"surface": surface, "camera": camera}))
    pose = still.surface.model_from_camera
    wave = {"type": "peristalsis", "amplitude_mm": 2.0, "period_s": 2.0, "axis": pose[:3, 2].tolist(),
            "radius_mm": 15.0, "wavelength_mm": 40.0, "centre_mm": pose[:3, 3].tolist()}  # fmt: skip
    table = scene_from_dict({"surface": surface, "camera": camera, "deformation": [wave], "time_s": 0.5})
    sampled = api.sample_views(table, tmp_path, 3, along=(0.3, 0.302), fps=10.0, labels=True)
    assert [view.time_s for view in sampled.views] == pytest.approx([0.5, 0.6, 0.7])
    flow = np.load(tmp_path / "flow_0000.npz")
    assert np.isfinite(flow["forward"]).mean() > 0.9
    assert (flow["forward_state"] == SEEN).mean() > 0.5
