"""A dataset on a Ray cluster of one node and of two, of one core each: wall time, and equal bytes.

Needs the extra `bench`. Both nodes are processes of this machine, so it must have two cores, and nothing else to do.
The nodes start beforehand; each cluster makes a small dataset first, so that its workers have imported all and hold
their kernels.
"""

import hashlib
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.measuring import Figure
from simtest.dataset.shard_writer import write_dataset
from simtest.runtime.processes import make_engine
from simtest.spec import load_dataset
from simtest.spec.recipes import Dataset

ROUNDS = 3
SETTINGS: dict[str, Any] = {"samples": 64, "samples_per_anatomy": 8, "shard_mb": 11.0}
"""Eight shards or so, of about the same length: two nodes share them evenly."""

LINEAR = 0.9


def figures(dataset: Dataset | None = None, rounds: int = ROUNDS) -> list[Figure]:
    """Make the dataset on one node and on two, in turns."""
    wanted = dataset or load_dataset("smooth", SETTINGS)
    times: dict[int, list[float]] = {1: [], 2: []}
    digests = set()
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(rounds):
            for nodes, own in times.items():
                folder = Path(scratch) / f"{number}-{nodes}"
                with _cluster(nodes) as address:
                    engine = make_engine("ray", nodes, address)
                    write_dataset(_warming(wanted), folder / "warm", engine)
                    start = time.perf_counter()
                    write_dataset(wanted, folder / "made", engine)
                    own.append(time.perf_counter() - start)
                digests.add(_digest(folder / "made"))
    one, two = (statistics.median(times[nodes]) for nodes in (1, 2))
    about = f"{one:.1f} s on one node, {two:.1f} s on two, of one core each"
    return [
        Figure("dataset on two Ray nodes: share of twice the speed of one", one / two / 2, LINEAR, True, "", about),
        Figure("different bytes among the runs on one node and on two", len(digests) - 1, 0, unit=""),
    ]


def _warming(dataset: Dataset) -> Dataset:
    """Return a part of the dataset, of which each node makes something: an anatomy for each of the three splits."""
    return dataset.model_copy(update={"samples": max(dataset.samples // 4, 3 * dataset.samples_per_anatomy)})


@contextmanager
def _cluster(nodes: int) -> Iterator[str]:
    """Start a cluster of this machine, one core a node; give the address of its head."""
    try:
        import ray
        from ray.cluster_utils import Cluster
    except ImportError:
        raise SystemExit("benchmark ray_nodes: needs Ray; install simtest[bench]") from None
    # The workers import this tree's simtest, as this process does.
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        for _ in range(nodes - 1):
            cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        yield cluster.address
    finally:
        ray.shutdown()
        cluster.shutdown()


def _digest(folder: Path) -> str:
    """Return a digest of all shards of a dataset."""
    made = hashlib.sha256()
    for shard in sorted(folder.glob("*.tar")):
        made.update(shard.name.encode() + hashlib.sha256(shard.read_bytes()).digest())
    return made.hexdigest()
