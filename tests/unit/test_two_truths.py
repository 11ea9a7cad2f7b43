"""Fine and base truth of surfaces with a relief: pools, maps, highlights, frame files; labels stand in test_frames."""

import json

import numpy as np
import pytest
from surface_helpers import angle

from simtest.rendering import Session
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import write_frame
from simtest.spec import scene_from_dict

pytestmark = pytest.mark.render

CAMERA = {"width": 90, "height": 70, "fx": 80.0, "fy": 76.0, "cx": 44.0, "cy": 37.0}
RELIEF = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}, {"slope_deg": 2.0, "wavelength_mm": 1.0}], "seed": 3}


def scene(surface, relief=RELIEF, samples=1, **more):
    surface = surface if relief is None else surface | {"relief": relief}
    return scene_from_dict({"surface": surface, "camera": CAMERA, "render": {"samples_per_pixel": samples}} | more)


@pytest.fixture(scope="module")
def session():
    return Session(scene({"type": "plane"}))


@pytest.mark.parametrize(
    ("file", "viewpoint"),
    [
        pytest.param("colon_edingca_00090.ply", 1, marks=pytest.mark.slow),
        pytest.param("liver_sksurgery.ply", 0, marks=pytest.mark.ci),
    ],
)
def test_labels_of_a_users_mesh_are_both_truths(session, shared_data, file, viewpoint):
    mesh = {"type": "anatomy", "path": str(shared_data / "meshes" / file), "viewpoint": viewpoint}
    session.update(scene(mesh))
    labels, truth = session.frame().labels, session.truth()
    both = labels.mask & truth.mask
    assert both.sum() > 1000
    # A real mesh is coarse: the limit is that of its own interpolation, and the relief adds nothing to it.
    for error in (angle(labels.normal_base, truth.normal_base), angle(labels.normal, truth.normal)):
        assert np.median(error[both]) < 5e-3
    assert np.median(angle(truth.normal, truth.normal_base)[both]) > np.radians(3)
    for name in ("k_min", "k_max"):
        gap = np.abs(getattr(labels, name) - getattr(truth, name))[both]
        assert np.nanmedian(gap) < 0.02 * np.nanmedian(np.abs(truth.larger_curvature[both]))


def test_smooth_surfaces_have_one_truth_which_is_not_traced_twice(session):
    session.update(scene({"type": "sphere", "radius_mm": 6.0}, relief=None))
    labels, truth = session.frame().labels, session.truth()
    assert labels.normal_base is labels.normal
    assert labels.k_min_base is labels.k_min
    assert labels.k_max_base is labels.k_max
    assert len(session._centre_hits()) == 15
    np.testing.assert_array_equal(truth.normal_base, truth.normal)
    np.testing.assert_array_equal(truth.k_max_base, truth.k_max)
    assert not labels.pool.any()


def test_pools_of_a_film_are_labelled_smooth_and_follow_the_relief(session):
    """Another relief or level is another parameter of the same kernel: the labels may keep nothing of the former."""
    shares = []
    for seed, level in ((3, 0.0), (4, 0.0), (4, 1.0)):
        film = {"type": "tissue", "film": {"index": 1.34, "level": level}}
        session.update(scene({"type": "plane"}, RELIEF | {"seed": seed}, reflectance=film))
        if not shares:
            rebuilds = session.rebuilds
        labels, truth = session.frame().labels, session.truth()
        assert np.mean(labels.pool != truth.pool) < 1e-3
        shares.append(labels.pool.mean())
        slope = angle(labels.normal, labels.normal_base)
        assert slope[labels.pool].mean() < 0.3 * slope[~labels.pool].mean()
    assert session.rebuilds == rebuilds
    # Of a gaussian height half lie below its mean, and 84 % below a deviation above it.
    np.testing.assert_allclose(shares, [0.5, 0.5, 0.84], atol=0.15)


