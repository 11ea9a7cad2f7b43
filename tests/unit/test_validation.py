"""Matching, rows, summary figures, seeds, cases, and that a row can be made again alone."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from scipy import stats

from simtest.detection import Detection, Region
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate, load_estimators
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import tangent_basis
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.rendering import Session
from simtest.runtime.seeds import Stage, from_integer, generator, integer, key, sequence
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import TrueHighlight
from simtest.spec import Experiment, load_experiment, scene_from_dict
from simtest.validation.cases import expand, swept_example
from simtest.validation.columns import SCHEMA, swept_columns, table
from simtest.validation.realisation import realise
from simtest.validation.run_summary import MOST_TEXTS, faults_of
from simtest.validation.runner import run_experiment
from simtest.validation.scoring import mahalanobis2, match, rows
from simtest.validation.statistics import figures, is_wrong_and_sure, summarise

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)


NORTH = np.array([0.0, 0.0, -1.0])


def truth_at(x, y, normal=NORTH, light=0):
    return TrueHighlight(
        light=light, bp_px=np.array([x, y]), position=np.array([0, 0, 10.0]), normal=normal,
        direction_min=np.array([1.0, 0.0, 0.0]), distance=10.0, kd_min=0.2, kd_max=0.5, lit=True, radiance=1.0,
        peak_snr=50.0, why_not="", normal_base=normal, kd_min_base=0.2, kd_max_base=0.5, pool=False,
    )  # fmt: skip


def detection(x, y, width, height, peak, estimates=None):
    """Return a detection whose isophote does not close, so that its region decides."""
    failure = Failure(Reason.NO_CLOSED_ISOPHOTE)
    return Specularity(Region((x, y, width, height), peak, 1.0), failure, estimates or {})


def spots(*centres, sigma=5.0):
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    return sum(a * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * sigma**2)) for u, v, a in centres).astype(np.float32)


def matched_to(found, truths):
    return match(found, [truth.bp_px for truth in truths])


def test_the_mahalanobis_distance_counts_deviations():
    """Two deviations along one axis and one along the other, in the tangent basis of the estimate's normal."""
    first, second = (axis[0] for axis in tangent_basis(NORTH[None]))
    truth = NORTH + np.tan(1e-3) * (2 * first + 3 * second)
    estimate = Estimate(NORTH, NORTH[None], np.zeros(2), covariance=np.diag([1e-6, 9e-6]))
    assert mahalanobis2(estimate, truth / np.linalg.norm(truth)) == pytest.approx(5.0, rel=1e-4)
    for none in (None, np.zeros((2, 2))):
        assert mahalanobis2(Estimate(NORTH, NORTH[None], np.zeros(2), covariance=none), NORTH) is None


def test_each_detection_takes_the_truth_inside_its_isophote():
    found = reconstruct(spots((40, 40, 1.0), (100, 70, 0.7)), CAMERA, {})
    assert [s.region.peak for s in found] == [(39, 39), (99, 69)]
    truths = [truth_at(100.4, 69.2), truth_at(41, 40)]
    assert matched_to(found, truths) == {0: 1, 1: 0}
    # The isophote at t = 0.5 of a spot of 5 px has a radius of 5.9 px; the smoothing of 2 px makes it 6.3.
    assert matched_to(found, [truth_at(46.0, 40)]) == {0: 0}
    assert matched_to(found, [truth_at(47.0, 40)]) == {}


def test_the_nearest_truth_wins_and_the_others_stay_unmatched():
    wide = detection(0, 0, 50, 50, (20, 20))
    assert matched_to([wide], [truth_at(30, 20), truth_at(22, 20), truth_at(10, 20)]) == {0: 1}
    assert matched_to([wide], [truth_at(60, 20)]) == {}
    # The peak's pixel (20, 20) has its centre at 20.5: 20.9 is nearer than 20.0.
    assert matched_to([wide], [truth_at(20.0, 20.5), truth_at(20.9, 20.5)]) == {0: 1}


def test_a_truth_is_given_to_one_detection_only():
    far, near = detection(0, 0, 50, 50, (5, 5)), detection(10, 10, 50, 50, (24, 24))
    assert matched_to([far, near], [truth_at(25, 25)]) == {1: 0}
    # The second best pair is kept where it does not collide.
    assert matched_to([far, near], [truth_at(25, 25), truth_at(12, 12)]) == {1: 0, 0: 1}
    assert matched_to([], [truth_at(1, 1)]) == {}


