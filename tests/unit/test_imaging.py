import csv
import gc
import json
import tracemalloc
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image as PillowImage
from test_colour_detection import HEIGHT, WIDTH, lobe, picture

import simtest
from simtest.api import Extras, reconstruct_picture
from simtest.calibration import Normal, Priors, Response
from simtest.cli import pictures
from simtest.cli.common import PictureOptions
from simtest.detection.detector import load_detector
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.reconstruction.images import is_coloured, open_source, read_picture
from simtest.reconstruction.options import Options
from simtest.reconstruction.outputs import constraints_arrays
from simtest.reconstruction.sequence import reconstruct_sequence
from simtest.reconstruction.tracking import Tracker
from simtest.runtime import provenance
from simtest.validation.depth_maps import depth_normals, depth_points, depth_problems, depths_at, read_depth
from simtest.validation.references import load_reference, read_pose
from tests.refusals import refused

SPOTS = [(90, 70, 5.0), (230, 160, 6.0)]
FOV = 60.0
TABLES = ("timeline.csv", "tracks.json")
CAMERA = Camera.from_fov(FOV, WIDTH, HEIGHT)


def frame(shift=0.0):
    return picture(sum(lobe(x + shift, y, width, peak=0.5) for x, y, width in SPOTS))


def save(path, values):
    """Write RGB values in [0, 1] as 8 bits."""
    cv2.imwrite(str(path), np.rint(255 * values[:, :, ::-1]).astype(np.uint8))
    return path


@pytest.fixture
def shot(tmp_path):
    return save(tmp_path / "shot.png", frame())


