"""Datasets: plan, fields, shards, resume, verify, reading."""

import hashlib
import json
import platform
import re
import shlex
import shutil
import tarfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import polars as pl
import psutil
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import simtest
from simtest.cli.main import main
from simtest.dataset import calibration_of, fields, png, read
from simtest.dataset.card import CARD, make_card, write_preview
from simtest.dataset.index import FOLDERS, TABLES, shortfall, table_file, write_index, write_shard_tables
from simtest.dataset.maker import Maker, _share_of
from simtest.dataset.manifest import NAME, FileEntry, Manifest, _digest, file_entry, new_manifest, read_manifest
from simtest.dataset.plan import Plan, Shard, _draw
from simtest.dataset.shard import BrokenShardError, decode, finish, read_member, sample_key, samples, write_sample
from simtest.dataset.shard_writer import _write_shards, write_dataset
from simtest.dataset.verify import compare, repair_files, reproduce_sample, verify
from simtest.errors import InputError, SimtestError
from simtest.pages.markdown import escaped, yaml_string
from simtest.runtime import processes
from simtest.runtime.processes import cores_per_task, make_engine
from simtest.simulation.frame_files import write_frame
from simtest.simulation.highlights import FAINT, NO_HIGHLIGHT, REMEDIES, STREAK
from simtest.spec import load_dataset, load_scene, scene_from_dict
from simtest.spec.recipes import Dataset, Distribution, Splits
from simtest.spec.spec_model import validate
from simtest.surfaces.recipe import load_recipe
from simtest.surfaces.tube import Tube
from tests.marked import marked
from tests.unit.engine_tasks import breaks, dies_once, fails, meets_a_full_disk, process, square

ROOT = Path(__file__).resolve().parents[2]
MESH = str(ROOT / "meshes" / "colon_40mm.ply")
SIX = {"samples": 6, "samples_per_anatomy": 1}


def tiny(**values):
    return load_dataset("tiny", values)


def test_every_anatomy_of_the_shipped_colons_can_be():
    plan, redrawn = Plan(load_dataset("endoscopy")), 0
    size = plan.samples_per_anatomy
    for block in range(0, plan.dataset.samples, size):
        if (anatomy := plan.anatomy(block)).family > 1:
            continue
        surface = plan.draw(block).scene.surface
        Tube(load_recipe(surface.file(), surface.recipe_values))
        first = _draw(
            plan.dataset.families[anatomy.family].per_anatomy, plan._rng(f"anatomy {anatomy.family}", anatomy.number)
        )
        redrawn += not first.items() <= plan.draw(block).values.items()
        assert surface.seed == anatomy.seed
    # Two of 27 colons of this seed would be closed by their folds; all others are as they are drawn first.
    assert redrawn == 2


def test_what_can_never_be_says_why(monkeypatch):
    monkeypatch.setattr("simtest.dataset.plan.ANATOMY_DRAWS", 3)
    dataset = load_dataset("endoscopy")
    bent = {"surface.recipe.length_mm": Distribution(low=60.0, high=61.0)}
    family = dataset.families[0].model_copy(update={"per_anatomy": {**dataset.families[0].per_anatomy, **bent}})
    plan = Plan(dataset.model_copy(update={"families": (family,), "samples": 3, "samples_per_anatomy": 1}))
    with pytest.raises(InputError, match="bends into itself"):
        Maker(plan).make(0)


def contents(folder: Path) -> dict[str, str]:
    """Hashes of a dataset's files and, so that a difference names the field, of the members of its shards."""
    held = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for shard in sorted(folder.glob("*.tar")):
        with tarfile.open(shard) as tar:
            held |= {f"{shard.name}: {member.name}": tar.extractfile(member).read() for member in tar}
    return {name: hashlib.sha256(data).hexdigest() for name, data in held.items()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset") / "tiny"
    write_dataset(tiny(**SIX), folder, make_engine())
    return folder


@pytest.fixture
def copy(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "copy"))


# Plan ---------------------------------------------------------------------------------------------------------------


