"""Optical flow: closed on the exact surface, equal to a plane's homography, and hidden where the horizon says so."""

from itertools import product

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.simulation.flow import HIDDEN, INSTRUMENT, NONE, OUT, SEEN, Flow, SeenSurface, flow_between, moved_between
from simtest.simulation.frame import render_view
from simtest.simulation.sequences import STRIDE_PX, SequenceLabels
from simtest.spec import scene_from_dict
from simtest.spec.camera import Moved
from tests.marked import marked

pytestmark = pytest.mark.render

SIZE = 96
LENSES = {"pinhole": None, "fisheye": {"type": "kannala_brandt", "k1": 0.02, "k2": -0.003}}
SURFACES = {
    "plane": {"type": "plane", "distance_mm": 10, "tilt_deg": 25, "azimuth_deg": 40},
    "sphere": {"type": "sphere", "distance_mm": 10, "radius_mm": 6},
    "inside": {"type": "sphere", "distance_mm": 10, "radius_mm": 14, "side": "inside"},
    "cylinder": {"type": "cylinder", "distance_mm": 10, "radius_mm": 4, "spin_deg": 20},
    "saddle": {"type": "quadric", "distance_mm": 10, "k1_per_mm": 0.05, "k2_per_mm": -0.05},
}


def scene_of(surface, lens=None, **tables):
    camera = {"width": SIZE, "height": SIZE, "fx": 90.0, "fy": 90.0, **({"distortion": lens} if lens else {})}
    return scene_from_dict({"surface": surface, "camera": camera, **tables})


def moved(scene, shift, turn):
    there = Moved(translation_mm=shift, rotation_deg=turn)
    return scene.model_copy(update={"camera": scene.camera.model_copy(update={"moved": there})})


def two_frames(scene, shift=(0.7, -0.4, 0.5), turn=(1.0, -2.0, 3.0)):
    session = Session(scene)
    first = SeenSurface.of(session)
    session.update(moved(scene, shift, turn))
    return session, first, SeenSurface.of(session)


def cycle_px(session, first, second, flow):
    """Cast back from where points arrive: how far from their pixels they end, px."""
    seen = flow.state == SEEN
    there = first.camera.pixel_centres()[seen] + flow.flow_px[seen]
    pose = second.world_from_camera
    directions = second.camera.unproject(there) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    points = origins + directions * session.exact_distances(origins, directions)[:, None]
    return np.linalg.norm(first.project(points) - first.camera.pixel_centres()[seen], axis=1)


@pytest.mark.parametrize(("lens", "name"), marked(product(LENSES, SURFACES), ci=[("fisheye", "saddle")]))
def test_the_cycle_closes(lens, name):
    session, first, second = two_frames(scene_of(SURFACES[name], LENSES[lens]))
    for a, b in ((first, second), (second, first)):
        flow = flow_between(session, a, b)
        assert np.count_nonzero(flow.state == SEEN) > SIZE * SIZE / 4
        found = cycle_px(session, a, b, flow)
        # A ray along an edge of a mesh may miss both its triangles.
        assert np.count_nonzero(np.isnan(found)) <= 2
        assert np.nanmax(found) < 1e-6


@pytest.mark.parametrize("wrong", ["inverted", "axes"])
def test_a_wrong_pose_opens_the_cycle(wrong):
    session, first, second = two_frames(scene_of(SURFACES["sphere"]))
    between = np.linalg.inv(first.world_from_camera) @ second.world_from_camera
    other = np.linalg.inv(between) if wrong == "inverted" else between @ np.diag([1.0, -1, -1, 1])
    off = SeenSurface(second.camera, first.world_from_camera @ other, second.position)
    flow = flow_between(session, first, off)
    state = np.where(np.isfinite(flow.flow_px[..., 0]), SEEN, NONE).astype(np.uint8)
    found = cycle_px(session, first, second, Flow(flow.flow_px, state))
    assert not np.any(found[np.isfinite(found)] < 1e-6)


