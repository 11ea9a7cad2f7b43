"""The best estimate and why; what is assumed where nobody told, and the keys that narrow it."""

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

import simtest
from simtest.calibration import NO_PRIORS, CameraPrior, Priors, Uniform, exactly, srgb_encode
from simtest.calibration.priors import NO_FLOORS, OF_PICTURES, Floors
from simtest.detection import Region
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.names import load_estimators
from simtest.estimators.process.messages import priors_message
from simtest.estimators.protocol import Estimate
from simtest.geometry import KannalaBrandt, ViewMask
from simtest.reconstruction.assumptions import (
    BORDERED,
    CENTRE_SD_SHARE,
    FOCAL_SD,
    LENS_SD,
    NEAR_MISSES,
    assumptions,
    calibration_of_round_view,
    calibration_of_view,
)
from simtest.reconstruction.options import Options, calibration_for
from simtest.reconstruction.pipeline import reconstruct_values
from simtest.reconstruction.records import Specularity, best_of, stated_errors
from simtest.runtime.files import write_json
from simtest.spec import load_calibration, save_calibration

NORMAL = np.array([0.0, 0.0, -1.0])
CAMERA_KEYS = "width = 200\nheight = 160\nfx = 200.0\nfy = 200.0\n"


def stating(deg=None, **given):
    parts = {} if deg is None else {"budget": {"noise": np.radians(deg) ** 2 / 2 * np.eye(2)}}
    return Estimate(NORMAL, NORMAL[None], np.array([100.0, 80.0]), **parts, **given)


def spot():
    x, y = np.meshgrid(np.arange(200), np.arange(160))
    frame = np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / 200)
    return (frame + 0.002 * np.random.default_rng(0).standard_normal(frame.shape)).clip(0, 1).astype(np.float32)


# The best estimate ----------------------------------------------------------------------------------------------------


def test_the_smallest_expected_error_is_the_best():
    two = {"bisector": stating(2.0), "other": stating(0.5), "circle_pose": stating()}
    best, because = best_of(two)
    assert best == "other"
    assert because == "smallest expected error, 0.5 deg; next bisector with 2 deg"
    assert best_of({**two, "other": Failure(Reason.NO_PEAK)})[0] == "bisector"


def test_the_best_is_that_of_the_estimates():
    """What follows from the estimates is kept, so nobody changes them in place; a copy with others judges anew."""
    nowhere = Failure(Reason.NO_PEAK, "none")
    made = Specularity(Region((0, 0, 1, 1), (0, 0), None), nowhere, {"curved": stating(1.0)})
    assert made.best == "curved"
    with pytest.raises(TypeError):
        made.estimates["cone_axis"] = stating(0.5)
    changed = replace(made, estimates={**made.estimates, "cone_axis": stating(0.5)})
    for copy in (changed, pickle.loads(pickle.dumps(changed))):
        assert copy.best == "cone_axis"


def test_what_states_no_uncertainty_comes_last():
    vague = {"brightest_point": stating(), "mine": stating(80.0)}
    assert best_of(vague) == ("mine", "smallest expected error, 80 deg; the others report no uncertainty")
    silent = {"circle_pose": stating(), "mine": stating(), "cone_axis": stating()}
    assert best_of(silent)[0] == "cone_axis"
    assert best_of({"circle_pose": stating(), "mine": stating()})[0] == "mine"
    assert best_of({"a": Failure(Reason.NO_PEAK)}) == (None, "no estimator answered")


def test_the_best_is_one_that_states_the_wanted_surface():
    both = {"cone_axis": stating(3.0), "cloud": stating(0.5, target="base")}
    assert best_of(both)[0] == "cone_axis"
    assert best_of(both, "base")[0] == "cloud"
    assert best_of({"cloud": both["cloud"]})[0] == "cloud"


def test_the_largest_part_is_named():
    light = {"light_offset": np.radians(4.0) ** 2 * np.eye(2)}
    assert "mostly light_offset" in best_of({"cone_axis": stating(1.0).with_parts(**light)})[1]


def test_the_stated_errors_of_a_picture():
    light = {"light_offset": np.radians(4.0) ** 2 / 2 * np.eye(2)}
    told = stated_errors([stating(3.0).with_parts(**light), stating(1.0), stating(2.0), stating()])
    assert (told.count, told.silent) == (3, 1)
    assert told.median_deg == pytest.approx(2.0)
    assert told.parts_deg == pytest.approx({"noise": 2.0, "light_offset": 0.0})
    assert str(told) == "median ± 2 deg of 3 best normals (noise 2); 1 report none"
    assert stated_errors([stating()]) is None


