"""Sampled views show isolated highlights, and every other place is counted with its reason."""

import itertools
import json

import pytest

from simtest import api
from simtest.errors import InputError
from simtest.spec import load_scene
from simtest.validation.sampling import NO_HIGHLIGHT, candidates, sample_views

SMALL = {"camera.width": 160, "camera.height": 120, "camera.fx": 80.0, "camera.fy": 80.0}


def test_candidates_are_numbers_or_cover_the_path_evenly():
    assert candidates(load_scene("anatomy"), 3) == [0, 1, 2]
    places = sorted(candidates(load_scene("anatomy", {"surface.view": "wall"}), 40))
    assert len(set(places)) == 40
    assert max(b - a for a, b in itertools.pairwise(places)) < 0.06


@pytest.mark.render
def test_every_place_is_either_kept_or_counted():
    scene, told = load_scene("anatomy", SMALL), []
    sampled = sample_views(scene, 3, range(12), tell=lambda *said: told.append(said))
    assert sampled.tried == len(told)
    assert len(sampled.places) == 3
    assert min(sampled.highlights) >= 1
    assert sampled.tried == sampled.places[-1] + 1
    few = sample_views(scene, 50, range(12))
    assert few.tried == 12
    assert few.places[:3] == sampled.places
    assert sum(few.rejected.values()) == 12 - len(few.places)


@pytest.mark.render
def test_a_view_into_the_noise_is_rejected_for_it(tmp_path):
    settings = {**SMALL, "sensor.noise_sigma": 0.3}
    sampled = api.sample_views("anatomy", tmp_path, 1, settings)
    assert sampled.places == []
    assert set(sampled.rejected) - {NO_HIGHLIGHT}
    written = json.loads((tmp_path / "views.json").read_text())
    assert written == {"tried": 10, "accepted": [], "rejected": sampled.rejected}


def test_only_anatomies_are_sampled(tmp_path):
    with pytest.raises(InputError, match=r"surface\.type = plane"):
        api.sample_views("plane", tmp_path)
    with pytest.raises(InputError, match="count = 0"):
        api.sample_views("anatomy", tmp_path, 0)