def estimate(normal, candidates=None, look=(80.0, 60.0)):
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    candidates = normal[None] if candidates is None else np.asarray(candidates, float)
    return Estimate(normal, candidates, np.array(look))


def context(look_normal=NORTH):
    """Return a session whose surface has one normal wherever an estimate looks, and what its rows share."""
    seen = SimpleNamespace(valid=np.array([True]), normal=look_normal[None])
    described = scene_from_dict({"surface": {"type": "plane"}})
    session = SimpleNamespace(scene=described, exact_points=lambda points: seen)
    return session, dict(experiment="e", setting="s", realisation=3, seed=11)


def leaned(degrees, towards=0.0):
    a, t = np.radians([degrees, towards])
    return np.array([np.sin(a) * np.cos(t), np.sin(a) * np.sin(t), -np.cos(a)])


def test_rows_count_matched_false_and_missed():
    found = [
        detection(0, 0, 50, 50, (20, 20), {"a": estimate(leaned(3)), "b": Failure(Reason.NOT_AN_ELLIPSE, "why")}),
        detection(100, 80, 20, 20, (110, 90), {"a": estimate(NORTH), "b": estimate(NORTH)}),
    ]
    truths = [truth_at(21, 21), truth_at(75, 100)]
    frame = table(rows(*context(), found, truths, matched_to(found, truths), {"a": (), "b": ()}), {})
    assert frame.columns == list(SCHEMA)
    told = frame.select("specularity", "true_id", "estimator", "status", "error_deg", "kd_max")
    assert told.rows() == [
        (0, 0, "a", "ok", pytest.approx(3), 0.5), (0, 0, "b", "not_an_ellipse", None, 0.5),
        (1, None, "a", "ok", None, None), (1, None, "b", "ok", None, None),
        (None, 1, "a", "missed", None, 0.5), (None, 1, "b", "missed", None, 0.5),
    ]  # fmt: skip
    assert frame["flags"][1] == "why"
    assert frame["realisation"].to_list() == [3] * 6


def test_a_row_has_the_columns_of_the_table_and_swept_parameters_by_their_own_names():
    swept = {"surface.radius_mm": 5.0, "surface": "sphere"}
    made = table([{"estimator": "a", "surface": "plane", **swept_columns(swept)}], swept)
    assert made.columns == [*SCHEMA, "surface.radius_mm"]
    # The scene's own column wins over a swept one of its name.
    assert made.select("surface", "surface.radius_mm", "label").row(0) == ("plane", 5.0, None)


def test_a_row_with_a_column_that_the_table_lacks_is_refused():
    """polars would drop it."""
    with pytest.raises(KeyError, match="no such column of results: eror_deg"):
        table([{"estimator": "a"}, {"estimator": "b", "eror_deg": 1.0}], {})


def test_errors_of_a_row():
    """The proposed candidate, the better one, and the surface where the estimate looks."""
    result = estimate(leaned(5), [leaned(5), leaned(1, 180)])
    found = [detection(0, 0, 50, 50, (20, 20), {"a": result})]
    (row,) = rows(*context(leaned(7)), found, [truth_at(20, 20)], {0: 0}, {"a": ()})
    assert row["error_deg"] == pytest.approx(5)
    assert row["error_oracle_deg"] == pytest.approx(1)
    assert row["error_look_deg"] == pytest.approx(2)
    assert row["rank_correct"] == 1
    assert row["n_candidates"] == 2


