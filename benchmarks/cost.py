"""What ten million frames cost: processor time, disk, and the run on a cluster; one command, some minutes.

`python -m benchmarks cost` prints tables of docs/measured/performance.md. Samples of new anatomies
are timed one by one, encoded and written as a dataset's run does it. An anatomy's own cost is what its first sample
takes beyond its others. The rest is arithmetic.
"""

import os
import statistics
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import polars as pl

from benchmarks.measuring import Figure, print_markdown
from simtest.dataset.index import HIGHLIGHTS, SAMPLES, shard_tables, shortfall, table_file, write_index
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan, Shard
from simtest.dataset.shard import finish, write_sample
from simtest.runtime.arrays import Array
from simtest.runtime.files import make_folder, write_parquet
from simtest.spec import load_dataset
from simtest.spec.recipes import Dataset

FRAMES = 10**7
ANATOMIES, EACH = 22, 3
"""Anatomies that are timed, and samples of each; the shares of the families are those of the recipe."""

COPIES = 30
"""Shards whose rows are read for the index and the card."""

WORKERS = 1000
CORE_HOUR, TB_MONTH = 0.04, 20.0
"""Prices that the table assumes, in any currency: of a core for an hour, and of a TB for a month."""

LINEAR = 0.9


@dataclass(frozen=True)
class Measured:
    """What samples of a recipe took.

    `samples_s`, `anatomies_s`: processor time of each sample, encoding and writing included, and of each anatomy
    beyond that of its samples, s; `sample_bytes`: mean size of a sample in its shard; `tables_s`: time of one
    sample in the index and card that one process makes at the end, s; `plan`: the plan of ten million frames.
    """

    samples_s: Array
    anatomies_s: Array
    sample_bytes: float
    tables_s: float
    plan: Plan

    @property
    def per_anatomy(self) -> int:
        """Samples of an anatomy."""
        return self.plan.dataset.samples_per_anatomy

    @property
    def sample_s(self) -> float:
        """Processor time of a sample with its share of its anatomy, s."""
        return float(self.samples_s.mean() + self.anatomies_s.mean() / self.per_anatomy)

    @property
    def shards(self) -> int:
        """Shards of ten million frames."""
        return -(-FRAMES // self.plan.samples_per_shard)


def recipes() -> dict[str, Dataset]:
    """Return the recipes that are costed, with seeds that no run had before: nothing of them is kept in any folder."""
    seed = int.from_bytes(os.urandom(4), "little")
    return {name: load_dataset(name, {"seed": seed}) for name in ("smooth", "endoscopy")}


def measure(dataset: Dataset, anatomies: int = ANATOMIES, samples: int = EACH) -> Measured:
    """Make some samples of new anatomies one by one, and write them."""
    # One thread, as a worker has that shares the processor with others.
    os.environ["SIMTEST_THREADS"] = "1"
    cv2.setNumThreads(1)
    plan = Plan(dataset)
    maker = Maker(plan)
    size = dataset.samples_per_anatomy
    blocks = _blocks(plan, anatomies)
    # The first sample of the process compiles kernels, those of each family once.
    for family in range(len(dataset.families)):
        spare = [b for b in _all_blocks(plan) if plan.anatomy(b * size).family == family and b not in blocks]
        maker.make(spare[0] * size).encode()
    first, later, sizes = [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        made = []
        with (folder / "train-000000.tar").open("wb") as file:
            for block in blocks:
                times = []
                for index in range(block * size, block * size + samples):
                    start = time.process_time()
                    sample = maker.make(index)
                    write_sample(file, sample.key, sample.encode())
                    times.append(time.process_time() - start)
                    made.append(index)
                first.append(times[0] - statistics.median(times[1:]))
                later += times[1:]
            finish(file)
        sizes.append((folder / "train-000000.tar").stat().st_size / len(made))
        tables_s = _tables(plan, folder, made)
    return Measured(np.array(later), np.array(first), float(np.mean(sizes)), tables_s, plan)


def _all_blocks(plan: Plan) -> range:
    return range(plan.dataset.samples // plan.dataset.samples_per_anatomy)


def _blocks(plan: Plan, count: int) -> list[int]:
    """Return blocks of samples whose families have about the shares that they have in the dataset."""
    size, blocks = plan.dataset.samples_per_anatomy, list(_all_blocks(plan))
    weights = np.array([family.weight for family in plan.dataset.families])
    wanted = np.maximum(1, np.rint(count * weights / weights.sum())).astype(int)
    return [
        block
        for family, number in enumerate(wanted.tolist())
        for block in [b for b in blocks if plan.anatomy(b * size).family == family][:number]
    ]


def _tables(plan: Plan, folder: Path, made: list[int]) -> float:
    """Return the processor time of one sample in what one process does once all shards are there, s."""

    class Written(Plan):
        shards: tuple[Shard, ...] = (Shard("train", 0, tuple(made)),)

    written, times = Written(plan.dataset), []
    rows = shard_tables(written, folder, written.shards[0])
    # Few samples were made; a shard of the run has more rows.
    more = max(round(plan.samples_per_shard / len(made)), 1)
    shards = tuple(Shard("train", number, ()) for number in range(COPIES))
    for shard in shards:
        for name in (SAMPLES, HIGHLIGHTS):
            copies = range(more * shard.number, more * (shard.number + 1))
            table = pl.concat([rows[name].with_columns(index=pl.col("index") + FRAMES * copy) for copy in copies])
            make_folder((folder / table_file(shard, name)).parent)
            write_parquet(folder / table_file(shard, name), table.with_columns(shard=pl.lit(shard.name)))
    for written.shards in (shards[:1], shards[:1], shards):
        start = time.process_time()
        write_index(written, folder)
        shortfall(written, folder)
        times.append(time.process_time() - start)
    # What is left of the difference is the samples' own.
    return (times[2] - times[1]) / (COPIES - 1) / (more * len(made))


def table(measured: Mapping[str, Measured]) -> list[list[str]]:
    """Return the cost model as rows of text, a column a recipe."""
    rows: list[tuple[str, Any]] = [
        ("a sample, without its anatomy, s of processor", lambda m: f"{m.samples_s.mean():.2f}"),
        ("an anatomy, s of processor", lambda m: f"{m.anatomies_s.mean():.1f}"),
        ("samples of an anatomy", lambda m: f"{m.per_anatomy}"),
        ("a sample with its share of the anatomy, s", lambda m: f"{m.sample_s:.2f}"),
        ("the same at 100 samples an anatomy, s", lambda m: f"{m.samples_s.mean() + m.anatomies_s.mean() / 100:.2f}"),
        ("a sample on disk, MB", lambda m: f"{m.sample_bytes / 1e6:.2f}"),
        ("10^7 samples: core hours", lambda m: f"{hours(m):,.0f}"),
        ("10^7 samples: TB", lambda m: f"{FRAMES * m.sample_bytes / 1e12:.1f}"),
        ("10^7 samples: shards", lambda m: f"{m.shards:,}"),
        ("index and card at the end, by one process, h", lambda m: f"{FRAMES * m.tables_s / 3600:.1f}"),
        (
            f"price at {CORE_HOUR:g} a core hour and {TB_MONTH:g} a TB and month, one month",
            lambda m: f"{price(m):,.0f}",
        ),
    ]
    return [["what", *measured], *([name, *(value(own) for own in measured.values())] for name, value in rows)]


def hours(measured: Measured) -> float:
    """Return the core hours of ten million frames."""
    return FRAMES * measured.sample_s / 3600


def price(measured: Measured) -> float:
    """Return what ten million frames cost at the assumed prices, kept for a month."""
    return hours(measured) * CORE_HOUR + FRAMES * measured.sample_bytes / 1e12 * TB_MONTH


def figures() -> list[Figure]:
    """Measure all recipes, and print their table beside what one process does alone."""
    measured = {name: measure(dataset) for name, dataset in recipes().items()}
    print_markdown(table(measured))
    name = f"index and card by one process, share of a run of {WORKERS} workers, "
    return [Figure(name + recipe, alone(own), 1 - LINEAR, unit="") for recipe, own in measured.items()]


def alone(measured: Measured) -> float:
    """Return the share of a run of `WORKERS` workers in which they wait for the process that makes index and card."""
    joining = FRAMES * measured.tables_s
    return joining / (FRAMES * measured.sample_s / WORKERS + joining)
