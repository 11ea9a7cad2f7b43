"""Columns of clouds and glints in results, against geometry that is computed here."""

import numpy as np
import polars as pl
import pytest

from simtest.estimators import load_estimators
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import CloudRegions
from simtest.spec import Experiment, scene_from_dict
from simtest.spec.spec_model import validate
from simtest.validation import laws
from simtest.validation.cases import expand
from simtest.validation.columns import table
from simtest.validation.predicted import centroid_law_deg, glint_count_law
from simtest.validation.realisation import Realiser
from simtest.validation.rough_truth import whole_clouds

CAMERA = {"width": 384, "height": 352, "fx": 320.0, "fy": 320.0, "cx": 192.0, "cy": 176.0}
RELIEF = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}], "seed": 4}
SURFACES = {
    "plane": {"type": "plane", "distance_mm": 20.0, "tilt_deg": 0.0},
    "cylinder": {"type": "cylinder", "distance_mm": 20.0, "tilt_deg": 0.0, "radius_mm": 20.0},
}
ROUGH = [name for name in table([], {}).columns if name.startswith("cloud_")] + ["radius_px", "radius_law_px", "pool"]


def scene_of(name="plane", relief=RELIEF, camera=CAMERA, **more):
    surface = SURFACES[name] | ({} if relief is None else {"relief": relief})
    return scene_from_dict({"surface": surface, "camera": camera, **more})


def rows_of(name="plane", relief=RELIEF, **settings):
    """One realisation's results, and its view."""
    own: dict = {f"camera.{key}": value for key, value in CAMERA.items()} | {
        "reflectance.exponent": 400.0,
        "sensor.noise_sigma": 0.005,
    }
    own |= {f"surface.{key}": value for key, value in SURFACES[name].items() if key != "type"}
    own |= {} if relief is None else {"surface.relief": relief, "surface.relief.seed": RELIEF["seed"]}
    groups = [{"scene": name, "label": name, "set": own | settings}]
    described = validate(Experiment, {"name": "small", "groups": groups, "estimators": ["brightest_point"]}, "small")
    (case,) = expand(described)
    made = Realiser(None).make(described, case, 0, load_estimators(described.estimators))
    return table(made.rows, {}), made


def on_surface(name, pixels):
    """Where rays through pixels meet the plane z = 20 or the cylinder about the axis x = 0, z = 40."""
    x, y = (pixels[:, 0] - CAMERA["cx"]) / CAMERA["fx"], (pixels[:, 1] - CAMERA["cy"]) / CAMERA["fy"]
    if name == "plane":
        z = np.full(len(x), 20.0)
    else:
        # (z x)^2 + (z - 40)^2 = 20^2, the nearer one.
        a = 1 + x**2
        z = (40 - np.sqrt(40**2 - a * (40**2 - 20**2))) / a
    return np.stack([x * z, y * z, z], axis=1)


@pytest.mark.render
@pytest.mark.parametrize("name", SURFACES)
def test_columns_of_a_cloud_are_its_glints(name):
    found, made = rows_of(name)
    row = found.filter(pl.col("cloud") == 0).row(0, named=True)
    glints = np.array([glint.bp_px for glint in made.view.highlights])
    assert row["cloud_glints"] == len(glints) >= 5
    # With the light at the camera a glint's normal is its reversed sightline; the base faces the camera.
    position = on_surface(name, glints)
    mean = (position / np.linalg.norm(position, axis=1, keepdims=True)).mean(axis=0)
    assert row["cloud_error_deg"] == pytest.approx(np.degrees(np.arctan2(np.hypot(*mean[:2]), mean[2])), abs=1e-4)
    moments = position[:, :2].T @ position[:, :2] / len(glints)
    covariance = np.array([row[f"cloud_cov_{i}"] for i in ("11", "12", "22")])
    assert covariance[0] + covariance[2] == pytest.approx(np.trace(moments), rel=1e-5)
    assert covariance[0] * covariance[2] - covariance[1] ** 2 == pytest.approx(np.linalg.det(moments), rel=1e-4)
    kd = 20.0 / SURFACES[name].get("radius_mm", np.inf)
    assert (row["cloud_kd_min"], row["cloud_kd_max"]) == pytest.approx((0.0, kd), abs=1e-5)
    if name == "cylinder":
        # Bent along x: the direction of k_max.
        assert (covariance[2], covariance[0]) == pytest.approx((moments[0, 0], moments[1, 1]), rel=1e-5)
    visible = [spot for spot in made.view.visible_highlights if spot.cloud == 0]
    assert row["cloud_visible"] == sum(spot.peak_snr >= 10 for spot in visible)
    assert 0 < row["cloud_visible"] <= len(visible)
    law = laws.glint_count(np.radians(4.0), 2.0, 20.0, (1 + kd, 1.0))
    assert row["cloud_glints_law"] == pytest.approx(law, rel=1e-5)


