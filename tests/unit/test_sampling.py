"""Sampled views show isolated highlights, and every other place is counted with its reason."""

import itertools
import json

import cv2
import numpy as np
import pytest

from simtest import api
from simtest.errors import InputError
from simtest.rendering.placement_checks import check_lights
from simtest.simulation.views import NO_HIGHLIGHT, NO_ROOM, along_path, candidates, sample_views
from simtest.spec import load_scene
from simtest.surfaces import make_surface

SMALL = {"camera.width": 160, "camera.height": 120, "camera.fx": 80.0, "camera.fy": 80.0}


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


@pytest.mark.render
def test_a_view_into_the_noise_is_rejected_for_it(tmp_path):
    settings = {**SMALL, "sensor.noise_sigma": 0.3}
    sampled = api.sample_views("anatomy", tmp_path, 1, settings)
    assert sampled.views == []
    assert set(sampled.rejected) - {NO_HIGHLIGHT}
    written = json.loads((tmp_path / "views.json").read_text())
    assert written == {"tried": 10, "accepted": [], "rejected": sampled.rejected}
    assert not (tmp_path / "sheet.png").exists()


def test_only_anatomies_are_sampled(tmp_path):
    with pytest.raises(InputError, match=r"surface\.type = plane"):
        api.sample_views("plane", tmp_path)
    with pytest.raises(InputError, match="count = 0"):
        api.sample_views("anatomy", tmp_path, 0)


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


def test_a_sequence_needs_a_path():
    with pytest.raises(InputError, match=r"surface\.view = auto"):
        along_path(load_scene("anatomy"), 3, 0.0, 1.0)
    with pytest.raises(InputError, match=r"along = 0\.5, 1\.5"):
        along_path(load_scene("anatomy", {"surface.view": "path"}), 3, 0.5, 1.5)
