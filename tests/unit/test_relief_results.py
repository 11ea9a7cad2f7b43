"""Results on a relief: a fresh one for each realisation, both truths and their law, columns of clouds and glints."""

import itertools
import shlex
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.estimators.cloud import CloudCentre, cloud
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.pages.style import degrees
from simtest.rendering import Session
from simtest.report.gallery import result_of
from simtest.report.run_folder import read_item
from simtest.runtime.seeds import Stage, integer
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import CloudRegions, TrueHighlight
from simtest.spec import Experiment, load_scene, scene_from_dict
from simtest.spec.spec_model import validate
from simtest.validation import laws
from simtest.validation.cases import expand
from simtest.validation.columns import SCHEMA, table
from simtest.validation.glints import whole_clouds
from simtest.validation.predicted import base_law_deg, centroid_law_deg, glint_count_law
from simtest.validation.realisation import Realiser, keep_frame
from simtest.validation.scoring import _cloud_errors, match_cloud, rows
from simtest.validation.statistics import summarise

SMALL = {"camera.width": 96, "camera.height": 96, "camera.fx": 120.0, "camera.fy": 120.0, "sensor.noise_sigma": 0.0}


RELIEF = {"bands": [{"slope_deg": 3.0, "wavelength_mm": 3.0}], "seed": 11}


def experiment(*groups, **values):
    return validate(Experiment, {"name": "small", "groups": list(groups), "realisations": 2} | values, "small")


def group(relief=RELIEF, **more):
    own = {} if relief is None else {"surface.relief": relief}
    return {"scene": "plane", "label": "plane", "set": SMALL | own} | more


def seeds(described, count=4):
    (case,) = expand(described)
    return [case.scene(described, number)[0].surface.relief.seed for number in range(count)]


def test_each_realisation_draws_a_relief_of_its_own_from_the_seed_tree():
    assert Stage.RELIEF == 5
    described = experiment(group())
    drawn = seeds(described)
    assert len(set(drawn)) == 4
    assert drawn == seeds(described)
    assert drawn[2] == integer(0, "small", "plane | part 0", 2, Stage.RELIEF) % 2**32
    assert seeds(experiment(group(), seed=1)) != drawn


@pytest.mark.parametrize(
    "named",
    [{"set": {**SMALL, "surface.relief": RELIEF, "surface.relief.seed": 5}}, {"sweep": [{"surface.relief.seed": [5]}]}],
)
def test_a_seed_that_the_experiment_names_stays(named):
    assert seeds(experiment(group(**named))) == [5] * 4


def test_smooth_scenes_are_what_they_were():
    described = experiment(group(relief=None))
    (case,) = expand(described)
    first, second = (case.scene(described, number)[0] for number in (0, 1))
    assert first == second
    assert first.surface.relief is None
    assert "relief" not in case.reproduce_command(described, 0)


def test_the_command_under_a_frame_makes_the_same_relief():
    described = experiment(group())
    (case,) = expand(described)
    words = shlex.split(case.reproduce_command(described, 1))
    settings = dict(word.split("=", 1) for flag, word in itertools.pairwise(words) if flag == "--set")
    drawn = case.scene(described, 1)[0]
    assert settings["surface.relief.seed"] == str(drawn.surface.relief.seed)
    again = load_scene("plane", {"surface.relief": RELIEF, "surface.relief.seed": int(settings["surface.relief.seed"])})
    assert again.surface.relief == drawn.surface.relief


def test_keys_of_the_relief_can_be_swept_and_are_checked():
    sweep = [{"surface.relief.bands.0.slope_deg": [2.0, 4.0]}, {"surface.relief.bands.0.wavelength_mm": [1.0, 2.0]}]
    settings = [case.setting for case in expand(experiment(group(sweep=sweep)))]
    assert settings == [f"plane, slope_deg={s}, wavelength_mm={w}" for s in (2.0, 4.0) for w in (1.0, 2.0)]
    with pytest.raises(InputError, match=r"surface\.relief\.bands\.0\.slope_deg = 60"):
        expand(experiment(group(sweep=[{"surface.relief.bands.0.slope_deg": [60.0]}])))


