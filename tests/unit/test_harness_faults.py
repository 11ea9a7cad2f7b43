"""Faults that the harness once had: each has its test."""

import json
import shlex
from dataclasses import dataclass

import numpy as np
import pytest

import simtest
from simtest.api import reconstruct_picture
from simtest.errors import Failure, InputError
from simtest.estimators import Estimate
from simtest.estimators.dispatch import run
from simtest.geometry import Camera, Patch, smooth
from simtest.reconstruction.options import Options
from simtest.rendering import HighlightPoint, Session
from simtest.report import write_report
from simtest.simulation.frame import render_view
from simtest.simulation.frame_files import write_frame
from simtest.simulation.highlights import examine, verdicts
from simtest.spec import Experiment, load_experiment, parse_settings, scene_from_dict
from simtest.validation.cases import expand
from simtest.validation.realisation import realise
from simtest.validation.runner import run_experiment
from tests.marked import marked
from tests.refusals import refused

CAMERA = Camera(80, 60, 100.0, 100.0, 40.0, 30.0)


GOOD = {"normal": np.array([0, 0, -1.0]), "candidates": np.array([[0, 0, -1.0]]), "look_px": np.array([40.0, 30.0])}


@dataclass(frozen=True)
class Returns:
    estimated: Estimate

    def estimate(self, patch, camera, priors):
        return self.estimated


def patch():
    y, x = np.mgrid[:60, :80]
    return Patch.cut(smooth(np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 100), 1.0), (0, 0, 80, 60))


SOUTH, LONG = np.array([0, 0, 1.0]), np.array([0, 0, -2.0])
MALFORMED = [
    {"normal": [0.0, 0.0, -1.0]},
    {"normal": np.array([0, 0, -1.0]), "candidates": np.array([0, 0, -1.0])},
    {"candidates": np.empty((0, 3))},
    {"candidates": np.array([[0, 0, -1.0], [np.nan, 0, -1.0]])},
    {"candidates": np.array([[0, 0.6, -0.8]])},
    {"look_px": None},
    {"covariance": [[1.0, 0.0], [0.0, 1.0]]},
    {"covariance": np.full((2, 2), np.nan)},
    {"axis_ratio": np.nan},
    {"flags": "abc"},
    {"normal": SOUTH, "candidates": SOUTH[None]},
    {"normal": LONG, "candidates": LONG[None]},
]


@pytest.mark.parametrize("change", MALFORMED)
def test_a_malformed_estimate_is_a_failure(change):
    result = run(Returns(Estimate(**{**GOOD, **change})), patch(), CAMERA)
    assert isinstance(result, Failure)
    assert result.reason in ("estimator_error", "not_finite")


def test_a_good_estimate_passes():
    assert isinstance(run(Returns(Estimate(**GOOD)), patch(), CAMERA), Estimate)


def small_experiment(**more):
    tables = {"scene": "plane", "isolated": False, "set": {"camera.width": 120, "camera.height": 120}, **more}
    return Experiment(name="small", realisations=2, estimators=("cone_axis",), groups=[tables])


@pytest.mark.render
def test_what_a_killed_run_left_is_swept_away(tmp_path):
    experiment = small_experiment()
    run_experiment(experiment, tmp_path)
    write_report(tmp_path)
    leftovers = [tmp_path / ".index.12.part.html", tmp_path / "gallery" / ".0000.12.part.npz"]
    for file in leftovers:
        file.write_bytes(b"half")
    write_report(tmp_path)  # a half-written gallery item is no item
    run_experiment(experiment, tmp_path)
    write_report(tmp_path)
    assert not any(file.exists() for file in leftovers)


def test_a_set_value_below_a_swept_table_is_refused(tmp_path):
    file = tmp_path / "tables.toml"
    file.write_text('[[groups]]\nscene = "plane"\nsweep = [{ reflectance = [{ type = "phong" }] }]\n')
    with pytest.raises(InputError, match=r"--set reflectance.diffuse: the experiment varies reflectance as a whole"):
        load_experiment(file, {"reflectance.diffuse": 0.2})


def test_a_set_table_takes_the_place_of_sweeps_below_it():
    experiment = load_experiment("grid", {"rig.lights": [{"offset_mm": 1.0}]})
    cases = expand(experiment)
    assert {case.data["rig"]["lights"][0]["offset_mm"] for case in cases} == {1.0}
    assert len(cases) == 6


def spot(x, lit):
    place = np.array([0, 0, 10.0])
    normal, along = np.array([0, 0, -1.0]), np.array([1.0, 0, 0])
    return HighlightPoint(
        0, np.array([x, 30.0]), place, normal, along, 10.0, 0.2, 0.5, lit, 1.0, normal, 0.2, 0.5, pool=False
    )


def test_a_shadowed_highlight_does_not_take_a_lit_one_s_peak():
    y, x = np.mgrid[:60, :80] + 0.5
    radiance = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 50).astype(np.float32)
    spots = [spot(40.1, lit=False), spot(41.5, lit=True)]
    judged = verdicts(spots, examine(spots, radiance), np.zeros(2))
    assert [j.why_not for j in judged] == ["in shadow", ""]


