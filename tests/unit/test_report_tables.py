"""The page's tables and its section of error laws, on hand-made rows."""

from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from simtest.errors import InputError
from simtest.report.error_laws import ABSENT, DEPARTS, LAWS, MET, SLOPE, law_charts, law_results, sentence
from simtest.report.tables import coverage, pairs
from simtest.spec import load_experiment
from simtest.validation import laws
from simtest.validation.cases import expand

SIDES = ("error_deg", "error_oracle_deg", "error_law_deg", "error_look_deg", "error_look_law_deg", "axis_ratio",
         "axis_ratio_law", "axis_ratio_seen_law", "noise_sigma")  # fmt: skip


def run_of(*rows):
    blank = dict.fromkeys(SIDES) | {"status": "ok", "laws": None, "label": "a", "realisation": 0, "true_id": 0}
    schema = dict.fromkeys(SIDES, pl.Float64) | {"laws": pl.String}
    table = pl.DataFrame([{"experiment": "x", **blank, **row} for row in rows], schema_overrides=schema)
    return SimpleNamespace(results=table)


def offset(setting, error, law, **more):
    return {
        "estimator": "cone_axis", "setting": setting, "laws": "offset", "error_deg": error, "error_law_deg": law,
        **more,
    }  # fmt: skip


def ratio(measured, law, **more):
    return {
        "estimator": "cone_axis", "setting": "r", "laws": "axis_ratio", "axis_ratio": measured, "axis_ratio_law": law,
        **more,
    }  # fmt: skip


def branch(sigma, scatter, highlights=1, power=0.5):
    """Rows of the branch point at one noise level: an error for each frame, the same at all of its highlights."""
    made = []
    for i, factor in enumerate(scatter):
        delta = 0.5 * (factor * sigma**power) ** 2
        error = float(np.degrees(laws.branch_point_error(delta)))
        row = {"estimator": "circle_pose", "setting": f"{sigma}", "realisation": i, "laws": "branch_point",
               "noise_sigma": sigma, "axis_ratio": 1 - delta, "error_oracle_deg": error}  # fmt: skip
        made += [row | {"true_id": j} for j in range(highlights)]
    return made


def result(run, name="offset"):
    return next(r for r in law_results(run) if r.name == name)


def test_a_departure_above_the_law_is_positive():
    found = result(run_of(offset("s", 0.65, 0.3), offset("l", 19.0, 20.0)))
    np.testing.assert_allclose(sorted(found.gap), [-1.0, 0.35])
    # The worst is told with its sign.
    assert found.cells["worst"] == "-1°"


def test_a_law_is_met_within_the_larger_of_both_tolerances_at_every_setting():
    met = run_of(offset("s", 0.55, 0.3), offset("l", 20.5, 20.0))
    assert (result(met).verdict, result(met).met) == (MET, 2)
    for error, law in ((0.65, 0.3), (20.7, 20.0), (19.3, 20.0)):
        departing = result(run_of(offset("s", 0.3, 0.3), offset("d", error, law)))
        assert (departing.verdict, departing.met) == (DEPARTS, 1)
    assert result(met, "look").verdict == ABSENT
    assert "1 are met" in sentence(law_results(met))


def test_a_row_without_a_value_is_a_departure():
    rows = [offset("s", 0.3, 0.3), offset("f", None, None, status="no_closed_isophote")]
    found = result(run_of(*rows))
    assert (found.verdict, found.met, found.failed, found.rows) == (DEPARTS, 1, 1, 2)
    assert "1 of 2 rows" in found.cells["met"]


def test_ratios_have_no_floor_and_other_rows_do_not_count():
    for measured, verdict in ((0.205, MET), (0.207, DEPARTS)):
        assert result(run_of(ratio(measured, 0.2)), "axis_ratio").verdict == verdict
    others = ratio(0.9, 0.2, estimator="circle_pose"), ratio(0.9, 0.2, laws=None)
    assert result(run_of(ratio(0.2, 0.2), *others), "axis_ratio").met == 1


