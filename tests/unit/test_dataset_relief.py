"""Datasets of surfaces with a relief: both truths stored, drawn, read, and checked."""

import hashlib
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from scipy.ndimage import label

from simtest.dataset import fields, read
from simtest.dataset.card import make_card, write_preview
from simtest.dataset.index import HIGHLIGHTS
from simtest.dataset.maker import Maker
from simtest.dataset.manifest import read_manifest
from simtest.dataset.plan import Plan
from simtest.dataset.shard import read_member, samples
from simtest.dataset.shard_writer import write_dataset
from simtest.dataset.verify import check_sample, verify
from simtest.errors import InputError
from simtest.runtime.processes import make_engine
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate

pytestmark = pytest.mark.render

CAMERA = {"camera.width": 64, "camera.height": 48, "camera.fx": 48.0, "camera.fy": 48.0}
RELIEF = {"surface.relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}}
ROUGH = {
    "scene": "sphere",
    "set": CAMERA | RELIEF,
    "per_sample": {
        "surface.relief.bands.0.slope_deg": {"low": 2.0, "high": 8.0},
        "surface.relief.seed": {"low": 0, "high": 2**32 - 1, "integer": True},
    },
}
SMOOTH = {"scene": "sphere", "set": CAMERA}


def recipe(**values):
    described = {"name": "two", "samples": 4, "samples_per_anatomy": 1, "highlights": 0, "families": [ROUGH, SMOOTH]}
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis"]}
    return validate(Dataset, described | values, "two")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("relief") / "two"
    write_dataset(recipe(), folder, make_engine())
    return folder


def angle_deg(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def is_rough(record):
    return record["meta"]["scene"]["surface"]["relief"] is not None


def test_samples_hold_both_truths_and_smooth_ones_hold_one(made):
    assert verify(made) == []
    records = list(read(made))
    rough = [record for record in records if is_rough(record)]
    assert len(rough) == 2
    assert len(records) == 4
    # Each sample has a relief of its own.
    assert len({record["meta"]["drawn"]["surface.relief.seed"] for record in rough}) == 2
    for record in records:
        fine, base = record["normal"], record["normal_base"]
        seen = np.isfinite(record["depth"])
        assert record["pool"].shape == seen.shape
        assert record["pool"].dtype == bool
        assert not record["pool"].any()
        if not is_rough(record):
            assert base is fine
            assert record["curvature_base"] is record["curvature"]
            continue
        # The drawn slope shows, and the base is a sphere.
        slope = record["meta"]["drawn"]["surface.relief.bands.0.slope_deg"]
        assert np.mean(angle_deg(fine, base)[seen]) == pytest.approx(np.sqrt(np.pi / 2) * slope, rel=0.35)
        radius = record["meta"]["scene"]["surface"]["radius_mm"]
        np.testing.assert_allclose(record["curvature_base"][seen], 1 / radius, atol=1e-4)
        assert np.abs(record["curvature"][seen] - 1 / radius).max() > 0.1


def test_smooth_samples_store_no_base(made):
    """Their members are those of a dataset without a relief."""
    names = {}
    for shard in made.glob("*.tar"):
        with shard.open("rb") as file:
            for stored in samples(file):
                names[stored.meta["index"]] = (stored.meta["scene"]["surface"]["relief"] is None, set(stored.members))
    base = {"normal_base.png", "curvature_base.png", "pool.png"}
    for smooth, members in names.values():
        assert members & base == (set() if smooth else base)


@pytest.mark.parametrize("name", ["normal_base", "curvature_base", "pool"])
def test_one_field_alone_is_read_as_well(made, name):
    for whole, alone in zip(read(made), read(made, fields=[name]), strict=True):
        assert set(alone) == {"meta", name}
        np.testing.assert_array_equal(alone[name], whole[name])


def test_tables_and_highlights_hold_both_truths(made):
    highlights = pl.read_parquet(made / HIGHLIGHTS)
    for record in read(made, fields=["image"]):
        meta = record["meta"]
        rows = highlights.filter(pl.col("index") == meta["index"])
        assert rows["normal_base_z"].to_list() == [own["normal_base"][2] for own in meta["highlights"]]
        assert rows["pool"].to_list() == [False] * rows.height
        off = [angle_deg(np.array(own["normal"]), np.array(own["normal_base"])) for own in meta["highlights"]]
        assert max(off) > 0.1 if is_rough(record) else max(off) == 0.0
        for estimate in meta["estimates"]:
            if "error_deg" in estimate:
                assert estimate["target"] == "fine"
                assert estimate["error_fine_deg"] == estimate["error_deg"]
                assert is_rough(record) or estimate["error_base_deg"] == estimate["error_deg"]


@pytest.mark.slow
def test_the_same_seeds_give_the_same_reliefs(made, tmp_path):
    write_dataset(recipe(), tmp_path / "again", make_engine())
    one, other = (
        {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.tar")}
        for folder in (made, tmp_path / "again")
    )
    assert one == other


def stored_rough(made):
    for shard in made.glob("*.tar"):
        with shard.open("rb") as file:
            for stored in samples(file):
                if stored.meta["scene"]["surface"]["relief"]:
                    return {s: read_member(file, stored, s) for s in stored.members if s != "json"}, stored.meta
    raise AssertionError


def recoded(members, name, change):
    field = fields.BY_NAME[name]
    return members | {field.suffix: field.codec.encode(change(field.codec.decode(members[field.suffix], {})))}


DAMAGE = {
    "base missing": (lambda m: {s: d for s, d in m.items() if s != "normal_base.png"}, "has no normal_base"),
    "pool missing": (lambda m: {s: d for s, d in m.items() if s != "pool.png"}, "has no pool"),
    "fine turned": (lambda m: recoded(m, "normal", lambda n: n[..., [1, 2, 0]]), "fine normals are"),
    "fine not there": (lambda m: recoded(m, "normal", lambda n: n * np.nan), "not there at the same pixels"),
    "base away": (lambda m: recoded(m, "normal_base", lambda n: -n), "do not face the camera"),
    "curvatures swapped": (lambda m: recoded(m, "curvature", lambda k: k[..., ::-1]), "k_min of the fine surface"),
}


@pytest.mark.parametrize(("damage", "said"), DAMAGE.values(), ids=DAMAGE)
def test_a_wrong_truth_is_found(made, damage, said):
    members, meta = stored_rough(made)
    assert list(check_sample(members, meta)) == []
    assert any(said in fault for fault in check_sample(damage(members), meta))


def test_card_and_preview_tell_both_truths(made, tmp_path):
    plan, manifest = Plan(recipe()), read_manifest(made)
    card = make_card(plan, manifest)
    assert "KEY.normal_base.png" in card
    assert "There are two truths" in card
    smooth = make_card(Plan(recipe(families=[SMOOTH], samples=1)), manifest)
    assert "KEY.normal_base.png" not in smooth
    assert "have no relief" in smooth
    page = write_preview(made, tmp_path / "preview.html")
    assert page.read_text().count("<figcaption>normal of the base, without the relief") == 2


UNRESOLVED = [
    {"surface.relief": {"bands": [{"slope_deg": slope_deg, "wavelength_mm": 0.02}]}, "render.samples_per_pixel": 64}
    for slope_deg in (1.0, 3.0)
]
MOVED = [{"camera.motion": {"velocity_mm_s": [speed, 0.0, 0.0]}} for speed in (100.0, 300.0)]


@pytest.mark.parametrize("values", [*UNRESOLVED, *MOVED])
def test_a_highlight_that_is_a_mean_is_the_pixels_above_half_of_it(values):
    """Its peak was that without relief, or of the middle of the exposure: too few pixels or none reached half of it."""
    camera = {"camera.width": 96, "camera.height": 72, "camera.fx": 96.0, "camera.fy": 96.0}
    family = {"scene": "sphere", "set": camera | {"reflectance.exponent": 200.0} | values}
    maker = Maker(Plan(recipe(samples=1, families=[family])))
    made, (_, view, _) = maker.make(0), maker.view(0)
    (highlight,) = made.meta["highlights"]
    assert highlight["isolated"]
    numbers, _ = label(view.lobe >= view.lobe.max() / 2)
    column, row = (int(v) for v in highlight["bp_px"])
    expected = numbers == numbers[row, column]
    assert numbers[row, column] > 0
    np.testing.assert_array_equal(made.images["instance"] == 1, expected)
    assert highlight["region"]["instance_px"] == np.count_nonzero(expected) > 5
    if "surface.relief" in values:
        # It was 0.03 to 0.1 px.
        area = highlight["region"]["instance_px"]
        assert highlight["radius_px"] == pytest.approx(np.sqrt(area / np.pi), rel=0.25)


def test_a_relief_of_a_whole_surface_that_is_drawn_counts():
    """Card and index left out the fields of the base, and shards were planned too long."""
    smooth = {"type": "plane", "distance_mm": 20.0}
    for others, counts in (([], False), ([smooth | {"relief": RELIEF["surface.relief"]}], True)):
        family = {"scene": "plane", "per_sample": {"surface": {"choose": [smooth, *others]}}}
        assert Plan(recipe(families=[family])).has_relief == counts


def test_ranges_that_make_too_high_a_relief_are_refused():
    wide = ROUGH | {"per_sample": {"surface.relief.bands.0.wavelength_mm": {"low": 1.0, "high": 15.0}}}
    with pytest.raises(InputError, match=r"families\.0.*must stay below 0\.3 mm"):
        Plan(recipe(families=[wide]))


@pytest.fixture(scope="module")
def with_visible(tmp_path_factory):
    folder = tmp_path_factory.mktemp("visible") / "two"
    smooth = {**SMOOTH, "set": CAMERA | {"reflectance.exponent": 400.0}}
    write_dataset(recipe(visible=True, families=[ROUGH, smooth]), folder, make_engine())
    return folder


def test_the_pixels_of_visible_highlights_are_kept_on_demand(made, with_visible):
    assert all("visible" not in record for record in read(made))
    with pytest.raises(InputError, match=r"sample 000000000 has no visible"):
        list(read(made, fields=["visible"]))
    assert verify(with_visible) == []
    records = list(read(with_visible))
    assert {is_rough(record) for record in records} == {True, False}
    assert sum(len(record["meta"]["visible_highlights"]) for record in records) >= len(records)
    for record in records:
        numbers = record["visible"]
        assert numbers.dtype == np.int32
        for index, spot in enumerate(record["meta"]["visible_highlights"]):
            assert np.count_nonzero(numbers == index + 1) == spot["area_px"]
            column, row = (int(v) for v in spot["peak_px"])
            assert numbers[row, column] == index + 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda n: np.where(n > 0, n + 500, 0), "visible names highlight 5"),
        (lambda n: 0 * n, "has 0 pixels; area_px is"),
    ],
)
def test_wrong_pixels_of_visible_highlights_are_found(with_visible, change, said):
    members, meta = stored_rough(with_visible)
    assert list(check_sample(members, meta)) == []
    assert any(said in fault for fault in check_sample(recoded(members, "visible", change), meta))