# What is assumed ------------------------------------------------------------------------------------------------------


def test_a_field_of_view_alone_leaves_all_of_it_open():
    calibration = calibration_of_view(70.0, 200, 160)
    assert calibration.priors == Priors(camera=CameraPrior(FOCAL_SD, 4.0, 0.1))
    fine = assumptions(calibration, None)
    assert [each.what for each in fine] == [
        "light", "distance of the tissue", "focal length", "principal point", "distortion", "response",
        "falloff towards the border", "slope of the relief", "highlights",
    ]  # fmt: skip
    assert "uniform from 0 to 6 mm" in str(fine[0])
    assert all(each.how_to_narrow for each in fine)
    assert assumptions(calibration, None)[-2].distribution == "uniform from 3 to 20 deg an axis, for the organ's normal"
    assert "response" not in {each.what for each in assumptions(calibration, "linear")}


@pytest.mark.parametrize(("across", "corner"), [("width", (100, 0)), ("height", (0, 80)), ("diagonal", (100, 80))])
def test_a_field_of_view_spans_what_it_is_told_to_span(across, corner):
    camera = calibration_of_view(70.0, 200, 160, across).camera
    ends = camera.unproject(np.add((100.0, 80.0), [corner, np.negative(corner)]))
    assert np.degrees(np.arccos(ends[0] @ ends[1])) == pytest.approx(70.0)
    assert camera.fx == camera.fy


def test_a_field_of_view_is_told_with_its_extent(tmp_path):
    with pytest.raises(InputError, match="--fov-of depth: must be one of width, height, diagonal"):
        calibration_of_view(70.0, 200, 160, "depth")
    # A wide field is that of an equidistant lens, which images nothing straight behind it.
    wide = calibration_of_view(120.0, 200, 160, "height")
    assert (wide.camera.distortion, wide.camera.fy) == (KannalaBrandt(), pytest.approx(80 / np.radians(60.0)))
    assert calibration_of_view(100.0, 200, 160).camera.distortion is None
    with pytest.raises(InputError, match="--fov 175: the corners of the picture would see more than 180 deg off"):
        calibration_of_view(175.0, 200, 10, "height")
    # Black corners far outside a round view need no direction.
    masked = calibration_of_round_view(170.0, 400, 160, ViewMask(200.0, 80.0, 60.0)).camera
    assert masked.view_mask == ViewMask(200.0, 80.0, 60.0)
    picture = np.zeros((160, 200), np.float32)
    _, (told,) = calibration_for(Options(fov_deg=70.0, fov_of="diagonal"), picture)
    assert "70 deg across the picture's diagonal" in told


def tissue(lit):
    picture = np.repeat(spot()[..., None], 3, axis=2) * [0.5, 0.3, 0.25] + [0.4, 0.2, 0.15]
    return np.where(lit[..., None], picture, 0.0).clip(0, 1).astype(np.float32)


def notes_of(picture, fov_of="width"):
    options = Options(fov_deg=70.0, fov_of=fov_of, estimators=("brightest_point",))
    warnings = reconstruct_values("a", picture, calibration_for(options, picture)[0], options).warnings
    return [each for each in warnings if each.startswith(BORDERED)]


Y, X = np.mgrid[:160, :200] + 0.5
ROUND = np.hypot(X - 110, Y - 80) < 75


def test_dark_borders_are_named_and_the_note_can_be_obeyed():
    (note,) = notes_of(tissue(ROUND))
    first, end, top, low = (
        int(v) for v in re.findall(r"(\d+) to (\d+)", note)[0] + re.findall(r"(\d+) to (\d+)", note)[1]
    )
    assert (first, end, top, low) == pytest.approx((35, 184, 5, 154), abs=2)
    assert "--fov-of view" in note
    # dark corners alone are no borders: nothing is left to crop
    assert notes_of(np.ascontiguousarray(tissue(ROUND)[top : low + 1, first : end + 1])) == []
    assert notes_of(tissue(ROUND), "view") == []
    assert notes_of(tissue(np.ones((160, 200), bool))) == []
    assert notes_of(tissue(np.abs(X - 100) + np.abs(Y - 80) < 160)) == []
    # straight borders, which no circle explains
    (straight,) = notes_of(tissue((X > 20) & (X < 190)))
    assert "columns 20 to 189 of 200" in straight
    assert "rows" not in straight
    assert "--fov-of view" not in straight


