"""Notebook manners: short texts, HTML with pictures, overrides by the last name of a key, results of runs."""

import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest

import simtest
from simtest.calibration import Priors, Uniform
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.protocol import Estimate
from simtest.geometry import BrownConrady, Camera, ViewMask
from simtest.geometry.vectors import tilt_deg
from simtest.pages.notebook import normal_html, picture_html, table_html
from simtest.rendering.frames import Radiance
from simtest.report.run_results import RunResults
from simtest.runtime.arrays import LONGEST, short
from simtest.simulation.frame import SURFACE_LEVEL, preview
from simtest.simulation.sensor import to_uint8
from simtest.spec.keys import full_keys
from simtest.spec.recipes import scene_models
from simtest.validation.cases import expand

SIZE = 160
LIMIT = 300


@pytest.fixture(scope="module")
def found():
    """Return a reconstruction of a lobe that no renderer made."""
    camera = Camera.from_fov(60.0, SIZE, SIZE)
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    lobe = np.exp(-(((x - 90) / 12) ** 2 + ((y - 70) / 9) ** 2) / 2)
    noise = np.random.default_rng(5).normal(0, 0.005, lobe.shape)
    return simtest.reconstruct((lobe + noise).astype(np.float32), simtest.Calibration(camera))


@pytest.fixture(scope="module")
def records(found):
    spot = found[0]
    answered = [each for each in spot.estimates.values() if isinstance(each, Estimate)]
    scene = simtest.load_scene("tissue_liver")
    return [
        found, spot, spot.patch, spot.region, *answered, *answered[0].isophotes, found.detection, found.choices,
        found.detection.frame, found.detection.frame.calibration, found.detection.frame.camera,
        Priors(lights_mm=((1.0, 0.0, 0.0),) * 9, distance_mm=Uniform(5.0, 50.0)),
        Failure(Reason.STREAK, "x" * 900), scene, simtest.load_experiment("overview"),
        simtest.load_experiment("overview").groups[0], scene.calibration(), BrownConrady(0.1, 0.2), ViewMask(5, 5, 4),
    ]  # fmt: skip


def test_no_record_has_a_long_text(records):
    for record in records:
        assert len(repr(record)) <= LIMIT, type(record)
        assert len(str(record)) <= LIMIT or isinstance(record, Failure), type(record)
        assert "\n" not in repr(record)


def test_texts_tell_what_matters(found):
    spot = found[0]
    assert repr(found).startswith("<Specularities: 1 specularity, 1 with a best normal; encoding linear")
    assert "normals: circle_pose" in repr(spot)
    estimate = spot.estimates["cone_axis"]
    assert f"{estimate.deviation_deg:.3g}" in repr(estimate)
    flagged = replace(estimate, flags=tuple(f"flag_{i}" for i in range(90)))
    assert len(repr(flagged)) <= LONGEST
    failed = replace(spot, estimates={"cone_axis": Failure(Reason.STREAK, "long")})
    assert "failed: cone_axis (streak)" in repr(failed)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.array([1.0, 2.5, 3.0]), "(1, 2.5, 3)"),
        (np.zeros((4, 5), np.float32), "<4 x 5 float32>"),
        (np.float32(0.12345678), "0.1235"),
        ({"a": np.zeros(99)}, "{a}"),
        ([1] * 40, "<40 items>"),
        (("isolated", "peaks", "colour", "auto"), "('isolated', 'peaks', 'colour', 'auto')"),
        (None, "None"),
    ],
)
def test_short_texts_of_values(value, text):
    assert short(value) == text


# HTML -------------------------------------------------------------------------------------------------------------


def test_pictures_of_a_reconstruction(found):
    for record in (found, found[0]):
        html = record._repr_html_()
        assert html.count("data:image/jpeg;base64,") == 1
    assert "<td>sightline rule</td>" in found._repr_html_()
    assert found.choices.estimators[-1] in found[0]._repr_html_()
    estimate = found[0].estimates["cone_axis"]
    html = estimate._repr_html_()
    assert "<svg" in html
    assert "noise" in html
    assert "<ellipse" not in estimate.without_uncertainty()._repr_html_()