@pytest.mark.parametrize(("power", "verdict"), [(0.5, MET), (1.0, DEPARTS)])
def test_the_branch_point_is_held_against_the_rows_own_ratio_and_a_slope_of_half(power, verdict):
    run = run_of(*(row for sigma in (0.01, 0.02, 0.04) for row in branch(sigma, (0.9, 1.0, 1.1), power=power)))
    assert result(run, "branch_point").verdict == MET
    slope = result(run, SLOPE)
    assert slope.verdict == verdict
    assert slope.measured[0] == pytest.approx(power, abs=1e-6)


def test_a_false_detection_says_nothing_of_a_law():
    found = result(run_of(offset("s", 0.3, 0.3), offset("s", None, None, true_id=None)))
    assert (found.verdict, found.failed, found.rows) == (MET, 0, 1)


def test_a_setting_without_noise_is_no_departure_from_the_slope_nor_hides_a_share():
    rows = [row for sigma in (0.0, 0.01, 0.02, 0.04) for row in branch(sigma, (0.9, 1.0, 1.1))]
    slope = result(run_of(*rows), SLOPE)
    assert (slope.verdict, slope.failed, slope.rows) == (MET, 0, 9)
    assert "–" not in result(run_of(*rows), "branch_point").cells["share"]


def test_the_slopes_error_is_that_of_frames_at_each_level():
    scatters = {0.01: (0.5, 1.0, 1.5), 0.02: (1.0, 1.0, 1.0), 0.04: (0.9, 1.0, 1.1)}
    level = np.log(list(scatters)) - np.log(list(scatters)).mean()
    spread = np.array([np.std(each, ddof=1) / np.sqrt(3) for each in scatters.values()])
    error = np.sqrt(np.sum((level * spread) ** 2)) / np.sum(level**2)
    # Highlights of one frame share its error, and say nothing new.
    for highlights in (1, 20):
        rows = [row for sigma, scatter in scatters.items() for row in branch(sigma, scatter, highlights)]
        (allowed,) = result(run_of(*rows), SLOPE).tolerance
        assert allowed == pytest.approx(0.015 + 2 * error, rel=1e-6)


def test_runs_that_name_no_law_have_no_section():
    assert law_results(run_of(offset("s", 0.3, 0.3, laws=None))) == []
    results = law_results(run_of(offset("s", 0.3, 0.3)))
    assert [result.name for result in results if result.name != SLOPE] == list(LAWS)
    assert [chart.key for chart in law_charts(results)] == ["laws_angles", "laws_departures"]


def test_the_experiment_tests_every_law_and_names_no_other(tmp_path):
    assert {name for case in expand(load_experiment("laws")) for name in case.laws} == set(LAWS)
    path = tmp_path / "e.toml"
    path.write_text('[[groups]]\nscene = "plane"\nlaws = ["gravity"]\n')
    with pytest.raises(InputError, match="gravity"):
        load_experiment(path)


def answer(name, error, realisation=0, status="ok", label="a", true_id=0):
    return {"estimator": name, "setting": label, "label": label, "realisation": realisation, "true_id": true_id,
            "status": status, "error_deg": error}  # fmt: skip


def test_pairs_are_over_the_highlights_that_both_answered():
    rows = [answer("cone_axis", e, i) for i, e in enumerate((1.0, 1.2, 0.9, 1.1))]
    rows += [answer("curved", e, i) for i, e in enumerate((2.0, 2.2, 1.9, 2.2))]
    rows += [answer("cone_axis", None, 4, "no_peak"), answer("curved", 9.0, 4)]
    rows += [answer("cone_axis", 50.0, 5, true_id=None), answer("curved", 0.0, 5, true_id=None)]
    ((label, pair),) = pairs(run_of(*rows))
    assert (label, pair.first, pair.second) == ("a", "cone_axis", "curved")
    assert (pair.n, pair.only_first, pair.only_second, pair.first_nearer) == (4, 0, 1, 4)
    assert pair.difference_deg == pytest.approx(-1.025)
    # Student's t with 3 degrees of freedom; the differences' standard deviation is 0.05, and one of them is far below.
    low, high = pair.interval_deg
    assert high == pytest.approx(-1.025 + 3.1824 * 0.025, abs=1e-4)
    assert low < -1.025 - 3.1824 * 0.025
    assert pair.better == "cone_axis"