def told(run, *fragments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refused(run, *fragments)


def by_fov(path, out, extras=None, **options):
    return reconstruct_picture(path, out, Options(fov_deg=FOV, **options), extras)


def quietly(path, out, extras=None, **options):
    with pytest.warns(UserWarning, match="angles depend on the field of view of 60 deg"):
        return by_fov(path, out, extras, **options)


# A picture --------------------------------------------------------------------------------------------------------


def test_a_picture_gives_all_files(shot, tmp_path):
    record, files = quietly(shot, tmp_path / "out")
    assert len(record) == 2
    assert [file.name for file in files] == [
        "normals.json", "normals.csv", "normals.ply", "overlay.png", "constraints.npz", "index.html",
    ]  # fmt: skip
    document = json.loads(files[0].read_text())
    assert document["detector"] == "colour"
    for spot in document["specularities"]:
        assert spot["kind"] == "isolated"
        assert len(spot["estimates"]["circle_pose"]["candidates"]) == 2
        best = spot["estimates"][spot["best"]]
        assert np.array(best["covariance"]).shape == (2, 2)
        assert np.dot(best["normal"], spot["sightline"]) == pytest.approx(-1, abs=1e-3)
    rows = list(csv.DictReader(files[1].read_text().splitlines()))
    assert {row["best"] for row in rows} == {"0", "1"}
    overlay = cv2.imread(str(files[3]))
    assert overlay.shape[1] == 3 * WIDTH
    page = files[5].read_text()
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")


def test_constraints_as_arrays(shot, tmp_path):
    record, files = quietly(shot, tmp_path / "out")
    described, stored = json.loads(files[0].read_text()), np.load(files[4], allow_pickle=False)
    for name, values in constraints_arrays(record).items():
        np.testing.assert_array_equal(stored[name], values)
    for i, spot in enumerate(described["specularities"]):
        best = spot["estimates"][spot["best"]]
        assert (stored["id"][i], stored["estimator"][i]) == (spot["id"], spot["best"])
        for name, key in (("pixel", "look_px"), ("normal", "normal"), ("covariance", "covariance")):
            np.testing.assert_array_equal(stored[name][i], best[key])
        np.testing.assert_array_equal(stored["candidates"][i], spot["estimates"]["circle_pose"]["candidates"])
    assert stored["normal"].shape == (2, 3)
    # Nobody gave the lobe's width, so the curvature is not known.
    assert np.isnan(stored["covariance_at_pixel"]).all()
    np.testing.assert_allclose(stored["basis"] @ stored["normal"][:, :, None], 0, atol=1e-12)
    np.testing.assert_allclose(stored["sightline"], CAMERA.unproject(stored["pixel"]))
    np.testing.assert_allclose(stored["K"], CAMERA.K)


def test_a_depth_places_the_points(shot, tmp_path):
    _, files = quietly(shot, tmp_path / "out", extras=Extras(depth="50"))
    vertices = [line.split() for line in files[2].read_text().split("end_header\n")[1].splitlines()]
    assert {float(v[2]) for v in vertices} == {50.0}
    told(lambda: depths_at("-3", [], (4, 4), None), "--depth -3", "must be 0.001 to 1e+06 mm")


@pytest.mark.parametrize("detector", ["auto", "peaks"])
def test_grey_pictures_keep_to_peaks(tmp_path, detector):
    values = np.clip(0.05 + 0.9 * lobe(160, 120, 8.0), 0, 1)
    cv2.imwrite(str(tmp_path / "grey.png"), np.rint(65535 * values).astype(np.uint16))
    record, files = quietly(tmp_path / "grey.png", tmp_path / "out", detector=detector)
    assert len(record) == 1
    assert json.loads(files[0].read_text())["detector"] == "peaks"
    told(lambda: by_fov(tmp_path / "grey.png", tmp_path / "o", detector="colour"), "the picture is grey")


# Bad pictures -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "write", "fragments"),
    [
        ("text.png", lambda p: p.write_text("this is no picture\n"), ("no picture (19 bytes)",)),
        ("empty.png", lambda p: p.write_bytes(b""), ("no picture (0 bytes)",)),
        ("huge.png", lambda p: PillowImage.new("1", (20000, 20000)).save(p), ("400000000 px", "at most 50000000 are")),
        ("large.png", lambda p: PillowImage.new("1", (12000, 9000)).save(p), ("12000 x 9000 px", "at most 50000000")),
        (
            "clip.mp4",
            lambda p: p.write_text("no video"),
            ("read (8 bytes, of no known container)",),
        ),
        ("none.avi", lambda p: p.write_bytes(b""), ("read (0 bytes, of no known container)",)),
        ("nothing", lambda p: p.mkdir(), ("holds no pictures",)),
        ("missing.mp4", lambda p: None, ("no such file",)),
    ],
)
def test_files_that_are_no_pictures(tmp_path, name, write, fragments):
    path = tmp_path / name
    write(path)
    told(lambda: (read_picture if path.suffix == ".png" else open_source)(path), name, *fragments)
    if name == "text.png":
        told(lambda: by_fov(path, tmp_path / "o"), name, *fragments)
        assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(("suffix", "words"), [("jpg", "as they are stored"), ("tif", "as the tag turns them")])
def test_a_picture_with_an_orientation_says_how_it_is_taken(tmp_path, suffix, words):
    exif, values = PillowImage.Exif(), np.zeros((40, 60), np.uint8)
    values[:20] = 200
    for orientation in (1, 3):
        exif[0x0112] = orientation
        PillowImage.fromarray(values).save(tmp_path / f"{orientation}.{suffix}", exif=exif)
    plain = read_picture(tmp_path / f"1.{suffix}")  # warnings are errors here
    with pytest.warns(UserWarning, match=f"its orientation tag is 3: pixels are taken {words}"):
        turned = read_picture(tmp_path / f"3.{suffix}")
    assert np.allclose(turned, plain if suffix == "jpg" else plain[::-1, ::-1], atol=0.02)


