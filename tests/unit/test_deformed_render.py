"""Deforming surfaces in a session: vertices move, nothing is rebuilt, and relief and colour ride on the tissue."""

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.rendering import Session
from simtest.rendering.placement_checks import check_camera
from simtest.spec import scene_from_dict
from simtest.surfaces import make_surface

DENT = {"type": "dent", "amplitude_mm": -2.0, "period_s": 2.0, "direction": [0.2, 0, 1], "radius_mm": 5.0,
        "centre_mm": [1, 0, 0]}  # fmt: skip
WARP = {"type": "breathing", "amplitude_mm": 1.5, "period_s": 4.0, "direction": [0, 1, 1], "along": [1, 0.5, 0],
        "wavelength_mm": 40.0, "turn_deg": 3.0, "axis": [1, 0, 0]}  # fmt: skip
RELIEF = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}
TISSUE = {"type": "tissue", "film": {"index": 1.35, "alpha": 0.05}, "albedo": {}}


def scene(time_s=0.0, deformation=(WARP, DENT), moved=None, **changes):
    surface = {"type": "quadric", "distance_mm": 20.0, "k1_per_mm": 0.02, "k2_per_mm": -0.01, "tilt_deg": 15.0}
    surface |= changes.pop("surface", {})
    camera = {"width": 64, "height": 48, "fx": 56.0, "fy": 56.0, "cx": 32.0, "cy": 24.0}
    camera |= {"moved": moved} if moved else {}
    data = {"surface": surface, "camera": camera, "time_s": time_s, "deformation": list(deformation)}
    return scene_from_dict({**data, **changes})


def test_at_rest_the_frame_is_that_without_deformation():
    with_table = Session(scene(0.0)).frame()
    without = Session(scene(0.0, deformation=())).frame()
    assert np.array_equal(with_table.radiance.total, without.radiance.total)


def test_labels_follow_the_exact_truth_on_relief():
    """Triangles and exact surface agree; relief looked up where the tissue is not would be off by its slope."""
    session = Session(scene(1.0, surface={"relief": RELIEF}), labelled=True)
    labels, truth = session.frame().labels, session.truth()
    assert truth.mask.all()
    fine = np.linalg.norm(labels.normal - truth.normal, axis=-1)
    assert np.percentile(fine, 99) < 2e-3
    assert np.percentile(np.abs(labels.k_max - truth.k_max), 99) < 1e-3 * np.percentile(np.abs(truth.k_max), 99)
    slope = np.linalg.norm(truth.normal - truth.normal_base, axis=-1)
    assert np.median(slope) > 0.03
    # Control: the relief of the space, not of the tissue.
    at = truth.position.reshape(-1, 3)[::7]
    X = session.to_model(at)
    rest = session.surface.deformation.at_rest(X)
    own, other = (session.surface.at_rest.relief.jets(p).gradient for p in (rest, X))
    assert np.median(np.linalg.norm(own - other, axis=1)) > 0.03


@pytest.mark.parametrize(
    ("reflectance", "samples"),
    [
        pytest.param({"type": "phong", "exponent": 200.0}, 1, marks=pytest.mark.ci),
        pytest.param(TISSUE, 1, marks=pytest.mark.ci),
        (TISSUE, 4),
    ],
)
def test_a_rigid_motion_of_tissue_is_the_reverse_motion_of_the_camera(reflectance, samples):
    """A film, relief and colour that move rigidly with a camera look as before."""
    rigid = {"type": "breathing", "amplitude_mm": 4.0, "period_s": 2.0, "direction": [0, 0, 1], "warp": 0.0}
    # At tilt 0 the camera looks along -z of the model: 4 mm along z is 4 mm back.
    common = {"surface": {"tilt_deg": 0.0, "relief": RELIEF}, "reflectance": reflectance}
    common["render"] = {"samples_per_pixel": samples}
    still = Session(scene(0.0, deformation=(), **common)).frame()
    moved = Session(scene(1.0, deformation=(rigid,), moved={"translation_mm": [0, 0, -4.0]}, **common)).frame()
    tolerance = 2e-4 * float(still.radiance.total.max())
    assert tolerance > 0
    assert moved.radiance.total == pytest.approx(still.radiance.total, rel=2e-3, abs=tolerance)
    # Control: without the motion of the camera it looks otherwise.
    seen = Session(scene(1.0, deformation=(rigid,), **common)).frame()
    assert np.abs(seen.radiance.total - still.radiance.total).max() > 0.05 * still.radiance.total.max()


def test_a_body_that_passed_over_the_camera_is_refused():
    ball = {"type": "sphere", "distance_mm": 20.0, "radius_mm": 3.0}
    ride = {"type": "breathing", "amplitude_mm": 100.0, "period_s": 2.0, "direction": [0, 0, 1], "warp": 0.0}
    passed = scene_from_dict({"surface": ball, "time_s": 1.0, "deformation": [ride]})
    surface = make_surface(passed.surface, deformation=passed.deformation, time_s=1.0)
    with pytest.raises(
        InputError, match=r"deformation: the wall has moved right over the camera at time_s = 1; it must"
    ):
        check_camera(passed, surface)


TUBE = {"type": "cylinder", "side": "inside", "distance_mm": 12.0, "radius_mm": 15.0, "tilt_deg": 50.0}
RINGS = {"type": "contractions", "amplitude_mm": 2.0, "period_s": 2.0, "radius_mm": 15.0, "width_mm": 8.0,
         "spacing_mm": 30.0, "path_mm": [[0, -60, 15], [2, 0, 14], [0, 60, 15]]}  # fmt: skip


@pytest.mark.parametrize(
    ("surface", "part"),
    [(TUBE, RINGS), pytest.param({"type": "sphere", "radius_mm": 9.0}, DENT, marks=pytest.mark.ci)],
)
def test_analytic_surfaces_deform(surface, part):
    """The rendered mesh is the exact surface within its cells, deformed and at rest."""
    camera = {"width": 64, "height": 48, "fx": 56.0, "fy": 56.0, "cx": 32.0, "cy": 24.0}
    still = {"surface": surface, "camera": camera, "reflectance": {"type": "phong", "exponent": 5.0}}
    session = Session(scene_from_dict({**still, "deformation": [{**part, "amplitude_mm": 0.0}]}), labelled=True)
    own = Session(scene_from_dict(still), labelled=True).frame()
    scale = float(own.radiance.total.max())
    # Pixels on the outline of a ball see another part of it.
    gap = np.abs(session.frame().radiance.total - own.radiance.total)
    assert np.quantile(gap, 0.99) < 2e-3 * scale
    session.update(scene_from_dict({**still, "deformation": [part], "time_s": 0.8}))
    moved, truth = session.frame(), session.truth()
    assert session.rebuilds == 1
    assert np.quantile(np.abs(moved.radiance.total - own.radiance.total), 0.99) > 0.02 * scale
    seen = truth.mask
    assert seen.mean() > 0.3
    assert np.quantile(np.linalg.norm(moved.labels.normal - truth.normal, axis=-1)[seen], 0.98) < 1e-3
    assert np.quantile(np.abs(moved.labels.depth - truth.depth)[seen], 0.98) < 1e-2
    assert np.quantile(np.abs(moved.labels.k_min - truth.k_min)[seen], 0.98) < 5e-3
