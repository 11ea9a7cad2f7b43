"""The folder of `simtest views`: which places are sampled, the camera's pose in every record, a sequence's labels."""

import itertools
import json

import cv2
import numpy as np
import pytest

from simtest import api
from simtest.errors import InputError
from simtest.reconstruction.poses import read_poses
from simtest.rendering.placement_checks import check_lights
from simtest.simulation.flow import STATES, Flow, flow_picture
from simtest.simulation.highlights import NO_HIGHLIGHT, REMEDIES, STREAK
from simtest.simulation.views import NO_ROOM, SampledView, SampledViews, candidates, sample_views
from simtest.spec import load_scene
from simtest.surfaces import make_surface

SMALL = {"camera.width": 160, "camera.height": 120, "camera.fx": 80.0, "camera.fy": 80.0}
LABELS = ("covisibility.npy", "flow_sheet.png", "flow_0000.npz", "flow_0001.npz")


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A labelled film of three frames."""
    folder = tmp_path_factory.mktemp("film")
    settings = {**SMALL, "surface.view": "wall", "sensor.exposure.percentile": 99.5}
    api.sample_views("anatomy", folder, 3, settings, along=(0.4, 0.42), fps=10.0, labels=True)
    return folder, settings


def poses_of(settings, shares):
    scene = load_scene("anatomy", settings)
    surfaces = [scene.surface.model_copy(update={"path_share": share}) for share in shares]
    return np.array([make_surface(surface).model_from_camera for surface in surfaces])


@pytest.mark.slow
@pytest.mark.render
def test_every_record_holds_the_cameras_pose(film):
    folder, settings = film
    written = json.loads((folder / "views.json").read_text())["accepted"]
    poses = poses_of(settings, [view["surface.path_share"] for view in written])
    for key in ("world_from_camera", "model_from_camera"):
        np.testing.assert_allclose([view[key] for view in written], poses, rtol=0, atol=1e-9)
    for name in ("views.json", "trajectory.txt", "transforms.json", "colmap/images.txt"):
        read = read_poses(folder / name)
        np.testing.assert_allclose(read.world_from_camera, poses, rtol=0, atol=1e-9, err_msg=name)
        assert not read.names or list(read.names) == [view["picture"] for view in written]
    assert [view["time_s"] for view in written] == pytest.approx([0.0, 0.1, 0.2])
    assert cv2.VideoCapture(str(folder / "film.avi")).get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)


@pytest.mark.slow
@pytest.mark.render
def test_a_rendered_frame_and_a_view_hold_the_same_pose(film, tmp_path):
    from simtest.simulation.frame_files import write_frame

    folder, settings = film
    view = json.loads((folder / "views.json").read_text())["accepted"][1]
    frame = api.render("anatomy", {**settings, "surface.path_share": view["surface.path_share"]})
    write_frame(frame, tmp_path)
    told = json.loads((tmp_path / "frame.json").read_text())["world_from_camera"]
    np.testing.assert_allclose(told, view["world_from_camera"], rtol=0, atol=1e-9)
    # The flow takes the frame's own surface points to where the next frame sees them.
    third = json.loads((folder / "views.json").read_text())["accepted"][2]
    T = np.linalg.inv(third["world_from_camera"]) @ told
    points = np.load(tmp_path / "truth.npz")["position_mm"] @ T[:3, :3].T + T[:3, 3]
    flow = np.load(folder / "flow_0001.npz")
    expected = frame.camera.project(points) - frame.camera.pixel_centres()
    seen = flow["forward_state"] == STATES.index("seen in both")
    assert np.count_nonzero(seen) > 5000
    np.testing.assert_allclose(flow["forward"][seen], expected[seen], atol=1e-3)


@pytest.mark.slow
@pytest.mark.render
def test_labels_of_a_film(film):
    folder, _ = film
    with np.load(folder / "flow_0000.npz") as flow:
        assert flow["forward"].dtype == flow["backward"].dtype == np.float32
        assert flow["forward"].shape == (120, 160, 2)
        assert flow["forward_state"].max() < len(STATES)
        share = np.mean(flow["forward_state"] == 1) / np.mean(np.isin(flow["forward_state"], (1, 2, 3)))
    shares = np.load(folder / "covisibility.npy")
    assert shares.shape == (3, 3)
    np.testing.assert_array_equal(np.diag(shares), 1)
    assert shares[0, 1] == pytest.approx(share, abs=0.05)
    assert 0 < shares[0, 2] <= shares[0, 1]
    assert cv2.imread(str(folder / "flow_sheet.png")).shape[1] == 2 * 160


@pytest.mark.render
def test_labels_of_an_earlier_film_are_removed(tmp_path):
    for name in (*LABELS, "trajectory.txt"):
        (tmp_path / name).write_text("of an earlier call")
    api.sample_views("anatomy", tmp_path, 1, SMALL)
    assert not [name for name in (*LABELS, "trajectory.txt") if (tmp_path / name).exists()]
    assert (tmp_path / "colmap" / "images.txt").is_file()
    assert (tmp_path / "transforms.json").is_file()


@pytest.mark.parametrize(
    ("scene", "told", "words"),
    [
        ("plane", {}, r"surface\.type = plane"),
        ("anatomy", {"count": 0}, "count = 0"),
        ("anatomy", {"labels": True}, "labels: needs along"),
        ("anatomy", {"fps": 25.0}, "fps: needs along"),
        (
            "anatomy",
            {"settings": {"surface.view": "wall"}, "along": (0.4, 0.5), "fps": 0.0},
            r"fps = 0: must be 0\.1 to",
        ),
        ("anatomy", {"along": (0.0, 1.0)}, r"surface\.view = auto"),
        ("anatomy", {"settings": {"surface.view": "path"}, "along": (0.5, 1.5)}, r"along = 0\.5, 1\.5"),
    ],
)
def test_what_only_anatomies_or_sequences_have_needs_one(tmp_path, scene, told, words):
    with pytest.raises(InputError, match=words):
        api.sample_views(scene, tmp_path, **{"count": 3, **told})


def test_a_flow_pictures_colours():
    x, y = np.meshgrid([-2.0, 0.0, 2.0] * 30, np.zeros(90))
    state = np.ones(x.shape, dtype=np.uint8)
    state[:, 40] = STATES.index("hidden")
    flow = np.stack([x, y], axis=-1)
    flow[:, 50] = np.nan
    picture = flow_picture(Flow(flow, state), 2.0)
    blue, green, red = picture[0, 2].astype(int)
    # Right is red, left is cyan, no motion is white, unknown is black, hidden is darker.
    assert (red, green, blue) == (255, 0, 0)
    np.testing.assert_allclose(picture[0, 0], (255, 255, 0), atol=2)
    assert tuple(picture[0, 1]) == (255, 255, 255)
    assert tuple(picture[0, 50]) == (0, 0, 0)
    assert 100 < picture[0, 40].max() < 130


# Places that are sampled ----------------------------------------------------------------------------------------------


def viewpoints_of(sampled):
    return [view.viewpoint for view in sampled.views]


def test_candidates_are_numbers_or_cover_the_path_evenly():
    assert candidates(load_scene("anatomy"), 3) == [0, 1, 2]
    places = sorted(candidates(load_scene("anatomy", {"surface.view": "wall"}), 40))
    assert len(set(places)) == 40
    assert max(b - a for a, b in itertools.pairwise(places)) < 0.06


@pytest.mark.render
def test_every_place_is_either_kept_or_counted():
    scene, told = load_scene("anatomy", SMALL), []
    sampled = sample_views(scene, 3, range(12), progress=lambda *said: told.append(said))
    assert sampled.tried == len(told)
    assert told[-1] == (3, 3, f"views kept, tried surface.viewpoint = {sampled.views[-1].viewpoint}")
    assert len(sampled.views) == 3
    assert min(view.isolated_highlights for view in sampled.views) >= 1
    assert sampled.tried == sampled.views[-1].viewpoint + 1
    few = sample_views(scene, 50, range(12))
    assert few.tried == 12
    assert viewpoints_of(few)[:3] == viewpoints_of(sampled)
    assert sum(few.rejected.values()) == 12 - len(few.views)


@pytest.mark.render
def test_a_place_without_room_for_the_light_is_counted_and_the_next_is_tried():
    source = {"position_mm": [11.0, 0.0, 0.0], "source": {"type": "disc", "radius_mm": 1.5}}
    camera = {"camera.width": 64, "camera.height": 48, "camera.fx": 32.0, "camera.fy": 32.0}
    scene = load_scene("anatomy", {**camera, "rig.lights": [source]})

    def has_room(viewpoint):
        surface = make_surface(scene.surface.model_copy(update={"viewpoint": viewpoint}))
        try:
            check_lights(scene, surface)
        except InputError:
            return False
        return True

    free = [viewpoint for viewpoint in range(30) if has_room(viewpoint)]
    without = next(viewpoint for viewpoint in range(30) if viewpoint not in free)
    sampled = sample_views(scene, 1, [without, without, *free])
    assert set(viewpoints_of(sampled)) < set(free)
    assert sampled.rejected[NO_ROOM] == 2
    # Where there is none anywhere, or a film would have a gap, the line says why.
    with pytest.raises(InputError, match=r"surface\.viewpoint = \d+: .* touches the colon"):
        sample_views(scene, 1, [without])
    with pytest.raises(InputError, match=r"surface\.viewpoint = \d+: .* touches the colon"):
        sample_views(scene, 1, [without, *free], fps=10.0)


@pytest.mark.parametrize(
    ("rejected", "said"),
    [({NO_HIGHLIGHT: 79, STREAK: 15}, REMEDIES[NO_HIGHLIGHT]), ({STREAK: 3}, REMEDIES[STREAK]), ({STREAK: 2}, ""),
     ({NO_ROOM: 9}, ""), ({}, "")],
)  # fmt: skip
def test_where_most_views_show_no_isolated_highlight_it_says_what_to_change(rejected, said):
    views = [SampledView(number, 1, np.eye(4)) for number in range(3 if said or not rejected else 4)]
    assert SampledViews(views, rejected).remedy == said


@pytest.mark.render
def test_a_view_into_the_noise_is_rejected_for_it(tmp_path):
    settings = {**SMALL, "sensor.noise_sigma": 0.3}
    sampled = api.sample_views("anatomy", tmp_path, 1, settings)
    assert sampled.views == []
    assert set(sampled.rejected) - {NO_HIGHLIGHT}
    written = json.loads((tmp_path / "views.json").read_text())
    assert written == {"tried": 10, "accepted": [], "rejected": sampled.rejected}
    assert not (tmp_path / "sheet.png").exists()


@pytest.mark.slow
@pytest.mark.render
def test_a_sequence_leaves_no_place_out_and_is_a_film(tmp_path):
    (tmp_path / "view_0007.png").write_text("of an earlier call")
    settings = {**SMALL, "surface.view": "path", "sensor.exposure.percentile": 99.5}
    sampled = api.sample_views("anatomy", tmp_path, 4, settings, along=(0.4, 0.43))
    assert viewpoints_of(sampled) == pytest.approx([0.4, 0.41, 0.42, 0.43])
    assert not sampled.rejected
    written = json.loads((tmp_path / "views.json").read_text())["accepted"]
    poses = np.array([view["model_from_camera"] for view in written])
    # A hundredth of a path of about 90 mm between frames, and hardly a turn.
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert ((steps > 0.3) & (steps < 2)).all()
    for a, b in itertools.pairwise(poses[:, :3, 2]):
        assert a @ b > 0.99
    assert [view["sensor.seed"] for view in written] == [0, 1, 2, 3]
    pictures = [cv2.imread(str(tmp_path / view["picture"])) for view in written]
    film = cv2.VideoCapture(str(tmp_path / "film.avi"))
    frames = []
    while (read := film.read())[0]:
        frames.append(read[1])
    assert len(frames) == len(pictures) == len(list(tmp_path.glob("view_*.png"))) == 4
    for frame, picture in zip(frames, pictures, strict=True):
        assert np.abs(cv2.blur(frame, (9, 9)).astype(float) - cv2.blur(picture, (9, 9))).mean() < 6
    assert cv2.imread(str(tmp_path / "sheet.png")).shape == (120, 4 * 160, 3)
