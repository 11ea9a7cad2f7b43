"""The worst cases: which rows are chosen, and that their frames are made again as they were."""

import json
import shlex

import numpy as np
import polars as pl
import pytest

from simtest.errors import InputError
from simtest.spec import load_experiment
from simtest.validation.results_table import SCHEMA
from simtest.validation.runner import run_experiment
from simtest.validation.worst import WorstCase, save_worst, worst_cases


def row(estimator, setting, realisation, error, law=None, status="ok", true_id=0):
    return {
        "experiment": "e", "label": "l", "surface": "s", "setting": setting, "estimator": estimator,
        "realisation": realisation, "status": status, "true_id": true_id, "error_oracle_deg": error,
        "error_law_deg": law,
    }  # fmt: skip


def table(*rows):
    return pl.DataFrame(list(rows), schema=SCHEMA)


def test_the_known_failure_of_a_model_is_no_worst_case():
    rows = table(
        row("circle_pose", "cylinder", 0, 60.0, law=60.0), row("circle_pose", "plane", 1, 9.0, law=0.0),
        row("cone_axis", "plane", 2, 0.01), row("cone_axis", "plane", 3, 0.5), row("cone_axis", "plane", 4, 0.02),
    )  # fmt: skip
    chosen = worst_cases(rows, most=2)
    assert [(c.estimator, c.setting, c.realisation) for c in chosen] == [
        ("circle_pose", "plane", 1),
        ("cone_axis", "plane", 3),
    ]
    assert chosen[0].why == "circle_pose missed by 9°; its law says 0°."
    assert chosen[1].why == "cone_axis missed by 0.5°; the setting's median is 0.02°."


def test_what_got_worse_comes_first_but_leaves_room():
    rows = table(*(row(name, f"setting {i}", i, 0.1 * i, law=0.0) for i in range(8) for name in ("a", "b")))
    worse = rows.filter((pl.col("estimator") == "b") & pl.col("setting").is_in(["setting 0", "setting 1", "setting 2"]))
    chosen = worst_cases(rows, worse, most=4)
    assert [c.setting for c in chosen[:2]] == ["setting 0", "setting 1"]
    assert [c.setting for c in chosen[2:]] == ["setting 7", "setting 6"]
    assert len({(c.setting, c.realisation) for c in chosen}) == 4


def test_what_is_of_no_frame_takes_no_room_from_what_got_worse():
    rows = table(*(row(name, f"setting {i}", i, 0.1 * i, law=0.0) for i in range(8) for name in ("a", "b")))
    own = rows.filter((pl.col("estimator") == "b") & pl.col("setting").is_in(["setting 0", "setting 1"]))
    pooled = own.with_columns(label=pl.lit("all"), surface=pl.lit("all"), setting=pl.lit("all"))
    cost = pooled.with_columns(experiment=pl.lit("cost"))
    chosen = worst_cases(rows, pl.concat([pooled, cost, own]), most=4)
    assert [(c.estimator, c.setting) for c in chosen[:2]] == [("b", "setting 0"), ("b", "setting 1")]


@pytest.mark.parametrize("law", [np.nan, np.inf])
def test_a_law_that_is_no_number_is_none(law):
    rows = table(
        *(row("a", "x", i, error, law=law) for i, error in enumerate([0.1, 0.2, 0.3])), row("a", "y", 3, 9.0, law=0.0)
    )
    chosen = worst_cases(rows)
    assert [c.setting for c in chosen] == ["y", "x"]
    assert chosen[1].why == "a missed by 0.3°; the setting's median is 0.2°."


def test_frames_are_chosen_once_and_rows_without_an_answer_never():
    rows = table(
        row("a", "x", 0, 5.0, law=0.0), row("b", "x", 0, 6.0, law=0.0), row("a", "y", 1, np.nan, law=0.0),
        row("a", "y", 2, None, status="no_peak"), row("a", "y", 3, 40.0, law=0.0, true_id=None),
    )  # fmt: skip
    assert [(c.setting, c.realisation) for c in worst_cases(rows)] == [("x", 0)]
    assert worst_cases(table()) == []


def test_a_case_of_another_experiment_is_refused(tmp_path):
    stranger = [WorstCase("nowhere", "plane", 0, "cone_axis", "why")]
    with pytest.raises(InputError, match="experiment 'nowhere'"):
        save_worst(stranger, [load_experiment("grid")], tmp_path)
    with pytest.raises(InputError, match="has no realisation 0 of the setting 'none'"):
        save_worst([WorstCase("grid", "none", 0, "cone_axis", "why")], [load_experiment("grid")], tmp_path)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    path = folder / "small.toml"
    path.write_text(
        'realisations = 2\nestimators = ["cone_axis", "circle_pose"]\n[[groups]]\nscene = "cylinder"\nlabel = "tube"\n'
        'set = { "camera.width" = 160, "camera.height" = 160 }\nsweep = [{ "surface.radius_mm" = [20.0, 40.0] }]\n'
        'random = { "surface.tilt_deg" = { low = 0.0, high = 3.0 } }\n'
        '[[groups]]\nscene = "published"\nlabel = "published"\n'
    )
    experiment = load_experiment(path)
    return experiment, run_experiment(experiment, folder / "run").results


def test_the_frames_of_worst_cases_are_those_of_their_rows(small, tmp_path):
    experiment, results = small
    cases = worst_cases(results, most=3)
    assert {case.experiment for case in cases} == {experiment.name}
    cases.append(next(WorstCase(r["experiment"], r["setting"], 1, r["estimator"], "the published protocol") for r in
                      results.filter(pl.col("label") == "published").iter_rows(named=True)))  # fmt: skip
    files = save_worst(cases, [experiment], tmp_path / "worst")
    assert len(files) == len(cases) == 4
    for case, file in zip(cases, files, strict=True):
        with np.load(file) as data:
            meta = json.loads(str(data["meta"]))
        assert meta["why"] == case.why
        rows = results.filter((pl.col("setting") == case.setting) & (pl.col("realisation") == case.realisation))
        seed = rows["seed"][0]
        assert f"sensor.seed={seed}" in shlex.split(meta["command"]) or str(seed) in meta["command"]
        for estimate in meta["estimates"]:
            own = rows.filter(
                (pl.col("estimator") == estimate["estimator"]) & (pl.col("true_id") == estimate["true_id"])
            )
            assert own["error_deg"].to_list() == [estimate["error_deg"]]