@pytest.mark.parametrize("channels", [2, 5])
def test_a_frame_of_any_number_of_channels_has_a_picture(channels):
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    lobe = np.exp(-(((x - 90) / 12) ** 2 + ((y - 70) / 9) ** 2) / 2).astype(np.float32)
    (spot,) = found = simtest.reconstruct(np.repeat(lobe[..., None], channels, axis=2), 60.0)
    for record in (found, spot):
        assert record._repr_html_().count("data:image/jpeg;base64,") == 1


def test_a_failure_says_what_it_means():
    html = Failure(Reason.STREAK, "1 < 2")._repr_html_()
    assert Reason.STREAK.meaning in html
    assert "1 &lt; 2" in html
    assert all(reason.meaning for reason in Reason)


def test_texts_in_html_are_escaped():
    assert "<b>" not in table_html(("<b>",), [("<b>",)])
    assert 'alt="&lt;b&gt;"' in picture_html(np.zeros((4, 4, 3), np.uint8), "<b>")


def test_the_ellipse_of_an_estimate_holds_95_percent():
    sd = np.array([0.02, 0.01])
    normal = np.array([0.0, 0.0, -1.0])
    answer = Estimate(normal, normal[None], np.array([80.0, 60.0]), covariance=np.diag(sd**2))
    reach = float(re.search(r'<circle r="([\d.]+)" fill="none"', answer._repr_html_())[1])
    radii = [float(v) for v in re.search(r'rx="([\d.]+)" ry="([\d.]+)"', answer._repr_html_()).groups()]
    # Of two dimensions, the 95 % radius of a normal distribution is sqrt(-2 ln 0.05) standard deviations.
    np.testing.assert_allclose(radii, reach * sd * np.sqrt(-2 * np.log(0.05)), atol=0.01)
    turned = normal_html((0.0, 0.0), np.diag([1e-4, 4e-4]))
    assert abs(float(re.search(r"rotate\((-?[\d.]+)\)", turned)[1])) == pytest.approx(90)
    assert tilt_deg(normal) == 0


# Overrides --------------------------------------------------------------------------------------------------------


def test_the_last_name_of_a_key_is_enough():
    scene = simtest.load_scene("cylinder")
    # The file states the surface's radius; the lights' is a default.
    assert full_keys([scene], {"radius_mm": 5.0, "noise_sigma": 0.0}) == {
        "surface.radius_mm": 5.0,
        "sensor.noise_sigma": 0.0,
    }
    assert full_keys([scene], {"width": 9}) == {"camera.width": 9}
    # One of a list of bands of the relief has a width too.
    assert full_keys([simtest.load_scene("tissue_liver")], {"width": 9}) == {"camera.width": 9}
    assert full_keys([scene], {"sensor": {}}) == {"sensor": {}}


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("type", ("2 keys end so", "surface.type, reflectance.type", "settings=")),
        ("seed", ("rig.seed, sensor.seed, render.seed",)),
        ("radiu_mm", ("no key", "did you mean radius_mm")),
        ("x" * 500, ("no key", "simtest schema scene")),
    ],
)
def test_names_that_mean_several_keys_or_none(name, parts):
    with pytest.raises(InputError) as told:
        full_keys([simtest.load_scene("cylinder")], {name: 1})
    for part in parts:
        assert part in str(told.value)
    assert len(str(told.value)) < LIMIT


@pytest.mark.parametrize(("name", "meant"), [("realisation", "realisations"), ("estimator", "estimators")])
def test_a_mistyped_key_of_an_experiment_is_guessed(tmp_path, name, meant):
    with pytest.raises(InputError, match=rf"did you mean {meant}\?"):
        simtest.validate("overview", tmp_path / "run", **{name: 1})
    with pytest.raises(InputError, match=rf"did you mean {meant}\?"):
        simtest.load_experiment("overview", {name: 1})


def test_the_number_of_viewpoints_is_a_key_of_the_experiment(tmp_path):
    """Scenes that are computed have no key of that name."""
    with pytest.raises(InputError, match=r"--set viewpoints: no group of .*paper\.toml varies surface\.viewpoint"):
        simtest.validate("paper", tmp_path / "run", viewpoints=1)
    with pytest.raises(InputError, match="--set viewpoints=0: must be a whole number from 1 on"):
        simtest.validate("colon", tmp_path / "run", viewpoints=0)