def test_a_cylinder_seen_along_its_axis_from_inside_is_allowed():
    surface = {"type": "cylinder", "side": "inside", "radius_mm": 10.0, "distance_mm": 15.0, "tilt_deg": 50.0}
    scene_from_dict({"surface": {**surface, "azimuth_deg": 90.0}})
    with pytest.raises(InputError, match="puts the camera outside"):
        scene_from_dict({"surface": {**surface, "azimuth_deg": 0.0}})


@pytest.mark.render
def test_the_command_of_a_frame_makes_the_same_frame():
    experiment = small_experiment(
        random={"surface.azimuth_deg": {"low": 0.0, "high": 360.0}}, sweep=[{"rig.lights.0.offset_mm": [0.0, 1.0]}]
    )
    case = expand(experiment)[1]
    scene, drawn = case.scene(experiment, 1)
    session = Session(scene)
    made = realise(session, experiment, case, 1, render_view(session, scene), drawn, {})
    reproduce = case.reproduce_command(experiment, 1)
    name, *words = shlex.split(reproduce.removeprefix("simtest render ").removesuffix(" --out frame"))
    alone = simtest.render(name, parse_settings([word for word in words if word != "--set"]))
    np.testing.assert_array_equal(alone.image, made.frame)


@pytest.mark.render
def test_random_paths_hang_on_the_run_s_seed():
    values = {"render.path_depth": 3, "reflectance.diffuse": 0.5, "camera.width": 32, "camera.height": 32}
    seeds = set()
    for seed in (0, 1):
        experiment = small_experiment(set=values).model_copy(update={"seed": seed})
        (case,) = expand(experiment)
        seeds.add(case.scene(experiment, 0)[0].render.seed)
        # The noise differs between realisations, the rendered scene does not.
        assert case.scene(experiment, 0)[0] == case.scene(experiment, 1)[0]
    assert len(seeds) == 2


@pytest.mark.render
def test_colour_frames_are_judged_by_the_noise_of_their_mean():
    camera = {"width": 80, "height": 80, "fx": 120, "fy": 120}
    scene = scene_from_dict({"surface": {"type": "plane"}, "sensor": {"noise_sigma": 0.03}, "camera": camera})
    mono, colour = (
        render_view(Session(scene, variant), scene).highlights[0] for variant in ("llvm_ad_mono", "llvm_ad_rgb")
    )
    assert colour.peak_snr == pytest.approx(np.sqrt(3) * mono.peak_snr, rel=1e-3)


@pytest.mark.render
@pytest.mark.parametrize(
    "name",
    marked(["plane", "cylinder", "sphere", "saddle", "anatomy"], ci=["cylinder", "sphere", "saddle"], slow=["anatomy"]),
)
def test_a_rendered_picture_can_be_reconstructed(name, tmp_path):
    """sRGB encoding lifts the noise of dark pixels: undone before detection."""
    write_frame(simtest.render(name), tmp_path / "frame")
    options = Options(tmp_path / "frame" / "camera.toml")
    record, files = reconstruct_picture(tmp_path / "frame" / "frame.png", tmp_path / "normals", options)
    document = json.loads(files[0].read_text())
    assert len(record) == len(document["specularities"]) >= 1
    assert document["specularities"][0]["estimates"]["cone_axis"]["status"] == "ok"


@pytest.mark.render
def test_a_finished_run_is_given_back_and_another_is_replaced_aloud(tmp_path):
    experiment = small_experiment()
    first = run_experiment(experiment, tmp_path)
    before = (tmp_path / "results.parquet").stat().st_mtime_ns
    again = run_experiment(experiment, tmp_path)
    assert again.resumed == 1
    assert again.results.equals(first.results)
    assert (tmp_path / "results.parquet").stat().st_mtime_ns == before
    with pytest.warns(UserWarning, match="holds another run"):
        other = run_experiment(another := experiment.model_copy(update={"seed": 9}), tmp_path)
    assert not other.results.equals(first.results)
    # Without its results it is no run.
    (tmp_path / "results.parquet").unlink()
    refused(lambda: run_experiment(another, tmp_path), f"--out {tmp_path}: holds gallery, which is no part")


def test_a_refused_number_of_workers_touches_no_folder(tmp_path):
    """A stopped run's parts stay for the command that goes on with it."""
    parts = tmp_path / "parts"
    parts.mkdir()
    (parts / "case-00000.parquet").write_bytes(b"half of a run")
    with pytest.raises(InputError, match="workers = 0"):
        simtest.validate("overview", tmp_path, workers=0)
    assert (parts / "case-00000.parquet").read_bytes() == b"half of a run"


def test_workers_are_told_the_variant_that_is_recorded(tmp_path, monkeypatch):
    class Elsewhere:
        """An engine whose workers have another environment."""

        def run(self, task, arguments, tell):
            self.variants = {part.variant for part in arguments}
            raise InputError("enough")

    engine = Elsewhere()
    monkeypatch.setenv("SIMTEST_VARIANT", "llvm_ad_rgb")
    with pytest.raises(InputError, match="enough"):
        run_experiment(load_experiment("curvature"), tmp_path / "run", engine=engine)
    assert engine.variants == {"llvm_ad_rgb"}
