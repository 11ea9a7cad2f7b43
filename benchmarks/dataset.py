"""Datasets: encoding, reading, and how well rendering and writing overlap.

The samples are those of the shipped dataset `smooth`: 640 x 480 with 16 samples a pixel and all labels.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2

from benchmarks.cost import measure, recipes
from benchmarks.measuring import Figure
from simtest.dataset import read
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.dataset.shard import Sample, finish, write_sample
from simtest.dataset.shard_writer import append
from simtest.spec import load_dataset

COUNT = 16
"""Samples that are made in each way, of one anatomy."""

ROUNDS = 5


def figures() -> list[Figure]:
    """Measure encoding, overlap and reading."""
    maker = Maker(Plan(load_dataset("smooth", {"samples": 10 * COUNT, "samples_per_anatomy": 2 * COUNT})))
    maker.make(0)
    samples = [maker.make(index) for index in range(COUNT)]
    size = sum(len(data) for data in samples[0].encode().values()) / 1e6
    encoding = _median([_time(lambda sample=sample: sample.encode()) for sample in samples])
    figures = [
        Figure("encoding a 640 x 480 sample", 1e3 * encoding, 20.0, unit="ms"),
        Figure("its size", size, 2.0, unit="MB"),
    ]
    figures += _with_anatomies()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "train-000000.tar"
        figures += _overlap(maker, samples, path)
        figures += _reading(path)
    return figures


def _with_anatomies() -> list[Figure]:
    """Time samples of new anatomies, each anatomy shared by as many samples as in a real run."""
    measured = measure(recipes()["smooth"])
    about = (
        f"{measured.samples_s.mean():.2f} s of its own, and {measured.anatomies_s.mean():.1f} s of each anatomy over "
    )
    about += (
        f"{measured.per_anatomy} samples; {len(measured.samples_s)} samples of {len(measured.anatomies_s)} anatomies"
    )
    return [Figure("a sample with its share of its anatomy, processor", measured.sample_s, unit="s", about=about)]


def _overlap(maker: Maker, samples: list[Sample], path: Path) -> list[Figure]:
    """Time rendering alone, writing alone, and both as a dataset's run does them, in turns."""
    indices = tuple(sample.index for sample in samples)

    def write() -> None:
        with path.open("wb") as file:
            for sample in samples:
                write_sample(file, sample.key, sample.encode())
            finish(file)

    def both() -> None:
        with (path.parent / "both.tar").open("wb") as file:
            append(file, maker, indices, lambda: None)
            finish(file)

    times: dict[str, list[float]] = {"render": [], "write": [], "both": []}
    for _ in range(3):
        times["render"].append(_time(lambda: [maker.make(index) for index in indices]))
        times["write"].append(_time(write))
        times["both"].append(_time(both))
    render, written, run = (_median(times[name]) / len(samples) for name in ("render", "write", "both"))
    about = f"a sample: rendering {1e3 * render:.0f} ms, writing {1e3 * written:.0f} ms, both {1e3 * run:.0f} ms"
    return [Figure("one run over the slower of rendering and writing, rate", max(render, written) / run, 0.8, True,
                   about=about)]  # fmt: skip


def _reading(path: Path) -> list[Figure]:
    """Time reading on one core."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        ways = {"all images": None, "image, depth, normal": ("image", "depth", "normal")}
        return [
            Figure(f"reading {name}, samples a second", COUNT / _median([
                _time(lambda fields=fields: list(read(path.parent, fields=fields, shards=[path.name])))
                for _ in range(ROUNDS)
            ]), 80.0, True, unit="1/s")
            for name, fields in ways.items()
        ]  # fmt: skip
    finally:
        cv2.setNumThreads(threads)


def _time(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