def test_a_field_of_view_may_span_the_round_view():
    options = Options(fov_deg=140.0, fov_of="view")
    calibration, (told,) = calibration_for(options, tissue(ROUND))
    camera, edge = calibration.camera, np.radians(70.0)
    assert (camera.cx, camera.cy) == pytest.approx((110, 80), abs=0.7)
    assert (camera.distortion, camera.view_mask) == (KannalaBrandt(), None)
    assert camera.fx == pytest.approx(75 / edge, rel=0.02)
    assert calibration.priors.camera == CameraPrior(FOCAL_SD, CENTRE_SD_SHARE * 200, LENS_SD, edge)
    (lens,) = (each for each in assumptions(calibration, None) if each.what == "distortion")
    assert (
        lens.distribution == "equidistant, its k1 normal, ± 0.17, unchanged 1.22 focal lengths from the principal point"
    )
    assert "across the picture's round view" in told
    with pytest.raises(InputError, match="--fov-of view: no round view was found"):
        calibration_for(options, tissue(np.ones((160, 200), bool)))


def test_a_full_calibration_leaves_nothing_open(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        CAMERA_KEYS + '[response]\ntype = "srgb"\n[vignetting]\ntype = "cosine"\n'
        '[emission]\ntype = "cosine"\n[rig]\nlights_mm = [[0, 0, 0]]\n'
        "distance_mm = 40.0\n[surface]\nrelief_slope_deg = 0.0\n"
    )
    # But for highlights that hold no highlight point; a plane has none of these.
    told = load_calibration(path)
    assert assumptions(told, None) == [NEAR_MISSES]
    assert assumptions(replace(told, priors=replace(told.priors, plane=True)), None) == []


def test_a_prior_that_a_file_states_is_given_where_it_is_the_default_too(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        CAMERA_KEYS + "[rig]\nlight_offset_mm = [0, 6]\n[surface]\nrelief_slope_deg = [3, 20]\n"
        "[uncertainty]\nfalloff_power = [0, 4]\n"
    )
    given = load_calibration(path)
    made = [each for each in assumptions(given, None) if each.given]
    assert {each.what for each in made} == {"light", "falloff towards the border", "slope of the relief"}
    # It is one still in a file that is written from it, and for a core in another process.
    save_calibration(given, tmp_path / "written.toml")
    assert load_calibration(tmp_path / "written.toml") == given
    for name in ("light_offset_mm", "falloff_power", "relief_slope"):
        assert priors_message(given.priors)[name]["told"]
        assert not priors_message(NO_PRIORS)[name]["told"]


def test_what_a_file_states_is_given_and_not_assumed(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        CAMERA_KEYS + "[rig]\nlights_mm = [[3, 0, 0]]\ndistance_range_mm = [20, 60]\n"
        "[uncertainty]\nfocal_sd = 0.05\ncentre_sd_px = 15.0\n"
    )
    made = assumptions(load_calibration(path), None)
    assert {each.what for each in made if each.given} == {"distance of the tissue", "focal length", "principal point"}
    assert {each.what for each in made if not each.given} == {
        "response", "falloff towards the border", "slope of the relief", "highlights",
    }  # fmt: skip
    assert (
        str(made[0])
        == "distance of the tissue: uniform from 20 to 60 mm along the sightline (given by the calibration)"
    )
    path.write_text(
        CAMERA_KEYS + "[rig]\nlight_offset_mm = [2, 4]\n[surface]\nrelief_slope_deg = 2.0\n"
        "[uncertainty]\nfalloff_power = [0, 2]\n"
    )
    made = assumptions(load_calibration(path), None)
    assert {each.what for each in made if each.given} == {"light", "falloff towards the border", "slope of the relief"}
    # A field of view states nothing of these.
    assert not any(each.given for each in assumptions(calibration_of_view(70.0, 200, 160), None))


