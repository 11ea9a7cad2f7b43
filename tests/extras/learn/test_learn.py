"""Samples as tensors. Skipped where PyTorch is absent."""

import shutil
from itertools import chain, islice

import numpy as np
import polars as pl
import pytest
import torch

import simtest
from simtest.dataset import calibration_of, read
from simtest.dataset.learn import Samples
from simtest.dataset.shard_writer import write_dataset
from simtest.errors import InputError
from simtest.geometry.vectors import angle_deg
from simtest.runtime.processes import make_engine
from simtest.spec import load_dataset

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learn") / "tiny"
    write_dataset(load_dataset("tiny", {"samples": 24, "visible": True}), folder, make_engine())
    return folder


def indices(items):
    return [item["meta"]["index"] for item in items]


# A spawned worker imports PyTorch anew, which takes seconds: one shows that everything reaches it.
@pytest.mark.parametrize(("start", "workers"), [("fork", 3), pytest.param("spawn", 1, marks=pytest.mark.slow)])
def test_a_plain_loader_batches_what_its_workers_share_out(made, start, workers):
    # Metadata hold None, which no loader can stack.
    samples = Samples(made, "train", shuffle=4)
    loader = torch.utils.data.DataLoader(samples, batch_size=2, num_workers=workers, multiprocessing_context=start)
    batches = list(loader)
    assert batches[0]["image"].shape == (2, 3, 48, 64)
    assert isinstance(batches[0]["meta"], list)
    assert None in [h["why_not"] for b in batches for m in b["meta"] for h in m["highlights"]]
    read_there = sorted(m["index"] for b in batches for m in b["meta"])
    assert read_there == sorted(indices(Samples(made, "train")))


def test_ranks_share_the_samples_out(made, monkeypatch):
    alone = sorted(indices(Samples(made, "train")))
    for world in (2, 3, len(alone) + 1):
        ranks = [Samples(made, "train", rank=r, world=world, even=False) for r in range(world)]
        assert sorted(chain.from_iterable(map(indices, ranks))) == alone
        # Training in step needs equal numbers: some samples are read twice, none is left out.
        ranks = [Samples(made, "train", rank=r, world=world, shuffle=3) for r in range(world)]
        each = -(-len(alone) // world)
        assert [len(indices(rank)) for rank in ranks] == [each] * world == [len(rank) for rank in ranks]
        assert set(chain.from_iterable(map(indices, ranks))) == set(alone)
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert indices(Samples(made, "train")) == indices(Samples(made, "train", rank=1, world=2))
    monkeypatch.setenv("RANK", "first")
    with pytest.raises(InputError, match="RANK = 'first': must be a whole number"):
        Samples(made, "train")
    with pytest.raises(InputError, match="rank = 2: must be 0 to 1"):
        Samples(made, rank=2, world=2)
    with pytest.raises(InputError, match="world = 0"):
        Samples(made, world=0)


def test_pixels_of_visible_highlights_come_through_workers_and_ranks(made):
    wanted = {index: visible for index, visible in ((i["meta"]["index"], i["visible"]) for i in visible_of(made))}
    found = {}
    for rank in range(2):
        samples = visible_of(made, rank=rank, world=2, even=False)
        for batch in torch.utils.data.DataLoader(samples, batch_size=3, num_workers=2, multiprocessing_context="fork"):
            # Numbers of highlights, not shares of 255.
            assert batch["visible"].dtype == torch.int32
            assert batch["visible"].shape[1:] == (48, 64)
            found |= {meta["index"]: visible for meta, visible in zip(batch["meta"], batch["visible"], strict=True)}
    assert found.keys() == wanted.keys()
    assert all(torch.equal(found[index], wanted[index]) for index in wanted)
    assert {int(visible.max()) for visible in wanted.values()} >= {1}


def visible_of(folder, **share):
    return Samples(folder, "train", fields=("visible",), **share)


def test_a_damaged_index_is_told_in_one_line(made, tmp_path):
    folder = tmp_path / "damaged"
    shutil.copytree(made, folder)
    table = pl.read_parquet(folder / "index.parquet")
    table.with_columns(offset=pl.col("offset") + 1).write_parquet(folder / "index.parquet")
    with pytest.raises(InputError, match=r"train-000000.tar: no tar header at byte 1 .*verify --repair"):
        indices(Samples(folder, "train"))
    table.drop("offset").write_parquet(folder / "index.parquet")
    with pytest.raises(InputError, match=r"index.parquet: cannot be read .*verify --repair"):
        Samples(folder, "train")
    (folder / "index.parquet").unlink()
    with pytest.raises(InputError, match=r"index.parquet: .*verify --repair"):
        Samples(folder, "train")


def test_the_calibration_of_a_sample_reconstructs_its_picture(made):
    errors = []
    for record in islice(read(made, fields=["image"]), 3):
        calibration, meta = calibration_of(record["meta"]), record["meta"]
        assert (calibration.camera.width, calibration.camera.height) == (
            meta["camera"]["width"],
            meta["camera"]["height"],
        )
        # The picture is sRGB, whatever the sensor's frame was.
        assert calibration.response.kind == "srgb"
        found = simtest.reconstruct(record["image"], calibration, ["brightest_point"], detector="peaks")
        errors.append(
            angle_deg(found[0].estimates["brightest_point"].normal, np.array(meta["highlights"][0]["normal"]))
        )
    assert max(errors) < 3


def test_shuffling_hangs_on_seed_and_epoch(made):
    first, again = Samples(made, "train", shuffle=5, seed=1), Samples(made, "train", shuffle=5, seed=1)
    order = indices(first)
    assert order == indices(again)
    again.set_epoch(1)
    assert order != indices(again)
    assert sorted(order) == sorted(indices(again))


def test_tensors_are_channels_first(made):
    item = next(iter(Samples(made, "train", fields=("image", "normal", "depth", "instance"))))
    assert item["image"].shape == (3, 48, 64)
    assert item["image"].dtype == torch.float32
    assert float(item["image"].max()) <= 1
    assert item["normal"].shape == (3, 48, 64)
    assert item["instance"].dtype == torch.int32
    batch = Samples.collate([item, item])
    assert batch["depth"].shape == (2, 48, 64)
    small = {**item, "depth": item["depth"][1:]}
    with pytest.raises(InputError, match=r"depth: samples of shapes \[\(47, 64\), \(48, 64\)\] in one batch"):
        Samples.collate([item, small])
    with pytest.raises(InputError, match="field colour: unknown"):
        Samples(made, fields=("colour",))
