"""What samples of a dataset hold: two truths of a relief, instruments, and estimates of the stored picture."""

import hashlib
import json
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from scipy.ndimage import label

import simtest
from simtest.dataset import calibration_of, fields, read
from simtest.dataset.card import make_card, write_preview
from simtest.dataset.index import ESTIMATES, HIGHLIGHTS, SAMPLES
from simtest.dataset.maker import Maker
from simtest.dataset.manifest import read_manifest
from simtest.dataset.plan import Plan
from simtest.dataset.shard import decode, read_member, samples
from simtest.dataset.shard_writer import write_dataset
from simtest.dataset.verify import check_sample, verify
from simtest.errors import Failure, InputError
from simtest.estimators import load_estimators
from simtest.rendering import Session
from simtest.runtime.processes import make_engine
from simtest.simulation.frame import render_view
from simtest.spec import Experiment, load_dataset
from simtest.spec.recipes import Dataset, Family
from simtest.spec.spec_model import validate
from simtest.validation.cases import expand, swept_example
from simtest.validation.columns import table
from simtest.validation.realisation import Realiser, realise
from simtest.validation.statistics import figures

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


@pytest.mark.parametrize("name", ["normal_base", "pool"])
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


MEAN_OF = {
    "an unresolved relief": {
        "surface.relief": {"bands": [{"slope_deg": 3.0, "wavelength_mm": 0.02}]},
        "render.samples_per_pixel": 64,
    },
    "a motion": {"camera.motion": {"velocity_mm_s": [300.0, 0.0, 0.0]}},
}


@pytest.mark.parametrize("values", MEAN_OF.values(), ids=MEAN_OF)
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


METAL_CAMERA = {"camera.width": 96, "camera.height": 72, "camera.fx": 72.0, "camera.fy": 72.0}
INSTRUMENTS = {"instruments": [{"kind": "grasper", "diameter_mm": 2.0, "alpha": 0.1}]}
DRAWN = {
    "instruments.0.present": {"choose": [True, False]},
    "instruments.0.azimuth_deg": {"low": -30.0, "high": 30.0},
    "instruments.0.depth_share": {"low": 0.5, "high": 0.9},
}


def metal_recipe(settings, drawn):
    family = {"scene": "sphere", "set": METAL_CAMERA | settings, "per_sample": drawn}
    described = {"name": "metal", "samples": 6, "samples_per_anatomy": 6, "highlights": 0, "families": [family]}
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis"]}
    return validate(Dataset, described, "metal")


@pytest.fixture(scope="module")
def with_metal(tmp_path_factory):
    folder = tmp_path_factory.mktemp("metal") / "metal"
    write_dataset(metal_recipe(INSTRUMENTS, DRAWN), folder, make_engine())
    return folder


def test_samples_hold_the_map_and_say_how_much_is_metal(with_metal):
    assert verify(with_metal) == []
    records = list(read(with_metal))
    shares = [record["meta"]["instrument_share"] for record in records]
    present = [record["meta"]["drawn"]["instruments.0.present"] for record in records]
    assert 0 < sum(present) < len(present)
    for record, share, there in zip(records, shares, present, strict=True):
        metal = record["instrument"]
        assert metal.dtype == np.uint8
        assert set(np.unique(metal)) <= {0, 1}
        assert (share > 0.02) == there
        assert np.mean(metal > 0) == share
        on = metal > 0
        # Depth and normals are the instrument's, before the sphere; its curvature has no value.
        assert np.isfinite(record["depth"][on]).all()
        assert np.isfinite(record["normal"][on]).all()
        assert np.isnan(record["curvature"][on]).all()
        assert np.isfinite(record["curvature"][~on & np.isfinite(record["depth"])]).all()
    index = pl.read_parquet(with_metal / SAMPLES)
    assert index["instrument_share"].to_list() == shares
    assert "on_instrument" in pl.read_parquet(with_metal / ESTIMATES).columns