def test_columns_of_a_row_are_what_their_names_say():
    session, common = context()
    light = {"rig": {"lights": [{"offset_mm": 2.0, "azimuth_deg": 90.0}]}}
    session.scene = scene_from_dict({"surface": {"type": "plane"}, **light})
    result = replace(estimate(leaned(3), look=(81.0, 63.0)), budget={"noise": np.diag([3e-4, 1e-4])})
    found = [detection(0, 0, 50, 50, (20, 20), {"a": result})]
    (row,) = rows(session, common, found, [truth_at(21.0, 33.0)], {0: 0}, {"a": ()})
    assert (row["bp_true_x_px"], row["bp_true_y_px"], row["look_x_px"], row["look_y_px"]) == (21.0, 33.0, 81.0, 63.0)
    assert (row["kd_min"], row["kd_max"], row["distance_mm"], row["peak_snr"]) == (0.2, 0.5, 10.0, 50.0)
    # 2 mm over 10 mm.
    assert row["eps_over_d"] == pytest.approx(0.2)
    assert row["axis_ratio_law"] == pytest.approx(1.2 / 1.5)
    assert row["budget_noise_deg"] == pytest.approx(np.degrees(0.02))


def hand_made():
    """Two ok, one failed, one missed, two false (one failed) of estimator a; three ok of b."""
    lines = [
        ("s1", "a", 0, "ok", 1.0, 0.5, 2.0, 3.0),
        ("s1", "a", 1, "ok", 3.0, 3.0, 8.0, 5.0),
        ("s1", "a", 2, "not_an_ellipse"),
        ("s1", "a", 3, "missed"),
        ("s1", "a", None, "ok"),
        ("s1", "a", None, "no_closed_isophote"),
        ("s1", "b", 0, "ok", 2.0, 2.0),
        ("s1", "b", 1, "ok", 2.0, 2.0),
        ("s1", "b", 2, "ok", 5.0, 5.0),
        ("s0", "a", 0, "missed"),
    ]
    names = ("setting", "estimator", "true_id", "status", "error_deg", "error_oracle_deg", "mahalanobis2",
             "error_base_deg")  # fmt: skip
    made = [dict(zip(names, line, strict=False), realisation=i) for i, line in enumerate(lines)]
    return table(made, {})


def test_summary_of_a_hand_made_table():
    summary = summarise(hand_made())
    assert list(summary) == ["s1", "s0"]
    a, b = summary["s1"].values()
    assert (a.n, a.n_ok, a.n_missed, a.n_false) == (4, 2, 1, 2)
    assert a.n_failed_by_reason == {"not_an_ellipse": 1}
    expected = {
        "mean_deg": 2.0, "mean_oracle_deg": 1.75, "mean_base_deg": 4.0, "rms_deg": np.sqrt(5), "std_deg": np.sqrt(2),
        "median_deg": 2.0, "p95_deg": 2.9, "max_deg": 3.0,
        # (1 + 3 + 90 + 90) / 4: the failed and the missed count 90 deg each, the false none.
        "mean_penalised_deg": 46.0,
        "coverage95": 0.5,  # chi-square of 2 at 95 %: 5.99
    }  # fmt: skip
    assert {name: getattr(a, name) for name in expected} == pytest.approx(expected)
    # Two frames: Student's t with 1 degree of freedom, 12.706 standard errors of 1.
    # Its lower end would be negative, which no angle is.
    assert a.ci95_deg == pytest.approx((0.0, 2 + 12.7062), abs=1e-4)
    assert (b.n, b.n_ok, b.n_missed, b.n_false) == (3, 3, 0, 0)
    assert b.mean_penalised_deg == b.mean_deg == pytest.approx(3.0)
    # Three: 4.302653 of them below, which no angle is; above more, as they are skewed.
    assert b.ci95_deg[0] == 0.0
    assert b.ci95_deg[1] > 3 + 4.302653
    assert b.coverage95 is None


def test_median_and_coverage_of_skewed_errors():
    lines = [(0, 1.0, 1.0), (1, 2.0, 4.5), (2, 9.0, 7.0)]
    made = [
        dict(setting="s", estimator="a", true_id=number, status="ok", error_deg=error, mahalanobis2=squared)
        for number, error, squared in lines
    ]
    (found,) = summarise(table(made, {}))["s"].values()
    assert (found.median_deg, found.mean_deg) == (2.0, 4.0)
    # 4.5 lies between the quantiles of one degree of freedom and of two, 3.84 and 5.99.
    assert found.coverage95 == pytest.approx(2 / 3)


