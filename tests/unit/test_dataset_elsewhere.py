"""Datasets as others read and make them: Hugging Face, WebDataset, a Ray cluster. Skipped where these are absent."""

import hashlib
import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from simtest.dataset import fields, read
from simtest.dataset.shard_writer import write_dataset
from simtest.errors import InputError
from simtest.runtime.engines import make_engine
from simtest.spec import load_dataset

# Others warn as they like.
pytestmark = [pytest.mark.slow, pytest.mark.extra, pytest.mark.filterwarnings("ignore")]


def contents(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset") / "tiny"
    write_dataset(load_dataset("tiny"), folder, make_engine())
    return folder


def test_hugging_face_reads_local_shards_offline(made, tmp_path, monkeypatch):
    datasets = pytest.importorskip("datasets")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    files = {split: str(made / f"{split}-*.tar") for split in ("train", "validation", "test")}
    loaded = datasets.load_dataset("webdataset", data_files=files, cache_dir=str(tmp_path / "cache"))
    ours = {record["meta"]["key"]: record for record in read(made, "train")}
    assert {row["__key__"] for row in loaded["train"]} == set(ours)
    for row in loaded["train"]:
        record = ours[row["__key__"]]
        assert (np.asarray(row["image.png"]) == record["image"]).all()
        # 16 bits are kept.
        counts = np.asarray(row["depth.png"]).astype(float)
        assert np.nanmax(np.abs(counts * row["json"]["depth_scale_mm"] - record["depth"])) < 1e-4


def test_webdataset_reads_the_shards(made):
    webdataset = pytest.importorskip("webdataset")
    files = [str(path) for path in sorted(made.glob("train-*.tar"))]
    rows = list(webdataset.WebDataset(files, shardshuffle=False))
    ours = {record["meta"]["key"]: record for record in read(made, "train")}
    assert {row["__key__"] for row in rows} == set(ours)
    for row in rows:
        assert (np.asarray(Image.open(io.BytesIO(row["image.png"]))) == ours[row["__key__"]]["image"]).all()
        normal = fields.BY_NAME["normal"].decode(row["normal.png"], {})
        assert np.array_equal(normal, ours[row["__key__"]]["normal"], equal_nan=True)


def test_two_processes_write_the_same_bytes(made, tmp_path):
    write_dataset(load_dataset("tiny"), tmp_path / "two", make_engine(workers=2))
    assert contents(tmp_path / "two") == contents(made)


def test_killed_writers_and_workers_leave_no_trace(made, tmp_path):
    command = [sys.executable, "-m", "simtest.cli.main", "dataset", "tiny", "--out", str(tmp_path / "out")]
    command = [sys.executable, "-c", "from simtest.cli.main import main; main()", *command[3:], "--workers", "2"]
    rng = np.random.default_rng(0)
    for _ in range(3):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        time.sleep(float(rng.uniform(2, 5)))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    subprocess.run(command, check=True, capture_output=True)
    assert contents(tmp_path / "out") == contents(made)


def test_a_ray_cluster_that_loses_a_node_writes_the_same_bytes(made, tmp_path):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    # Workers import the package from where this test does.
    paths = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).resolve().parents[2]), *sys.path])}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False, runtime_env={"env_vars": paths})
    told = 0

    def tell(*_):
        nonlocal told, second
        told += 1
        if told >= 4 and second is not None:
            cluster.remove_node(second, allow_graceful=False)
            second = None

    try:
        write_dataset(load_dataset("tiny"), tmp_path / "ray", make_engine("ray", workers=2), progress=tell)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert second is None
    assert contents(tmp_path / "ray") == contents(made)


def test_ray_that_cannot_be_joined_is_told():
    pytest.importorskip("ray")
    for address, said in (("127.0.0.1:1", "no Ray cluster answers"), ("here", "must be HOST:PORT")):
        with pytest.raises(InputError, match=said):
            list(make_engine("ray", address=address).run(len, [1], lambda: None))
