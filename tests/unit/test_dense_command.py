"""`simtest score` of maps, from the command line, on rendered frames: tissue, a lens, a view mask, an instrument."""

import json
import shutil

import numpy as np
import pytest
from dense_frames import turned, write_png

import simtest
from simtest.cli.runs import WORDS
from simtest.dataset.scoring.dense import score
from simtest.dataset.scoring.dense.maps import METHODS
from simtest.dataset.scoring.dense.score import frames_of
from simtest.dataset.scoring.dense.truth import SURFACES
from simtest.errors import InputError
from simtest.rendering.bitmap import write_exr
from simtest.spec import calibration_toml
from simtest.validation.run_folder import TRUTH

pytestmark = pytest.mark.render

EXPERIMENT = """
title = "Dense"
description = "Frames for maps."
realisations = 1
seed = 4242
estimators = ["brightest_point"]

[[groups]]
scene = "saddle"
label = "tissue"
pool = [{ "surface.distance_mm" = [14.0, 18.0] }]
[groups.set]
"surface.relief" = { bands = [{ slope_deg = 4.0, wavelength_mm = 2.0 }] }
reflectance = { type = "tissue", albedo = { preset = "liver_capsule" }, film = { index = 1.35, alpha = 0.05 } }
"camera.width" = 128
"camera.height" = 96
"camera.fx" = 90.0
"camera.fy" = 90.0
"camera.view_mask.radius" = 55.0
"camera.distortion.type" = "brown_conrady"
"camera.distortion.k1" = -0.1
"render.samples_per_pixel" = 1

[[groups]]
scene = "cylinder"
label = "fisheye"
[groups.set]
"camera.width" = 128
"camera.height" = 96
"camera.fx" = 60.0
"camera.fy" = 60.0
"camera.distortion.type" = "kannala_brandt"
"surface.tilt_deg" = 20.0
"""