def test_a_planes_flow_is_its_homography():
    scene = scene_of(SURFACES["plane"])
    session, first, second = two_frames(scene)
    flow = flow_between(session, first, second)
    # n . X = d in the first camera's frame, from the plane's own description.
    tilt, azimuth = np.radians([25, 40])
    n = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    d = n @ [0, 0, 10.0]
    pose = Moved(translation_mm=(0.7, -0.4, 0.5), rotation_deg=(1.0, -2.0, 3.0)).pose()
    K = first.camera.K
    R, t = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    H = K @ (R + np.outer(t, n) / d) @ np.linalg.inv(K)
    pixels = first.camera.pixel_centres()
    mapped = np.concatenate([pixels, np.ones((SIZE, SIZE, 1))], axis=-1) @ H.T
    np.testing.assert_allclose(pixels + flow.flow_px, mapped[..., :2] / mapped[..., 2:], atol=1e-9)
    assert set(np.unique(flow.state)) == {SEEN, OUT}


def test_what_lies_beyond_the_horizon_is_hidden():
    scene = scene_of({"type": "sphere", "distance_mm": 10, "radius_mm": 3})
    session, first, second = two_frames(scene, (6.0, 0.0, 0.0), (0.0, -20.0, 0.0))
    flow = flow_between(session, first, second)
    # On a sphere the tangent plane at a point decides; the centre is 13 mm before the first camera.
    T = first.world_from_camera
    centre = T[:3, :3] @ [0, 0, 13.0] + T[:3, 3]
    facing = np.einsum("...i,...i", first.position - centre, second.world_from_camera[:3, 3] - first.position) > 0
    with np.errstate(invalid="ignore"):
        inside = second.camera.contains(first.camera.pixel_centres() + flow.flow_px)
    on = np.isfinite(first.position[..., 0])
    np.testing.assert_array_equal(flow.state == SEEN, on & inside & facing)
    np.testing.assert_array_equal(flow.state == HIDDEN, on & inside & ~facing)
    np.testing.assert_array_equal(flow.state == OUT, on & ~inside)
    np.testing.assert_array_equal(flow.state == NONE, ~on)
    assert np.isnan(flow.flow_px[~on]).all()
    assert np.count_nonzero(flow.state == HIDDEN) > 50


def test_instruments_have_no_flow_and_hide():
    shaft = {"kind": "shaft", "tip": [0.5, 0.5], "depth_share": 0.5, "diameter_mm": 2}
    scene = scene_of(SURFACES["plane"], instruments=[shaft])
    session, first, second = two_frames(scene, (0.0, 1.5, 0.0), (0.0, 0.0, 0.0))
    flow = flow_between(session, first, second)
    covered = first.instrument > 0
    assert np.count_nonzero(covered) > 100
    np.testing.assert_array_equal(flow.state == INSTRUMENT, covered)
    assert np.isnan(flow.flow_px[covered]).all()
    hidden = flow.state == HIDDEN
    assert np.count_nonzero(hidden) > 100
    at = (first.camera.pixel_centres() + np.nan_to_num(flow.flow_px)).astype(int)[hidden]
    assert (second.instrument[at[:, 1], at[:, 0]] > 0).all()