@pytest.mark.parametrize(
    ("relief", "expected"),
    [
        (None, None),
        (RELIEF, 1.2533 * 3.0),
        ({"bands": [{"slope_deg": 3.0, "wavelength_mm": 2.0}, {"slope_deg": 4.0, "wavelength_mm": 1.0}]}, 1.2533 * 5.0),
        ({"bands": [{"slope_deg": 3.0, "wavelength_mm": 2.0, "kind": "ridged"}]}, None),
        ({"bands": [{"slope_deg": 3.0, "wavelength_mm": 2.0, "anisotropy": 2.0}]}, None),
    ],
)
def test_the_law_holds_for_isotropic_gaussian_relief(relief, expected):
    surface = {"type": "plane"} | ({} if relief is None else {"relief": relief})
    found = base_law_deg(scene_from_dict({"surface": surface}))
    assert found is None if expected is None else found == pytest.approx(expected, rel=1e-4)


@pytest.mark.render
@pytest.mark.parametrize("relief", [None, RELIEF])
def test_rows_hold_both_errors(relief):
    described = experiment(group(relief), estimators=["cone_axis", "circle_pose"])
    (case,) = expand(described)
    made = Realiser(None).make(described, case, 0, load_estimators(described.estimators))
    found = table(made.rows, {})
    assert set(found["target"]) == {"fine"}
    # What a detection saw, and whose cloud it is; without a relief a highlight is its own cloud.
    assert (found["visible_id"].null_count() < found.height) == (relief is not None)
    true = found.filter(pl.col("true_id").is_not_null())
    assert true["cloud"].null_count() == 0
    answered = true.filter(pl.col("status") == "ok")
    assert answered.height >= 2
    assert answered["error_fine_deg"].to_list() == answered["error_deg"].to_list()
    for row in answered.iter_rows(named=True):
        base = made.truths[row["true_id"]].normal_base
        normal = np.array([row["normal_x"], row["normal_y"], row["normal_z"]])
        expected = np.degrees(np.arctan2(np.linalg.norm(np.cross(normal, base)), normal @ base))
        assert row["error_base_deg"] == pytest.approx(expected, abs=1e-9)
        assert (row["kd_min_base"], row["kd_max_base"]) == pytest.approx((0.0, 0.0), abs=1e-9)
    summary = summarise(found)[case.setting]["cone_axis"]
    own = answered.filter(pl.col("estimator") == "cone_axis")
    assert summary.mean_base_deg == pytest.approx(own["error_base_deg"].mean())
    if relief is None:
        assert answered["error_base_deg"].to_list() == answered["error_deg"].to_list()
        assert answered["error_base_law_deg"].null_count() == answered.height
        assert set(true["cloud"]) == {0}
        assert all(found[name].null_count() == found.height for name in ROUGH)
    else:
        # A glint's own normal is met; the base's is off by the relief.
        assert own["error_fine_deg"].max() < 0.5 * own["error_base_deg"].min()
        assert own["error_base_deg"].min() > 1.0
        assert answered["error_base_law_deg"].unique().to_list() == pytest.approx([1.2533 * 3.0], rel=1e-4)


@pytest.mark.render
def test_rows_of_truths_that_nothing_found_have_a_target_and_no_error():
    session = Session(scene_from_dict({"surface": {"type": "plane", "relief": RELIEF}}))
    view = session.highlights(session.radiance())
    truths = [TrueHighlight(**vars(point), peak_snr=50.0, why_not="") for point in view[:2]]
    found = table(rows(session, dict(experiment="e", setting="s"), [], truths, {}, {"cone_axis": ()}), {})
    assert found.columns == list(SCHEMA)
    assert found.select("status", "target", "error_base_deg").rows() == [("missed", "fine", None)] * len(truths)
    assert summarise(found)["s"]["cone_axis"].mean_base_deg is None


CAMERA = {"width": 384, "height": 352, "fx": 320.0, "fy": 320.0, "cx": 192.0, "cy": 176.0}


BUMPS = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}], "seed": 4}


SURFACES = {
    "plane": {"type": "plane", "distance_mm": 20.0, "tilt_deg": 0.0},
    "cylinder": {"type": "cylinder", "distance_mm": 20.0, "tilt_deg": 0.0, "radius_mm": 20.0},
}