@given(
    samples=st.integers(1, 400), each=st.integers(1, 30), seed=st.integers(0, 99), weight=st.floats(0.1, 9.0)
)  # fmt: skip
@settings(max_examples=25, deadline=None)
def test_plan_shares_samples_out_once_and_no_anatomy_twice(samples, each, seed, weight):
    colon = {"scene": "anatomy", "set": {"surface.path": "colon"}, "seeds": {"low": 5, "high": 10_000}}
    liver = {"scene": "anatomy", "set": {"surface.path": "liver"}, "seeds": {"high": 400}, "weight": weight}
    described = {"name": "d", "samples": samples, "samples_per_anatomy": each, "seed": seed, "families": [colon, liver]}
    plan = Plan(validate(Dataset, described, "d"))
    assert bool(plan.made_small) == (-(-samples // each) < 3)
    everything = [index for shard in plan.shards for index in shard.indices]
    assert sorted(everything) == list(range(samples))
    splits: dict[object, set[str]] = {}
    for index in range(samples):
        splits.setdefault(plan.anatomy(index), set()).add(plan.split(index))
    assert all(len(found) == 1 for found in splits.values())
    names = ("train", "validation", "test")[: min(samples, 3)]
    assert {split for found in splits.values() for split in found} == set(names)
    seeds = [(anatomy.family, anatomy.seed) for anatomy in splits]
    assert len(set(seeds)) == len(seeds)
    # A split misses its share by less than two anatomies.
    train = sum(plan.split(index) == "train" for index in range(samples))
    assert abs(train - 0.8 * samples) <= 2 * max(plan.samples_per_anatomy, 1) or samples < 3


@pytest.mark.render
def test_a_first_try_of_few_samples_is_a_whole_dataset_and_says_what_it_lacks(tmp_path):
    recipe = tiny(samples=4, samples_per_anatomy=20, estimators=())
    with pytest.warns(UserWarning, match="^samples = 4, few for the splits: samples_per_anatomy is 1, not 20$"):
        write_dataset(recipe, tmp_path / "few", make_engine())
    assert verify(tmp_path / "few") == []
    assert {path.name.split("-")[0] for path in (tmp_path / "few").glob("*.tar")} == {"train", "validation", "test"}
    assert "A small dataset: samples = 4" in (tmp_path / "few" / "README.md").read_text()
    plan = Plan(tiny(samples=1, samples_per_anatomy=20))
    assert plan.made_small.endswith("samples_per_anatomy is 1, not 20; validation and test: no sample")
    assert plan.split(0) == "train"


def test_draws_hang_on_index_and_attempt_alone():
    plan, again = Plan(tiny()), Plan(tiny())
    assert [plan.draw(i).scene for i in (3, 1, 2)] == [again.draw(i).scene for i in (3, 1, 2)]
    assert plan.draw(3, 1).values != plan.draw(3, 0).values
    assert plan.draw(3, 1).scene.sensor.seed == plan.draw(3, 0).scene.sensor.seed
    seeds = {plan.draw(i).scene.sensor.seed for i in range(12)}
    assert len(seeds) == 12


@given(
    low=st.floats(1e-3, 1e3), factor=st.floats(1, 100), log=st.booleans(), integer=st.booleans(), seed=st.integers(0, 9)
)
def test_draws_lie_in_their_range(low, factor, log, integer, seed):
    low, high = (np.ceil(low), np.ceil(low * factor)) if integer else (low, low * factor)
    drawn = Distribution(low=low, high=high, log=log, integer=integer).draw(np.random.default_rng(seed))
    assert low * (1 - 1e-12) <= drawn <= high * (1 + 1e-12)
    assert isinstance(drawn, int) == integer


def colons(**more):
    return {"scene": "anatomy", "seeds": {"high": 9}} | more


def test_families_may_have_different_seeds_of_one_recipe():
    drawn = {"per_anatomy": {"surface.path": {"choose": ["liver", "colon"]}}}

    def plan(low, **more):
        families = [colons(**more), colons(seeds={"low": low, "high": 19})]
        data = tiny().model_dump(mode="json", exclude_unset=True)
        return Plan(validate(Dataset, data | {"families": families, "per_sample": {}, "name": "two"}, "two"))

    assert {plan(10).anatomy(i).seed // 10 for i in range(12)} == {0, 1}
    with pytest.raises(InputError, match=r"families.1: .* must have seeds that do not overlap"):
        plan(9)
    # A drawn recipe is held against the others too.
    with pytest.raises(InputError, match=r"families.1: has surface.path = colon.toml in common with families.0"):
        plan(9, set={"surface.path": "liver"}, **drawn)


def test_drawn_recipes_are_among_the_inputs_and_files_of_one_name_stand_apart(tmp_path):
    (tmp_path / "liver.toml").write_bytes((ROOT / "meshes" / "liver.toml").read_bytes() + b"# another\n")
    chosen = ["colon", "liver", str(tmp_path / "liver.toml")]
    data = tiny().model_dump(mode="json", exclude_unset=True) | {"name": "drawn", "per_sample": {}}
    families = [colons(seeds={"high": 99}, per_anatomy={"surface.path": {"choose": chosen}})]
    plan = Plan(validate(Dataset, data | {"families": families}, "drawn"))
    inputs = new_manifest(plan, "llvm_ad_rgb").origin["inputs"]
    assert list(inputs) == ["anatomy.toml", "colon.toml", "liver.toml", "liver.toml (2)"]
    assert len(set(inputs.values())) == 4


def test_a_shard_is_planned_for_the_largest_frames():
    data = tiny().model_dump(mode="json", exclude_unset=True) | {"name": "sizes", "per_sample": {}}
    data["splits"] = {"train": 1.0, "validation": 0.0, "test": 0.0}
    small, large = ({"camera.width": 64 * n, "camera.height": 48 * n} for n in (1, 4))

    def each(families, **more):
        return Plan(validate(Dataset, data | {"families": families, "shard_mb": 2.0} | more, "sizes")).samples_per_shard

    alone = each([{"scene": "plane", "set": large}])
    assert each([{"scene": "plane", "set": small}]) > 15 * alone
    assert each([{"scene": "plane", "set": small}, {"scene": "sphere", "set": large}]) == alone
    drawn = {"camera.width": {"choose": [64, 256]}, "camera.height": {"choose": [48, 192]}}
    assert each([{"scene": "plane", "set": small}], per_sample=drawn) == alone


BAD = {
    "no range": ("per_sample", {"sensor.noise_sigma": {}}, "nothing to draw from"),
    "contradiction": ("per_sample", {"sensor.noise_sigma": {"low": 0.2, "high": 0.1}}, "must not exceed high"),
    "outside": ("per_sample", {"sensor.noise_sigma": {"low": 0.0, "high": 2.0}}, "sensor.noise_sigma = 2.0"),
    "no such key": ("per_sample", {"sensor.noise": {"low": 0.0, "high": 0.1}}, "sensor.noise = 0.0: unknown key"),
    "log of 0": ("per_sample", {"sensor.noise_sigma": {"low": 0, "high": 0.1, "log": True}}, "must be above 0"),
    "splits": ("splits", {"train": 0.5, "test": 0.1}, r"train \+ validation \+ test = 0.6: must be 1"),
    "few anatomies": ("families", [{"scene": "plane"}], "1 anatomies for 3 splits"),
    "estimator": ("estimators", ["cone"], "cone"),
    "weights": ("per_sample", {"sensor.seed": {"choose": [1, 2], "weights": [1]}}, "must be as many"),
    "twice": ("per_sample", {"surface.radius_mm": {"low": 5, "high": 6}}, "drawn twice"),
    "seeds": ("families", [{"scene": "plane", "seeds": {"high": 4}}], "has no seed; leave it out"),
    "anatomy of a sample": (
        "families",
        [colons(per_sample={"surface.seed": {"low": 0, "high": 9, "integer": True}})],
        "surface.seed is drawn for each sample",
    ),
    "a whole anatomy of a sample": (
        "families",
        [{"scene": "plane", "per_sample": {"surface": {"choose": [{"type": "anatomy", "path": "colon"}]}}}],
        "surface is drawn for each sample",
    ),
    "seeds of a mesh": (
        "families",
        [colons(set={"surface.path": MESH})],
        "families.0.seeds: the mesh surface.path = colon_40mm.ply is the same for each seed",
    ),
    "seeds of drawn meshes": (
        "families",
        [colons(per_anatomy={"surface.path": {"choose": ["colon", MESH]}})],
        "families.0.seeds: the mesh surface.path = colon_40mm.ply is the same for each seed",
    ),
    "both": (
        "families",
        [colons(per_anatomy={"surface.tilt_deg": {"low": 0.0, "high": 1.0}})],
        "surface.tilt_deg is drawn for each sample too",
    ),
}


@pytest.mark.parametrize(("key", "value", "said"), BAD.values(), ids=BAD)
def test_what_cannot_be_made_is_refused_before_anything_is_written(key, value, said, tmp_path):
    data = tiny().model_dump(mode="json", exclude_unset=True) | {"name": "bad"}
    with pytest.raises(InputError, match=said):
        write_dataset(validate(Dataset, {**data, key: value}, "bad"), tmp_path / "out", make_engine())
    assert not (tmp_path / "out").exists()


def test_other_folders_are_left_alone(copy, tmp_path):
    with pytest.raises(InputError, match=r"another dataset \(seed = 1 there, 2 here\)"):
        write_dataset(tiny(**SIX, seed=2), copy, make_engine())
    assert contents(copy)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"holds thesis.tex and no dataset"):
        write_dataset(tiny(**SIX), tmp_path / "full", make_engine())
    with pytest.raises(InputError, match="is a file"):
        write_dataset(tiny(**SIX), tmp_path / "full" / "thesis.tex", make_engine())


# Fields -------------------------------------------------------------------------------------------------------------


def test_whole_numbers_may_be_even_in_the_logarithm():
    """`log` was ignored beside `integer`: the median of 1 to 1000 was 517."""
    rng = np.random.default_rng(1)
    drawn = np.array([Distribution(low=1, high=1000, log=True, integer=True).draw(rng) for _ in range(4000)])
    assert (drawn.min(), drawn.dtype.kind) == (1, "i")
    assert drawn.max() <= 1000
    # P(n) = ln((n + 1) / n) / ln(1001), to four standard deviations
    for number in (1, 2, 10):
        share = np.log((number + 1) / number) / np.log(1001)
        assert np.mean(drawn == number) == pytest.approx(share, abs=4 * np.sqrt(share / 4000))
    assert Distribution(low=7, high=7, log=True, integer=True).draw(rng) == 7


def test_settings_of_a_dataset_fix_what_lies_below_them():
    """A drawn `sensor.exposure.average` won over the table that was set, and misspelt keys were taken."""
    dataset = load_dataset("endoscopy", {"sensor.exposure": {"gain": 2.0}})
    assert all(family.set["sensor.exposure"] == {"gain": 2.0} for family in dataset.families)
    assert not [key for family in dataset.families for key in family.per_sample if key.startswith("sensor.exposure")]
    with pytest.raises(InputError, match=r"--set sensr.exposure: unknown key; allowed: .*\(did you mean sensor\?\)"):
        load_dataset("endoscopy", {"sensr.exposure": {"gain": 2.0}})
    with pytest.raises(InputError, match=r"the dataset varies reflectance\.colour as a whole"):
        load_dataset("smooth", {"reflectance.colour.0": 0.5})


@given(seed=st.integers(0, 999), scale=st.floats(1.0, 5e3))
@settings(max_examples=30, deadline=None)
def test_fields_come_back(seed, scale):
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal((5, 7, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = scale * rng.uniform(0.05, 1, (5, 7))
    curvature = rng.uniform(-3, 3, (5, 7, 2))
    for array in (normal, depth, curvature):
        array[2, 3] = np.nan
    meta = {"depth_scale_mm": fields.depth_scale_mm(depth)}
    back = {name: fields.BY_NAME[name].codec.decode(fields.BY_NAME[name].codec.encode(array), meta)
            for name, array in (("normal", normal), ("depth", depth), ("curvature", curvature))}  # fmt: skip
    for array in back.values():
        assert np.isnan(array[2, 3]).all()
    # Half a step, and the rounding of float32 where depths are large.
    assert np.nanmax(np.abs(back["depth"] - depth) - 1.3e-7 * depth) <= 0.51 * meta["depth_scale_mm"]
    assert meta["depth_scale_mm"] < 2.5e-7 * scale
    assert np.nanmax(np.abs(back["curvature"] - curvature)) <= 0.51 * fields.CURVATURE_SCALE
    sine = np.linalg.norm(np.cross(back["normal"], normal), axis=-1)
    assert np.nanmax(np.degrees(np.arcsin(sine))) < 0.015
    assert np.nanmin(np.sum(back["normal"] * normal, axis=-1)) > 0


@pytest.mark.render
def test_stored_depth_gives_the_normals():
    """By differences of neighbouring pixels: a tilted plane's normal is that of its highlight, at each pixel."""
    large = {"camera.width": 160, "camera.height": 120, "camera.fx": 120.0, "camera.fy": 120.0}
    family = {"scene": "plane", "set": large | {"surface.tilt_deg": 30.0, "surface.distance_mm": 30.0}}
    told = {"samples": 1, "families": [family], "splits": {"train": 1.0, "validation": 0.0, "test": 0.0}}
    plan = Plan(validate(Dataset, {"name": "plane", "estimators": [], "exact": True, **told}, "plane"))
    members = Maker(plan).make(0).encode()
    meta = json.loads(members["json"])
    depth = decode(members, meta).images["depth"].astype(float)
    camera = calibration_of(meta).camera
    points = depth[..., None] * camera.unproject(camera.pixel_centres())
    own = np.cross(points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2])
    normal = np.array(meta["highlights"][0]["normal"])
    off = np.degrees(np.arcsin(np.linalg.norm(np.cross(own, normal), axis=-1) / np.linalg.norm(own, axis=-1)))
    assert np.nanmedian(off) < 0.005


# The folder -----------------------------------------------------------------------------------------------------------


def test_dataset_is_sound_and_says_what_it_holds(made):
    assert verify(made) == []
    names = {path.name for path in made.iterdir()}
    plan = read_manifest(made).plan()
    assert {NAME, "README.md", *TABLES} <= names
    for name in FOLDERS:
        assert {path.name for path in (made / name).iterdir()} == {f"{Path(s.name).stem}.parquet" for s in plan.shards}
    assert not any(".part" in name for name in names)
    records = list(read(made))
    assert sorted(record["meta"]["index"] for record in records) == list(range(6))
    for record in records:
        assert record["image"].shape == (48, 64, 3)
        assert record["normal"].shape == (48, 64, 3)
        assert "radiance" not in record
        isolated = [i + 1 for i, h in enumerate(record["meta"]["highlights"]) if h["isolated"]]
        assert set(np.unique(record["instance"])) - {0} == set(isolated)
        # The scene that it names is the one that was rendered.
        assert scene_from_dict(record["meta"]["scene"]).camera.width == 64
    table = pl.read_parquet(made / "highlights.parquet")
    truths = sum(len(record["meta"]["highlights"]) for record in records)
    assert table.height == truths
    assert {r["meta"]["index"] for r in read(made, "train")} == set(
        pl.read_parquet(made / "index.parquet").filter(pl.col("split") == "train")["index"]
    )
    assert "no anatomy" in (made / "README.md").read_text().lower()


def test_truth_is_where_the_highlight_is(made):
    for record in read(made, fields=["normal", "depth", "curvature"]):
        for highlight in record["meta"]["highlights"]:
            column, row = (int(v) for v in highlight["bp_px"])
            seen = record["normal"][row, column]
            # Half a pixel at 64 px is up to a degree of the surface's turn.
            assert seen @ np.asarray(highlight["normal"]) > np.cos(np.radians(6))
            assert abs(record["depth"][row, column] - highlight["distance_mm"]) < 0.2
            kd = np.sort(record["curvature"][row, column]) * highlight["distance_mm"]
            assert np.allclose(kd, (highlight["kd_min"], highlight["kd_max"]), atol=0.05)


def test_same_bytes_again_whole_and_alone(made, tmp_path):
    steps: list[tuple[int, int, str]] = []
    write_dataset(tiny(**SIX), tmp_path / "again", make_engine(), progress=lambda *step: steps.append(step))
    # Progress counts samples, and nothing else.
    assert {total for _, total, _ in steps} == {6}
    assert steps[-1][0] == 6
    assert contents(tmp_path / "again") == contents(made)
    reproduce_sample(made, 4, tmp_path / "alone")
    assert compare(made, 4, tmp_path / "alone").endswith("same bytes")
    (tmp_path / "alone" / "000000004.image.png").write_bytes(b"x")
    assert compare(made, 4, tmp_path / "alone").endswith("differs in image.png")


class StopError(Exception):
    pass


@pytest.mark.parametrize("stop_after", marked([1, 3, 5], ci=[1, 3]))
def test_a_stopped_run_goes_on(made, tmp_path, stop_after):
    told = 0

    def stop(*_):
        nonlocal told
        told += 1
        if told == stop_after:
            raise StopError

    with pytest.raises(StopError):
        write_dataset(tiny(**SIX), tmp_path / "cut", make_engine(), progress=stop)
    with pytest.raises(InputError, match="not finished"):
        read(tmp_path / "cut")
    assert all("not finished" in fault.what for fault in verify(tmp_path / "cut"))
    # The rows of finished shards are final.
    begun = read_manifest(tmp_path / "cut")
    before = {name: (tmp_path / "cut" / name).stat() for name in begun.tables}
    finished = [shard for shard in begun.plan().shards if shard.name in begun.shards]
    assert set(before) == {table_file(shard, name) for shard in finished for name in FOLDERS}
    assert bool(before) == (stop_after == 5)
    write_dataset(tiny(**SIX), tmp_path / "cut", make_engine())
    assert contents(tmp_path / "cut") == contents(made)
    assert {name: (tmp_path / "cut" / name).stat() for name in before} == before


@pytest.mark.ci  # meanwhile: test_a_stopped_run_goes_on[5] and test_damage_is_mended
@given(cut=st.floats(0, 1), noise=st.binary(max_size=600))
@settings(max_examples=12, deadline=None)
def test_a_shard_cut_anywhere_goes_on(made, tmp_path_factory, cut, noise):
    folder = Path(shutil.copytree(made, tmp_path_factory.mktemp("cut") / "copy"))
    manifest = read_manifest(folder)
    name = sorted(manifest.shards)[0]
    data = (folder / name).read_bytes()
    (folder / name).unlink()
    (folder / f"{name}.part").write_bytes(data[: int(cut * len(data))] + noise)
    write_dataset(tiny(**SIX), folder, make_engine())
    assert contents(folder) == contents(made)


@pytest.fixture(scope="module")
def many():
    return Plan(tiny(samples=360, samples_per_anatomy=6, shard_mb=1e-6))


@given(stop=st.integers(1, 360))
@settings(max_examples=15, deadline=None)
def test_the_manifest_is_written_in_proportion_to_the_shards_and_once_more_at_an_end(many, stop):
    manifest, written = new_manifest(many, "llvm_ad_rgb"), []

    def finished():
        for number in range(stop):
            # A kill here leaves few shards to be read again.
            assert len(manifest.shards) - len(written[-1] if written else ()) <= 0.05 * len(manifest.shards)
            yield number, {many.shards[number].name: FileEntry(bytes=number, sha256="")}
        raise StopError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Manifest, "save", lambda own, _: written.append(set(own.shards)))
        with pytest.raises(StopError):
            _write_shards(many, manifest, Path("unused"), finished(), list(range(len(many.shards))))
    assert len(manifest.shards) == stop
    assert written[-1] == set(manifest.shards)
    # Each shard by itself would be stop (stop + 1) / 2 entries.
    assert sum(map(len, written)) <= 25 * stop


def test_shards_that_the_manifest_lacks_after_a_kill_are_not_made_again(copy, made, monkeypatch):
    manifest = read_manifest(copy)
    for name in manifest.tables:
        (copy / name).unlink()
    manifest.shards.clear()
    manifest.tables.clear()
    manifest.complete = False
    manifest.save(copy)
    assert {fault.what for fault in verify(copy)} == {"not finished; the dataset's command goes on with it"}
    monkeypatch.setattr("simtest.dataset.maker.Maker.make", lambda *_: pytest.fail("made again"))
    write_dataset(tiny(**SIX), copy, make_engine())
    assert contents(copy) == contents(made)


def test_the_index_from_the_rows_of_workers_is_that_from_the_shards(copy):
    plan = read_manifest(copy).plan()
    before = contents(copy)
    for shard in plan.shards:
        write_shard_tables(plan, copy, shard)
    parts = [copy / table_file(shard, INDEX) for shard in plan.shards]
    assert sorted(parts) == sorted(copy.rglob("*.part"))
    # one cut short, one missing: both are made from their shard
    parts[0].write_bytes(parts[0].read_bytes()[:50])
    parts[1].unlink()
    (copy / INDEX).unlink()
    write_index(plan, copy)
    assert {name: digest for name, digest in contents(copy).items() if name in before} == before
    # Negative control: the rows of the workers are what is joined.
    pl.read_parquet(parts[-1]).clear().write_parquet(parts[-1])
    write_index(plan, copy)
    assert {name for name, digest in contents(copy).items() if before.get(name, digest) != digest} == {INDEX}


def test_rows_that_are_lost_are_made_again_from_their_shard_alone(copy, made, monkeypatch):
    monkeypatch.setattr("simtest.dataset.maker.Maker.make", lambda *_: pytest.fail("made again"))
    shards = read_manifest(copy).plan().shards
    lost, kept = table_file(shards[0], HIGHLIGHTS), table_file(shards[1], HIGHLIGHTS)
    (copy / lost).unlink()
    assert [str(fault) for fault in verify(copy)] == [f"{lost}: missing"]
    before = (copy / kept).stat()
    write_dataset(tiny(**SIX), copy, make_engine())
    assert contents(copy) == contents(made)
    assert (copy / kept).stat() == before
    # all of them, and what a killed run leaves among them
    shutil.rmtree(copy / ESTIMATES)
    (copy / HIGHLIGHTS / ".train-000000.1.part.parquet").touch()
    write_dataset(tiny(**SIX), copy, make_engine())
    assert contents(copy) == contents(made)


def test_rows_that_cannot_be_read_are_made_again_where_they_are_judged(tmp_path):
    # No plane shows an isolated highlight.
    family = {"scene": "plane", "set": {"camera.width": 64, "camera.height": 64, "camera.fx": 64, "camera.fy": 64}}
    splits = {"train": 1, "validation": 0, "test": 0}
    values = {"name": "few", "samples": 1, "tries": 1, "highlights": 2, "families": [family], "splits": splits}
    dataset = validate(Dataset, {**values, "estimators": []}, "few")
    with pytest.warns(UserWarning, match="1 of 1 samples show fewer") as first:
        write_dataset(dataset, tmp_path, make_engine())
    plan = Plan(dataset)
    rows = tmp_path / table_file(plan.shards[0], HIGHLIGHTS)
    for damage in (lambda: rows.write_bytes(b"PAR1"), rows.unlink):
        damage()
        assert shortfall(plan, tmp_path) == str(first[0].message)


def test_a_file_in_the_place_of_a_tables_folder_is_refused_and_repaired(copy, made):
    """As versions before wrote it."""
    shutil.rmtree(copy / HIGHLIGHTS)
    pl.DataFrame({"index": [0]}).write_parquet(copy / HIGHLIGHTS)
    with pytest.raises(InputError, match=r"^--out .*highlights.parquet: is a file; must be a folder$"):
        write_dataset(tiny(**SIX), copy, make_engine())
    faults = verify(copy)
    assert f"{HIGHLIGHTS}: does not belong to the dataset" in map(str, faults)
    assert repair_files(copy, faults, make_engine()) == []
    assert contents(copy) == contents(made)


def test_a_table_that_is_one_file_is_read_as_versions_before_wrote_it(copy, tmp_path):
    manifest = read_manifest(copy)
    for name in FOLDERS:
        table = pl.read_parquet(copy / name).sort("index", maintain_order=True)
        shutil.rmtree(copy / name)
        table.write_parquet(copy / name)
        manifest.tables[name] = file_entry(copy / name)
    manifest.tables = {name: entry for name, entry in manifest.tables.items() if "/" not in name}
    manifest.origin["source"] = "that of an older version"
    manifest.save(copy)
    assert verify(copy) == []
    assert len(list(read(copy))) == 6
    assert write_preview(copy, tmp_path / "page.html", 4).exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda c: c["shards"].update({"../secret.tar": {"bytes": 1, "sha256": "0"}}),
            "shards.../secret.tar = '../secret.tar': must match",
        ),
        (lambda c: c["tables"].update({"..": {"bytes": 1, "sha256": "0"}}), "must match the pattern"),
        (lambda c: c["tables"].update({"x.parquet/..": {"bytes": 1, "sha256": "0"}}), "must match the pattern"),
        (lambda c: c["tables"].update({"a/b/c": {"bytes": 1, "sha256": "0"}}), "must match the pattern"),
        (lambda c: c["tables"].update({"x.parquet": {"bytes": 1}}), "x.parquet.sha256: missing"),
    ],
)
def test_a_manifest_with_a_digest_that_fits_is_not_trusted(copy, change, said):
    content = json.loads((copy / NAME).read_text())
    del content["digest"]
    change(content)
    (copy / NAME).write_text(json.dumps({**content, "digest": _digest(content)}))
    with pytest.raises(InputError) as raised:
        list(read(copy))
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_card_of_a_strange_recipe_holds_no_markup():
    title = 'a"b: [c]\n# d | e <script>alert(1)</script>'
    dataset = tiny(title=title, description="![x](http://a.b/c)\n\n# head\n- [y](z) @all `code`")
    plan = Plan(dataset)
    card = make_card(plan, new_manifest(plan, "llvm_ad_rgb"))
    head = yaml.safe_load(card.split("---")[1])
    assert head["pretty_name"] == " ".join(title.split())
    assert set(head) == {"pretty_name", "tags", "configs"}
    assert "<script" not in card.split("---", 2)[2]
    assert "](" not in card.split("## Reading")[0]
    assert "@all" not in card
    # Negative control: plain words stay as they are.
    assert "Rendered by simtest" in card


