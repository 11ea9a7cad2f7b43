"""Twins of real highlights: views of the patches, draws from what was told, the weighing of a bank, and refusals."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from simtest.advice.tissue import NAMES, WIDER, tissue_of
from simtest.advice.twin import bank as banks
from simtest.advice.twin.bank import BankFrame, frames_for
from simtest.advice.twin.run import COLUMNS, TwinResult, match_spots, twin_picture, twins_of, write_twins
from simtest.advice.twin.scenes import (
    ANCHOR_MM,
    MOST_TILT_DEG,
    REACH_MM,
    Look,
    SceneDraws,
    TissuePatch,
    _distance,
    drawn_camera,
    look_at,
    look_of,
    make_pool,
)
from simtest.advice.twin.scoring import FEATURES, TWINS, Matcher, ScoredSpot, Spot, usable_spots
from simtest.calibration import Calibration, CameraPrior, Normal, Priors, Response, Uniform
from simtest.calibration.photometry import AngularProfile
from simtest.errors import InputError, SimtestError
from simtest.estimators import Estimate
from simtest.geometry import Camera
from simtest.geometry.lenses import BrownConrady, KannalaBrandt, Scaramuzza
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.assumptions import NEAR_MISSES
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import run
from simtest.runtime.arrays import kept
from simtest.spec import load_scene
from simtest.spec.camera import SceneCamera
from simtest.spec.recipes import load_dataset
from simtest.spec.spec_model import validate
from simtest.surfaces.factory import make_surface

CAMERA = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)


def rng(seed=0):
    return np.random.default_rng(seed)


# Patches -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", range(8))
def test_a_sightline_meets_its_patch_at_the_drawn_distance_and_a_small_tilt(number):
    """The pose is checked on the surface that is rendered, through the camera that was moved."""
    patch = make_pool(number + 1)[-1]
    sightline = CAMERA.unproject(np.array([130.0, 20.0]))
    draws, seen = rng(number), 0
    for _ in range(5):
        distance = float(draws.uniform(10, 60))
        moved = look_at(patch, draws, sightline, distance)
        if moved is None:
            continue
        seen += 1
        smooth = {name: value for name, value in patch.surface.items() if name != "relief"}
        scene = load_scene("plane", {"surface": smooth, "camera.moved": moved})
        pose = make_surface(scene.surface, None, scene.camera.moved).model_from_camera
        x, y, z = pose[:3, :3] @ (distance * sightline) + pose[:3, 3]
        k1, k2 = patch.k_per_mm
        assert z == pytest.approx(-(k1 * x * x + k2 * y * y) / 2, abs=1e-9)
        assert max(abs(x), abs(y)) <= REACH_MM + 1e-9
        normal = np.array([k1 * x, k2 * y, 1.0])
        normal = pose[:3, :3].T @ (normal / np.linalg.norm(normal))
        assert float(angle_deg(normal, -sightline)) <= MOST_TILT_DEG + 1e-6
    assert seen > 0


def test_a_patch_whose_centre_of_curvature_is_the_camera_has_no_view():
    bowl = TissuePatch((-0.1, -0.1), {"type": "quadric", "distance_mm": ANCHOR_MM, "k1_per_mm": -0.1})
    ahead = np.array([0.0, 0.0, 1.0])
    assert look_at(bowl, rng(), ahead, 10.0) is None
    assert look_at(bowl, rng(), ahead, 4.0) is not None
    # From beyond it the far wall of a lumen is seen.
    assert look_at(bowl, rng(), ahead, 20.0) is not None


def test_the_pool_is_always_the_same_and_has_many_shapes():
    assert make_pool(4) == make_pool(16)[:4]
    assert len({patch.k_per_mm for patch in make_pool()}) == len(make_pool())


@pytest.mark.parametrize("organ", NAMES)
def test_a_told_organ_has_its_relief_and_film_and_form(organ):
    """All that the recipe draws lies in the ranges, and the ranges are no wider than they say."""
    tissue, family = (
        tissue_of(organ),
        next(f for f in load_dataset("endoscopy_close").families if f.scene.endswith(organ)),
    )
    drawn = {**family.per_anatomy, **family.per_sample}
    for number, band in enumerate(tissue.bands):
        for key in ("slope_deg", "wavelength_mm"):
            low, high = getattr(band, key)
            if (told := drawn.get(f"surface.relief.bands.{number}.{key}")) is not None:
                assert (low * WIDER, high / WIDER) == pytest.approx(told.ends)
            assert high / low >= WIDER**2 - 1e-9
    for patch in make_pool(6, tissue):
        k1, k2 = patch.k_per_mm
        assert tissue.organ.k1_per_mm[0] <= k1 <= tissue.organ.k1_per_mm[1]
        assert tissue.organ.k2_per_mm[0] <= k2 <= tissue.organ.k2_per_mm[1]
        for band, made in zip(tissue.bands, patch.surface["relief"]["bands"], strict=True):
            assert band.wavelength_mm[0] <= made["wavelength_mm"] <= band.wavelength_mm[1]
            assert band.slope_deg[0] <= made["slope_deg"] <= band.slope_deg[1]
    assert tissue != tissue_of(None)


def test_an_organ_that_nobody_knows_is_refused_before_anything_is_rendered(framed):
    with pytest.raises(InputError, match="--organ brain: must be one of colon, stomach, liver, gallbladder"):
        twin_picture(framed, Options(fov_deg=60.0), organ="brain")


# Scenes ------------------------------------------------------------------------------------------------------------


def drawn(calibration, seed=0):
    draws = SceneDraws(calibration, Look("tissue_colon", 0.4))
    scene = draws.draw(rng(seed), make_pool(1)[0], np.array([[80.0, 60.0]]), (seed % 6 + 0.5) / 12)
    assert scene is not None
    return scene


def test_what_was_told_is_what_is_rendered():
    lights = ((3.0, 0.0, 0.0), (-3.0, 0.5, -1.0))
    told = Calibration(
        CAMERA, response=Response("gamma", 2.0), vignetting=AngularProfile(3.0), emission=AngularProfile(1.5),
        priors=Priors(lights_mm=lights, distance_mm=Uniform(20.0, 21.0)),
    )  # fmt: skip
    for seed in range(2):
        scene = drawn(told, seed)
        assert tuple(light.nominal_mm for light in scene.rig.lights) == lights
        assert scene.camera.model() == CAMERA
        assert (scene.sensor.response.type, scene.sensor.response.gamma) == ("gamma", 2.0)
        assert scene.sensor.vignetting.power == 3.0
        assert all(light.profile.power == 1.5 for light in scene.rig.lights)
        pose = make_surface(scene.surface, scene.film_level, scene.camera.moved).model_from_camera
        k1, k2 = scene.surface.k1_per_mm, scene.surface.k2_per_mm
        ends = [pose[:3, :3] @ [0, 0, d] + pose[:3, 3] for d in (20.0, 21.0)]
        # The surface lies between both ends of the told distance.
        near, far = (p[2] + (k1 * p[0] ** 2 + k2 * p[1] ** 2) / 2 for p in ends)
        assert near > 0 > far


def test_a_told_table_is_kept():
    light, value = (0.0, 0.3, 1.0), (0.0, 0.6, 1.0)
    scene = drawn(Calibration(CAMERA, response=Response("table", light=light, value=value)))
    assert (scene.sensor.response.light, scene.sensor.response.value) == (light, value)
    falloff = AngularProfile(angles=(0.0, 1.0), values=(1.0, 0.25))
    scene = drawn(Calibration(CAMERA, vignetting=falloff))
    assert scene.sensor.vignetting.model().at(np.cos(1.0), np.sin(1.0)) == pytest.approx(0.25)


def test_what_was_not_told_differs_between_draws():
    scenes = [drawn(Calibration(CAMERA), seed) for seed in range(12)]
    offsets = [float(np.linalg.norm(scene.rig.lights[0].nominal_mm)) for scene in scenes]
    assert len({len(scene.rig.lights) for scene in scenes}) > 1
    assert min(offsets) < 2 < 4 < max(offsets) <= 6
    assert len({scene.sensor.preset for scene in scenes}) > 1


def test_a_guessed_camera_is_drawn_about_the_guess():
    exact = drawn_camera(CAMERA, CameraPrior(), rng())
    assert (exact["fx"], exact["cx"], exact.get("distortion")) == (100.0, 80.0, None)
    made = [drawn_camera(CAMERA, CameraPrior(0.1, 2.0, 0.05), rng(seed)) for seed in range(200)]
    assert np.std([each["fx"] for each in made]) == pytest.approx(10.0, rel=0.2)
    assert np.std([each["cx"] for each in made]) == pytest.approx(2.0, rel=0.2)
    assert np.std([each["distortion"]["k1"] for each in made]) == pytest.approx(0.05, rel=0.2)


def test_a_lens_whose_edge_is_given_is_drawn_about_that_edge():
    camera, prior = replace(CAMERA, distortion=KannalaBrandt()), CameraPrior(distortion_sd=0.1, edge_reach=1.0)
    pixels = np.array([camera.cx, camera.cy]) + np.array([[1.0], [0.5]]) * [camera.fx, 0.0]
    made = [validate(SceneCamera, drawn_camera(camera, prior, rng(seed)), "camera").model() for seed in range(200)]
    seen = np.array([each.project(camera.unproject(pixels)) for each in made])[..., 0] - pixels[:, 0]
    assert seen[:, 0] == pytest.approx(0, abs=1e-6)
    assert np.std(seen[:, 1]) == pytest.approx(0.1 * 0.5 * 0.75 * camera.fx, rel=0.25)


@pytest.mark.parametrize("lens", [None, BrownConrady(0.1), KannalaBrandt(0.02), Scaramuzza(-0.1)])
def test_a_given_lens_is_drawn_about_what_is_given(lens):
    """The prior moves a point at r focal lengths by k1 r^3 focal lengths, whatever the lens."""
    camera = replace(CAMERA, distortion=lens)
    pixel = np.array([camera.cx + 0.3 * camera.fx, camera.cy])
    made = [validate(SceneCamera, drawn_camera(camera, CameraPrior(distortion_sd=0.02), rng(seed)), "camera").model()
            for seed in range(200)]  # fmt: skip
    seen = np.array([each.project(camera.unproject(pixel)) for each in made]) - pixel
    assert seen[:, 1] == pytest.approx(0, abs=1e-6)
    assert np.std(seen[:, 0]) == pytest.approx(0.02 * 0.3**3 * camera.fx, rel=0.25)


@pytest.mark.parametrize(("colour", "organ"), [((0.66, 0.29, 0.19), "tissue_colon"),
                                               ((0.10, 0.020, 0.0165), "tissue_liver"),
                                               ((0.36, 0.235, 0.155), "tissue_gallbladder")])  # fmt: skip
def test_the_tissue_is_that_of_the_nearest_colour(colour, organ):
    picture = np.tile(np.float32(colour) ** (1 / 2.2), (40, 50, 1)).astype(np.float32)
    assert look_of(picture, None).organ == organ
    # Black borders do not count.
    bordered = np.zeros((60, 80, 3), dtype=np.float32)
    bordered[10:50, 10:60] = picture
    for seen in (bordered.any(axis=2), None):
        look = look_of(bordered, seen)
        assert look.organ == organ
        assert look.mean == pytest.approx(float(np.clip(picture.mean(), 0.1, 0.8)), rel=1e-5)


@pytest.mark.parametrize("grey", [False, True])
def test_a_background_without_tissue_tells_neither_colour_nor_exposure(grey):
    """The dark room behind a small organ once made a liver a gallbladder, and halved the exposure of its twins."""
    colour = np.float32((0.10, 0.020, 0.0165)) ** (1 / 2.2)
    picture = (rng().uniform(0.0, 0.01, (60, 80, 3))).astype(np.float32)
    picture[10:50, 10:40] = colour
    # Highlights are far brighter than the tissue, and few.
    picture[20:22, 20:22] = 1.0
    look = look_of(picture.mean(axis=2) if grey else picture, None)
    assert look.organ == ("tissue_colon" if grey else "tissue_liver")
    assert look.mean == pytest.approx(float(colour.mean()), rel=0.02)


@pytest.mark.parametrize(("organ", "shape"), [("colon", (40, 50)), *((organ, (40, 50, 3)) for organ in NAMES)])
def test_a_told_organ_decides_the_colour(organ, shape):
    """A picture's colour does not tell how dark its tissue is, and that decides which spots stand out of it."""
    look = look_of(np.full(shape, 0.5, dtype=np.float32), None, tissue_of(organ))
    assert look == Look(f"tissue_{organ}", 0.5)
    assert tissue_of(None).organ is None