def test_wrong_and_sure_is_above_5_deg_and_above_three_deviations():
    # An error with its deviation, both in deg; of the last nobody states one, which counts nowhere.
    lines = [(4.9, 0.1), (5.1, 1.6), (5.1, 1.8), (30.0, 9.9), (30.0, 10.1), (80.0, None)]
    wrong = [False, True, False, True, False, False]
    assert is_wrong_and_sure(*zip(*lines, strict=True)).tolist() == wrong
    made = []
    for number, (error, deviation) in enumerate(lines):
        row = dict(setting="s", estimator="a", true_id=number, status="ok", error_deg=error)
        if deviation is not None:
            # A third of the variance along one axis, so that the trace alone has the deviation.
            variance = np.radians(deviation) ** 2
            row |= dict(cov_11=variance / 3, cov_12=0.0, cov_22=variance * 2 / 3)
        made.append(row)
    (found,) = summarise(table(made, {}))["s"].values()
    assert found.wrong_and_sure == pytest.approx(2 / 5)
    assert summarise(hand_made())["s1"]["b"].wrong_and_sure is None


def test_summary_where_nothing_answered():
    figure = summarise(hand_made())["s0"]["a"]
    assert figure.n == figure.n_missed == 1
    assert figure.mean_deg is None
    assert figure.ci95_deg == (None, None)
    assert figure.mean_penalised_deg == 90
    assert figures(hand_made().clear()).mean_penalised_deg is None


def test_seeds_do_not_change_from_version_to_version():
    assert key("plane") == 7486435753795864637
    assert key("") == 13020603013274838756
    first = (0, "overview", "plane | part 0", 0, Stage.SENSOR)
    assert integer(*first) == 5181135501325619883
    assert generator(*first).integers(2**63, size=2).tolist() == [4976117887560075625, 1653885339742518633]
    second = (5, "anatomy", "colon | part 3", 7, Stage.SWEEP)
    assert integer(*second) == 2080042430547182738
    assert from_integer(7).integers(2**63) == 404542462756400999
    assert generator(*second).standard_normal() == pytest.approx(-0.020281610121228436, rel=1e-12)


def test_every_branch_of_the_seed_tree_is_another():
    branches = [
        (seed, experiment, case, realisation, stage)
        for seed in (0, 1)
        for experiment in ("a", "b")
        for case in ("a", "b", "a | part 1")
        for realisation in range(20)
        for stage in Stage
    ]
    states = {sequence(*branch).generate_state(4).tobytes() for branch in branches}
    assert len(states) == len(branches)
    assert [int(stage) for stage in Stage] == [0, 1, 2, 3, 4, 5, 6]


def experiment(*groups, **settings):
    return Experiment.model_validate({"name": "test", "realisations": 3, "groups": list(groups), **settings})


def test_lists_of_one_table_vary_together_and_tables_are_multiplied_out():
    group = {
        "scene": "saddle",
        "sweep": [
            {"surface.k1_per_mm": [0.01, 0.02], "surface.k2_per_mm": [-0.01, -0.02]},
            {"reflectance.exponent": [50.0, 100.0, 200.0]},
        ],
    }
    cases = expand(experiment(group))
    seen = [tuple(c.swept[path] for table in group["sweep"] for path in table) for c in cases]
    assert seen == [(k, -k, n) for k in (0.01, 0.02) for n in (50, 100, 200)]
    assert cases[1].setting == "quadric, k1_per_mm=0.01, k2_per_mm=-0.01, exponent=100.0"
    assert len({case.name for case in cases}) == 6
    scene, drawn = cases[5].scene(experiment(group), 0)
    assert (scene.surface.k1_per_mm, scene.surface.k2_per_mm, scene.reflectance.exponent) == (0.02, -0.02, 200)
    assert drawn == {}
    assert [list(case.numbers()) for case in cases] == [[0, 1, 2]] * 6


def test_pooled_values_share_a_setting_and_number_on():
    group = {"scene": "sphere", "label": "ball", "pool": [{"surface.radius_mm": [5.0, 6.0]}], "realisations": 4}
    cases = expand(experiment(group))
    assert [case.setting for case in cases] == ["ball", "ball"]
    assert [list(case.numbers()) for case in cases] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert cases[0].name != cases[1].name
    assert [case.swept["surface.radius_mm"] for case in cases] == [5, 6]


