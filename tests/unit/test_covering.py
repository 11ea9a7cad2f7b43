"""What covers tissue, debris and what the processor draws: its map, hidden highlights, files, datasets, detection."""

import json
from copy import deepcopy

import numpy as np
import pytest

from simtest.dataset import read
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.dataset.shard_writer import write_dataset
from simtest.dataset.verify import check_sample, verify
from simtest.rendering import Session
from simtest.runtime.processes import make_engine
from simtest.simulation.frame import COVERED, make_frame, render_picture
from simtest.simulation.frame_files import write_frame
from simtest.simulation.sensor import overlaid
from simtest.spec import load_scene
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate
from studies.detection.overlays import drawn_counts

pytestmark = pytest.mark.render

SMALL = {"camera.width": 160, "camera.height": 120, "camera.fx": 80.0, "camera.fy": 80.0, "render.samples_per_pixel": 2,
         "reflectance.albedo.vessels.strength": 0.0}  # fmt: skip
ROUGH = {
    "surface": {"type": "sphere", "radius_mm": 15.0, "distance_mm": 18.0, "side": "inside",
                "relief": {"bands": [{"slope_deg": 6.0, "wavelength_mm": 2.0}]}},
    "reflectance": {"type": "tissue", "film": {"index": 1.35, "alpha": 0.05},
                    "albedo": {"vessels": {"strength": 0.0}, "seed": 2}},
    "rig.lights": [{"position_mm": [2.0, 0.0, 0.0]}],
    "camera": {"width": 160, "height": 120, "fx": 100.0, "fy": 100.0},
    "render.samples_per_pixel": 2,
}  # fmt: skip
DEBRIS = {"reflectance.albedo.debris": {"stool": 0.25, "bile": 0.25, "size_mm": 4.0}}
BOX = {"sensor.overlay": {"boxes": [{"x": 0.5, "y": 0.0, "width": 0.5, "height": 1.0}]}}


@pytest.fixture(scope="module")
def frames():
    described = {"clean": {}, "debris": DEBRIS, "box": BOX, "both": DEBRIS | BOX}
    return {name: make_frame(load_scene("sphere", deepcopy(ROUGH) | keys)) for name, keys in described.items()}


def under(frame, points):
    return np.array([frame.covering[int(point.bp_px[1]), int(point.bp_px[0])] for point in points])


def test_what_is_drawn_lies_over_debris(frames):
    assert frames["clean"].covering is None
    drawn = overlaid(frames["box"].scene.sensor.overlay, (120, 160))
    np.testing.assert_array_equal(frames["box"].covering, np.where(drawn, 3, 0))
    np.testing.assert_array_equal(frames["both"].covering, np.where(drawn, 3, frames["debris"].covering))
    shares = np.bincount(frames["debris"].covering.ravel(), minlength=4) / drawn.size
    assert (shares[:3] > 0.08).all()
    assert shares[3] == 0


def test_highlights_below_stool_and_below_what_is_drawn_are_hidden_and_all_others_stay(frames):
    clean = frames["clean"]
    for name in ("debris", "box", "both"):
        made = frames[name]
        # The points are where they were: neither stool nor a box has a shape.
        order = {tuple(point.bp_px): point for point in clean.highlights}
        assert order.keys() == {tuple(point.bp_px) for point in made.highlights}
        below = np.isin(under(made, made.highlights), (1, 3))
        assert 5 < below.sum() < len(below) - 5
        for point, hidden in zip(made.highlights, below, strict=True):
            assert (point.hidden, point.why_not == COVERED) == (hidden, hidden)
            assert point.lit == (order[tuple(point.bp_px)].lit and not hidden)
        np.testing.assert_array_equal(made.truth.normal, clean.truth.normal)
        below = np.isin(under(made, made.clouds), (1, 3))
        assert [point.hidden for point in made.clouds] == below.tolist()
        assert not any(point.lit and hidden for point, hidden in zip(made.clouds, below, strict=True))
    assert any(point.hidden for name in ("debris", "box", "both") for point in frames[name].clouds)
    # A negative control: bile hides nothing.
    assert any(point.lit for point in frames["debris"].highlights if under(frames["debris"], [point])[0] == 2)