@given(st.text(max_size=60))
def test_any_text_is_one_line_and_a_string_of_yaml(text):
    assert "\n" not in escaped(text)
    assert yaml.safe_load(f"key: {yaml_string(text)}") == {"key": json.loads(yaml_string(text))}


def test_full_disk_keeps_what_is_written(made, tmp_path, monkeypatch):
    def full(file, key, members):
        if key == "000000003":
            file.write(b"half a sample")
            raise OSError(28, "No space left on device")
        write_sample(file, key, members)

    monkeypatch.setattr("simtest.dataset.shard_writer.write_sample", full)
    said = r"full: No space left on device; .* are free .*; what is written stays valid"
    with pytest.raises(SimtestError, match=said) as error:
        write_dataset(tiny(**SIX), tmp_path / "full", make_engine())
    assert error.type is SimtestError
    monkeypatch.undo()
    write_dataset(tiny(**SIX), tmp_path / "full", make_engine())
    assert contents(tmp_path / "full") == contents(made)


def test_reader_names_what_it_does_not_know(made, tmp_path):
    with pytest.raises(InputError, match="field colour: unknown; allowed: image, depth"):
        read(made, fields=["colour"])
    with pytest.raises(InputError, match="split = dev: unknown; allowed: test, train, validation"):
        read(made, split="dev")
    with pytest.raises(InputError, match="no dataset to read"):
        read(tmp_path)
    with pytest.raises(InputError, match="must be 0 to 5"):
        reproduce_sample(made, 6, tmp_path / "x")