@pytest.mark.parametrize("deformed", [False, True])
def test_patches_of_film_have_one_truth_and_labels_of_it(session, deformed):
    """Normals, curvatures and pools of the kernel are those of the exact truth, and glints mirror the light."""
    film = {"index": 1.34, "level": -0.3, "patches": {"wavelength_mm": 4.0}}
    wave = {"type": "dent", "amplitude_mm": -3.0, "period_s": 2.0, "direction": [0, 0.2, 1], "radius_mm": 5.0,
            "centre_mm": [3, 1, 2]}  # fmt: skip
    moment = {"deformation": [wave], "time_s": 0.7} if deformed else {}
    session.update(scene({"type": "plane"}, reflectance={"type": "tissue", "film": film}, **moment))
    labels, truth = session.frame().labels, session.truth()
    assert np.median(angle(labels.normal, truth.normal)[truth.mask]) < 1e-4
    assert np.mean(labels.pool != truth.pool) < 5e-3
    bent = np.abs(labels.k_max - truth.k_max)[truth.mask]
    assert np.median(bent) < 1e-3 * np.median(np.abs(truth.k_max[truth.mask]))
    found = session.highlights(session.radiance())
    assert len(found) >= 3
    assert max(angle(point.normal, -point.position) for point in found) < 1e-4
    assert 0.1 < truth.pool.mean() < 0.9


def test_a_coarse_truth_is_the_full_one_at_its_pixels(session):
    session.update(scene({"type": "sphere", "radius_mm": 6.0}))
    full, coarse = session.truth(), session.truth(stride=5)
    for name, values in vars(coarse).items():
        if values is not None:
            np.testing.assert_array_equal(values, getattr(full, name)[::5, ::5], err_msg=name)
    assert np.median(angle(coarse.shading_normal, coarse.normal_base)[coarse.mask]) > np.radians(2)


def test_highlights_hold_both_truths_at_one_point(session):
    session.update(scene({"type": "cylinder", "radius_mm": 10.0, "tilt_deg": 5.0}))
    found = session.highlights(session.radiance())
    assert len(found) >= 3
    points = session.exact_points(np.array([point.bp_px for point in found]))
    for i, point in enumerate(found):
        # The fine normal is the bisector of the lights and the camera, here the way back to the camera.
        assert angle(point.normal, -point.position) < 1e-4
        np.testing.assert_allclose(point.normal_base, points.normal_base[i], atol=1e-12)
        # Convex with radius 10 mm along one direction, straight along the other.
        np.testing.assert_allclose([point.kd_min_base, point.kd_max_base], [0.0, point.distance / 10], atol=1e-6)
        assert point.kd_max > point.kd_max_base
        assert not point.pool
    off = [np.degrees(angle(point.normal, point.normal_base)) for point in found]
    assert max(off) > 2


@pytest.mark.parametrize("relief", [None, RELIEF])
def test_frame_files_hold_both_truths(tmp_path, relief):
    described = scene({"type": "sphere", "radius_mm": 9.0}, relief)
    frame = make_frame(described)
    write_frame(frame, tmp_path)
    with np.load(tmp_path / "truth.npz") as truth:
        fine, base = truth["normal"], truth["normal_base"]
        bent, bent_base, pool, mask = (truth[name] for name in ("curvature", "curvature_base", "pool", "mask"))
    written = json.loads((tmp_path / "frame.json").read_text())
    for name in ("normal_base", "curvature_base", "pool"):
        assert name in written["fields"]
    assert pool.dtype == bool
    np.testing.assert_allclose(bent_base[mask], 1 / 9, rtol=1e-6)
    highlight = written["highlights"][0]
    np.testing.assert_allclose([highlight["kd_min_base"], highlight["kd_max_base"]], highlight["distance_mm"] / 9)
    assert highlight["pool"] is False
    if relief is None:
        np.testing.assert_array_equal(fine, base)
        np.testing.assert_array_equal(bent, bent_base)
        assert highlight["normal"] == highlight["normal_base"]
    else:
        assert np.mean(angle(fine, base)[mask]) > np.radians(3)
        assert np.abs(bent[mask] - 1 / 9).mean() > 0.05
        assert highlight["normal"] != highlight["normal_base"]