def test_what_instruments_cover_is_seen_by_no_frame(tmp_path):
    """The matrix counts what the flow's states count: the points of the tissue that both frames show."""
    shaft = {"kind": "shaft", "tip": [0.4, 0.5], "depth_share": 0.5, "diameter_mm": 2, "azimuth_deg": -90.0}
    scene = scene_of(SURFACES["plane"], instruments=[shaft])
    labels, session = SequenceLabels(tmp_path), Session(scene)
    for now in (scene, moved(scene, (3.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
        session.update(now)
        labels.add(session, render_view(session, now))
    labels.close()
    sparse = np.s_[STRIDE_PX // 2 :: STRIDE_PX, STRIDE_PX // 2 :: STRIDE_PX]
    flow, shares = np.load(tmp_path / "flow_0000.npz"), np.load(tmp_path / "covisibility.npy")
    for name, share in (("forward", shares[0, 1]), ("backward", shares[1, 0])):
        counts = np.bincount(flow[f"{name}_state"][sparse].ravel(), minlength=5)
        assert min(counts[SEEN], counts[HIDDEN], counts[INSTRUMENT]) > 0
        assert share == pytest.approx(counts[SEEN] / (counts[SEEN] + counts[OUT] + counts[HIDDEN]))


def test_material_that_moves_takes_its_flow_along():
    session, first, _ = two_frames(scene_of(SURFACES["plane"]))
    session.update(scene_of(SURFACES["plane"]))
    shift = first.world_from_camera[:3, :3] @ [0.2, 0.0, 0.0]
    flow = flow_between(session, first, first, lambda points: points + shift)
    still = flow_between(session, first, first)
    np.testing.assert_allclose(still.flow_px, 0, atol=1e-9)
    depth = ((first.position - first.world_from_camera[:3, 3]) @ first.world_from_camera[:3, :3])[..., 2]
    np.testing.assert_allclose(flow.flow_px[..., 0], 90.0 * 0.2 / depth, rtol=1e-9)
    np.testing.assert_allclose(flow.flow_px[..., 1], 0, atol=1e-9)


def test_depths_are_those_of_the_truth():
    tissue = {"seed": 1, "bands": [{"slope_deg": 3.0, "wavelength_mm": 2.0}]}
    for surface in ({"type": "anatomy", "path": "colon", "relief": tissue}, SURFACES["saddle"]):
        session = Session(scene_of(surface))
        depth = session.depths()
        truth = session.truth()
        np.testing.assert_array_equal(np.isfinite(depth), truth.mask)
        np.testing.assert_allclose(depth, truth.depth, rtol=0, atol=1e-9)


# Tissue that deforms --------------------------------------------------------------------------------------------------


PRESS = {"type": "dent", "amplitude_mm": -1.5, "period_s": 2.0, "direction": [0.2, 0, 1], "radius_mm": 6.0,
         "centre_mm": [2, 1, 0]}  # fmt: skip
WARP = {"type": "breathing", "amplitude_mm": 1.5, "period_s": 4.0, "direction": [0, 0.3, 1], "along": [1, 0.5, 0],
        "wavelength_mm": 40.0, "turn_deg": 2.0, "axis": [1, 0, 0]}  # fmt: skip


def deforming(time_s, across_mm):
    surface = {"type": "quadric", "distance_mm": 20.0, "k1_per_mm": 0.03, "k2_per_mm": -0.02}
    camera = {"width": 48, "height": 36, "fx": 42.0, "fy": 42.0, "cx": 24.0, "cy": 18.0}
    moved = {"translation_mm": [across_mm, 0.0, 0.0]}
    return scene_from_dict(
        {"surface": surface, "camera": {**camera, "moved": moved}, "deformation": [WARP, PRESS], "time_s": time_s}
    )


@pytest.mark.ci  # meanwhile: test_flow for tissue at rest, test_deformed_render for tissue that moves
def test_flow_is_that_of_the_tissue():
    """Forward and back is no way at all; and the flow is the motion of material points."""
    times = 0.1, 0.3
    told_scenes = [deforming(t, 2 * t) for t in times]
    session = Session(told_scenes[0])
    seen = []
    for now in told_scenes:
        session.update(now)
        seen.append(SeenSurface.of(session))
    there, back = moved_between(session, *times), moved_between(session, *times[::-1])
    forward = flow_between(session, *seen, there)
    session.update(told_scenes[0])
    assert (forward.state == SEEN).mean() > 0.7
    # To the next frame's pixels: cast the rays there, move back, project.
    where = forward.state == SEEN
    pixels = (session.camera.pixel_centres() + forward.flow_px)[where][::20]
    session.update(told_scenes[1])
    world = session.to_model(session.exact_points(pixels).position)
    returned = seen[0].project(back(world))
    assert np.abs(returned - session.camera.pixel_centres()[where][::20]).max() < 1e-6
    # Control: as if the tissue stood still.
    rigid = flow_between(session, *seen)
    assert np.nanmedian(np.linalg.norm(rigid.flow_px - forward.flow_px, axis=-1)) > 0.05


@pytest.mark.slow
def test_a_film_of_a_deforming_colon(tmp_path):
    """`simtest views --along --fps` moves the deforming's time, and writes the flow of the tissue."""
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