def test_other_depths_and_channels_are_read(tmp_path):
    values = frame()
    wide = np.rint(65535 * values[:, :, ::-1]).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "wide.png"), wide)
    cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([wide >> 8, np.full(wide.shape[:2], 255)]).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "grey.png"), (wide[:, :, 0] >> 8).astype(np.uint8))
    np.testing.assert_allclose(read_picture(tmp_path / "wide.png"), values, atol=1e-5)
    assert read_picture(tmp_path / "alpha.png").shape == (HEIGHT, WIDTH, 3)
    assert read_picture(tmp_path / "grey.png").shape == (HEIGHT, WIDTH)
    assert is_coloured(read_picture(tmp_path / "alpha.png"))
    assert not is_coloured(np.repeat(read_picture(tmp_path / "grey.png")[:, :, None], 3, axis=2))


def test_a_camera_of_another_size(shot, tmp_path):
    (tmp_path / "camera.toml").write_text("width = 640\nheight = 480\nfx = 500.0\nfy = 500.0\n")
    told(
        lambda: reconstruct_picture(shot, tmp_path / "o", Options(tmp_path / "camera.toml")),
        f"{shot.name}: frame is 320 x 240 px: must be 640 x 480, the size of the camera's calibration",
    )


# Folders and videos -----------------------------------------------------------------------------------------------


def run(path, out, progress=None, **options):
    with pytest.warns(UserWarning, match="angles depend"):
        return reconstruct_sequence(path, out, Options(fov_deg=FOV, **options), progress)


def noted(path, out):
    """Return the result and the texts of all warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = reconstruct_sequence(path, out, Options(fov_deg=FOV))
    assert [each.what for each in result.assumed][:2] == ["light", "distance of the tissue"]
    return result, " ".join(str(w.message) for w in caught)


@pytest.fixture
def folder(tmp_path):
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for i in (1, 2, 10):
        save(pictures / f"frame{i}.png", frame(3.0 * min(i, 3)))
    return pictures


def test_a_folder_gives_tracks_and_a_table_over_time(folder, tmp_path):
    result = run(folder, tmp_path / "out")
    assert (result.frames, result.failed, result.specularities, result.tracks) == (3, 0, 6, 2)
    rows = list(csv.DictReader((tmp_path / "out" / "timeline.csv").read_text().splitlines()))
    assert [row["track"] for row in rows if row["estimator"] == "cone_axis" and row["frame"] == "0"] == ["0", "1"]
    for track in json.loads((tmp_path / "out" / "tracks.json").read_text()):
        assert track["frames"] == [0, 1, 2]
        x = [peak[0] for peak in track["peaks_px"]]
        np.testing.assert_allclose(np.diff(x), 3.0, atol=0.3)
    assert cv2.imread(str(tmp_path / "out" / "frames" / "000002.jpg")) is not None
    assert "frames/000001.jpg" in (tmp_path / "out" / "index.html").read_text()


def test_a_stopped_run_goes_on(folder, tmp_path):
    def stop(done, total, what):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(folder, tmp_path / "out", progress=stop)
    kept = tmp_path / "out" / "frames" / "000000.json"
    before = kept.stat().st_mtime_ns
    (tmp_path / "out" / "frames" / "000001.json").write_text("{half a fi")
    (tmp_path / "out" / "frames" / "000002.json").write_text('{"image": "frame10.png", "size": [320, 240]}')
    run(folder, tmp_path / "out")
    assert kept.stat().st_mtime_ns == before
    run(folder, tmp_path / "whole")
    for name in TABLES:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    other = Options(fov_deg=FOV, every=True)
    told(lambda: reconstruct_sequence(folder, tmp_path / "out", other), "holds a run with another every")


def lost(folder, out):
    """The first frame can no longer be read: without it the tracks are counted otherwise."""
    (folder / "frame1.png").write_text("no picture")
    (out / "frames" / "000000.json").unlink()


def broken(folder):
    (folder / "frame2.png").write_text("no picture")


def repaired(folder, out):
    save(folder / "frame2.png", frame(16.0))


def lacking(folder, out):
    """Each frame's file lacks another thing that the tables need."""
    keys = ("peak_px", "box_px", "track", "estimates", "best")
    for key, path in zip(keys, sorted((out / "frames").glob("*.json")), strict=True):
        content = json.loads(path.read_text())
        del content["specularities"][0][key]
        path.write_text(json.dumps(content))


