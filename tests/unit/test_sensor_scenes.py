"""Sensors in rendered scenes: the law of vignetting, dark frames, exposure, saturation, and pictures that read back."""

import json
import math
import warnings

import cv2
import numpy as np
import pytest

from simtest.api import reconstruct_picture, render
from simtest.calibration import Response
from simtest.calibration.priors import UNTOLD_FALLOFF_POWER
from simtest.errors import Failure, Reason
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.simulation.frame import render_picture, render_view
from simtest.simulation.frame_files import encoded_png, thumbnail, write_frame
from simtest.spec import Experiment, load_calibration, scene_from_dict
from simtest.spec.sensor import Sensor
from simtest.validation import laws
from simtest.validation.predicted import unknown_falloff
from simtest.validation.runner import run_experiment
from tests.marked import marked

pytestmark = pytest.mark.render

COS4 = {"type": "cosine", "power": 4.0}
LIMIT_DEG = 0.02
ESTIMATORS = ("circle_pose", "brightest_point", "cone_axis")


def scene(sensor=None, tilt=10.0, size=320, focal=250.0, surface=None, **keys):
    shape = {"type": "plane", "tilt_deg": tilt, "azimuth_deg": 30.0, **(surface or {})}
    camera = {"width": size, "height": size, "fx": focal, "fy": focal}
    return scene_from_dict({"surface": shape, "camera": camera, "sensor": sensor or {}, **keys})


@pytest.fixture(scope="module")
def session():
    return Session(scene())


def errors(session, described, seeds=(0,)):
    """Return each estimator's errors, deg, against the normal at the true BP."""
    seen = render_view(session, described)
    normal = seen.highlights[0].normal
    made = {name: [] for name in ESTIMATORS}
    for seed in seeds:
        (found,) = reconstruct(seen.frame(seed), seen.calibration, ESTIMATORS)
        for name, estimate in found.estimates.items():
            made[name].append(float(angle_deg(estimate.candidates, normal).min()))
    return made


# Vignetting ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, pytest.param(0.05, marks=pytest.mark.ci)])
def test_known_vignetting_is_undone(session, sigma):
    """cos^4, the highlight 20 deg off axis; the full-size frame, whose lobe is as wide as the project's others."""
    sensor = {"vignetting": COS4, "noise_sigma": sigma}
    made = errors(session, scene(sensor, tilt=20.0, size=560, focal=406.0), range(10 if sigma else 1))
    assert np.max(made["cone_axis"]) < LIMIT_DEG


def test_known_emission_is_undone_and_unknown_emission_follows_the_law_of_vignetting(session):
    """A cos^4 light at the camera, the highlight 20 deg off axis."""
    for known in (True, False):
        rig = {"lights": [{"profile": COS4}], "emission_known": known}
        described = scene(tilt=20.0, size=560, focal=406.0, rig=rig)
        (error,) = errors(session, described)["cone_axis"]
        law = math.degrees(laws.vignetting_shift(math.radians(20.0), 4.0, 200.0))
        assert error < 0.002 if known else error == pytest.approx(law, rel=0.03)


def test_the_emission_of_other_rigs_is_not_divided_away():
    """Beside the camera, or aslant, what a pixel gets hangs on the distance too."""
    light = {"profile": COS4}
    for lights in (
        [{**light, "offset_mm": 1.0}], [{**light, "direction": [1, 0, 1]}], [light, {"offset_mm": 2.0}],
        [{**light, "spot_deg": 90.0}], [{**light, "offset_mm": 1e-8}],
    ):  # fmt: skip
        assert scene(rig={"lights": lights}).calibration().emission.is_uniform
    # As the renderer has it, a light within AT_CAMERA_MM is at the camera.
    for own in ({}, {"offset_mm": 1e-10}):
        assert scene(rig={"lights": [{**light, **own}]}).calibration().emission.power == 4.0