@pytest.mark.render
@pytest.mark.parametrize("scene", ["cylinder", simtest.load_scene("cylinder")], ids=["by name", "object"])
def test_render_takes_overrides_for_files_and_objects(scene):
    """Another type drops the keys of the former."""
    told = {"sensor.noise_sigma": 0.0, "reflectance.type": "rough_conductor"}
    frame = simtest.render(scene, told, radius_mm=5.0, width=32, height=32, alpha=0.2)
    made = frame.scene
    assert (made.surface.radius_mm, made.sensor.noise_sigma) == (5.0, 0.0)
    assert (made.reflectance.type, made.reflectance.alpha) == ("rough_conductor", 0.2)
    assert frame.image.shape == (32, 32)
    assert all(len(repr(each)) <= LIMIT for each in (frame, frame.truth, frame.radiance, *frame.highlights))


def test_a_sweep_may_change_the_type(tmp_path):
    file = tmp_path / "both.toml"
    file.write_text(
        'title = "t"\nestimators = ["cone_axis"]\n[[groups]]\nscene = "cylinder"\n'
        'sweep = [{"reflectance.type" = ["phong", "rough_conductor"]}]\n'
    )
    cases = expand(simtest.load_experiment(file))
    assert [case.data["reflectance"]["type"] for case in cases] == ["phong", "rough_conductor"]
    assert "exponent" not in cases[1].data["reflectance"]
    # Short names find the keys of a type that a group sets.
    file.write_text(
        'title = "t"\nestimators = ["cone_axis"]\n[[groups]]\nscene = "cylinder"\n'
        'set = {"reflectance.type" = "rough_conductor"}\n'
    )
    models = scene_models(simtest.load_experiment(file))
    assert full_keys(models, {"alpha": 0.2}) == {"reflectance.alpha": 0.2}


@pytest.mark.render
def test_the_preview_shows_a_lit_surface():
    frame = simtest.render("cylinder", width=96, height=96)
    shown = preview(frame).astype(float)
    surface = np.median(shown[frame.truth.mask], axis=0)
    # lit, of tissue's colour, and darker than the highlight
    assert surface[0] > 80
    assert surface[0] > 1.2 * surface[2]
    assert shown.max() == 255
    assert "data:image/jpeg" in frame._repr_html_()


@pytest.mark.render
def test_a_preview_exposes_diffuse_light_where_there_is_any():
    frame = simtest.render("cylinder", width=64, height=64)
    specular = np.zeros_like(frame.radiance.specular)
    specular[30, 30] = 1.0
    own = np.full((*specular.shape, 3), 0.02, np.float32) * [1.0, 0.5, 0.5]
    lit = replace(frame, radiance=Radiance(specular, own.astype(np.float32), np.zeros_like(specular)[..., None]))
    shown = preview(lit)
    # The dullest pixel of the surface is at the level of the exposure, in its own colour.
    level = SURFACE_LEVEL * np.array([1.5, 0.75, 0.75])
    np.testing.assert_allclose(shown[0, 0], to_uint8(level[None, None].astype(np.float32))[0, 0], atol=3)
    assert shown.max() == 255


# Runs -------------------------------------------------------------------------------------------------------------


def test_results_of_a_run_are_read_when_asked(tmp_path):
    figures = {"median_deg": 0.25, "n": 3}
    summary = {"experiments": {"small": {"settings": {f"k={i}": {"cone_axis": figures} for i in range(40)}}}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "index.html").write_text("page")
    run = RunResults(tmp_path / "index.html")
    assert os.fspath(run) == str(run) == str(tmp_path / "index.html")
    assert run.folder == tmp_path
    assert "small: 40 settings, 1 estimators" in repr(run)
    assert len(repr(run)) <= LIMIT
    html = run._repr_html_()
    assert "0.25" in html
    assert "and 28 more settings" in html


@pytest.mark.slow
@pytest.mark.render
def test_validate_gives_results(tmp_path):
    run = simtest.validate("paper", tmp_path / "run", realisations=1, estimators=["cone_axis"], size=64)
    assert run.results["estimator"].unique().to_list() == ["cone_axis"]
    assert run.page.is_file()
    assert "data:image/jpeg" in run._repr_html_()