def test_the_keys_that_narrow(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        CAMERA_KEYS + "[rig]\nlight_offset_mm = [2, 4]\ndistance_range_mm = [20, 60]\n"
        "[surface]\nrelief_slope_deg = 2.0\n"
        "[uncertainty]\nfocal_sd = 0.02\ncentre_sd_px = 5.0\ndistortion_sd = 0.01\nfalloff_power = [0, 2]\n"
    )
    assert load_calibration(path).priors == Priors(
        distance_mm=Uniform(20.0, 60.0),
        light_offset_mm=Uniform(2.0, 4.0),
        camera=CameraPrior(0.02, 5.0, 0.01),
        falloff_power=Uniform(0.0, 2.0),
        relief_slope=exactly(np.radians(2.0)),
    )
    path.write_text(CAMERA_KEYS + "[surface]\nrelief_slope_deg = [1, 3]\n[rig]\nlight_offset_mm = [3, 3]\n")
    told = load_calibration(path).priors
    assert (told.relief_slope, told.light_offset_mm) == (Uniform(*np.radians([1.0, 3.0]).tolist()), exactly(3.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[rig]\nlight_offset_mm = [4, 2]\n", r"light_offset_mm = \[4, 2\]: must be a lower and an upper end"),
        ("[rig]\ndistance_range_mm = [0, 20]\n", r"distance_range_mm = \[0, 20\].*above 0"),
        ("[rig]\ndistance_range_mm = [5, 20]\ndistance_mm = 9.0\n", "exclude each other"),
        ("[rig]\nlight_offset_mm = [0, 2]\nlights_mm = [[0, 0, 0]]\n", "exclude each other"),
        ("[uncertainty]\nfalloff_power = [3, 1]\n", "falloff_power"),
    ],
)
def test_malformed_keys_are_named(tmp_path, text, said):
    (tmp_path / "c.toml").write_text(CAMERA_KEYS + text)
    with pytest.raises(InputError, match=said) as caught:
        load_calibration(tmp_path / "c.toml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("target", ["fine", "base"])
def test_a_picture_of_which_nothing_is_told(tmp_path, target):
    options = Options(fov_deg=53.0, estimators=("cone_axis",), encoding="linear", target=target)
    calibration, _ = calibration_for(options, spot())
    record = reconstruct_values("spot", spot(), calibration, options)
    write_json(tmp_path / "normals.json", record.to_json())
    document = json.loads((tmp_path / "normals.json").read_text())
    (found,) = document["specularities"]
    assert (found["best"], found["estimates"]["cone_axis"]["target"]) == ("cone_axis", target)
    parts = found["estimates"]["cone_axis"]["budget"]
    deviations = {name: np.degrees(np.sqrt(np.trace(part))) for name, part in parts.items()}
    assert max(deviations, key=deviations.get) == ("light_offset" if target == "fine" else "relief")
    assert f"mostly {max(deviations, key=deviations.get)}" in found["best_because"]
    assert document["stated"]["count"] == 1
    assert next(iter(document["stated"]["parts_deg"])) == max(deviations, key=deviations.get)
    # Not 0.009 deg: between a few deg and what the priors allow, of which the relief is 12.7 deg and the light 5.5.
    stated = np.degrees(np.sqrt(np.trace(found["estimates"]["cone_axis"]["covariance"])))
    assert 4 < stated < (7 if target == "fine" else 32)
    assert [each["what"] for each in document["assumed"]][:2] == ["light", "distance of the tissue"]
    with pytest.raises(InputError, match="target = 'top': must be one of fine, base"):
        Options(fov_deg=53.0, target="top")


@pytest.mark.render
@pytest.mark.parametrize(("surface", "distance_mm"), [("plane", 30.0), ("cylinder", 60.0), ("plane", 80.0)])
def test_the_best_without_a_distance_errs_least_at_every_working_distance(surface, distance_mm):
    """Lights told, distance not: the named estimator is measured best too, near and far."""
    settings = {
        "surface.distance_mm": distance_mm, "surface.tilt_deg": 14.0, "sensor.noise_sigma": 0.03, "sensor.seed": 9071,
        "rig.lights.0.offset_mm": 4.0, "rig.lights.0.azimuth_deg": 205.0,
    }  # fmt: skip
    frame = simtest.render(surface, settings)
    calibration = frame.calibration
    assert calibration.priors.lights_mm
    assert calibration.priors.distance_mm is None
    (found,) = simtest.reconstruct(
        frame.image, calibration, estimators=["bisector", "curved", "cone_axis", "brightest_point"]
    )
    true = frame.highlights[0].normal
    errors = {name: np.degrees(np.arccos(min(1.0, each.normal @ true))) for name, each in found.estimates.items()}
    best, _ = best_of(found.estimates)
    assert best == min(errors, key=errors.get)
    # And it says how far it may be off.
    assert errors[best] <= 2.5 * np.degrees(np.sqrt(np.trace(found.estimates[best].covariance)))


# Floors of pictures ---------------------------------------------------------------------------------------------------


def shaded(cut=0):
    """A body whose broad shading has its maximum 12 px beside a small highlight; 8 bits, sRGB."""
    x, y = np.meshgrid(np.arange(200), np.arange(160))
    light = 0.7 * np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / 1800) + 0.15 * np.exp(
        -((x - 112) ** 2 + (y - 80) ** 2) / 50
    )
    return np.rint(255 * srgb_encode(light[cut:])).astype(np.uint8)