@pytest.mark.parametrize("tilt", [5.0, 10.0, 20.0])
@pytest.mark.parametrize("exponent", [50.0, 200.0])
def test_unknown_vignetting_follows_its_law(session, tilt, exponent):
    sensor = {"vignetting": COS4, "vignetting_known": False}
    phong = {"type": "phong", "exponent": exponent}
    made = errors(session, scene(sensor, tilt=tilt, size=560, focal=406.0, reflectance=phong))
    phi = math.radians(tilt)
    # To leading order, for all estimators (theory.md section 4).
    leading = math.degrees(4 * math.tan(phi) / (4 * exponent + 2))
    assert made["cone_axis"][0] == pytest.approx(leading, rel=0.03)
    # Whole: the cone's axis at the default isovalues to 1 %, the peak to 2 % or a fiftieth of a pixel.
    peak = math.degrees(laws.vignetting_shift(phi, 4.0, 4 * exponent))
    axis = np.degrees(laws.vignetting_shift(phi, 4.0, 4 * exponent, isovalue=[0.3, 0.4, 0.5, 0.6, 0.7])).mean()
    assert made["cone_axis"][0] == pytest.approx(axis, rel=0.01)
    assert made["brightest_point"][0] == pytest.approx(peak, rel=0.02, abs=0.003)


@pytest.mark.parametrize(("side", "radius"), [("outside", 10.0), ("outside", 5.0), ("inside", 30.0)])
def test_the_law_holds_on_spheres(session, side, radius):
    """By 1 + d k, convex and concave; the highlight is brought off axis by the tilt of the sphere."""
    sensor = {"vignetting": {"type": "cosine", "power": 8.0}, "vignetting_known": False}
    ball = {"type": "sphere", "side": side, "radius_mm": radius}
    described = scene(sensor, tilt=20.0, size=400, focal=300.0, surface=ball)
    seen = render_view(session, described)
    truth = seen.highlights[0]
    (found,) = reconstruct(seen.frame(0), seen.calibration)
    estimate = found.estimates["cone_axis"]
    phi = np.arccos(truth.position[2] / np.linalg.norm(truth.position))
    isovalues = [i.isovalue for i in estimate.isophotes]
    law = np.degrees(laws.vignetting_shift(phi, 8.0, 200.0, truth.kd_min, isovalues)).mean()
    assert law > 0.02
    assert float(angle_deg(estimate.normal, truth.normal)) == pytest.approx(law, rel=0.03)


def rows_of(tmp_path, settings, size=320, focal=250.0, **group):
    """Return a run of an experiment on the plane."""
    camera = {"camera.width": size, "camera.height": size, "camera.fx": focal, "camera.fy": focal}
    table = {"scene": "plane", "isolated": False, "set": {**camera, "sensor.noise_sigma": 0.0, **settings}, **group}
    experiment = {"name": "law", "realisations": 3 if "isolated" in group else 1, "groups": [table]}
    return run_experiment(Experiment.model_validate(experiment), tmp_path / "run")


def test_the_law_is_in_the_rows_where_it_speaks(tmp_path):
    rows = rows_of(tmp_path, {"sensor.vignetting": COS4}, sweep=[{"sensor.vignetting_known": [True, False]}]).results
    known = rows.filter(rows["sensor.vignetting_known"])
    unknown = rows.filter(~rows["sensor.vignetting_known"] & (rows["estimator"] != "circle_pose"))
    assert known["error_law_deg"].null_count() + known["error_law_deg"].eq(0).sum() >= 2
    for row in unknown.iter_rows(named=True):
        assert row["error_deg"] == pytest.approx(row["error_law_deg"], rel=0.02)