def test_a_range_of_distances_is_even_in_the_logarithm():
    shares = np.linspace(0.05, 0.95, 7)
    told = [_distance(Uniform(8.0, 80.0), share) for share in shares]
    assert told == pytest.approx(8 * 10**shares)
    assert _distance(Normal(30.0, 3.0), 0.5) == pytest.approx(30.0)


# Weighing ----------------------------------------------------------------------------------------------------------


def spot(features, estimator="curved", index=0):
    normal = np.array([0.0, 0.0, -1.0])
    estimate = Estimate(normal, normal[None], np.array([80.0, 60.0]), covariance=1e-4 * np.eye(2))
    return Spot(index, np.array([80.0, 60.0]), math.exp(features[0]), estimator, estimate, np.array(features, float))


def made_bank(count=3000, frames=30, seed=0, law=lambda size: 2 * size, kinds=("glint", "near_miss")):
    """Return highlights whose errors are Rayleigh with a mean square law(radius)^2."""
    draws, spots = rng(seed), []
    for i in range(count):
        size = float(draws.uniform(0.0, 2.0))
        features = [size, *draws.normal(0.5, 0.05, len(FEATURES) - 1)]
        error = law(size) * float(np.hypot(*draws.standard_normal(2))) / math.sqrt(2)
        kind = kinds[int(draws.integers(len(kinds)))]
        scored = ScoredSpot(spot(features), kind, error, 2 * error, error < law(size), 10 * (1 + size))
        spots.append((i % frames, scored))
    return spots