GOING_ON = {"lost": (None, lost), "repaired": (broken, repaired), "lacking": (None, lacking)}


@pytest.mark.parametrize("name", GOING_ON)
def test_a_run_that_goes_on_ends_with_the_files_of_one_that_saw_all(tmp_path, name):
    # One step lies within the reach of a track, two lie beyond.
    before, after = GOING_ON[name]
    folder, out, whole = tmp_path / "pictures", tmp_path / "out", tmp_path / "whole"
    folder.mkdir()
    for i in (1, 2, 3, 4, 5):
        save(folder / f"frame{i}.png", frame(8.0 * i))
    if before:
        before(folder)
    noted(folder, out)
    after(folder, out)
    noted(folder, out)
    noted(folder, whole)
    # The later frames of a repaired film were done after another one.
    same = [path for path in whole.rglob("*.*") if path.parent.name == "frames" or path.name in TABLES]
    assert len(same) >= 8
    for path in same:
        made, wanted = (each.read_bytes() for each in (out / path.relative_to(whole), path))
        if name == "repaired" and path.suffix == ".json" and path.parent != whole:
            made, wanted = ([spot["track"] for spot in json.loads(text)["specularities"]] for text in (made, wanted))
        assert made == wanted, path.name


@pytest.mark.parametrize("given", [{"estimators": {"mine": object()}}, {"detector": load_detector("peaks")}])
def test_objects_that_no_later_run_can_compare_are_refused_for_a_folder(folder, tmp_path, given):
    told(lambda: reconstruct_sequence(folder, tmp_path / "out", Options(fov_deg=FOV, **given)), "given by name")


def test_another_calibration_is_another_run(folder, tmp_path):
    camera, options = tmp_path / "camera.toml", Options(camera=tmp_path / "camera.toml")
    simtest.save_calibration(simtest.Calibration(CAMERA), camera)
    reconstruct_sequence(folder, tmp_path / "out", options)
    before = (tmp_path / "out" / "timeline.csv").read_bytes()
    # The same content, written otherwise, and the same folder by another path.
    camera.write_text(camera.read_text() + "\n# a comment\n")
    other = tmp_path / "out" / ".." / folder.name
    reconstruct_sequence(other, tmp_path / "out", options)
    assert (tmp_path / "out" / "timeline.csv").read_bytes() == before
    simtest.save_calibration(simtest.Calibration(replace(CAMERA, fx=2 * CAMERA.fx)), camera)
    (tmp_path / "out" / "frames" / "000002.json").unlink()
    told(lambda: reconstruct_sequence(folder, tmp_path / "out", options), "holds a run with another calibration")


def test_an_encoding_beside_a_stated_response_is_refused_before_the_work(folder, tmp_path):
    simtest.save_calibration(simtest.Calibration(CAMERA, Response("srgb")), tmp_path / "camera.toml")
    options = Options(camera=tmp_path / "camera.toml", encoding="linear")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=r"^--encoding linear: the calibration states the response"):
            reconstruct_sequence(folder, tmp_path / "out", options)