def test_powers_of_unknown_vignetting_and_emission_add_up_in_the_law(tmp_path):
    settings = {
        "rig.lights.0.profile": COS4, "sensor.vignetting": {"type": "cosine", "power": 2.0},
        "sensor.vignetting_known": False,
    }  # fmt: skip
    rows = rows_of(tmp_path, settings, sweep=[{"rig.emission_known": [True, False]}]).results
    single = rows.filter(rows["estimator"] != "circle_pose")
    laws_by = {}
    for row in single.iter_rows(named=True):
        assert row["error_deg"] == pytest.approx(row["error_law_deg"], rel=0.02)
        laws_by.setdefault(row["estimator"], []).append(row["error_law_deg"])
    for known, unknown in laws_by.values():
        assert unknown == pytest.approx(3 * known, rel=0.1)
    # Circle pose's law knows no falloff.
    assert rows.filter(rows["estimator"] == "circle_pose")["error_law_deg"].null_count() == 2


@pytest.mark.parametrize(
    ("light", "power"),
    [
        ({}, 0.0), ({"profile": COS4}, 4.0), ({"offset_mm": 1.0}, 0.0), ({"offset_mm": 1.0, "profile": COS4}, None),
        ({"profile": COS4, "spot_deg": 90.0}, None), ({"profile": COS4, "direction": [1.0, 0.0, 1.0]}, None),
        ({"profile": {"type": "table", "angle_deg": [0, 50], "value": [1, 0.5]}}, None),
    ],
    ids=str,
)  # fmt: skip
def test_the_law_is_silent_on_emission_of_another_form(light, power):
    rig = {"lights": [light], "emission_known": False}
    assert unknown_falloff(scene(rig=rig), 0) == power
    vignetted = scene({"vignetting": COS4, "vignetting_known": False}, rig=rig)
    assert unknown_falloff(vignetted, 0) == (None if power is None else power + 4.0)


# Exposure and saturation ---------------------------------------------------------------------------------------------


def test_full_scale_is_fixed_or_a_percentile_or_the_highlights(session):
    def full_scale(exposure):
        return render_view(session, scene({"exposure": exposure})).full_scale

    light = render_view(session, scene()).light
    assert full_scale({"full_scale": 0.02}) == 0.02
    assert full_scale({"full_scale": 0.02, "gain": 4.0}) == 0.005
    assert full_scale({"percentile": 90.0}) == pytest.approx(float(np.percentile(light, 90)))
    assert full_scale({"percentile": 100.0}) == pytest.approx(float(light.max()))
    # The highlight's nearest pixel; the brightest is at most the next.
    assert full_scale({}) == pytest.approx(float(light.max()), rel=1e-3)
    assert full_scale({"gain": 2.0}) == full_scale({}) / 2


@pytest.mark.parametrize("sensor", [{"exposure": {"gain": 2.0}}, {"noise_sigma": 0.01, "point_spread_px": 1.5}])
@pytest.mark.parametrize("before", [{}, {"exposure": {"percentile": 90.0}}])
def test_a_radiance_is_exposed_by_the_sensor_that_is_given(session, sensor, before):
    """Not by that of the scene at which it was rendered, as where `simtest fit` draws several sensors of a scene."""
    session.update(scene(before))
    shared = render_picture(session, scene(sensor), session.radiance())
    np.testing.assert_array_equal(shared, render_picture(session, scene(sensor)))


@pytest.mark.parametrize(
    ("percentile", "exponent", "words"),
    [(1.0, 20000.0, "percentile = 1"), (50.0, 100.0, "percentile = 50: .* 1e-12 of its maximum or less")],
)
def test_a_percentile_of_darkness_falls_back_on_the_maximum(session, percentile, exponent, words):
    """A share of 1e-33 of the peak would make a frame that single precision does not hold; half of it is black."""
    sharp = {"type": "phong", "exponent": exponent}
    described = scene({"exposure": {"percentile": percentile}}, reflectance=sharp, tilt=20.0)
    with pytest.warns(UserWarning, match=words) as caught:
        seen = render_view(session, described)
    assert len(caught) == 1
    assert np.percentile(seen.light, percentile) < 1e-12 * seen.light.max()
    assert seen.full_scale == pytest.approx(float(seen.light.max()))


