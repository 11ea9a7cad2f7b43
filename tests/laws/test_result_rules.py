"""The columns of results agree with each other: rows of each kind of experiment, and rows that were spoilt."""

import numpy as np
import polars as pl
import pytest

from simtest.conventions import MOTION, MOTION_COLUMNS
from simtest.estimators.motion_signs import RankedHypotheses
from simtest.runtime.processes import make_engine
from simtest.spec import Experiment, load_experiment
from simtest.validation.runner import run_experiments
from studies.gate.faults import Mutation, planted
from tests.laws.results import RULES, broken_rules
from tests.unit.gate_nights import changed, rows, whole

SETTINGS = tuple("abcdefghijkl")
TONIGHT = whole()
FIRST = (pl.col("realisation") == 0) & pl.col("true_id").is_not_null()


def plain():
    small = {"camera.width": 128, "camera.height": 128, "sensor.noise_sigma": 0.03}
    groups = [
        {"scene": "plane", "label": "plane", "isolated": False, "set": small, "sweep": [{"surface.tilt_deg": [5, 20]}]},
        {"scene": "cylinder", "label": "cylinder", "set": small},
    ]  # fmt: skip
    estimators = ("circle_pose", "brightest_point", "cone_axis", "curved", "photometric")
    return Experiment(name="plain", realisations=6, estimators=estimators, groups=groups)


def labelled(name, label, **values):
    experiment = load_experiment(name, values)
    return experiment.model_copy(update={"groups": tuple(own for own in experiment.groups if own.label == label)})


def motion():
    whole_one = labelled("motion", "saddle", realisations=3)
    group = whole_one.groups[0].model_copy(update={"sweep": ({"views.length_mm": (0.5, 1.0)},)})
    return whole_one.model_copy(update={"groups": (group,)})


def run(folder, *experiments):
    return [
        made.results
        for made in run_experiments([(own, folder / own.name) for own in experiments], engine=make_engine(workers=1))
    ]


@pytest.mark.ci
@pytest.mark.law
@pytest.mark.render
def test_results_break_no_rule(tmp_path):
    experiments = (
        plain(), labelled("paper", "noise", realisations=5), labelled("relief", "cylinder", realisations=1), motion()
    )  # fmt: skip
    made = run(tmp_path, *experiments)
    assert all(table.filter(pl.col("status") == "ok", pl.col("true_id").is_not_null()).height for table in made)
    assert broken_rules(pl.concat(made, how="diagonal_relaxed")) == {}
    # The noise that the scenes were given is what the rows have.
    assert set(made[0]["noise_sigma"]) == {0.03}


@pytest.mark.ci
@pytest.mark.law
@pytest.mark.render
def test_reversed_signs_of_motion_are_seen_where_nothing_else_changes(tmp_path):
    told = "np.sign(self.hypotheses[0])"
    (sound,) = run(tmp_path, motion())
    with planted(Mutation(RankedHypotheses.told_signs.fget, told, f"-{told}")):
        (turned,) = run(tmp_path / "turned", motion())
    assert not broken_rules(sound)
    assert set(broken_rules(turned)) == {"signs that motion tells are right at the rate that it reports"}
    assert sound.drop(MOTION_COLUMNS).equals(turned.drop(MOTION_COLUMNS))


def test_rows_that_agree_break_no_rule_and_columns_that_are_missing_neither():
    assert broken_rules(TONIGHT) == {}
    assert broken_rules(TONIGHT.select("experiment", "label", "surface", "setting", "estimator", "realisation",
                                       "specularity", "true_id", "seed", "status", "error_deg")) == {}  # fmt: skip


@pytest.mark.parametrize(
    ("rule", "values", "everywhere"),
    [
        ("error_deg, error_fine_deg", {"error_fine_deg": 3.0}, False),
        ("error_deg, error_fine_deg", {"target": "base", "error_base_deg": 3.0}, False),
        ("error_deg, error_fine_deg", {"error_oracle_deg": 80.0}, False),
        ("answers have errors that are finite", {"error_deg": float("nan")}, False),
        ("no answer is exact", {"error_deg": 0.0}, False),
        ("mahalanobis2 is that of", {"mahalanobis2": 77.0}, False),
        ("the budget's parts", {"budget_shape_deg": 0.5}, False),
        ("axis_ratio_law is that of", {"axis_ratio_law": 0.51}, False),
        ("axis ratios lie in 0 to 1", {"axis_ratio": 1.2}, False),
        ("axis ratios lie in 0 to 1", {"axis_ratio": 0.6}, True),
        ("gain_error is that of", {"gain_2": 2.2}, False),
        ("gain_error is that of", {"gain_oracle_error": 0.5}, False),
        ("each frame has a seed", {"seed": 5}, False),
        ("no noisy answer repeats", {"normal_x": 0.1, "normal_y": 0.2, "normal_z": -0.97, "error_deg": 0.3}, True),
        ("all estimators of a frame", {"true_id": 7}, False),
    ],
)
def test_each_rule_is_broken_by_what_it_is_about(rule, values, everywhere):
    (rule,) = (name for name in RULES if name.startswith(rule))
    cell = (pl.col("setting") == "b") & (pl.col("estimator") == "curved")
    of_seed = (pl.col("setting") == "b") | (pl.col("setting") == "c")
    where = of_seed if "seed" in rule else cell if everywhere else cell & FIRST
    assert broken_rules(changed(TONIGHT, where & pl.col("true_id").is_not_null(), **values))[rule] > 0


def test_round_highlights_all_have_the_ratio_1():
    assert broken_rules(changed(TONIGHT, pl.col("axis_ratio").is_not_null(), axis_ratio=1.0)) == {}


# Signs of motion -------------------------------------------------------------------------------------------------


def with_signs(wrong=0.0, told=1.0, count=60):
    """Return rows of `motion` with true gains of both signs; a share of the told signs is wrong."""
    table = rows(count=count, settings=SETTINGS, estimators=(MOTION,))
    rng = np.random.default_rng(0)
    gains = np.random.default_rng(3).choice([-0.5, 1.5], (table.height, 2))
    signs = told * np.sign(gains) * np.where(rng.random(gains.shape) < wrong, -1, 1)
    values = dict.fromkeys(MOTION_COLUMNS, np.full(table.height, 1.0))
    for i in (0, 1):
        values |= {f"motion_sign_{i + 1}": signs[:, i], f"motion_gain_{i + 1}": gains[:, i]}
    return table.with_columns(pl.Series(name, value) for name, value in values.items())


def wrong_signs(table):
    return bool(RULES["signs that motion tells are right at the rate that it reports"](table).any())


@pytest.mark.parametrize(("wrong", "seen"), [(0.0, False), (0.01, False), (0.15, True), (1.0, True)])
def test_told_signs_are_held_to_the_reported_rate(wrong, seen):
    assert wrong_signs(with_signs(wrong)) == seen


@pytest.mark.parametrize(("count", "seen"), [(2, False), (3, True), (10, True)])
def test_three_highlights_all_wrong_are_enough(count, seen):
    assert wrong_signs(with_signs(1.0).head(count)) == seen


def test_motion_that_tells_nothing_is_seen_and_rows_without_motion_are_not_judged():
    assert wrong_signs(with_signs(told=0.0))
    assert not wrong_signs(rows())