def test_random_values_are_drawn_anew_for_each_realisation_and_the_same_again():
    drawn_path = "rig.lights.0.azimuth_deg"
    group = {"scene": "plane", "random": {drawn_path: {"low": 10.0, "high": 350.0}}}
    described = experiment(group, realisations=200)
    (case,) = expand(described)
    values = [case.scene(described, number)[1][drawn_path] for number in range(200)]
    assert len(set(values)) == 200
    assert all(10 <= value < 350 for value in values)
    assert stats.kstest(values, stats.uniform(10, 340).cdf).pvalue > 0.01
    scene, drawn = case.scene(described, 17)
    assert drawn[drawn_path] == values[17] == scene.rig.lights[0].azimuth_deg
    other = experiment(group, realisations=200, seed=1)
    assert case.scene(other, 17)[1][drawn_path] != values[17]
    assert swept_example([case]) == {drawn_path: 0.0}


MINE = """
realisations = 2
[[groups]]
scene = "cylinder"
set = { "surface.tilt_deg" = 3.0 }
sweep = [{ "surface.radius_mm" = [5.0, 6.0] }, { "reflectance.exponent" = [50.0, 60.0] }]
pool = [{ "surface.spin_deg" = [0.0, 10.0] }]
[groups.random]
"surface.azimuth_deg" = { low = 0.0, high = 90.0 }
"""