def test_a_later_run_takes_the_field_of_view_from_the_first_picture(folder, tmp_path):
    """The round view moves a little from frame to frame; all frames are of one camera."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for shift, name in enumerate(("frame1.png", "frame2.png", "frame10.png")):
        save(folder / name, frame() * (np.hypot(x - 160 - 3 * shift, y - 120) < 110)[..., None])
    run(folder, tmp_path / "out", fov_of="view")
    done = sorted((tmp_path / "out" / "frames").glob("*.json"))
    before = [path.read_bytes() for path in done]
    done[1].unlink()
    run(folder, tmp_path / "out", fov_of="view")
    assert [path.read_bytes() for path in done] == before


def test_a_run_asks_once_for_its_commit(folder, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(provenance, "commit", lambda: asked.append(1))
    run(folder, tmp_path / "out")
    assert len(asked) == 1


def test_a_broken_picture_behind_a_stranger_is_passed_over(folder, tmp_path):
    """Files that the poses do not name may come first; what cannot be read behind them stops nothing."""
    rig = Priors(lights_mm=((0.0, 0.0, 0.0),), distance_mm=Normal(30.0, 1.0))
    simtest.save_calibration(simtest.Calibration(CAMERA, priors=rig), tmp_path / "camera.toml")
    with (tmp_path / "camera.toml").open("a") as file:
        file.write("\n[surface]\nlobe_curvature = 50.0\n")
    save(folder / "a_sheet.png", frame()[:100])
    (folder / "frame1.png").write_text("no picture")
    poses = [{"frame": f"frame{i}.png", "world_from_camera": np.eye(4).tolist()} for i in (1, 2, 10)]
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    options = Options(camera=tmp_path / "camera.toml", poses=tmp_path / "poses.json")
    with pytest.warns(UserWarning, match="frame 0: .* must be 320 x 240|frame 1: .* no picture"):
        made = reconstruct_sequence(folder, tmp_path / "out", options)
    assert (made.frames, made.failed, made.not_named) == (4, 2, 1)


@pytest.mark.ci
def test_a_film_takes_little_memory(folder, tmp_path):
    """Of each frame tracks are kept, and no isophotes: a film of ten minutes has 15,000 frames."""
    made = run(folder, tmp_path / "warm")
    assert made.specularities == 6
    held = []

    def measure(done, total, what):
        gc.collect()
        held.append(tracemalloc.get_traced_memory()[0])

    for i in range(20, 32):
        save(folder / f"frame{i}.png", frame(3.0))
    tracemalloc.start()
    run(folder, tmp_path / "out", progress=measure)
    tracemalloc.stop()
    # Two highlights a frame; with isophotes they take 300 kB.
    growth = (held[-2] - held[5]) / (len(held) - 7)
    assert growth < 15_000


def test_a_broken_picture_in_a_folder_is_told_and_passed_over(folder, tmp_path):
    (folder / "frame5.png").write_text("no picture")
    result, texts = noted(folder, tmp_path / "out")
    assert "frame 2: " in texts
    assert "no picture (10 bytes)" in texts
    assert (result.frames, result.failed, result.tracks) == (4, 1, 2)


@pytest.fixture
def of_two_sizes(folder):
    save(folder / "frame7.png", frame()[:200, :300])
    return folder


def test_a_field_of_view_gives_each_size_a_camera(of_two_sizes, tmp_path, capsys):
    with pytest.warns(UserWarning, match="angles depend") as caught:
        code = pictures.reconstruct(of_two_sizes, out=tmp_path / "out", known=PictureOptions(fov_deg=FOV))
    assert (code, len(caught)) == (0, 1)
    printed = capsys.readouterr().out
    assert "4 frames: 8 specularities, 2 seen in several frames" in printed
    assert f"note: 320 x 240 px (3 frames), 300 x 200 px (1 frame): each size has a camera of {FOV:g} deg" in printed
    cameras = [json.loads((tmp_path / "out" / "frames" / f"00000{i}.json").read_text())["camera"] for i in range(4)]
    widths, focal = [320, 320, 300, 320], 0.5 / np.tan(np.radians(FOV) / 2)
    np.testing.assert_allclose([each["K"][0][0] for each in cameras], np.multiply(widths, focal))
    # Frames of the other size have other tracks, and end none.
    assert sorted(len(track["frames"]) for track in json.loads((tmp_path / "out" / "tracks.json").read_text())) == [
        1, 1, 3, 3,
    ]  # fmt: skip


def test_pictures_of_another_size_than_the_cameras_are_refused_before_the_work(of_two_sizes, tmp_path):
    simtest.save_calibration(simtest.Calibration(CAMERA), tmp_path / "camera.toml")
    words = r"is of 320 x 240 px, and 1 of 4 pictures are of another size: frame7\.png \(300 x 200\); give"
    with pytest.raises(InputError, match=words) as raised:
        reconstruct_sequence(of_two_sizes, tmp_path / "out", Options(camera=tmp_path / "camera.toml"))
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_a_skipped_picture_is_counted_and_makes_the_exit_code_1(folder, tmp_path, capsys):
    (folder / "frame5.png").write_text("no picture")
    with pytest.warns(UserWarning, match="angles depend|no picture"):
        code = pictures.reconstruct(folder, out=tmp_path / "out", known=PictureOptions(fov_deg=FOV))
    assert code == 1
    assert "4 frames, 1 skipped: 6 specularities" in capsys.readouterr().out


def video(path, count):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("OpenCV writes no MJPG here")
    for i in range(count):
        writer.write(np.rint(255 * frame(float(i))[:, :, ::-1]).astype(np.uint8))
    writer.release()
    return path


def test_a_video_that_stops_half_way_keeps_what_was_read(tmp_path):
    path = video(tmp_path / "whole.avi", 6)
    assert open_source(path).count == 6
    broken = tmp_path / "broken.avi"
    broken.write_bytes(path.read_bytes()[: path.stat().st_size * 55 // 100])
    result, texts = noted(broken, tmp_path / "out")
    assert 1 <= result.frames < 6
    assert result.specularities >= 2 * (result.frames - 1)
    assert "ends after" in texts
    assert "what was read is kept" in texts
    assert (tmp_path / "out" / "timeline.csv").stat().st_size > 1000


def test_tracks_cross_gaps_and_do_not_jump():
    tracker = Tracker((640, 480))
    assert tracker.update([(100, 100), (300, 200)], 0) == [0, 1]
    assert tracker.update([(305, 203), (104, 100)], 1) == [1, 0]
    assert tracker.update([(108, 100)], 2) == [0]
    assert tracker.update([(111, 101), (310, 206)], 3) == [0, 1]
    assert tracker.update([(500, 400)], 4) == [2]
    assert tracker.update([], 5) == []


@pytest.mark.parametrize(("unread", "number"), [(0, 0), (3, 0), (4, 1), (40, 1)])
def test_frames_that_could_not_be_read_count_as_unseen(unread, number):
    tracker = Tracker((640, 480))
    assert tracker.update([(100, 100)], 7) == [0]
    assert tracker.update([(103, 100)], 8 + unread) == [number]


def test_a_step_over_frames_without_the_highlight_is_that_of_one_frame():
    tracker = Tracker((640, 480))
    assert tracker.update([(100, 100)], 0) == [0]
    assert [tracker.update([], index) for index in (1, 2)] == [[], []]
    assert tracker.update([(118, 100)], 4) == [0]
    # It goes on at 4.5 px a frame; the other one begins where a step of 18 px would have led.
    assert tracker.update([(122.5, 100), (128, 100)], 5) == [0, 1]


# References -------------------------------------------------------------------------------------------------------


def pose_file(path, matrix):
    path.write_text(f"matrix = {np.asarray(matrix).tolist()}\n")
    return path


def rotation(axis, angle):
    return cv2.Rodrigues(np.array(axis, dtype=float) / np.linalg.norm(axis) * angle)[0]


def test_a_registered_sphere_gives_its_normals(shot, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=40.0)
    ball.export(tmp_path / "ball.ply")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation([1, 2, 3], 0.7), [3.0, -2.0, 100.0]
    reference = load_reference(tmp_path / "ball.ply", pose_file(tmp_path / "pose.toml", pose), CAMERA)
    pixels = np.array([[160.0, 120.0], [180.0, 100.0], [2.0, 2.0]])
    normals = reference.normals_at(pixels, CAMERA)
    rays, centre = CAMERA.unproject(pixels), pose[:3, 3]
    for ray, normal in zip(rays[:2], normals[:2], strict=True):
        along = ray @ centre - np.sqrt((ray @ centre) ** 2 - centre @ centre + 1600)
        np.testing.assert_allclose(normal, (along * ray - centre) / 40, atol=4e-3)
    assert np.isnan(normals[2]).all()


def test_comparison_with_a_reference(shot, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=60.0)
    ball.apply_translation([0, 0, 100])
    ball.export(tmp_path / "ball.ply")
    pose = pose_file(tmp_path / "pose.toml", np.eye(4))
    _, files = quietly(shot, tmp_path / "out", extras=Extras(tmp_path / "ball.ply", camera_from_model=pose))
    document = json.loads(files[0].read_text())
    table = document["reference"]
    assert table["compared"] == 2
    assert table["missed"] == 0
    for name, row in table["estimators"].items():
        angles = [spot["reference"]["errors"][name]["error_deg"] for spot in document["specularities"]]
        assert row["mean_deg"] == pytest.approx(np.mean(angles))
        assert row["std_deg"] == pytest.approx(np.std(angles, ddof=1))
        assert row["mean_oracle_deg"] <= row["mean_deg"] + 1e-9


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        (f"matrix = {(2 * np.eye(4)).tolist()}", ("last row",)),
        (f"matrix = {np.diag([1.1, 1.0, 1.0, 1.0]).tolist()}", ("no rotation", "R^T R")),
        (f"matrix = {np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()}", ("no rotation", "mirror image")),
        ("rotation = [[1, 0], [0, 1]]\ntranslation_mm = [0, 0, 0]", ("rotation", "must be 3 x 3 finite numbers")),
        ("rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", ("translation_mm: missing",)),
        ("pose = 3", ("pose: unknown key", "allowed: matrix, rotation, translation_mm")),
        (f"matrix = {np.eye(4).tolist()}\ntranslation_mm = [0, 0, 0]", ("excludes",)),
    ],
)
def test_poses_that_are_none(tmp_path, text, fragments):
    (tmp_path / "pose.toml").write_text(text + "\n")
    told(lambda: read_pose(tmp_path / "pose.toml"), "pose.toml", *fragments)


def test_references_without_or_with_too_much(shot, tmp_path):
    trimesh.creation.icosphere(radius=40.0).export(tmp_path / "ball.ply")
    told(lambda: by_fov(shot, tmp_path / "o", extras=Extras(tmp_path / "ball.ply")), "needs --camera-from-model")
    pose = pose_file(tmp_path / "pose.toml", np.eye(4))
    told(lambda: by_fov(shot, tmp_path / "o", extras=Extras(camera_from_model=pose)), "needs --reference")
    np.save(tmp_path / "depth.npy", np.ones((HEIGHT, WIDTH)))
    told(lambda: load_reference(tmp_path / "depth.npy", pose, CAMERA), "leave it out")


# Depth maps -------------------------------------------------------------------------------------------------------


def plane_depth(normal, offset=80.0, camera=CAMERA):
    """z of a plane's points; its unit normal faces the camera."""
    rays = camera.unproject(camera.pixel_centres())
    along = -offset / (rays @ normal)
    return along * rays[..., 2]