def test_a_frames_description_holds_the_places_that_its_keys_do_not_show(tmp_path):
    rigs = ({"preset": "colonoscope_2"}, {"lights": [{"position_error_mm": 0.1}], "seed": 3}, {})
    for rig in rigs:
        described = scene(size=48, focal=48.0, rig=rig)
        write_frame(render(described), tmp_path)
        told = json.loads((tmp_path / "frame.json").read_text())
        assert told.get("lights_mm") == (described.rig.true_mm().tolist() if rig else None)
        assert scene_from_dict(told["scene"]) == described


@pytest.mark.parametrize("gain", [1.5, 4.0])
def test_clipped_highlights_are_answered_and_flagged(session, gain):
    sensor = {"saturation": True, "exposure": {"gain": gain}, "noise_sigma": 0.02}
    described = scene(sensor, size=406, focal=406.0)
    seen = render_view(session, described)
    assert seen.frame(0).max() == 1.0
    (found,) = reconstruct(seen.frame(0), seen.calibration)
    assert found.patch.saturated_share(0.5) == pytest.approx(math.log(gain) / math.log(2 * gain), abs=0.02)
    assert all("saturated" in estimate.flags for estimate in found.estimates.values())
    made = errors(session, described, range(5))
    assert np.max(made["cone_axis"]) < LIMIT_DEG
    assert np.max(made["brightest_point"]) < 0.25


def test_peak_snr_is_that_of_the_peaks_level(session):
    read = render_view(session, scene({"full_well": 400.0, "read_noise": 10.0})).highlights[0].peak_snr
    white = render_view(session, scene({"noise_sigma": 0.05})).highlights[0].peak_snr
    # sqrt(400 + 100) electrons of 400; the smoothed peak is a little below full scale.
    assert read / white == pytest.approx(0.05 / (math.sqrt(500) / 400), rel=0.02)
    assert render_view(session, scene()).highlights[0].peak_snr == np.inf


# Darkness ------------------------------------------------------------------------------------------------------------

NO_LIGHT = {"vignetting": {"type": "table", "angle_deg": [0.0, 1e-6], "value": [1.0, 0.0]}}


@pytest.mark.parametrize(
    "sensor",
    [
        {"exposure": {"percentile": 50.0}},
        {"exposure": {"full_scale": 1.0}},
        {"point_spread_px": 2.0, "saturation": True, "full_well": 100.0},
        {"bits": 8, "response": {"type": "gamma"}, "vignetting_known": False},
    ],
    ids=str,
)
def test_a_dark_frame_is_zero_with_one_warning(session, sensor):
    with pytest.warns(UserWarning, match="no light reaches the sensor") as caught:
        seen = render_view(session, scene({**NO_LIGHT, **sensor}))
    assert len(caught) == 1
    assert seen.full_scale == 0
    np.testing.assert_array_equal(seen.light, 0)
    frame = seen.frame(0)
    np.testing.assert_array_equal(frame, 0)
    assert not any(truth.isolated for truth in seen.highlights)
    assert reconstruct(frame, seen.calibration) == []
    (found,) = reconstruct(frame, seen.calibration, roi=(100, 100, 80, 80))
    for result in found.estimates.values():
        assert isinstance(result, Failure)
        assert result.reason == Reason.NO_PEAK


@pytest.mark.parametrize(("isolated", "sigma"), [(True, 0.0), (False, 0.05)])
def test_rows_of_a_dark_frame_are_failures(tmp_path, isolated, sigma):
    sensor = {**NO_LIGHT, "noise_sigma": sigma}
    with pytest.warns(UserWarning, match="no light reaches the sensor") as caught:
        run = rows_of(tmp_path, {"sensor": sensor}, 64, 64.0, isolated=isolated)
    assert len(caught) == 1
    assert run.results["status"].to_list() == ["no_light"] * 9
    summary = json.loads((run.folder / "summary.json").read_text())
    (figures,) = {json.dumps(f) for f in summary["experiments"]["law"]["settings"]["plane"].values()}
    assert json.loads(figures)["n_failed_by_reason"] == {"no_light": 3}