@pytest.mark.render
def test_radii_are_those_of_highlights_alone_in_their_spots():
    found, made = rows_of()
    rows = found.filter(pl.col("true_id").is_not_null())
    assert rows.height
    alone = 0
    for row in rows.iter_rows(named=True):
        truth = made.truths[row["true_id"]]
        assert row["pool"] is False
        # The highlight of the plane itself, d times the lobe's half-width wide, over the root of the gains (7.3).
        half_angle = np.arccos(0.5 ** (1 / made.view.scene.reflectance.exponent)) / 2
        gains = abs((1 + truth.kd_min) * (1 + truth.kd_max))
        assert row["radius_law_px"] == pytest.approx(CAMERA["fx"] * half_angle / np.sqrt(gains), rel=0.05)
        held = [s for s in made.view.visible_highlights if any(made.view.highlights[i] is truth for i in s.glints)]
        if row["radius_px"] is None:
            assert not any(len(spot.glints) == 1 and spot.whole for spot in held)
        else:
            alone += 1
            assert [np.sqrt(spot.area_px / np.pi) for spot in held] == [row["radius_px"]]
    assert alone


@pytest.mark.render
def test_smooth_scenes_hold_none_of_it():
    found, _ = rows_of(relief=None)
    assert found.filter(pl.col("true_id").is_not_null()).height
    assert set(found["cloud"]) == {0}
    assert len(ROUGH) == 13
    for name in ROUGH:
        assert found[name].null_count() == found.height, name


@pytest.mark.render
def test_clouds_that_the_frame_cuts_do_not_count():
    session = Session(scene_of())
    view = render_view(session, session.scene)
    # The nearest pixels of the border lie 175.5 px from the base's point.
    (edge,) = CloudRegions.of(session, view.clouds).edges()
    assert edge == pytest.approx(np.sin(np.arctan(175.5 / 320)), rel=1e-4)
    assert set(whole_clouds(session, view)) == {0}
    # 3 slopes of 4 deg are 68.5 px: moved so near to the border, the cloud is cut.
    for centre, whole in ((74.0, True), (63.0, False)):
        session.update(scene_of(camera=CAMERA | {"cx": centre}))
        view = render_view(session, session.scene)
        assert (0 in whole_clouds(session, view)) == whole
        (edge,) = CloudRegions.of(session, view.clouds).edges()
        assert edge == pytest.approx(np.sin(np.arctan((centre - 0.5) / 320)), rel=1e-4)


@pytest.mark.render
def test_what_a_cut_cloud_leaves_null():
    found, _ = rows_of(**{"camera.cx": 50.0})
    assert found.filter(pl.col("cloud") == 0).height
    assert found["cloud_glints"].null_count() == found.height
    assert found.filter(pl.col("true_id").is_not_null())["radius_law_px"].null_count() == 0


@pytest.mark.render
def test_the_laws_hold_for_isotropic_gaussian_relief_under_a_light_at_the_camera():
    session = Session(scene_of())
    (centre,) = session.base_highlights(session.radiance())
    expected = glint_count_law(session.scene, centre)
    assert expected == pytest.approx(laws.glint_count(np.radians(4.0), 2.0, 20.0), rel=1e-6)
    assert centroid_law_deg(session.scene, centre, 9) == pytest.approx(1.2533 * 4.0 / 3, rel=1e-4)

    def law(*bands, **more):
        scene = scene_of(relief={"bands": list(bands)}, **more)
        return glint_count_law(scene, centre), centroid_law_deg(scene, centre, 9)

    # Bands add their variances: of slope, and of curvature (2 pi / wavelength)^2 times as much.
    one = {"slope_deg": 4.0, "wavelength_mm": 2.0}
    parts = [{"slope_deg": 4.0 * share, "wavelength_mm": 2.0} for share in (0.6, 0.8)]
    assert law(*parts) == pytest.approx(law(one), rel=1e-6)
    mixed = [{"slope_deg": 2.0, "wavelength_mm": 2.0}, {"slope_deg": 2.0, "wavelength_mm": 1.0}]
    curved = 2 * np.radians(2.0) ** 2 * (2 * np.pi) ** 2 * (1 / 2**2 + 1)
    wave = 2 * np.pi * np.sqrt(2 * np.radians(np.sqrt(8)) ** 2 / curved)
    assert law(*mixed)[0] == pytest.approx(laws.glint_count(np.radians(np.sqrt(8)), wave, 20.0), rel=1e-6)
    # Elsewhere there is none.
    assert law(one | {"kind": "ridged"}) == (None, None)
    assert law(one | {"anisotropy": 2.0}) == (None, None)
    assert law(one, rig={"lights": [{"offset_mm": 3.0}]}) == (None, None)
    film = {"type": "tissue", "film": {"index": 1.34, "alpha": 0.05, "level": 0.0}}
    assert law(one, reflectance=film) == (None, None)