def test_no_visible_highlight_lies_where_nothing_of_it_is_seen(frames):
    """Its peak is a pixel of light off the film, which stool has not, and which is not drawn over."""
    for name in ("debris", "box", "both"):
        made = frames[name]
        peaks = np.array([spot.peak_px for spot in made.visible_highlights], dtype=int)
        on = made.covering[peaks[:, 1], peaks[:, 0]]
        assert not (on == 3).any()
        # Of a pixel's two samples one may see the tissue beside stool.
        assert (on == 1).mean() < 0.15
    assert len(frames["box"].visible_highlights) < len(frames["clean"].visible_highlights)


def test_files_hold_the_map_and_frames_without_it_are_written_as_ever(frames, tmp_path):
    for name in ("clean", "both"):
        write_frame(frames[name], tmp_path / name)
        truth = np.load(tmp_path / name / "truth.npz")
        described = json.loads((tmp_path / name / "frame.json").read_text())
        assert ("covering" in truth) == ("covering" in described["fields"]) == (name == "both")
        text = json.dumps(described["scene"])
        assert all((word in text) == (name == "both") for word in ('"debris"', "stool"))
        assert not any(word in text for word in ('"fringe"', '"denoising"', '"interlacing"', '"insets"'))
    np.testing.assert_array_equal(np.load(tmp_path / "both" / "truth.npz")["covering"], frames["both"].covering)


def test_a_picture_alone_is_the_frames(frames):
    """Its exposure asks for the isolated highlights as well."""
    scene = load_scene("sphere", deepcopy(ROUGH) | DEBRIS | BOX | {"sensor.exposure": {}})
    np.testing.assert_array_equal(render_picture(Session(scene), scene), make_frame(scene).image)


@pytest.mark.slow
def test_samples_hold_the_map_where_their_scene_is_covered(tmp_path):
    stool = {"reflectance.albedo.debris.stool": {"low": 0.1, "high": 0.3}}
    colon = {"scene": "tissue_colon", "set": SMALL | {"reflectance.albedo.debris": {}}, "seeds": {"high": 9}}
    families = [
        colon | {"per_anatomy": stool},
        {"scene": "sphere", "set": {"camera.width": 64, "camera.height": 48} | BOX},
        {"scene": "cylinder", "set": {"camera.width": 64, "camera.height": 48}},
    ]
    described = {"name": "covered", "samples": 3, "samples_per_anatomy": 1, "highlights": 0, "families": families}
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis"]}
    recipe = validate(Dataset, described, "covered")
    write_dataset(recipe, tmp_path / "covered", make_engine())
    assert verify(tmp_path / "covered") == []
    maker = Maker(Plan(recipe))
    soiled = next(each for each in map(maker.make, range(3)) if each.meta["anatomy"]["family"] == 0)
    members = soiled.encode()
    del members["covering.png"]
    assert list(check_sample(members, soiled.meta)) == ["has no covering"]
    found = {record["meta"]["anatomy"]["family"]: record["covering"] for record in read(tmp_path / "covered")}
    assert {family: set(np.unique(values)) for family, values in found.items()} == {0: {0, 1}, 1: {0, 3}, 2: {0}}
    assert all(values.dtype == np.uint8 for values in found.values())


def test_detection_answers_on_nothing_that_is_drawn_and_loses_no_tissue():
    """Text, squares, coloured and black boxes and an inset, by exact masks; the study has more viewpoints."""
    (_, made), *_ = drawn_counts((3,), **{"reflectance.albedo.vessels.strength": 0.0})
    # Without the mask the squares and some characters are taken for highlights.
    assert made.kept_on_overlays >= 20
    assert made.on_overlays == 0
    assert made.tissue >= 40
    assert made.hidden <= 0.02 * made.tissue
