"""The same seed gives the same bytes, whatever the process did before: other scenes, orders, threads, load."""

import gc
import random
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest

from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session
from simtest.rendering.backend import COLOUR_VARIANT, DEFAULT_VARIANT
from simtest.spec import load_dataset, load_scene
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate

pytestmark = [pytest.mark.render, pytest.mark.slow]

SMALL = {"camera.width": 80, "camera.height": 60, "camera.fx": 50.0, "camera.fy": 50.0}
VIEWS = {"surface.viewpoint": {"low": 0, "high": 1000, "integer": True}}
KEPT = 3


def tiny(**values):
    return load_dataset("tiny", {"samples": 6, "samples_per_anatomy": 1, **values})


def tissue(**values):
    described = {"name": "tissue", "samples": 4, "samples_per_anatomy": 2, "seed": 3, "tries": 2, **values}
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis"]}
    families = [{"scene": "tissue_stomach", "set": SMALL | {"render.samples_per_pixel": 2}, "per_sample": VIEWS}]
    return validate(Dataset, described | {"families": families}, "tissue")


@contextmanager
def busy(count):
    """Keep threads computing meanwhile."""
    stop = threading.Event()

    def compute():
        x = np.random.default_rng(0).random((200, 200))
        while not stop.is_set():
            x = x @ x
            x /= x.max()

    threads = [threading.Thread(target=compute) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@pytest.mark.parametrize(("recipe", "steps"), [(tiny, 60), (tissue, 12)])
def test_bytes_hang_on_nothing_that_was_done_before(recipe, steps):
    plan, rng = Plan(recipe()), random.Random(7)
    alone = [Maker(plan).make(index).encode() for index in range(plan.dataset.samples)]
    # A sample of another seed has other bytes in each of its pictures.
    other = Maker(Plan(recipe(seed=11))).make(1).encode()
    assert other["image.png"] != alone[1]["image.png"]
    assert other["normal.png"] != alone[1]["normal.png"]
    import drjit as dr

    threads, maker, kept, done = dr.thread_count(), Maker(plan), [], []
    differing, comparisons = [], []
    scenes = ["sphere", "plane", "cylinder", "saddle"]

    def compare(index, sample, history):
        found = sample.encode()
        differing.extend((index, name, history) for name, data in found.items() if data != alone[index][name])

    # As a shard is written, each sample is encoded while the next one is rendered.
    try:
        with busy(2), ThreadPoolExecutor(1) as writer:
            for _ in range(steps):
                step = rng.choice(["sample", "sample", "sample", "scene", "threads", "maker", "collect"])
                if step == "sample":
                    index = rng.randrange(len(alone))
                    done.append(index)
                    comparisons.append(writer.submit(compare, index, maker.make(index), done[-8:]))
                elif step == "scene":
                    name, variant = rng.choice(scenes), rng.choice([DEFAULT_VARIANT, COLOUR_VARIANT])
                    kept = [*kept, Session(load_scene(name), variant)][-KEPT:]
                    kept[-1].radiance()
                    done.append((name, variant))
                elif step == "threads":
                    dr.set_thread_count(rng.choice([1, 2, 3, 8]))
                    done.append(f"{dr.thread_count()} threads")
                elif step == "maker":
                    maker = Maker(plan)
                else:
                    kept.clear()
                    gc.collect()
    finally:
        dr.set_thread_count(threads)
    for comparison in comparisons:
        comparison.result()
    assert differing == []
    assert sum(isinstance(step, int) for step in done) > steps / 4
