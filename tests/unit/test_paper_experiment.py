"""The published protocol through the harness: contract, workers, bad input."""

import json

import polars as pl
import pytest

from simtest import validate
from simtest.errors import InputError
from simtest.runtime.processes import make_engine
from simtest.spec import Experiment, load_experiment, load_scene
from simtest.spec.recipes import PaperSetting
from simtest.validation.cases import expand
from simtest.validation.columns import SCHEMA
from simtest.validation.runner import run_experiment

SMALL = {"paper.size": 128, "paper.height": 315.0, "paper.isovalue": 0.3, "paper.smoothing_px": 2.0}


def test_an_estimator_with_a_covariance_has_its_coverage_in_the_results(tmp_path):
    groups = [{"scene": "published", "set": SMALL}]
    estimators = ("circle_pose", "photometric")
    run = run_experiment(Experiment(name="pair", realisations=40, groups=groups, estimators=estimators), tmp_path)
    (figures,) = json.loads((run.folder / "summary.json").read_text())["experiments"]["pair"]["settings"].values()
    assert figures["circle_pose"]["coverage95"] is None
    assert 0.8 <= figures["photometric"]["coverage95"] <= 1.0
    rows = run.results.filter(pl.col("estimator") == "photometric")
    assert (
        rows.select("cov_11", "cov_12", "cov_22", "mahalanobis2", "choice_margin").null_count().sum_horizontal()[0] == 0
    )
    assert (rows["error_deg"] == rows["error_oracle_deg"]).all()


def small(**more):
    groups = [{"scene": "published", "label": "noise", "set": SMALL, "sweep": [{"paper.sigma": [0.0, 0.05]}]}]
    groups += [{"scene": "published", "label": "offset", "set": SMALL, "sweep": [{"paper.eps": [60.0]}]}]
    return Experiment(name="small", realisations=130, groups=groups, estimators=("circle_pose", "cone_axis"), **more)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    return run_experiment(small(), folder)


def test_results_fit_the_contract(run):
    assert list(run.results.columns)[: len(SCHEMA)] == list(SCHEMA)
    every = {f"paper.{name}" for name in PaperSetting.model_fields}
    assert every | {"bound_deg"} <= set(run.results.columns)
    first = run.results.row(0, named=True)
    assert (first["paper.size"], first["paper.theta_deg"], first["paper.recentre"]) == (128.0, 58.0, True)
    law = run.results.group_by("setting", "estimator", maintain_order=True).agg(pl.col("error_law_deg").first())
    assert [value is not None for value in law["error_law_deg"]] == [True, False, True, False, False, False]
    figures = json.loads((run.folder / "summary.json").read_text())["experiments"]["small"]["settings"][
        "noise, sigma=0.05"
    ]
    assert set(figures) == {"circle_pose", "cone_axis"}
    assert figures["circle_pose"]["n"] == 130
    assert figures["circle_pose"]["mean_oracle_deg"] < 3
    pose = run.results.filter(pl.col("estimator") == "circle_pose")
    assert set(pose["isovalue"].drop_nulls()) == {0.3}
    bounds = run.results.group_by("setting", maintain_order=True).agg(pl.col("bound_deg").first())
    assert bounds["bound_deg"][0] == 0
    assert bounds["bound_deg"][1] > 0
    assert bounds["bound_deg"][2] is None  # the light is not at V


def test_no_two_realisations_share_a_seed(run):
    pose = run.results.filter(pl.col("estimator") == "circle_pose")
    assert pose["seed"].n_unique() == pose.height


@pytest.mark.slow
def test_rows_do_not_depend_on_the_workers(run, tmp_path):
    with_two = run_experiment(small(), tmp_path / "two", engine=make_engine(workers=2))
    assert with_two.results.equals(run.results)
    assert (tmp_path / "two" / "results.parquet").read_bytes() == (run.folder / "results.parquet").read_bytes()


@pytest.mark.ci  # meanwhile: test_cli: the same command goes on and gives the same results
def test_a_run_cut_in_two_gives_the_same_bytes(run, tmp_path):
    def stop_in_the_second_setting(done, _total, _name):
        if done > 130:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_experiment(small(), tmp_path / "cut", progress=stop_in_the_second_setting)
    resumed = run_experiment(small(), tmp_path / "cut")
    assert resumed.resumed == 1
    assert (tmp_path / "cut" / "results.parquet").read_bytes() == (run.folder / "results.parquet").read_bytes()


@pytest.mark.slow
def test_rows_do_not_depend_on_five_workers(run, tmp_path):
    assert run_experiment(small(), tmp_path, engine=make_engine(workers=5)).results.equals(run.results)


@pytest.mark.parametrize(
    ("key", "value"),
    [("sigma", -0.1), ("theta_deg", 90.0), ("exponent", 0.0), ("isovalue", 1.0), ("isovalue", 0.0), ("size", 15)],
)
def test_bad_values_are_refused_before_anything_runs(key, value):
    with pytest.raises(InputError, match=rf"paper\.{key} = .*must be"):
        expand(load_experiment("paper", {f"paper.{key}": value}))


def test_random_values_are_refused():
    random = {"paper.sigma": {"low": 0.0, "high": 0.1}}
    experiment = Experiment(name="r", groups=[{"scene": "published", "random": random}])
    with pytest.raises(InputError, match="draws its light itself"):
        expand(experiment)


def test_the_published_scene_is_not_for_rendering():
    with pytest.raises(InputError, match="published"):
        load_scene("published")


@pytest.mark.parametrize("workers", [0, -1, 1000, True])
def test_a_bad_number_of_workers_is_refused(workers, tmp_path):
    with pytest.raises(InputError, match=r"workers = .*: must be 1 to"):
        validate(small(), tmp_path / "run", workers=workers)
    assert not (tmp_path / "run").exists()


def test_a_setting_where_nothing_can_be_fitted_is_reported(tmp_path):
    groups = [{"scene": "published", "set": {**SMALL, "paper.theta_deg": 89.0}}]
    run = run_experiment(Experiment(name="steep", realisations=3, groups=groups), tmp_path)
    (figures,) = json.loads((run.folder / "summary.json").read_text())["experiments"]["steep"]["settings"].values()
    assert figures["circle_pose"]["n_ok"] == 0
    assert sum(figures["circle_pose"]["n_failed_by_reason"].values()) == 3