def test_a_normal_that_leans_away_is_its_triangles_if_the_base_leans_away():
    """Interpolated normals lean away at the silhouette of a mesh; a fine normal may do so on a sound base."""
    position = np.tile([0.0, 0.0, 10.0], (1, 3, 1))
    towards, away, flat = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.1, 1.0]), np.array([0.0, 0.6, -0.8])
    seen = SimpleNamespace(
        position=position, depth=np.full((1, 3), 10.0), pool=np.zeros((1, 3), bool),
        normal=np.array([[towards, away, away]]), normal_base=np.array([[towards, towards, away]]),
        geometric_normal=np.array([[flat, flat, flat]]),
        **{name: np.zeros((1, 3)) for name in ("k_min", "k_max", "k_min_base", "k_max_base")},
    )  # fmt: skip
    maker = SimpleNamespace(plan=SimpleNamespace(dataset=SimpleNamespace(exact=False)))
    drawn = SimpleNamespace(scene=SimpleNamespace(instruments=(), surface=SimpleNamespace(relief=object())))
    truth = Maker._truth(maker, drawn, SimpleNamespace(labels=seen))
    np.testing.assert_array_equal(truth["normal"], [[towards, away, flat]])
    np.testing.assert_array_equal(truth["normal_base"], [[towards, towards, flat]])