def like(size):
    return spot([size, *[0.5] * (len(FEATURES) - 1)])


def test_twins_measure_the_error_of_highlights_alike():
    """alpha = 1e-4 by the spread of an RMS of 40 Rayleigh errors (8 %), five sizes."""
    matcher = Matcher(made_bank())
    for size in (0.3, 0.6, 1.0, 1.4, 1.7):
        twins = matcher.find(like(size))
        assert twins.effective == pytest.approx(TWINS, rel=0.05)
        assert twins.rms_deg == pytest.approx(2 * size, rel=0.35)
        assert twins.base_rms_deg == pytest.approx(2 * twins.rms_deg)
        assert twins.interval_deg[0] < twins.rms_deg < twins.interval_deg[1]
        assert twins.is_covered
        assert twins.distance_mm[0] < 10 * (1 + size) < twins.distance_mm[2]
        assert twins.distance_mm[1] == pytest.approx(10 * (1 + size), rel=0.2)
        # Of Rayleigh errors 63 % lie below the root of their mean square.
        assert twins.coverage == pytest.approx(0.63, abs=0.3)
    # Negative control: twins of another size measure another error.
    assert matcher.find(like(1.7)).rms_deg > 1.5 * matcher.find(like(0.6)).rms_deg


def test_each_frame_counts_once_and_coverage_is_over_those_that_report():
    """All alike: one highlight of 1 deg in one frame, four of 3 deg in another, of which none reports a region."""
    features = [1.0] * len(FEATURES)
    bank = [(0, ScoredSpot(spot(features), "glint", 1.0, 2.0, True))]
    bank += [(1, ScoredSpot(spot(features), "glint", 3.0, 6.0, None)) for _ in range(4)]
    twins = Matcher(bank).find(spot(features))
    assert twins.rms_deg == pytest.approx(math.sqrt((1 + 9) / 2))
    assert twins.base_rms_deg == pytest.approx(2 * twins.rms_deg)
    assert (twins.coverage, twins.wrong_and_sure) == (1.0, 0.0)
    bank.append((0, replace(bank[0][1], is_wrong=True)))
    assert Matcher(bank).find(spot(features)).wrong_and_sure == pytest.approx(0.5)
    assert Matcher(bank[1:5]).find(spot(features)).wrong_and_sure is None