ROUGH = [name for name in table([], {}).columns if name.startswith("cloud_")] + ["radius_px", "radius_law_px", "pool"]


def scene_of(name="plane", relief=BUMPS, camera=CAMERA, **more):
    return scene_from_dict({"surface": SURFACES[name] | {"relief": relief}, "camera": camera, **more})


def results_of(name="plane", **settings):
    """One realisation's results, and what it was made from."""
    own = {f"camera.{key}": value for key, value in CAMERA.items()}
    own |= {"reflectance.exponent": 400.0, "sensor.noise_sigma": 0.005}
    own |= {f"surface.{key}": value for key, value in SURFACES[name].items() if key != "type"}
    own |= {"surface.relief": BUMPS, "surface.relief.seed": BUMPS["seed"]}
    described = experiment({"scene": name, "label": name, "set": own | settings}, estimators=["brightest_point"])
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
    found, made = results_of(name)
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
        # Bent along x: the direction of k_max, which with the normal and that of k_min is right-handed.
        assert covariance == pytest.approx((moments[1, 1], moments[0, 1], moments[0, 0]), rel=1e-4)
    visible = [spot for spot in made.view.visible_highlights if spot.cloud == 0]
    assert row["cloud_visible"] == sum(spot.peak_snr >= 10 for spot in visible)
    assert 0 < row["cloud_visible"] <= len(visible)
    law = laws.glint_count(np.radians(4.0), 2.0, 20.0, (1 + kd, 1.0))
    assert row["cloud_glints_law"] == pytest.approx(law, rel=1e-5)


@pytest.mark.render
def test_radii_are_those_of_highlights_alone_in_their_spots():
    found, made = results_of()
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
def test_clouds_that_the_frame_cuts_do_not_count():
    session = Session(scene_of())
    # In the middle the nearest pixels of the border lie 175.5 px from the base's point. 3 slopes of 4 deg are 68.5 px:
    # moved nearer to the border, the cloud is cut.
    for centre, nearest, whole in ((192.0, 175.5, True), (74.0, 73.5, True), (63.0, 62.5, False)):
        session.update(scene_of(camera=CAMERA | {"cx": centre}))
        view = render_view(session, session.scene)
        assert set(whole_clouds(session, view)) == ({0} if whole else set())
        (edge,) = CloudRegions.of(session, view.clouds).edges()
        assert edge == pytest.approx(np.sin(np.arctan(nearest / 320)), rel=1e-4)
    found, _ = results_of(**{"camera.cx": 50.0})
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


def direction(tilt_deg):
    tilt = np.radians(tilt_deg)
    return np.array([np.sin(tilt), 0.0, -np.cos(tilt)])


PLANE = {
    "surface.tilt_deg": 25.0, "surface.distance_mm": 25.0, "reflectance.exponent": 400.0, "camera.width": 512,
    "camera.height": 512, "camera.fx": 300.0, "camera.fy": 300.0, "sensor.noise_sigma": 0.01,
    "sensor.point_spread_px": 0.7, "surface.relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]},
}  # fmt: skip


def of_clouds():
    return experiment({"scene": "plane", "set": PLANE}, name="clouds", seed=3, realisations=1)


def made_of(estimators):
    described, realiser = of_clouds(), Realiser(None)
    return realiser.make(described, expand(described)[0], 0, estimators), realiser.session


@pytest.mark.render
def test_a_cloud_is_measured_against_the_base():
    made, session = made_of({"cloud": cloud})
    (row,) = [row for row in made.rows if row["estimator"] == "cloud"]
    (centre,) = [point for point in made.view.clouds if point.lit]
    assert (row["status"], row["target"]) == ("ok", "base")
    assert row["cloud"] == row["true_id"] == made.view.clouds.index(centre)
    # The normal of a plane 25 deg off the optical axis.
    normal = np.array([row["normal_x"], row["normal_y"], row["normal_z"]])
    assert row["error_base_deg"] == pytest.approx(float(angle_deg(normal, centre.normal_base)), abs=1e-6)
    assert row["error_deg"] == pytest.approx(row["error_base_deg"], abs=1e-6)
    assert row["error_deg"] < 3.0
    assert row["error_look_deg"] == pytest.approx(row["error_deg"], abs=1e-6)
    assert row.get("error_fine_deg") is None
    assert row["cloud_visible"] is not None
    assert row["budget_relief_deg"] > 0
    # Where no estimate is of it, the vote is empty.
    estimate = made.specularities[-1].estimates["cloud"]
    assert match_cloud(CloudRegions.of(session, made.view.clouds), made.view, estimate) == [row["cloud"]]


