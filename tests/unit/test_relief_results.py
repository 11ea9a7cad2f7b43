"""Results on a relief: errors against both truths, their law, and a fresh relief for each realisation."""

import itertools
import shlex

import numpy as np
import polars as pl
import pytest

from simtest.errors import InputError
from simtest.rendering import Session
from simtest.runtime.seeds import Stage, integer
from simtest.spec import Experiment, load_scene, scene_from_dict
from simtest.spec.spec_model import validate
from simtest.validation.cases import expand
from simtest.validation.columns import SCHEMA, table
from simtest.validation.predicted import base_law_deg
from simtest.validation.realisation import Realiser
from simtest.validation.scoring import rows
from simtest.validation.statistics import summarise

SMALL = {"camera.width": 96, "camera.height": 96, "camera.fx": 120.0, "camera.fy": 120.0, "sensor.noise_sigma": 0.0}
RELIEF = {"bands": [{"slope_deg": 3.0, "wavelength_mm": 3.0}], "seed": 11}


def experiment(*groups, **values):
    return validate(Experiment, {"name": "small", "groups": list(groups), "realisations": 2} | values, "small")


def group(relief=RELIEF, **more):
    own = {} if relief is None else {"surface.relief": relief}
    return {"scene": "plane", "label": "plane", "set": SMALL | own} | more


# Seeds of the relief -------------------------------------------------------------------------------------------------


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
    [
        {"set": {**SMALL, "surface.relief": RELIEF, "surface.relief.seed": 5}},
        {"sweep": [{"surface.relief.seed": [5]}]},
    ],
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
    cases = expand(experiment(group(sweep=sweep)))
    assert [case.setting for case in cases] == [
        f"plane, slope_deg={slope}, wavelength_mm={wave}" for slope in (2.0, 4.0) for wave in (1.0, 2.0)
    ]
    with pytest.raises(InputError, match=r"surface\.relief\.bands\.0\.slope_deg = 60"):
        expand(experiment(group(sweep=[{"surface.relief.bands.0.slope_deg": [60.0]}])))


# Law -----------------------------------------------------------------------------------------------------------------


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


# Rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.parametrize("relief", [None, RELIEF])
def test_rows_hold_both_errors(relief):
    described = experiment(group(relief), estimators=["cone_axis", "circle_pose"])
    (case,) = expand(described)
    from simtest.estimators import load_estimators

    made = Realiser(None).make(described, case, 0, load_estimators(described.estimators))
    found = table(made.rows, {})
    assert set(found["target"]) == {"fine"}
    # What a detection saw, and whose cloud it is; without a relief a highlight is its own cloud.
    assert (found["visible_id"].null_count() < found.height) == (relief is not None)
    assert found.filter(pl.col("true_id").is_not_null())["cloud"].null_count() == 0
    answered = found.filter(pl.col("true_id").is_not_null() & (pl.col("status") == "ok"))
    assert answered.height >= 2
    assert answered["error_fine_deg"].to_list() == answered["error_deg"].to_list()
    truths = {row: made.truths[row] for row in answered["true_id"].to_list()}
    for row in answered.iter_rows(named=True):
        truth = truths[row["true_id"]]
        normal = np.array([row["normal_x"], row["normal_y"], row["normal_z"]])
        base = truth.normal_base
        expected = np.degrees(np.arctan2(np.linalg.norm(np.cross(normal, base)), normal @ base))
        assert row["error_base_deg"] == pytest.approx(expected, abs=1e-9)
        assert (row["kd_min_base"], row["kd_max_base"]) == pytest.approx((0.0, 0.0), abs=1e-9)
    summary = summarise(found)[case.setting]["cone_axis"]
    own = answered.filter(pl.col("estimator") == "cone_axis")
    if relief is None:
        assert answered["error_base_deg"].to_list() == answered["error_deg"].to_list()
        assert answered["error_base_law_deg"].null_count() == answered.height
        assert summary.mean_base_deg == summary.mean_deg
    else:
        # A glint's own normal is met; the base's is off by the relief.
        assert own["error_fine_deg"].max() < 0.5 * own["error_base_deg"].min()
        assert own["error_base_deg"].min() > 1.0
        assert answered["error_base_law_deg"].unique().to_list() == pytest.approx([1.2533 * 3.0], rel=1e-4)
        assert summary.mean_base_deg == pytest.approx(own["error_base_deg"].mean())


@pytest.mark.render
def test_rows_of_truths_that_nothing_found_have_a_target_and_no_error():
    session = Session(scene_from_dict({"surface": {"type": "plane", "relief": RELIEF}}))
    view = session.highlights(session.radiance())
    from simtest.simulation.highlights import TrueHighlight

    truths = [TrueHighlight(**vars(point), peak_snr=50.0, why_not="") for point in view[:2]]
    made = rows(session, dict(experiment="e", setting="s"), [], truths, {}, {"cone_axis": ()})
    found = table(made, {})
    assert found.columns == list(SCHEMA)
    assert found["status"].to_list() == ["missed"] * len(truths)
    assert found["target"].to_list() == ["fine"] * len(truths)
    assert found["error_base_deg"].null_count() == len(truths)
    assert summarise(found)["s"]["cone_axis"].mean_base_deg is None