def test_the_interval_covers():
    """95 % intervals of 60 banks hold the law in 48 to 60: alpha < 1e-4 for a coverage of 93 % or more."""
    held = 0
    for seed in range(60):
        twins = Matcher(made_bank(200, seed=seed, law=lambda _: 2.0)).find(like(1.0))
        held += twins.interval_deg[0] <= 2.0 <= twins.interval_deg[1]
    assert 48 <= held <= 60


def test_false_detections_stand_in_no_error():
    real = made_bank(500, kinds=("glint",))
    false = [(frame, ScoredSpot(each.spot, "false", 80.0, 80.0, False)) for frame, each in real]
    matcher = Matcher([*real, *false])
    twins, clean = matcher.find(like(1.0)), Matcher(real).find(like(1.0))
    assert twins.rms_deg == pytest.approx(clean.rms_deg)
    assert twins.false == pytest.approx(0.5, abs=0.02)
    assert twins.near_misses == 0
    assert math.isnan(twins.near_rms_deg)
    assert all(number < len(real) for number in twins.best)


def test_another_estimator_is_less_alike():
    bank = made_bank(400)
    bank += [(frame, ScoredSpot(spot(each.spot.features, "bisector"), "glint", 30.0, 30.0, False))
             for frame, each in bank]  # fmt: skip
    assert Matcher(bank).find(like(1.0)).rms_deg < 10 < Matcher(bank).find(
        spot(like(1.0).features, "bisector")
    ).rms_deg  # fmt: skip