@pytest.mark.parametrize("tilt", [0.0, 20.0, 50.0])
def test_normals_of_a_plane_are_exact(tilt):
    normal = np.array([np.sin(np.radians(tilt)), 0.1, -np.cos(np.radians(tilt))])
    normal /= np.linalg.norm(normal)
    found = depth_normals(depth_points(plane_depth(normal), CAMERA))[5:-5, 5:-5].reshape(-1, 3)
    np.testing.assert_allclose(found, np.broadcast_to(normal, found.shape), atol=1e-9)


def test_distance_along_the_ray_is_told_apart():
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    normals = depth_normals(depth_points(np.full((HEIGHT, WIDTH), 30.0), CAMERA, "distance"))[5:-5, 5:-5]
    np.testing.assert_allclose(normals, -rays[5:-5, 5:-5], atol=2e-4)


def test_edges_and_holes_have_no_normal():
    depth = np.full((HEIGHT, WIDTH), 50.0)
    depth[:, 160:] = 80.0
    depth[100, 50] = np.nan
    normals = depth_normals(depth_points(depth, CAMERA))
    assert np.isnan(normals[60, 158:162]).all()
    assert np.isnan(normals[98:103, 48:53]).all()
    assert np.isfinite(normals[60, 100]).all()


@pytest.mark.parametrize("suffix", ["png", "tiff", "npy", "exr"])
def test_depth_maps_of_all_formats(tmp_path, suffix):
    depth = plane_depth(np.array([0.3, 0.1, -0.9]) / np.linalg.norm([0.3, 0.1, -0.9]))
    path, scale = tmp_path / f"depth.{suffix}", 0.005
    if suffix in ("png", "tiff"):
        cv2.imwrite(str(path), np.rint(depth / scale).astype(np.uint16))
    elif suffix == "npy":
        np.save(path, depth)
    else:
        from simtest.rendering.bitmap import write_exr

        write_exr(path, depth.astype(np.float32))
    integers = suffix in ("png", "tiff")
    found = read_depth(path, scale if integers else None)
    np.testing.assert_allclose(found, depth, atol=0.6 * scale if integers else 1e-4)
    assert depth_problems(found, depth_normals(depth_points(found, CAMERA)), CAMERA) == ()
    if integers:
        told(lambda: read_depth(path), "--depth-scale must say how many mm one step is")


