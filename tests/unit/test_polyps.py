"""Masks of polyps: on stalks, behind metal, in a frame's files and in a dataset; of domes see tests/laws/labels.py."""

import json

import numpy as np
import pytest

from simtest.dataset.fields import BY_NAME
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.dataset.shard import decode
from simtest.dataset.verify import check_sample
from simtest.rendering import Session
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import write_frame
from simtest.spec import scene_from_dict
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate

pytestmark = pytest.mark.render
POLYPS = [{"along_mm": 50, "around_deg": 80, "height_mm": 4, "width_mm": 8, "steepness": 4},
          {"along_mm": 60, "around_deg": -60, "height_mm": 8, "width_mm": 6, "neck_mm": 2.4}]  # fmt: skip
CAMERA = {"width": 96, "height": 72, "fx": 40.0, "fy": 40.0}


def scene(polyps=POLYPS, **more):
    surface = {"type": "anatomy", "path": "colon", "viewpoint": 14, "recipe": {"polyps": polyps}}
    return scene_from_dict({"surface": surface, "camera": CAMERA, **more})


@pytest.fixture(scope="module")
def session():
    return Session(scene())


def test_a_stalk_is_where_its_points_were_lifted_and_a_dome_where_the_wall_is_nearer(session):
    session.update(scene())
    truth, tube = session.truth(), session.surface.tube
    seen = truth.mask
    points = session.to_model(truth.position[seen])
    # Lifted along the axis: how far from where the point was before the map
    stalk = tube._stalks[1]
    lifted = (points - stalk.undo(points)) @ stalk.axis / 8
    u, v, radial = tube.slice_of(points)
    bare = Session(scene([])).surface.tube
    dome = (bare.radius(u, v, second=False).value - radial) / 4
    # What `slice_of` finds of a point on the stalk is where it came from.
    wanted = np.where(lifted > np.maximum(dome, 0.1), 2, np.where(dome > 0.1, 1, 0))
    sure = (np.abs(lifted - 0.1) > 2e-3) & (np.abs(dome - 0.1) > 2e-3)
    assert np.bincount(wanted[sure]).min() > 100
    for maps in (truth, session.frame().labels):
        np.testing.assert_array_equal(maps.polyp[seen][sure], wanted[sure])
    np.testing.assert_array_equal(session.truth(3).polyp, truth.polyp[::3, ::3])


def test_metal_hides_a_polyp(session):
    session.update(scene())
    row, column = np.argwhere(session.truth().polyp == 1).mean(axis=0).astype(int)
    tip = [(column + 0.5) / CAMERA["width"], (row + 0.5) / CAMERA["height"]]
    session.update(scene(instruments=[{"kind": "shaft", "tip": tip, "diameter_mm": 3.0, "depth_share": 0.8}]))
    for maps in (session.truth(), session.frame().labels):
        metal = maps.instrument > 0
        assert metal[row, column]
        assert not maps.polyp[metal].any()
        assert (maps.polyp == 1).any()


def test_a_frame_is_written_with_its_polyps_and_without_any_where_there_are_none(tmp_path):
    for polyps, present in ((POLYPS, True), ([], False)):
        made = make_frame(scene(polyps))
        write_frame(made, tmp_path / str(present))
        arrays = np.load(tmp_path / str(present) / "truth.npz")
        described = json.loads((tmp_path / str(present) / "frame.json").read_text(encoding="utf-8"))
        assert ("polyp" in arrays) == ("polyps" in described) == ("polyp" in described["fields"]) == present
        if present:
            np.testing.assert_array_equal(arrays["polyp"], made.truth.polyp)
            assert [own["height_mm"] for own in described["polyps"]] == [4.0, 8.0]


def test_samples_hold_the_masks_of_drawn_polyps():
    family = {
        "scene": "anatomy",
        "set": {f"camera.{key}": value for key, value in CAMERA.items()} | {"surface.recipe.polyp_stalked": 0.0},
        "seeds": {"low": 0, "high": 3},
        "per_anatomy": {"surface.recipe.polyp_count": {"choose": [0, 12]}},
    }
    described = {"name": "polyps", "samples": 2, "seed": 1, "samples_per_anatomy": 1, "highlights": 0,
                 "families": [family], "splits": {"train": 1, "validation": 0, "test": 0},
                 "estimators": ["cone_axis"]}  # fmt: skip
    plan = Plan(validate(Dataset, described, "polyps"))
    assert BY_NAME["polyp"] in plan.fields
    maker, drawn, highest = Maker(plan), [], []
    for index in range(2):
        sample = maker.make(index)
        drawn.append(sample.meta["drawn"]["surface.recipe.polyp_count"])
        listed = sample.meta.get("polyps", [])
        assert len(listed) == drawn[-1]
        members = sample.encode()
        assert ("polyp.png" in members) == bool(listed)
        assert not [fault for fault in check_sample(members, sample.meta) if "polyp" in fault]
        if not listed:
            continue
        back = decode(members, sample.meta).images["polyp"]
        np.testing.assert_array_equal(back, sample.images["polyp"])
        highest.append(int(back.max()))
        short = {**sample.meta, "polyps": listed[:1]}
        assert any("polyp has the value" in fault for fault in check_sample(members, short)) == (highest[-1] > 1)
        del members["polyp.png"]
        assert list(check_sample(members, sample.meta)) == ["has no polyp"]
    assert set(drawn) == {0, 12}
    assert max(highest) > 1
    smooth = {**family, "per_anatomy": {}}
    assert BY_NAME["polyp"] not in Plan(validate(Dataset, {**described, "families": [smooth]}, "polyps")).fields
