"""The ways of a picture and of an experiment to their pages are straight."""

import numpy as np
import pytest
from test_imaging import frame, save

from studies.ways import layers, trace


def test_layers_are_those_of_the_contract():
    height = layers()
    assert height["cli"] > height["validation"] > height["reconstruction"] > height["detection"] > height["pages"]
    assert height["detection"] == height["estimators"]


@pytest.mark.parametrize("detector", [pytest.param("colour", marks=pytest.mark.ci), "peaks"])
def test_a_picture_climbs_four_times_through_five_packages(tmp_path, detector):
    picture = frame() if detector == "colour" else np.repeat(frame().mean(axis=2)[:, :, None], 3, axis=2)
    file = save(tmp_path / "shot.png", picture)
    with pytest.warns(UserWarning, match="angles depend"):
        way = trace("reconstruct", str(file), ["--fov", "60", "--detector", detector])
    assert way.passed == [
        "reconstruction", "calibration", "reconstruction", "detection", "calibration", "reconstruction", "detection",
        "calibration", "reconstruction", "estimators", "reconstruction", "pages",
    ]  # fmt: skip
    assert way.climbs == 4


@pytest.mark.ci
def test_an_experiment_goes_down_to_its_rows_and_comes_back_to_its_page():
    way = trace("validate", "overview", ["--realisations", "1"])
    assert set(way.passed) == {"spec", "validation", "report"}
    assert way.climbs <= 6
    assert len(way.names) <= 45