def test_degenerate_and_coarse_maps_are_told():
    def problems(depth):
        return depth_problems(depth, depth_normals(depth_points(depth, CAMERA)), CAMERA)

    assert "degenerate" in problems(np.full((HEIGHT, WIDTH), 50.0))[0]
    slanted = plane_depth(np.array([0.5, 0.0, -0.8]) / np.hypot(0.5, 0.8))
    coarse = 1.0 * np.round(slanted / 1.0)
    assert any("degenerate" in text or "too coarse" in text for text in problems(coarse))
    assert any("too coarse for highlights: steps of" in text for text in problems(2.0 * np.round(slanted / 2.0)))
    rng = np.random.default_rng(0)
    rough = slanted + rng.normal(0, 0.3, slanted.shape)
    assert any("normals turn by" in text for text in problems(rough))


@pytest.mark.parametrize(
    ("name", "write", "fragments"),
    [
        ("depth.jpg", lambda p: p.write_bytes(b"x"), ("unknown suffix .jpg",)),
        ("depth.npy", lambda p: p.write_text("text"), ("no NPY file, or a damaged one",)),
        (
            "depth.npy",
            lambda p: np.save(p, np.array([{}], dtype=object), allow_pickle=True),
            ("Python objects, which are never",),
        ),
        ("depth.npy", lambda p: np.save(p, np.zeros((4, 4))), ("no positive depth",)),
        ("depth.npy", lambda p: np.save(p, np.zeros((4, 4, 4, 4))), ("must be (H, W)",)),
        ("depth.exr", lambda p: p.write_text("text"), ("no OpenEXR image",)),
        ("depth.png", lambda p: cv2.imwrite(str(p), np.dstack([np.eye(9)] * 2 + [np.ones((9, 9))])), ("channels",)),
    ],
)
def test_depth_maps_that_are_none(tmp_path, name, write, fragments):
    write(tmp_path / name)
    told(lambda: read_depth(tmp_path / name, 1.0), name, *fragments)


def test_a_depth_map_as_reference(shot, tmp_path):
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    # A sphere around the camera: its normals point back along the sightlines, as do those of highlights.
    np.save(tmp_path / "depth.npy", 30.0 * rays[..., 2])
    _, files = quietly(shot, tmp_path / "out", extras=Extras(tmp_path / "depth.npy"))
    row = json.loads(files[0].read_text())["reference"]["estimators"]["cone_axis"]
    assert row["n"] == 2
    assert row["mean_deg"] < 0.3