@pytest.fixture
def maps(tmp_path):
    """Return a folder for maps, which holds nothing yet."""
    (tmp_path / "maps").mkdir()
    return tmp_path / "maps"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a small run whose frames were exported, and the truth of these."""
    folder = tmp_path_factory.mktemp("dense")
    (folder / "small.toml").write_text(EXPERIMENT)
    simtest.validate(folder / "small.toml", folder / "run", export=folder / "frames")
    return folder / "run", list(frames_of(folder / "run"))


def test_flipped_maps_of_rendered_frames_score_their_turn(run, here, maps, tmp_path):
    on, truths = run
    assert len(truths) == len({truth.scene for truth in truths}) == 3
    assert {truth.excluded["outside_view"] > 0 for truth in truths if truth.setting == "tissue"} == {True}
    for seed, truth in enumerate(truths):
        # Relief: against the fine surface a degree is scored, against the base more.
        write_png(maps / f"{truth.name}.png", turned(truth.normal["fine"], 1.0, seed) * [1, -1, -1])
    code, output, _ = here("score", maps, "--on", on, "--out", tmp_path / "wrong")
    assert code == 0
    assert "warning: normals fit the truth better with --frame x,-y,-z" in output.replace("\n", " ")
    options = ("--frame", "opengl", "--out", tmp_path / "scored")
    code, output, errors = here("score", maps, "--on", on, *options)
    assert (code, [line for line in errors if "Error" in line]) == (0, [])
    assert "x,-y,-z (opengl), as stated" in output.replace("\n", " ")
    record = json.loads((tmp_path / "scored" / "dense.json").read_text())
    cells = record["sources"]["normal"]["angle_deg"]
    for cell in cells["fine"]:
        assert cell["mean"] == pytest.approx(1.0, abs=1e-3), cell
        assert cell["median"] == pytest.approx(1.0, abs=4e-3), cell
    assert cells["base"][0]["mean"] > 1.5
    assert record["counts"]["scored"] == sum(int(truth.scored.sum()) for truth in truths)
    assert "wall" not in json.dumps(record["counts"])


def test_the_truth_that_an_export_kept_is_that_of_the_frames_rendered_again(run, tmp_path):
    folder, kept = run
    shutil.copytree(folder, tmp_path / "run")
    assert len([*(tmp_path / "run" / TRUTH).iterdir()]) == len(kept)
    shutil.rmtree(tmp_path / "run" / TRUTH)
    for one, again in zip(kept, frames_of(tmp_path / "run"), strict=True):
        where = again.scored
        np.testing.assert_array_equal(one.scored, where)
        np.testing.assert_array_equal(one.distance[where], again.distance[where])
        for surface in SURFACES:
            np.testing.assert_array_equal(one.normal[surface][where], again.normal[surface][where])
            np.testing.assert_array_equal(one.curvature[surface][where], again.curvature[surface][where])
        np.testing.assert_array_equal(one.zone, again.zone)
        np.testing.assert_array_equal(one.image, again.image)
        assert calibration_toml(one.calibration) == calibration_toml(again.calibration)
        for name in ("name", "eps", "excluded", "setting", "swept", "scene"):
            assert getattr(one, name) == getattr(again, name)


def test_a_kept_truth_is_read_without_rendering_and_a_damaged_one_is_told(run, tmp_path, monkeypatch):
    shutil.copytree(run[0], tmp_path / "run")
    monkeypatch.setattr(score, "scored_frames", None)
    assert len([*frames_of(tmp_path / "run")]) == len(run[1])
    for file in (tmp_path / "run" / TRUTH).iterdir():
        file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(InputError, match="cannot be read"):
        list(frames_of(tmp_path / "run"))


@pytest.mark.slow
def test_maps_in_exr_are_read(run, here, maps, tmp_path):
    on, truths = run
    for truth in truths:
        write_exr(maps / f"{truth.name}_depth.exr", truth.distance)
    options = ("--depth", "ray", "--out", tmp_path / "scored", "--json")
    code, output, _ = here("score", maps, "--on", on, *options)
    assert code == 0
    record = json.loads(output)
    assert record["conventions"]["depths"]["along"] == "ray"
    assert record["sources"]["depth_none"]["depth_percent"]["fine"][0]["p95"] < 1e-4


@pytest.mark.slow
def test_the_baseline_is_scored_by_its_name(run, here, tmp_path):
    code, output, _ = here("score", "shading", "--on", run[0], "--out", tmp_path / "scored")
    assert code == 0
    assert (tmp_path / "scored" / "index.html").is_file()
    assert "depth_affine" in output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--encoding", "rgb"], "--encoding rgb: unknown"),
        (["--frame", "north"], "--frame north: unknown"),
        (["--depth", "far"], "--depth far: unknown"),
        (["--unit-mm", "0"], "--unit-mm 0: must be"),
    ],
)
def test_wrong_options_are_one_line(run, here, maps, tmp_path, options, message):
    np.save(maps / "a.npy", np.zeros((4, 4, 3)))
    code, _, errors = here("score", maps, "--on", run[0], "--out", tmp_path / "scored", *options)
    assert code != 0
    assert message in errors[-1]
    assert not (tmp_path / "scored" / "dense.json").exists()


def test_names_of_maps_are_checked_before_anything_is_rendered(run, here, maps, tmp_path, monkeypatch):
    def render(*_):
        raise AssertionError("rendered")

    monkeypatch.setattr(score, "frames_of", render)
    np.save(maps / "stranger.npy", np.zeros((4, 4, 3)))
    code, _, errors = here("score", maps, "--on", run[0], "--out", tmp_path / "scored")
    assert code != 0
    assert "no map is called as a frame (found stranger.npy" in errors[-1]


def test_a_stopped_score_does_not_say_that_it_goes_on(run, here, maps, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(score, "frames_of", stop)
    np.save(maps / f"{run[1][0].name}.npy", np.zeros((4, 4, 3)))
    code, _, errors = here("score", maps, "--on", run[0], "--out", tmp_path / "scored")
    assert code == 130
    assert errors[-1] == "simtest: stopped; an earlier page stays; the same command begins anew"


def test_options_of_maps_are_refused_for_a_table(run, here, tmp_path):
    (tmp_path / "table.csv").write_text("frame,x_px,y_px,normal_x,normal_y,normal_z\n")
    code, _, errors = here("score", tmp_path / "table.csv", "--on", run[0], "--frame", "opengl")
    assert code != 0
    assert "for folders of maps alone" in errors[-1]


def test_a_run_is_not_written_over(run, here, maps, tmp_path):
    np.save(maps / "a.npy", np.zeros((4, 4, 3)))
    code, _, errors = here("score", maps, "--on", run[0], "--out", run[0])
    assert code != 0
    assert "holds another page" in errors[-1]


def test_the_command_knows_the_methods():
    assert set(WORDS) == set(METHODS)