def test_a_dark_scene_is_rendered_without_nan(tmp_path):
    with pytest.warns(UserWarning, match="no light"):
        frame = render(scene(NO_LIGHT, size=64))
    files = write_frame(frame, tmp_path)
    assert not cv2.imread(str(files[0]), cv2.IMREAD_UNCHANGED).any()
    assert json.loads((tmp_path / "frame.json").read_text())["full_scale"] == 0


# Pictures ------------------------------------------------------------------------------------------------------------

ENCODED = [
    {"bits": 8, "response": {"type": "gamma", "gamma": 2.2}},
    {"bits": 8},
    {"bits": 12, "response": {"type": "srgb"}, "vignetting": COS4, "noise_sigma": 0.01, "exposure": {"gain": 1.5}},
    {"response": {"type": "table", "light": [0, 0.2, 1], "value": [0, 0.5, 1]}, "full_well": 2000, "read_noise": 5},
    {"vignetting": COS4, "saturation": True, "exposure": {"gain": 2.0}},
]


@pytest.mark.parametrize("sensor", marked(ENCODED, ci=[ENCODED[2]]), ids=range(len(ENCODED)))
def test_pictures_read_back_as_the_frame(tmp_path, sensor):
    described = scene(sensor, size=240, focal=200.0)
    frame = render(described)
    write_frame(frame, tmp_path)
    bits = 16 if described.sensor.encodes and described.sensor.bits != 8 else 8
    picture = cv2.imread(str(tmp_path / "frame.png"), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == (np.uint8 if bits == 8 else np.uint16)
    if described.sensor.encodes:
        step = 1 / (2 ** (described.sensor.bits or 16) - 1)
        assert np.abs(picture / np.iinfo(picture.dtype).max - frame.image).max() < 0.5 * step
        told = json.loads((tmp_path / "frame.json").read_text())["encoding"]
        assert told["response"] == described.sensor.response.model_dump(mode="json")
        assert (told["bits"], told["png_bits"]) == (described.sensor.bits, bits)
    calibration = load_calibration(tmp_path / "calibration.toml")
    assert calibration.vignetting == described.calibration().vignetting
    assert calibration.camera == described.camera.model()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        options = Options(tmp_path / "calibration.toml")
        record, _ = reconstruct_picture(tmp_path / "frame.png", tmp_path / "normals", options)
    assert len(record) == 1
    (direct,) = reconstruct(frame.image, described.calibration())
    (read,) = json.loads((tmp_path / "normals" / "normals.json").read_text())["specularities"]
    for name, estimate in direct.estimates.items():
        made = read["estimates"][name]
        if name != "circle_pose":
            assert angle_deg(np.array(made["normal"]), estimate.normal) < (0.005 if bits == 16 else 0.05)
        # At its branch point circle_pose's own flags hang on the last digits too, as on a plane curved's does.
        own = {"circle_pose": {"ambiguous", "near_degenerate"}, "curved": {"round"}}.get(name, set())
        assert [f for f in made["flags"] if f not in own] == [f for f in estimate.flags if f not in own]
    truth = frame.highlights[0].normal
    assert angle_deg(np.array(read["estimates"]["cone_axis"]["normal"]), truth) < LIMIT_DEG


LENS = {
    "width": 400, "height": 400, "fx": 200.0, "fy": 200.0, "view_mask": {"radius": 190.0},
    "distortion": {"type": "kannala_brandt", "k1": -0.02},
}  # fmt: skip


def test_a_picture_through_a_lens_with_vignetting_reads_back(tmp_path):
    """Lens, view mask, vignetting and response through the files; the lens and the falloff are missed if left out."""
    surface = {"type": "plane", "tilt_deg": 40.0, "azimuth_deg": 30.0}
    sensor = {"vignetting": COS4, "response": {"type": "gamma"}, "bits": 12, "exposure": {"gain": 0.8}}
    frame = render(scene_from_dict({"surface": surface, "camera": LENS, "sensor": sensor}))
    write_frame(frame, tmp_path)
    truth = frame.highlights[0].normal
    stated = (tmp_path / "calibration.toml").read_text()
    assert load_calibration(tmp_path / "calibration.toml").camera == frame.camera

    def error(text):
        (tmp_path / "told.toml").write_text(text)
        options = Options(tmp_path / "told.toml")
        record, files = reconstruct_picture(tmp_path / "frame.png", tmp_path / "normals", options)
        document = json.loads(files[0].read_text())
        assert len(record) == 1
        assert document["camera"]["view_mask"]["radius"] == 190.0
        made = document["specularities"][0]["estimates"]["cone_axis"]
        assert made["flags"] == []
        return angle_deg(np.array(made["normal"]), truth)

    assert error(stated) < LIMIT_DEG
    without_lens = "\n".join(line for line in stated.splitlines() if not line.startswith("distortion"))
    without_falloff = stated.replace("power = 4.0", "power = 0.0")
    assert error(without_lens) > 1
    # About 4 tan(phi) / (4 n + 2), the law of a pinhole's vignetting.
    assert error(without_falloff) > 0.5


def test_the_automatic_exposure_goes_by_what_is_in_view(session):
    described = {"surface": {"type": "plane"}, "camera": LENS | {"view_mask": {"radius": 60.0}}}
    sensor = {"exposure": {"percentile": 50.0}, "vignetting": COS4}
    seen = render_view(
        session, scene_from_dict({**described, "reflectance": {"type": "phong", "diffuse": 0.3}, "sensor": sensor})
    )
    inside = session.camera.seen
    assert np.median(seen.light) == 0
    assert np.mean(seen.light[inside] > seen.full_scale) == pytest.approx(0.5, abs=0.01)


def test_the_picture_of_a_plain_sensor_is_calibrated_too(tmp_path):
    frame = render(scene({"noise_sigma": 0.02}, size=80, focal=80.0))
    names = "frame.png radiance.exr truth.npz frame.json camera.toml calibration.toml preview.jpg"
    assert [path.name for path in write_frame(frame, tmp_path)] == names.split()
    assert cv2.imread(str(tmp_path / "frame.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint8
    described = json.loads((tmp_path / "frame.json").read_text())
    assert "encoding" not in described
    assert "calibration.toml" in described["fields"]
    # frame.png itself is sRGB-encoded in 8 bits, whatever the sensor.
    stated = load_calibration(tmp_path / "calibration.toml")
    assert (stated.response, stated.noise.bits, stated.saturation_level) == (Response("srgb"), 8, 1.0)
    assert stated.priors == frame.calibration.priors == frame.scene.calibration().priors


def test_what_is_not_known_is_not_written(tmp_path):
    sensor = {"vignetting": COS4, "vignetting_known": False, "response": {"type": "gamma"}, "response_known": False}
    write_frame(render(scene(sensor, size=80, focal=80.0)), tmp_path)
    calibration = load_calibration(tmp_path / "calibration.toml")
    assert calibration.response.kind == "linear"
    assert calibration.falloff is None
    # That nobody told it leaves a falloff of unknown power in the frame.
    assert calibration.priors.falloff_power == UNTOLD_FALLOFF_POWER
    said = (tmp_path / "calibration.toml").read_text().splitlines()[1]
    assert said == "# Of frame.png; the scene does not tell: response (taken as linear), vignetting."


def test_render_then_reconstruct_knows_its_light(tmp_path):
    """Two lights aside of the camera: the folder's calibration tells them, its camera alone does not."""
    rig = {"preset": "colonoscope_2", "radius_mm": 3.0}
    surface = {"type": "plane", "distance_mm": 30.0, "tilt_deg": 20.0}
    described = scene_from_dict({
        "surface": surface, "rig": rig, "camera": {"width": 240, "height": 240, "fx": 240.0, "fy": 240.0},
        "reflectance": {"type": "phong", "exponent": 600.0}, "sensor": {"bits": 8, "response": {"type": "srgb"}},
        "known": {"distance_error": 0.0, "distance_sd": 0.1},
    })  # fmt: skip
    frame = render(described)
    write_frame(frame, tmp_path)
    stated = load_calibration(tmp_path / "calibration.toml")
    assert stated == frame.calibration
    assert len(stated.priors.lights_mm) == 2
    assert stated.priors.distance_mm is not None
    record, _ = reconstruct_picture(tmp_path / "frame.png", tmp_path / "out", Options(tmp_path / "calibration.toml"))
    truths = np.array([h.normal for h in frame.highlights if h.isolated])
    assert len(record) == len(truths) == 2
    for spot in record:
        near, far = (
            min(angle_deg(spot.normals[name].normal, truth) for truth in truths) for name in ("bisector", "cone_axis")
        )
        assert near < 0.1 < 2 < far


# Files of a frame, by closed forms ------------------------------------------------------------------------------------


RADIUS, SIZE, FOCAL = 15.0, 48, 60.0


@pytest.mark.parametrize("sensor", [{}, {"bits": 8, "response": {"type": "srgb"}}, {"bits": 12}])
def test_a_picture_is_red_where_the_frame_is(sensor):
    frame = np.zeros((4, 6, 3), np.float32)
    frame[0, :, 0], frame[1, :, 1], frame[2, :, 2] = 1.0, 1.0, 1.0
    data = np.frombuffer(encoded_png(frame, Sensor.model_validate(sensor)), np.uint8)
    # OpenCV gives blue first.
    blue, green, red = np.moveaxis(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), -1, 0)
    for row, channel in enumerate((red, green, blue)):
        assert (channel[row] == channel.max()).all()
        assert not np.delete(channel, row, axis=0).any()


def test_the_truths_curvatures_and_depth_are_those_of_the_tube(here, tmp_path):
    """The inside of a cylinder: concave across its axis, straight along it; the first of the two is the smaller."""
    camera = {"width": SIZE, "height": SIZE, "fx": FOCAL, "fy": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    settings = {"surface.radius_mm": RADIUS, "surface.side": "inside", "surface.tilt_deg": 0.0, "surface.spin_deg": 0.0}
    settings |= {f"camera.{key}": value for key, value in camera.items()}
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    assert here("render", "cylinder", "--out", tmp_path, *words)[0] == 0
    with np.load(tmp_path / "truth.npz") as truth:
        curvature, depth, position = (truth[name].astype(float) for name in ("curvature", "depth_mm", "position_mm"))
    np.testing.assert_allclose(curvature[..., 0], -1 / RADIUS, rtol=1e-3)
    np.testing.assert_allclose(curvature[..., 1], 0.0, atol=1e-3 / RADIUS)
    np.testing.assert_allclose(depth, np.linalg.norm(position, axis=-1), rtol=1e-5)
    # The pixels' centres lie half a pixel inside.
    x = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    along = position / position[..., 2:]
    np.testing.assert_allclose(along[..., 0], np.broadcast_to(x, (SIZE, SIZE)), atol=1e-5)
    np.testing.assert_allclose(along[..., 1], np.broadcast_to(x[:, None], (SIZE, SIZE)), atol=1e-5)


def test_a_picture_of_one_row_has_a_thumbnail():
    assert thumbnail(np.full((1, 400, 3), 7, np.uint8)).tolist() == [[[7, 7, 7]] * 160]