def test_poses_lead_to_the_surface(with_metal):
    for record in read(with_metal):
        pose = np.array(record["meta"]["world_from_camera"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        # The world is the surface's own frame: all true highlights lie on one sphere about (0, 0, -R).
        radius = record["meta"]["scene"]["surface"]["radius_mm"]
        for highlight in record["meta"]["highlights"]:
            place = pose[:3, :3] @ highlight["position_mm"] + pose[:3, 3]
            assert np.linalg.norm(place + np.array([0, 0, radius])) == pytest.approx(radius, rel=1e-9)


def test_card_and_preview_show_instruments(with_metal, tmp_path):
    plan = Plan(metal_recipe(INSTRUMENTS, DRAWN))
    card = make_card(plan, read_manifest(with_metal))
    assert "KEY.instrument.png" in card
    assert "on_instrument" in card
    page = write_preview(with_metal, tmp_path / "page.html", 6).read_text(encoding="utf-8")
    # A picture's title stands twice.
    assert page.count("instruments, by number") == 2 * sum(r["meta"]["instrument_share"] > 0 for r in read(with_metal))


def test_map_of_an_instrument_that_is_not_listed_is_a_fault(with_metal):
    with next(with_metal.glob("*.tar")).open("rb") as file:
        stored = next(iter(samples(file)))
        members = {suffix: read_member(file, stored, suffix) for suffix in stored.members if suffix != "json"}
    assert list(check_sample(members, stored.meta)) == []
    members["instrument.png"] = members["image.png"]
    assert any("instrument" in fault for fault in check_sample(members, stored.meta))
    del members["instrument.png"]
    assert list(check_sample(members, stored.meta)) == ["has no instrument"]


def test_without_instruments_nothing_is_stored(tmp_path):
    plain = metal_recipe({}, {"surface.radius_mm": {"low": 20.0, "high": 30.0}})
    plain = plain.model_copy(update={"samples": 1})
    write_dataset(plain, tmp_path / "plain", make_engine())
    (record,) = read(tmp_path / "plain")
    assert not record["instrument"].any()
    assert "instrument_share" not in record["meta"]
    assert "instruments" not in record["meta"]["scene"]
    assert "instrument_share" not in pl.read_parquet(tmp_path / "plain" / SAMPLES).columns
    assert "on_instrument" not in pl.read_parquet(tmp_path / "plain" / ESTIMATES).columns
    assert "instrument" not in make_card(Plan(plain), read_manifest(tmp_path / "plain"))


def realised(*instruments):
    listed = {"instruments": list(instruments)} if instruments else {}
    described = {
        "name": "metal",
        "groups": [{"label": "metal", "scene": "sphere", "set": METAL_CAMERA | listed | {"sensor.noise_sigma": 0.002}}],
        "realisations": 1,
        "estimators": ["cone_axis"],
    }
    experiment = validate(Experiment, described, "metal")
    (case,) = expand(experiment)
    made = Realiser(None).make(experiment, case, 0, load_estimators(experiment.estimators))
    return made, table(made.rows, swept_example([case]))


def test_detection_on_an_instrument_is_counted_as_such():
    # Beside the sphere's highlight, which stays.
    made, rows = realised({"tip": [0.72, 0.5], "depth_share": 0.7, "diameter_mm": 2.0, "alpha": 0.1, "azimuth_deg": 15})
    on = rows["on_instrument"].to_list()
    assert any(on)
    for i, specularity in enumerate(made.specularities):
        column, row = specularity.region.peak
        expected = bool(made.view.instruments[row, column]) and i not in made.matched
        assert {value for value, number in zip(on, rows["specularity"], strict=True) if number == i} == {expected}
    found = figures(rows)
    assert found.n_ok == 1
    assert found.n_instrument == sum(on)
    false = (not metal and true is None for metal, true in zip(on, rows["true_id"], strict=True))
    assert found.n_false == sum(false)
    assert found.model_dump(exclude_unset=True)["n_instrument"] == found.n_instrument


def test_without_instruments_results_have_no_further_column():
    _, rows = realised()
    assert "on_instrument" not in rows.columns
    assert "n_instrument" not in figures(rows).model_dump(exclude_unset=True)


CLOUDY = {
    "surface.distance_mm": 25.0, "reflectance.exponent": 400.0, "camera.width": 160, "camera.height": 120,
    "camera.fx": 110.0, "camera.fy": 110.0, "sensor.point_spread_px": 0.3, "sensor.noise_sigma": 0.0, "sensor.bits": 8,
    "sensor.response": {"type": "srgb"}, "surface.relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]},
}  # fmt: skip


def planes(values, **recipe):
    """A recipe of one family of planes with these values."""
    told = {"samples": 1, "highlights": 0, "splits": {"train": 1.0, "validation": 0.0, "test": 0.0}, "per_sample": {}}
    data = load_dataset("tiny").model_dump(mode="json", exclude_unset=True) | {"name": "planes", **told, **recipe}
    return validate(Dataset, data | {"families": [Family(scene="plane", set=values)]}, "planes")


def test_a_cloud_in_a_dataset_is_scored_as_in_an_experiment():
    plan = Plan(planes(CLOUDY | {"surface.tilt_deg": 20.0}, estimators=["cone_axis", "cloud"]))
    stored = Maker(plan).make(0).meta["estimates"]
    group = {"scene": "plane", "set": CLOUDY}
    experiment = validate(Experiment, {"name": "same", "realisations": 1, "groups": [group]}, "experiment")
    scene = plan.draw(0).scene
    session = Session(scene, "llvm_ad_rgb", labelled=True)
    view = render_view(session, scene)
    estimators = load_estimators(plan.dataset.estimators)
    made = realise(session, experiment, expand(experiment)[0], 0, view, {}, estimators)
    told = {
        (row["estimator"], row["specularity"], row["true_id"], row.get("error_deg"))
        for row in made.rows
        if row["estimator"] == "cloud"
    }
    own = [row for row in stored if row["estimator"] == "cloud"]
    assert any(row["status"] == "ok" and row.get("error_deg") < 5 for row in own)
    assert {(row["estimator"], row.get("specularity"), row["true_id"], row.get("error_deg")) for row in own} == told
    # What is of single highlights is the same too, but for their numbers in the list of all.
    count = {"ok": 0, "missed": 0}
    for row in stored:
        if row["estimator"] == "cone_axis" and "true_id" in row:
            count[row["status"]] = count.get(row["status"], 0) + 1
            assert view.highlights[row["true_id"]].isolated
    assert count["ok"] == sum(row["estimator"] == "cone_axis" and row.get("error_deg") is not None for row in made.rows)


SMALL = {"camera.width": 96, "camera.height": 72, "camera.fx": 80.0, "camera.fy": 80.0, "reflectance.exponent": 120.0}
NOISY = {"sensor.full_well": 20_000.0, "sensor.read_noise": 5.0}
SENSORS = {
    "linear, overexposed, a given distance": {"sensor.exposure.gain": 4.0, "known.distance_error": 0.1},
    "of 12 bits, a given distance": NOISY | {"sensor.bits": 12, "known.distance_error": -0.2},
    "of a response that is not known": NOISY | {"sensor.bits": 10, "sensor.response.type": "gamma",
                                               "sensor.response_known": False},
    "linear, a response that is not known": {"sensor.response_known": False, "sensor.noise_sigma": 0.01},
}  # fmt: skip


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_stored_estimates_are_those_of_the_stored_picture(sensor):
    names = ["bisector", "cone_axis", "curved"]
    plan = Plan(planes(SMALL | {"surface.tilt_deg": 10.0} | sensor, estimators=names))
    members = Maker(plan).make(0).encode()
    meta = json.loads(members["json"])
    picture = decode(members, meta).images["image"]
    found = simtest.reconstruct(picture, calibration_of(meta), names, detector="peaks")
    assert [list(each.region.box) for each in found] == [each["box_px"] for each in meta["detections"]]
    stored = {(row["specularity"], row["estimator"]): row for row in meta["estimates"] if "specularity" in row}
    assert stored.keys() == {(i, name) for i in range(len(found)) for name in names} != set()
    for (i, name), row in stored.items():
        result = found[i].estimates[name]
        if isinstance(result, Failure):
            assert row["status"] == str(result.reason)
            continue
        assert [row[f"normal_{axis}"] for axis in "xyz"] == result.normal.tolist()
        assert [row["look_x_px"], row["look_y_px"]] == result.look_px.tolist()
        assert [row[f"cov_{place}"] for place in ("11", "12", "22")] == result.covariance[[0, 0, 1], [0, 1, 1]].tolist()
        assert row.get("flags", "") == ",".join(result.flags)


def test_a_normal_that_leans_away_is_its_triangles_if_the_base_leans_away():
    """Interpolated normals lean away at the silhouette of a mesh; a fine normal may do so on a sound base."""
    position = np.tile([0.0, 0.0, 10.0], (1, 3, 1))
    towards, away, flat = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.1, 1.0]), np.array([0.0, 0.6, -0.8])
    seen = SimpleNamespace(
        position=position, depth=np.full((1, 3), 10.0), polyp=None, pool=np.zeros((1, 3), bool),
        normal=np.array([[towards, away, away]]), normal_base=np.array([[towards, towards, away]]),
        geometric_normal=np.array([[flat, flat, flat]]),
        **{name: np.zeros((1, 3)) for name in ("k_min", "k_max", "k_min_base", "k_max_base")},
    )  # fmt: skip
    maker = SimpleNamespace(plan=SimpleNamespace(dataset=SimpleNamespace(exact=False)))
    drawn = SimpleNamespace(scene=SimpleNamespace(instruments=(), surface=SimpleNamespace(relief=object())))
    truth = Maker._truth(maker, drawn, SimpleNamespace(labels=seen))
    np.testing.assert_array_equal(truth["normal"], [[towards, away, flat]])
    np.testing.assert_array_equal(truth["normal_base"], [[towards, towards, flat]])