def test_a_feature_that_one_of_both_does_not_show_counts():
    bank = made_bank(400)
    bank = [(f, ScoredSpot(spot([s.spot.features[0], math.nan, *s.spot.features[2:]]), *list(vars(s).values())[1:]))
            for f, s in bank]  # fmt: skip
    shown = like(1.0).features
    hidden = np.where(np.arange(len(shown)) == 1, math.nan, shown)
    matcher = Matcher(bank)
    # All lack it: one unit of unlikeness against a highlight that shows it, none against one that does not.
    apart = matcher.find(spot(shown)).unlikeness ** 2 - matcher.find(spot(hidden)).unlikeness ** 2
    assert apart * len(FEATURES) == pytest.approx(1.0, abs=0.05)


def test_a_highlight_unlike_all_is_called_so():
    twins = Matcher(made_bank(300)).find(like(9.0))
    assert not twins.is_covered


def test_a_bank_that_is_too_small_is_refused():
    with pytest.raises(InputError, match=r"a\.png: 10 usable highlights in 2 rendered frames; needs 20 or more"):
        match_spots([like(1.0)], made_bank(10), "a.png", 2)


def test_large_pictures_have_fewer_frames():
    assert [frames_for(n) for n in (100, 640 * 480, 1280 * 960, 1920 * 1080, 10**8)] == [48, 48, 12, 12, 12]


# The whole ---------------------------------------------------------------------------------------------------------