def test_pairs_say_so_where_chance_may_decide():
    rows = [answer("cone_axis", e, i) for i, e in enumerate((1.0, 2.0))]
    rows += [answer("curved", e, i) for i, e in enumerate((2.0, 1.0))]
    ((_, pair),) = pairs(run_of(*rows))
    assert (pair.difference_deg, pair.better) == (0.0, None)
    ((_, single),) = pairs(run_of(rows[0], rows[2]))
    assert (single.n, single.interval_deg, single.ahead, single.better) == (1, (None, None), "cone_axis", None)


def test_pairs_name_no_better_method_by_chance():
    """Two methods of equal mean over 10 frames of 20 highlights, one with an effect of the frame."""
    rng, named = np.random.default_rng(1), 0
    for _ in range(100):
        errors = {"cone_axis": rng.normal(1.0, 0.1, (10, 20))}
        errors["curved"] = errors["cone_axis"] + rng.normal(0.0, 0.5, (10, 1)) + rng.normal(0.0, 0.3, (10, 20))
        rows = [answer(name, error, i, true_id=j) for name, own in errors.items() for (i, j), error in
                np.ndenumerate(own)]  # fmt: skip
        ((_, pair),) = pairs(run_of(*rows))
        named += pair.better is not None
    # As independent highlights they would name one in 65 of 100; 5 are meant, and 13 or more have a chance of 0.0015.
    assert named <= 12


def test_pairs_come_label_by_label():
    rows = [answer(name, 1.0, label=label) for label in "ab" for name in ("cone_axis", "curved", "bisector")]
    made = pairs(run_of(*rows))
    assert [label for label, _ in made] == ["a"] * 3 + ["b"] * 3
    assert pairs(run_of(answer("curved", 1.0))) == []


def detected(estimator, true_id, status, error=None, law=None, ratio=None, ratio_law=None, setting="a"):
    return {
        "setting": setting, "estimator": estimator, "true_id": true_id, "status": status, "error_oracle_deg": error,
        "specularity": None if status == "missed" else 0, "error_law_deg": law,
        "axis_ratio": ratio, "axis_ratio_law": ratio_law, "surface.viewpoint": 0.0,
    }  # fmt: skip


DETECTED = [
    detected("cone_axis", 0, "ok", 2.1, 2.0, 0.50, 0.51),
    detected("cone_axis", 1, "ok", 3.0, 2.0, 0.50, 0.60),
    detected("cone_axis", 2, "missed"),
    detected("cone_axis", 3, "no_closed_isophote"),
    detected("cone_axis", None, "ok"),
    *(detected("circle_pose", i, "ok") for i in (0, 1, None, 3)),
    detected("circle_pose", 2, "missed"),
]


def coverage_of(rows):
    schema = dict.fromkeys(("error_oracle_deg", "error_law_deg", "axis_ratio", "axis_ratio_law"), pl.Float64)
    return coverage(SimpleNamespace(results=pl.DataFrame(rows, schema_overrides=schema)))


# A cloud estimator that stands first has one answer for several detections, which are not counted by it.
@pytest.mark.parametrize("clouds", [[], [detected("cloud", 0, "ok", 2.1, 2.0), detected("cloud", 1, "missed")]])
def test_found_missed_and_false_are_counted_by_detections(clouds):
    (found,) = coverage_of([*clouds, *DETECTED]).found.rows(named=True)
    assert (found["true"], found["found"], found["missed"], found["false"]) == (4, 3, 1, 1)
    assert (found["coverage"], found["false_share"]) == (0.75, 0.25)


def test_laws_are_counted_where_they_are_met():
    error, ratio = coverage_of(DETECTED).laws.rows(named=True)
    assert (error["measure"], error["n"], error["met"]) == ("error", 2, 1)
    assert error["median_gap"] == pytest.approx(0.55)
    assert (ratio["measure"], ratio["n"], ratio["met"]) == ("axis ratio", 2, 1)


def test_runs_of_no_anatomy_have_no_coverage():
    assert coverage(SimpleNamespace(results=pl.DataFrame({"setting": ["a"]}))) is None