def test_settings_take_the_place_of_sweeps_pools_and_draws(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(MINE)
    plain = expand(load_experiment(path))
    assert len(plain) == 8
    assert plain[0].scene(load_experiment(path), 0)[0].surface.tilt_deg == 3
    settings = {"surface.radius_mm": 7.0, "surface.spin_deg": 20.0, "surface.azimuth_deg": 45.0}
    fixed = load_experiment(path, {**settings, "realisations": 9, "seed": 4})
    assert (fixed.name, fixed.realisations, fixed.seed) == ("mine", 9, 4)
    cases = expand(fixed)
    assert [case.setting for case in cases] == ["cylinder, exponent=50.0", "cylinder, exponent=60.0"]
    for case in cases:
        scene, drawn = case.scene(fixed, 0)
        surface = scene.surface
        assert (surface.radius_mm, surface.spin_deg, surface.azimuth_deg, surface.tilt_deg) == (7, 20, 45, 3)
        assert drawn == {}
    tilted = expand(load_experiment(path, {"surface.tilt_deg": 1.0}))[0]
    assert tilted.data["surface"]["tilt_deg"] == 1


def test_malformed_groups_are_refused_before_anything_is_rendered(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text('[[groups]]\nscene = "plane"\nsweep = [{ "a.b" = [1.0, 2.0], "c.d" = [1.0] }]\n')
    with pytest.raises(InputError, match="equally long"):
        load_experiment(path)
    with pytest.raises(InputError, match="radius_mm"):
        expand(experiment({"scene": "sphere", "sweep": [{"surface.radius_mm": [5.0, -1.0]}]}))
    with pytest.raises(InputError, match="nowhere"):
        expand(experiment({"scene": "nowhere"}))


SMALL = {"camera.width": 120, "camera.height": 100, "camera.fx": 130.0, "camera.fy": 130.0}


FIXED = {"scene": "plane", "set": SMALL, "isolated": False}


DRAWN = {
    "scene": "cylinder",
    "set": SMALL,
    "isolated": False,
    "sweep": [{"surface.radius_mm": [8.0, 30.0]}],
    "random": {"surface.spin_deg": {"low": 0.0, "high": 180.0}},
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run_experiment(experiment(FIXED, DRAWN, realisations=4), tmp_path_factory.mktemp("runs") / "whole")


def sorted_rows(results):
    return results.sort("setting", "realisation", "estimator", "specularity", nulls_last=True)


@pytest.mark.render
def test_a_run_has_a_row_for_each_estimator_and_realisation(whole):
    results = whole.results
    assert len(results) == 3 * 4 * 3
    assert results["status"].unique().to_list() == ["ok"]
    summary = json.loads((whole.folder / "summary.json").read_text())
    for setting, estimators in summary["experiments"]["test"]["settings"].items():
        part = results.filter(pl.col("setting") == setting)
        for name, figure in estimators.items():
            assert figure["n"] == figure["n_ok"] == 4
            assert figure["mean_deg"] == pytest.approx(part.filter(pl.col("estimator") == name)["error_deg"].mean())
    assert results.filter(pl.col("estimator") == "cone_axis")["error_deg"].max() < 0.2
    assert results["seed"].n_unique() == 12
    assert pl.read_parquet(whole.folder / "results.parquet").equals(results)


def alone(described, index=0, realisation=0):
    """Make one realisation of one case."""
    case = expand(described)[index]
    scene, drawn = case.scene(described, realisation)
    session = Session(scene)
    estimators = load_estimators(described.estimators)
    return case, realise(session, described, case, realisation, render_view(session, scene), drawn, estimators)


@pytest.mark.render
@pytest.mark.parametrize("index", [0, 2])
def test_a_realisation_alone_gives_the_rows_of_the_whole_run(whole, index):
    described = experiment(FIXED, DRAWN, realisations=4)
    case, made = alone(described, index, 3)
    own = table(made.rows, swept_example(expand(described)))
    in_run = whole.results.filter((pl.col("setting") == case.setting) & (pl.col("realisation") == 3))
    assert len(own) == 3
    assert sorted_rows(own).equals(sorted_rows(in_run))
    assert alone(described, index, 2)[1].frame.tobytes() != made.frame.tobytes()


@pytest.mark.render
def test_the_order_of_the_groups_changes_no_row(whole, tmp_path):
    turned = run_experiment(experiment(DRAWN, FIXED, realisations=4), tmp_path / "turned").results
    columns = whole.results.columns
    assert sorted_rows(turned.select(columns)).equals(sorted_rows(whole.results))


@pytest.mark.render
def test_what_drowns_in_noise_is_missed():
    dark = {**FIXED, "set": {**SMALL, "sensor.noise_sigma": 1.0}}
    _, made = alone(experiment(dark, realisations=1, estimators=["cone_axis"]))
    assert [row["status"] for row in made.rows if row["true_id"] is not None] == ["missed"]
    assert all(isinstance(s.patch, Patch | Failure) for s in made.specularities)


@pytest.mark.render
def test_highlights_of_a_frame_that_the_detector_refuses_are_missed(monkeypatch):
    class Refusing:
        def detect(self, frame, camera, priors):
            return Detection((), frame, refusal=Failure(Reason.NO_ESTIMATE, "unlike the training"))

    def refused(frame, calibration, estimators, isolated, detector, regions):
        return reconstruct(frame, calibration, estimators, smoothing_px=2.0, detector=Refusing())

    monkeypatch.setattr("simtest.validation.realisation.reconstruct", refused)
    _, made = alone(experiment(FIXED, realisations=1, estimators=["cone_axis"]))
    assert [(row["status"], row["true_id"]) for row in made.rows] == [("missed", 0)]


def faulty(estimator, status, text, count=1):
    return [{"estimator": estimator, "status": status, "flags": text}] * count


def test_each_distinct_text_is_told_once_with_its_count():
    table = pl.DataFrame([
        *faulty("moment", "ok", ""), *faulty("moment", "estimator_error", "TypeError: other"),
        *faulty("moment", "estimator_error", "ValueError: my\n  bug (my_core.py:11)", 29),
        *faulty("core", "core_timeout", "no answer within 2 s"), *faulty("cone_axis", "no_peak", "peak 0", 3),
    ])  # fmt: skip
    assert list(map(str, faults_of(table))) == [
        "moment: ValueError: my bug (my_core.py:11), 29 times",
        "moment: TypeError: other, once",
        "core: core_timeout: no answer within 2 s, once",
    ]


def test_texts_that_differ_at_every_highlight_are_cut():
    table = pl.DataFrame([row for i in range(MOST_TEXTS + 3) for row in faulty("a", "estimator_error", f"E: {i}", 2)])
    found = list(map(str, faults_of(table)))
    assert len(found) == MOST_TEXTS + 1
    assert found[-1] == "a: 3 other texts; column flags of results.parquet holds them, 6 times"


def test_results_without_a_fault_have_none():
    assert faults_of(pl.DataFrame({"status": ["ok", "missed"], "estimator": ["a", "a"], "flags": ["", None]})) == []
    assert faults_of(pl.DataFrame({"status": ["ok"]})) == []