def picture_of_spots(size=(120, 160), spots=((40, 30), (90, 70), (130, 40))):
    """Return a picture of pale red tissue with Gaussian highlights, 8 bits, BGR."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    light = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18) for u, v in spots) if spots else np.zeros(size)
    noise = 0.004 * rng().standard_normal((*size, 3))
    linear = np.array([0.08, 0.09, 0.2]) * 0.6 + 0.7 * light[..., None] + noise
    return np.rint(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)


@pytest.fixture
def framed(tmp_path):
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), picture_of_spots())
    return path


@pytest.mark.parametrize(
    ("name", "said"),
    [("nothing.png", "no such"), ("folder", "folder: is a folder or a film; twin takes one picture"),
     ("film.avi", "film.avi: is a folder or a film"), ("plain.png", "plain.png: no usable highlight")],
)  # fmt: skip
def test_refusals_are_one_line(tmp_path, monkeypatch, name, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "film.avi").write_bytes(b"RIFF")
    cv2.imwrite("plain.png", picture_of_spots(spots=()))
    with pytest.raises(InputError) as error:
        twin_picture(Path(name), Options(fov_deg=60.0), frames=1)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_features_are_those_of_the_picture(framed):
    picture = cv2.imread(str(framed))[..., ::-1].astype(np.float32) / 255
    made = run(np.ascontiguousarray(picture), Calibration(CAMERA), Options())
    spots = usable_spots(made)
    assert len(spots) == 3
    for each in spots:
        values = dict(zip(FEATURES, each.features.tolist(), strict=True))
        # A Gaussian of 3 px falls to half at 3.5 px.
        assert math.exp(values["radius"]) == pytest.approx(3.53, rel=0.15)
        assert values["axis_ratio"] > 0.9
        assert values["clipped"] == 0
        assert 0 <= values["off_axis"] < 0.9
    # Two neighbours: there is no third.
    assert [math.exp(each.features[FEATURES.index("crowding")]) for each in spots] == pytest.approx([500.0] * 3)


def test_the_files_hold_what_was_measured(tmp_path, framed):
    """The bank is made up, so that nothing is rendered."""
    picture = np.ascontiguousarray(cv2.imread(str(framed))[..., ::-1].astype(np.float32) / 255)
    made = run(picture, Calibration(CAMERA), Options())
    spots = usable_spots(made)
    twins = made_bank(200, frames=2)
    found = match_spots(spots, twins, "frame.png", 2)
    frames = [BankFrame(np.asarray(255 * picture, np.uint8), [s for f, s in twins if f == i]) for i in range(2)]
    result = TwinResult("frame.png", picture, found, frames, Look("tissue_colon", 0.4),
                        list(made.choices.assumed), [], 1.0)  # fmt: skip
    files = write_twins(result, tmp_path / "out", "simtest twin frame.png")
    told = json.loads(files[0].read_text())
    rows = list(csv.DictReader(files[1].read_text().splitlines()))
    assert list(rows[0]) == list(COLUMNS)
    assert [int(row["specularity"]) for row in rows] == [each["id"] for each in told["specularities"]]
    for row, each in zip(rows, told["specularities"], strict=True):
        assert float(row["twin_rms_deg"]) == pytest.approx(each["twins"]["rms_deg"])
        assert float(row["stated_deg"]) == pytest.approx(each["stated_deg"])
        assert float(row["median_mm"]) == pytest.approx(each["twins"]["distance_mm"][1])
    assert told["bank"]["highlights"] == 200
    assert told["bank"]["near_misses"] + told["bank"]["false"] <= 1
    page = files[2].read_text()
    assert "http://" not in page
    assert 'src="https' not in page
    assert page.count("<tr><td>") == len(spots)
    assert page.count('alt="Twin ') == 6 * len(spots)


def test_a_bank_keeps_no_relief(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "kept"))

    def session(scene, variant):
        for kind in ("colon", "relief"):
            kept(kind, "one", lambda: {"a": np.zeros(1)})
        raise SimtestError("rendered nothing")

    monkeypatch.setattr(banks, "Session", session)
    monkeypatch.setattr(banks, "make_pool", lambda tissue: [None])
    subject = SimpleNamespace(draws=SimpleNamespace(tissue=None, draw=lambda *told: "scene"), pixels=None)
    assert banks.make_bank([subject], None, 1, 0) == []
    assert [path.name.split("-")[0] for path in (tmp_path / "kept").iterdir()] == ["colon"]


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.parametrize("grey", [False, True])
def test_a_picture_has_twins_of_its_own_kind(monkeypatch, grey):
    """Frames of the bank have the picture's size and colours, and the same seed measures the same."""
    monkeypatch.setattr(banks, "FRAMES_PER_PATCH", 6)
    # Large enough that peaks are found without colours too.
    camera = Camera(320, 240, 400.0, 400.0, 160.0, 120.0)
    drawn_picture = picture_of_spots((240, 320), ((80, 60), (180, 140), (260, 80)))
    picture = np.ascontiguousarray(drawn_picture[..., ::-1].astype(np.float32) / 255)
    picture = picture.mean(axis=2) if grey else picture
    told = Calibration(camera, priors=Priors(lights_mm=((3.0, 0.0, 0.0),), distance_mm=Uniform(15.0, 30.0)))
    options = Options(fov_deg=60.0)
    first, second = (twins_of(picture, told, options, frames=6, seed=5) for _ in range(2))
    assert all(frame.picture.shape == picture.shape for frame in first.bank)
    assert len(first.bank) == 6
    scored = [s for _, s in first.bank_spots]
    assert all(0 <= each.error_deg < 90 for each in scored)
    assert {each.kind for each in scored} <= {"glint", "near_miss", "false"}
    assert [each.twins.rms_deg for each in first.spots] == [each.twins.rms_deg for each in second.spots]
    # Glints of a light that is told are reconstructed to a few degrees.
    glints = [each.error_deg for each in scored if each.kind == "glint"]
    assert np.median(glints) < 5


def test_nothing_is_assumed_of_near_misses_where_twins_have_them(monkeypatch, framed):
    twins = made_bank(200, frames=2)
    bank = [BankFrame(np.zeros((2, 2), np.uint8), [spot for frame, spot in twins if frame == i]) for i in range(2)]
    monkeypatch.setattr("simtest.advice.twin.run.make_bank", lambda *told: bank)
    picture = np.ascontiguousarray(cv2.imread(str(framed))[..., ::-1].astype(np.float32) / 255)
    assert NEAR_MISSES in run(picture, Calibration(CAMERA), Options()).choices.assumed
    assert NEAR_MISSES not in twins_of(picture, Calibration(CAMERA), Options(), frames=2).assumed