def lit(height=160, floors=None):
    priors = Priors(((40.0, 0.0, 0.0),), exactly(100.0), falloff_power=None, floors=floors)
    return simtest.Calibration(simtest.Camera.from_fov(40.0, 200, height), priors=priors)


def test_an_answer_off_its_peak_is_given_there_with_the_distance_in_its_budget():
    roi = (20, 10, 170, 140)
    before = simtest.reconstruct(shaded(), lit(floors=Floors()), ["bisector"], roi)[0].best_estimate
    after = simtest.reconstruct(shaded(), lit(), ["bisector", "brightest_point"], roi)[0]
    peak = after.patch.peak_px
    assert np.hypot(*(before.look_px - peak)) > 3
    assert "off_peak" in after.best_estimate.flags
    assert np.hypot(*(after.best_estimate.look_px - peak)) < 1.5
    assert after.best_estimate.deviation_deg > 3 * before.deviation_deg
    assert "off_peak" in after.estimates["brightest_point"].flags


def test_off_its_peak_and_cut_is_refused():
    found = simtest.reconstruct(shaded(60), lit(100), ["bisector"], (20, 0, 170, 90))[0].estimates["bisector"]
    assert isinstance(found, Failure)
    assert found.reason == Reason.NO_ESTIMATE
    assert "off the peak" in found.detail


def test_pictures_have_floors_and_linear_frames_none():
    picture = np.rint(255 * srgb_encode(spot())).astype(np.uint8)
    of_picture, open_ = (simtest.reconstruct(picture, lit(floors=f), ["bisector"]) for f in (None, Floors()))
    linear = simtest.reconstruct(spot(), lit(), ["bisector"])
    parts = [each[0].best_estimate.budget for each in (of_picture, open_, linear)]
    assert np.trace(parts[0]["resolution"]) >= 2 * OF_PICTURES.feature_sd**2
    assert "light_offset" in parts[0]
    assert "response" in parts[0]
    assert all(not {"light_offset", "response"} & set(part) for part in parts[1:])
    named = {each.what: each for each in of_picture.choices.assumed}
    floors = {
        "light positions",
        "distance of the tissue",
        *(what for what in named if what.startswith(("response at", "features"))),
    }
    assert len(floors) == 4
    assert not any(named[what].given for what in floors)
    assert "light_floor_mm" in named["light positions"].how_to_narrow
    assert "distance_floor" in named["distance of the tissue"].how_to_narrow
    others = [each for spots in (open_, linear) for each in spots.choices.assumed]
    assert not floors & {each.what for each in others}
    assert not any("_floor" in each.how_to_narrow for each in others)


def test_what_may_be_the_maximum_of_shading_has_a_region_that_holds_the_normal_that_faces_the_light():
    camera = simtest.Camera.from_fov(40.0, 200, 160)
    x, y = np.meshgrid(np.arange(200), np.arange(160))
    spot = 0.1 + 0.6 * np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / 200)
    patch = simtest.Patch.cut(spot, (60, 40, 80, 80), noise=1e-3)

    def answer(score, light=(60.0, 0.0, 0.0), floors=OF_PICTURES):
        priors = Priors((light,), exactly(100.0), falloff_power=None, floors=floors)
        return load_estimators(["bisector"])["bisector"].estimate(replace(patch, score=score), camera, priors)

    sightline = camera.unproject(patch.peak_px)
    to_light = np.array([60.0, 0.0, 0.0]) - 100 * sightline
    off = np.degrees(np.arccos(answer(0.0).normal @ to_light / np.linalg.norm(to_light)))
    assert off > 10
    assert off < 1.5 * answer(0.3).deviation_deg
    assert off > 3 * answer(1.0).deviation_deg
    # a light at the camera, a render, and a patch without a score have no such part
    for told in ({"light": (0.0, 0.0, 0.0)}, {"floors": NO_FLOORS}):
        assert answer(0.0, **told).deviation_deg == answer(1.0, **told).deviation_deg
    assert answer(None).deviation_deg == answer(1.0).deviation_deg