@pytest.mark.parametrize("seen", [True, False])
def test_the_error_of_a_cloud_is_that_where_it_looks(seen):
    """Its highlight point may lie elsewhere on a curved base, or nowhere; off the surface it is all there is."""
    at_look, at_point = direction(30.0), direction(20.0)
    session = SimpleNamespace(
        exact_points=lambda pixels, fine: SimpleNamespace(normal_base=at_look[None], valid=np.array([seen]))
    )
    estimate = Estimate(
        normal=direction(33.0), candidates=direction(33.0)[None], look_px=np.zeros(2), axis_ratio=1.0, target="base"
    )
    found = _cloud_errors(session, estimate, [SimpleNamespace(normal_base=at_point)])
    assert found["error_deg"] == pytest.approx(3.0 if seen else 13.0)
    assert found["error_base_deg"] == pytest.approx(13.0)
    assert found["error_look_deg"] == (pytest.approx(3.0) if seen else None)
    assert [found[f"truth_{axis}"] for axis in "xyz"] == (at_look if seen else at_point).tolist()
    alone = _cloud_errors(session, estimate, [])
    assert alone.get("error_base_deg") is None
    assert alone.get("error_deg") == (pytest.approx(3.0) if seen else None)


@pytest.mark.render
def test_the_card_of_a_frame_says_what_the_results_say(tmp_path):
    """A cloud is no false detection there, nor is a spot of several glints."""
    made, session = made_of({"cone_axis": cone_axis, "cloud": cloud})
    described = of_clouds()
    keep_frame(tmp_path / "item.npz", session, described, expand(described)[0], made)
    shown = {(each.specularity, each.estimator): each for each in read_item(tmp_path / "item.npz").meta.estimates}
    told = {(row.get("specularity"), row["estimator"]): row for row in made.rows if row.get("specularity") is not None}
    assert {key: (each.error_deg, each.status) for key, each in shown.items()} == {
        key: (row.get("error_deg"), row["status"]) for key, row in told.items()
    }
    (of_cloud,) = [each for (_, name), each in shown.items() if name == "cloud"]
    assert result_of(of_cloud) == degrees(of_cloud.error_deg) != "–"
    in_spots = {key for key, each in shown.items() if "in a spot of several glints or of none" in result_of(each)}
    false = [key for key, row in told.items() if row["true_id"] is None and row["visible_id"] is not None]
    assert in_spots
    assert {key for key in in_spots if key[1] == "cone_axis"} == {key for key in false if key[1] == "cone_axis"}


@pytest.mark.render
def test_a_cloud_that_is_not_answered_is_a_row_with_its_reason():
    made, _ = made_of({"cloud": CloudCentre(least_spots=500)})
    (row,) = [row for row in made.rows if row["estimator"] == "cloud"]
    assert row["status"] == "no_estimate"
    assert row.get("error_deg") is None
    assert "a cloud takes 500" in row["flags"]


def test_a_cloud_belongs_to_the_point_of_most_of_its_spots_also_where_an_instrument_covers_that():
    """One stray spot at a lit point far away does not make that point the truth."""
    centres = [SimpleNamespace(light=0, lit=lit, bp_px=np.array(at)) for lit, at in ((False, (50, 50)), (True, (9, 9)))]
    points = np.zeros((26, 2))
    estimate = SimpleNamespace(cloud=SimpleNamespace(points_px=points), look_px=np.array([50.0, 50.0]))
    view = SimpleNamespace(clouds=centres)
    for owners, expected in (([0] * 25 + [1], [0]), ([0] * 12 + [1] * 14, [1]), ([None] * 26, [])):
        regions = SimpleNamespace(assign=lambda *_, owners=owners: owners)
        assert match_cloud(regions, view, estimate) == expected