def test_the_card_says_where_surfaces_come_from():
    def card(dataset):
        plan = Plan(dataset)
        return make_card(plan, new_manifest(plan, "llvm_ad_rgb"))

    assert "No patient's data" in card(tiny())
    mesh = load_dataset("smooth", {"surface.path": MESH, "samples": 6, "samples_per_anatomy": 1})
    family = mesh.families[0].model_copy(update={"seeds": None, "per_anatomy": {}})
    text = card(mesh.model_copy(update={"families": (family,), "splits": Splits(train=1.0, validation=0.0, test=0.0)}))
    assert "meshes: colon_40mm.ply" in text
    assert "No patient's data" not in text


def test_stored_normals_have_the_levels_that_their_description_says():
    """Levels count from 1 to 16383 over the square, u above v; 0 stands for no surface."""
    normals = np.array([[[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [np.nan] * 3]], dtype=np.float32)
    counts = png.decode(fields.BY_NAME["normal"].codec.encode(normals))
    assert counts.tolist() == [[8192, 16383, 8192, 0], [8192, 8192, 1, 0]]


def test_parts_of_the_radiance_are_shares_of_full_scale():
    part = np.full((2, 3), 3.0, np.float32)
    half = _share_of(part, 6.0)
    assert half.shape == (2, 3, 3)
    # sRGB of one half is 188 of 255.
    assert (half == 188).all()
    assert (_share_of(part, 3.0) == 255).all()
    assert not _share_of(np.zeros((2, 3), np.float32), 6.0).any()


def test_the_tables_say_what_the_samples_hold(made):
    index, highlights = (pl.read_parquet(made / name) for name in (INDEX, HIGHLIGHTS))
    assert index["width"].unique().to_list() == [64]
    assert index["height"].unique().to_list() == [48]
    for sample in read(made):
        row = index.row(by_predicate=pl.col("index") == sample["meta"]["index"], named=True)
        assert sample["image"].shape[:2] == (row["height"], row["width"])
        assert row["n_highlights"] == len(sample["meta"]["highlights"])
        own = highlights.filter(pl.col("index") == sample["meta"]["index"])
        for found, held in zip(own.iter_rows(named=True), sample["meta"]["highlights"], strict=True):
            for key, names in (
                ("normal", ("normal_x", "normal_y", "normal_z")), ("position_mm", ("x_mm", "y_mm", "z_mm")),
                ("bp_px", ("bp_x_px", "bp_y_px")),
            ):  # fmt: skip
                assert [found[name] for name in names] == held[key]


# Damage -------------------------------------------------------------------------------------------------------------


def flip(path, place):
    data = bytearray(path.read_bytes())
    data[int(place * (len(data) - 1))] ^= 0x40
    path.write_bytes(data)


def edit_manifest(folder, change):
    content = json.loads((folder / NAME).read_text())
    change(content)
    (folder / NAME).write_text(json.dumps(content))


def honest(folder, name):
    """Make the manifest agree with a changed file: only its content then tells."""
    manifest = read_manifest(folder)
    where = manifest.tables if name in manifest.tables else manifest.shards
    where[name] = file_entry(folder / name)
    manifest.save(folder)


def rewrite(folder, name, change):
    """Write a shard again with changed samples, hashes and all."""
    with (folder / name).open("rb") as file:
        stored = [(s.key, {x: read_member(file, s, x) for x in s.members}, s.meta) for s in samples(file)]
    changed = change(stored)
    with (folder / name).open("wb") as file:
        for key, members, meta in changed:
            images = {suffix: data for suffix, data in members.items() if suffix != "json"}
            hashes = {suffix: hashlib.sha256(data).hexdigest() for suffix, data in images.items()}
            write_sample(file, key, {**images, "json": json.dumps({**meta, "sha256": hashes}).encode()})
        finish(file)
    honest(folder, name)


def with_image(name, change):
    """Change one decoded image of the first sample."""

    def apply(stored):
        key, members, meta = stored[0]
        field = fields.BY_NAME[name]
        array = field.codec.decode(members[field.suffix], meta)
        return [(key, {**members, field.suffix: field.codec.encode(change(array.copy()))}, meta), *stored[1:]]

    return lambda folder: rewrite(folder, TAR, apply)


def with_meta(change):
    def apply(stored):
        key, members, meta = stored[0]
        meta = json.loads(json.dumps(meta))
        change(meta)
        return [(key, members, meta), *stored[1:]]

    return lambda folder: rewrite(folder, TAR, apply)


def put(array, value):
    array[10:30, 10:30] = value
    return array


TAR, OTHER = "train-000000.tar", "test-000000.tar"


def swap(folder):
    (folder / TAR).rename(folder / "x")
    (folder / OTHER).rename(folder / TAR)
    (folder / "x").rename(folder / OTHER)


def link(folder):
    (folder / TAR).rename(folder.parent / "away")
    (folder / TAR).symlink_to(folder.parent / "away")


def link_highlights(folder):
    (folder / HIGHLIGHTS).rename(folder.parent / "away")
    (folder / HIGHLIGHTS).symlink_to(folder.parent / "away")


def as_folder(folder):
    (folder / TAR).unlink()
    (folder / TAR).mkdir()


def edit(name, change):
    """Change a table, and let the manifest agree."""

    def apply(folder):
        change(pl.read_parquet(folder / name)).write_parquet(folder / name)
        honest(folder, name)

    return apply


def new_card(folder):
    (folder / "README.md").write_text("Better than any other.")
    honest(folder, "README.md")


def unfinished(folder):
    """As a kill before the last save leaves it."""
    manifest = read_manifest(folder)
    manifest.complete = False
    manifest.save(folder)


def first(change):
    """Change the members of the first sample."""
    return lambda folder: rewrite(folder, TAR, lambda s: [(s[0][0], change(dict(s[0][1])), s[0][2]), *s[1:]])


def without(members):
    members.pop("normal.png")
    return members


INDEX, HIGHLIGHTS, ESTIMATES = TABLES
SPOTS, ANSWERS = (f"{name}/train-000000.parquet" for name in FOLDERS)
DAMAGE = {
    "flipped byte at the beginning": (lambda f: flip(f / TAR, 0.0), TAR),
    "flipped byte in the middle": (lambda f: flip(f / TAR, 0.5), TAR),
    "flipped byte near the end": (lambda f: flip(f / TAR, 0.9), TAR),
    "flipped byte in the padding": (lambda f: flip(f / TAR, 1.0), TAR),
    "truncated shard": (lambda f: (f / TAR).write_bytes((f / TAR).read_bytes()[:5000]), TAR),
    "empty shard": (lambda f: (f / TAR).write_bytes(b""), TAR),
    "longer shard": (lambda f: (f / TAR).write_bytes((f / TAR).read_bytes() + b"more"), TAR),
    "missing shard": (lambda f: (f / TAR).unlink(), TAR),
    "swapped shards": (swap, TAR),
    "shard is a folder": (as_folder, TAR),
    "shard is a link": (link, TAR),
    "foreign file": (lambda f: (f / "notes.txt").write_text("mine"), "notes.txt"),
    "left-over part": (lambda f: (f / "train-000009.tar.part").write_bytes(b"x"), "train-000009.tar.part"),
    "missing manifest": (lambda f: (f / NAME).unlink(), NAME),
    "manifest is no JSON": (lambda f: (f / NAME).write_text("{"), NAME),
    "manifest of another format": (lambda f: edit_manifest(f, lambda c: c.update(format="mine")), NAME),
    "edited hash": (lambda f: edit_manifest(f, lambda c: c["shards"][TAR].update(sha256="0" * 64)), NAME),
    "edited seed": (lambda f: edit_manifest(f, lambda c: c["dataset"].update(seed=5)), NAME),
    "missing index": (lambda f: (f / INDEX).unlink(), INDEX),
    "truncated index": (lambda f: (f / INDEX).write_bytes(b"PAR1"), INDEX),
    "edited index": (edit(INDEX, lambda t: t.with_columns(n_isolated=pl.lit(7))), INDEX),
    "row lost from the highlights": (edit(SPOTS, lambda t: t[1:]), SPOTS),
    "edited estimates": (edit(ANSWERS, lambda t: t.with_columns(error_deg=pl.col("error_deg") / 2)), ANSWERS),
    "missing estimates": (lambda f: (f / ANSWERS).unlink(), ANSWERS),
    "truncated highlights": (lambda f: (f / SPOTS).write_bytes(b"PAR1"), SPOTS),
    "foreign file among the highlights": (lambda f: (f / f"{HIGHLIGHTS}/mine").touch(), f"{HIGHLIGHTS}/mine"),
    "folder of the highlights is a link": (link_highlights, HIGHLIGHTS),
    "edited card": (new_card, "README.md"),
    "not finished": (unfinished, "README.md"),
    "normals turned away": (with_image("normal", lambda n: put(n, (0.0, 0.0, 1.0))), TAR),
    "normals of another frame": (with_image("normal", lambda n: n * np.array([-1, 1, 1])), TAR),
    "holes in the depth": (with_image("depth", lambda d: put(d, np.nan)), TAR),
    "depth without a unit": (with_meta(lambda m: m.update(depth_scale_mm=0.0)), TAR),
    "depth in another unit": (with_meta(lambda m: m.update(depth_scale_mm=10 * m["depth_scale_mm"])), TAR),
    "curvature with its sign turned": (with_image("curvature", lambda k: -k - np.array([0.0, 0.1])), TAR),
    "image of another size": (with_image("image", lambda i: i[:-1]), TAR),
    "no PNG": (first(lambda m: {**m, "depth.png": b"no"}), TAR),
    "member lost": (first(without), TAR),
    "sample lost": (lambda f: rewrite(f, TAR, lambda s: s[1:]), TAR),
    "sample of another split": (with_meta(lambda m: m.update(split="test")), TAR),
    "highlight's normal scaled": (with_meta(lambda m: m["highlights"][0].update(normal=[0, 0, -2])), TAR),
    "instance of no highlight": (with_image("instance", lambda i: put(i, 200)), TAR),
}


@pytest.mark.parametrize(("damage", "named"), DAMAGE.values(), ids=DAMAGE)
def test_damage_is_found_and_named(copy, damage, named):
    damage(copy)
    faults = verify(copy)
    assert named in {fault.file for fault in faults}, faults


BY_HASH = "differs from its SHA-256 in the manifest"


def test_leftovers_of_rows_are_told_and_removed_and_foreign_folders_stay(copy, made):
    left, mine = copy / HIGHLIGHTS / ".train-000000.7.part.parquet", copy / "mine.parquet" / "a.part.csv"
    left.touch()
    assert list(map(str, verify(copy))) == [f"{HIGHLIGHTS}/{left.name}: left over from a stopped run"]
    mine.parent.mkdir()
    mine.touch()
    write_dataset(tiny(**SIX), copy, make_engine())
    assert mine.exists()
    shutil.rmtree(mine.parent)
    assert contents(copy) == contents(made)


def test_a_preview_needs_the_rows_of_highlights(copy, tmp_path):
    manifest = read_manifest(copy)
    manifest.tables = {name: entry for name, entry in manifest.tables.items() if not name.startswith(HIGHLIGHTS)}
    manifest.save(copy)
    with pytest.raises(InputError, match=r"manifest.json: lists no file of highlights.parquet; simtest dataset verify"):
        write_preview(copy, tmp_path / "page.html", 4)


def test_each_file_is_held_against_its_hash(copy):
    """One bit of each file, its size kept: whatever else might tell is not asked before."""
    manifest = read_manifest(copy)
    for name in {**manifest.shards, **manifest.tables}:
        data = (copy / name).read_bytes()
        flip(copy / name, 0.5)
        assert [(fault.file, fault.what) for fault in verify(copy) if fault.file == name] == [(name, BY_HASH)]
        (copy / name).write_bytes(data)
    assert verify(copy) == []


def test_a_digit_of_a_samples_values_is_found_by_its_hash_alone(copy):
    data = (copy / TAR).read_bytes()
    # The noise that a sample was given: no table has it, and no picture is held against it.
    start = data.index(b'"noise_sigma":') + len(b'"noise_sigma":')
    place = next(i for i in range(start, start + 9) if data[i : i + 1] in b"123456789" and data[i : i + 1])
    changed = data[:place] + (b"1" if data[place : place + 1] != b"1" else b"2") + data[place + 1 :]
    (copy / TAR).write_bytes(changed)
    assert [(fault.file, fault.what) for fault in verify(copy)] == [(TAR, BY_HASH)]
    # Negative control: nothing else tells.
    honest(copy, TAR)
    assert not [fault for fault in verify(copy) if fault.file == TAR]


def test_a_member_is_held_against_its_samples_hash(copy):
    with (copy / TAR).open("rb") as file:
        start, length = next(samples(file)).members["normal.png"]
    flip_at = (start + length // 2) / ((copy / TAR).stat().st_size - 1)
    flip(copy / TAR, flip_at)
    honest(copy, TAR)
    assert any("normal.png differs from its hash" in fault.what for fault in verify(copy))


def test_damage_is_mended(made, copy):
    DAMAGE["flipped byte in the middle"][0](copy)
    DAMAGE["edited estimates"][0](copy)
    DAMAGE["truncated highlights"][0](copy)
    DAMAGE["foreign file"][0](copy)
    DAMAGE["foreign file among the highlights"][0](copy)
    assert repair_files(copy, verify(copy), make_engine()) == []
    assert contents(copy) == contents(made)
    DAMAGE["folder of the highlights is a link"][0](copy)
    assert repair_files(copy, verify(copy), make_engine()) == []
    assert contents(copy) == contents(made)
    (copy / NAME).write_text("{")
    with pytest.raises(InputError, match="is broken; remove it"):
        repair_files(copy, verify(copy), make_engine())


def test_mending_leaves_a_strange_folder_alone(copy):
    (copy / "mine").mkdir()
    (copy / "mine" / "notes.txt").write_text("mine")
    DAMAGE["foreign file"][0](copy)
    assert [fault.file for fault in repair_files(copy, verify(copy), make_engine())] == ["mine"]
    assert (copy / "mine" / "notes.txt").read_text() == "mine"


def test_shards_that_are_no_tar_are_told(tmp_path):
    for data in (b"", b"x" * 700, bytes(512)):
        (tmp_path / "a.tar").write_bytes(data)
        with (tmp_path / "a.tar").open("rb") as file, pytest.raises(BrokenShardError):
            list(samples(file))


# Engines ------------------------------------------------------------------------------------------------------------


def test_engines_are_checked():
    with pytest.raises(InputError, match="allowed: local, ray"):
        make_engine("slurm")
    with pytest.raises(InputError, match="workers = 0: must be 1 to 256"):
        make_engine(workers=0)
    with pytest.raises(InputError, match="is for --engine ray"):
        make_engine(address="here")


def test_processes_give_the_same_results_and_dead_ones_are_replaced(tmp_path):
    told = []
    got = dict(make_engine(workers=2).run(square, range(5), lambda: told.append(1)))
    assert got == {i: i * i for i in range(5)}
    assert len(told) == 5
    arguments = [(str(tmp_path), i) for i in range(3)]
    assert dict(make_engine(workers=2).run(dies_once, arguments, lambda: None)) == {i: i for i in range(3)}
    with pytest.raises(SimtestError, match=r"no such number: [12]"):
        list(make_engine(workers=2).run(fails, [1, 2], lambda: None))
    with pytest.raises(OSError, match="No space left on device"):
        list(make_engine(workers=2).run(meets_a_full_disk, [1, 2], lambda: None))


def test_an_error_of_a_worker_tells_where_it_came_up():
    """The message stays one line; `--traceback` prints the note."""
    with pytest.raises(SimtestError) as raised:
        list(make_engine(workers=2).run(breaks, [1, 1], lambda: None))
    assert str(raised.value) == "a worker failed (TypeError: no such kind: 1)"
    (note,) = raised.value.__notes__
    assert "engine_tasks.py" in note
    assert 'raise TypeError(f"no such kind' in note


@pytest.mark.parametrize(
    ("cores", "workers", "each"),
    [((8,), 4, 2), ((4, 4), 1, 4), ((16, 4), 2, 10), ((None, 4), 3, 1), ((2,), 8, 1), ((), 1, 1)],
)
def test_no_task_asks_a_cluster_for_more_cores_than_a_node_has(cores, workers, each):
    nodes = [{"memory": 1e9} if count is None else {"CPU": float(count)} for count in cores]
    assert cores_per_task(nodes, workers) == each


# Command line -------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")
def test_commands(made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr("sys.argv", ["simtest", "dataset", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capsys.readouterr().out.splitlines()

    size = ["--samples", "6", "--set", "samples_per_anatomy=1"]
    assert run("tiny", "--out", "made", *size) == (0, ["made/README.md"])
    assert contents(tmp_path / "made") == contents(made)
    assert run("verify", "made") == (0, ["sound"])
    code, said = run("sample", "made", "2")
    assert (code, said[-1].partition(": ")[2]) == (0, "same bytes")
    # The command that it prints renders the sample's frame.
    monkeypatch.setattr("sys.argv", [*shlex.split(said[-2].partition(": ")[2]), "--out", "again"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    capsys.readouterr()
    frames = (cv2.imread(str(tmp_path / name)) for name in ("sample-2/000000002.image.png", "again/frame.png"))
    np.testing.assert_array_equal(*frames)
    assert run("preview", "made", "--samples", "3") == (0, ["preview.html"])
    page = (tmp_path / "preview.html").read_text()
    assert page.count('<section class="card">') == 3
    assert "http" not in page.replace("http-equiv", "")
    flip(tmp_path / "made" / TAR, 0.5)
    code, said = run("verify", "made")
    assert code == 1
    assert said[-1] == "1 fault"
    code, said = run("verify", "made", "--repair")
    assert (code, said[-1]) == (0, "mended")
    assert contents(tmp_path / "made") == contents(made)


def test_samples_below_the_recipes_number_of_highlights_are_counted(tmp_path):
    # The highlight of a plane tilted by 60 deg is out of view.
    small = {"camera.width": 64, "camera.height": 64, "camera.fx": 64, "camera.fy": 64, "reflectance.diffuse": 0.3}
    families = [{"scene": "plane", "set": {**small, "surface.tilt_deg": tilt}} for tilt in (0.0, 60.0, 60.0)]
    values = {"name": "few", "samples": 3, "samples_per_anatomy": 1, "tries": 3, "families": families}
    split = {"train": 1, "validation": 0, "test": 0}
    dataset = validate(Dataset, {**values, "splits": split, "estimators": ["cone_axis"]}, "few")
    with pytest.warns(UserWarning, match=r"^2 of 3 samples show fewer isolated highlights than highlights = 1") as told:
        write_dataset(dataset, tmp_path / "few", make_engine())
    # Why, and what to change; the card says the same.
    said = str(told[0].message)
    assert "(2: no highlight in view); no normal in view is half-way" in said
    assert escaped(said, 1000) + "." in (tmp_path / "few" / CARD).read_text(encoding="utf-8")
    assert verify(tmp_path / "few") == []


def test_why_samples_show_too_few_highlights_is_that_of_the_highlight_that_stands_out_most(tmp_path):
    one, other = Shard("train", 0, (0, 3)), Shard("test", 0, (1, 2))
    counts = {"n_highlights": [2, 1, 0, 1], "n_isolated": [0, 0, 0, 1]}
    samples = pl.DataFrame({"index": [0, 1, 2, 3], "shard": [one.name, other.name, other.name, one.name], **counts})
    rows = [(0, False, FAINT, 3.0), (0, False, STREAK, 40.0), (1, False, STREAK, 20.0), (3, True, None, 50.0)]
    highlights = pl.DataFrame(rows, schema=["index", "isolated", "why_not", "peak_snr"], orient="row")
    dataset = SimpleNamespace(highlights=1, tries=8)
    plan = SimpleNamespace(dataset=dataset, inputs=[Path("tube.toml"), Path("tube.obj")], shards=(one, other))
    (tmp_path / HIGHLIGHTS).mkdir()
    for shard in plan.shards:
        own = highlights.filter(pl.col("index").is_in(shard.indices))
        own.write_parquet(tmp_path / table_file(shard, HIGHLIGHTS))

    def judged(samples):
        samples.write_parquet(tmp_path / INDEX)
        return shortfall(plan, tmp_path)

    said = judged(samples)
    assert f"(2: {STREAK}, 1: {NO_HIGHLIGHT}); {REMEDIES[STREAK]}; `simtest mesh check` says whether tube.obj" in said
    assert not judged(samples[3:])
    # A recipe that takes every frame is told where most of them show no highlight at all.
    dataset.highlights = 0
    assert not judged(samples)
    none = samples.with_columns(n_highlights=pl.Series([0, 0, 0, 1]))
    for shard in plan.shards:
        highlights.clear().write_parquet(tmp_path / table_file(shard, HIGHLIGHTS))
    assert judged(none).startswith(f"3 of 4 samples show no highlight (3: {NO_HIGHLIGHT}); ")


def test_a_samples_metadata_are_a_scene_that_is_rendered_again(made, tmp_path):
    index = 3
    reproduce_sample(made, index, tmp_path)
    variant = read_manifest(made).origin["variant"]
    frame = simtest.render(tmp_path / f"{sample_key(index)}.json", variant=variant)
    write_frame(frame, tmp_path / "frame")
    stored, again = (cv2.imread(str(tmp_path / name)) for name in (f"{sample_key(index)}.image.png", "frame/frame.png"))
    np.testing.assert_array_equal(again, stored)
    # frame.json is a scene as well.
    assert load_scene(tmp_path / "frame" / "frame.json") == frame.scene


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ('{"camera": {}}', "scene: must be a table, as in a dataset's sample"),
        ('{"scene": {"surface": {"type": "cube"}}}', "surface"),
    ],
)
def test_metadata_without_a_scene_are_refused_by_name(tmp_path, text, message):
    (tmp_path / "frame.json").write_text(text)
    with pytest.raises(InputError, match=f"frame.json.* {message}"):
        load_scene(tmp_path / "frame.json")


def test_a_dataset_of_another_version_is_sound_as_well(copy):
    manifest = read_manifest(copy)
    manifest.origin["source"] = "that of an older version"
    manifest.save(copy)
    edit(ANSWERS, lambda t: t.drop(t.columns[-1]))(copy)
    new_card(copy)
    assert verify(copy) == []
    edit(ANSWERS, lambda t: t.with_columns(error_deg=pl.col("error_deg") / 2))(copy)
    assert [fault.file for fault in verify(copy)] == [ANSWERS]


def test_a_preview_shows_samples_of_the_whole_dataset(made, tmp_path):
    page = write_preview(made, tmp_path / "page.html", 4).read_text()
    assert re.findall(r"<h3>(\d)", page) == list("0235")
    # Histograms are charts of the page.
    assert "<h3>distance of isolated highlights</h3>" in page
    assert page.count('data-chart="histogram-') >= 1


def test_the_order_of_keys_in_a_file_does_not_matter():
    drawn = {name: Distribution(low=0.0, high=1.0) for name in ("b", "a", "c")}
    one = _draw(drawn, np.random.default_rng(4))
    assert _draw(dict(reversed(drawn.items())), np.random.default_rng(4)) == one


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps less")
def test_a_large_worker_gives_back_what_it_has_freed(monkeypatch):
    held, before = psutil.Process().memory_info, psutil.Process().memory_info().rss
    pieces = [bytes(100_000) for _ in range(600)]
    # What stays in between keeps the heap from shrinking.
    pieces = pieces[::100]
    processes.give_back()
    assert held().rss - before > 30e6
    monkeypatch.setattr(processes, "MOST_BYTES", 0)
    processes.give_back()
    assert held().rss - before < 10e6
    assert len(pieces) == 6


def test_a_process_is_replaced_after_its_tasks():
    pids = [pid for _, pid in make_engine(workers=2, renew_after=1).run(process, range(6), lambda: None)]
    assert len(set(pids)) == 6


@pytest.mark.parametrize(
    ("given", "shares"),
    [
        ({}, {"train": 0.8, "validation": 0.1, "test": 0.1}),
        ({"train": 1.0}, {"train": 1.0}),
        ({"train": 0.75, "test": 0.25}, {"train": 0.75, "test": 0.25}),
    ],
)
def test_splits_that_are_not_named_are_empty(given, shares):
    """A dataset of one mesh is of one anatomy: `splits = { train = 1.0 }` is enough."""
    assert validate(Splits, given, "splits").shares == shares


def test_named_splits_must_be_whole():
    with pytest.raises(InputError, match=r"train \+ validation \+ test = 0.5: must be 1"):
        validate(Splits, {"train": 0.5}, "splits")
