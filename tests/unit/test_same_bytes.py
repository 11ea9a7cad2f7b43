"""Samples and frames are the same bytes whatever is kept between them, and whatever the process did before."""

import gc
import json
import os
import random
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest

from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session, lighting
from simtest.rendering.backend import COLOUR_VARIANT, DEFAULT_VARIANT, colour_variant
from simtest.simulation.frame import DEAR_SAMPLES, quick_look, render_view, shows_isolated
from simtest.spec import load_dataset, load_scene, scene_from_dict
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate
from tests.marked import marked

pytestmark = pytest.mark.render

CAMERA = {"width": 64, "height": 48, "fx": 40.0, "fy": 40.0}
ROUGH = {"type": "sphere", "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}}
LIGHT = {"position_mm": [1.0, 0.5, 0.0]}

SET = {f"camera.{key}": value for key, value in CAMERA.items()} | {"render.samples_per_pixel": 2}
VIEWS = {"surface.viewpoint": {"low": 0, "high": 1000, "integer": True}}
BANDS = {"surface.relief.seed": {"low": 0, "high": 1000, "integer": True}}
RELIEF = {"surface.relief": {"bands": [{"slope_deg": 6.0, "wavelength_mm": 1.0}]}}
FAMILIES = {
    "colon": {"scene": "anatomy", "set": SET | {"surface.path": "colon"}, "per_sample": VIEWS},
    "liver": {"scene": "anatomy", "set": SET | {"surface.path": "liver"}, "per_sample": VIEWS},
    "rough": {"scene": "sphere", "set": SET | RELIEF, "per_sample": BANDS},
    "one sample": {"scene": "anatomy", "set": SET | {"render.samples_per_pixel": 1}, "per_sample": VIEWS},
}


def recipe(family, **values):
    described = {"name": "reuse", "samples": 3, "families": [FAMILIES[family]], "tries": 4} | values
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis", "circle_pose"]}
    return validate(Dataset, described, "reuse")


@pytest.mark.parametrize(
    ("family", "least"),
    [
        pytest.param("colon", 3, marks=pytest.mark.slow),
        pytest.param("liver", 3, marks=pytest.mark.ci),
        pytest.param("rough", 6, marks=pytest.mark.slow),
        ("one sample", 3),
    ],
)
def test_samples_are_the_same_bytes_without_reuse(family, least, monkeypatch):
    plan = Plan(recipe(family, highlights=least))
    kept = [Maker(plan).make(index) for index in range(1)] + [(maker := Maker(plan)).make(1), maker.make(2)]
    # Attempts were rejected, and not for want of light.
    assert any(sample.meta["attempt"] for sample in kept)
    update = Session.update

    def forgetful(session, scene):
        update(session, scene)
        session._forget()

    monkeypatch.setattr(Session, "update", forgetful)
    fresh = Maker(plan)
    for index, sample in enumerate(kept):
        assert fresh.make(index).encode() == sample.encode()


# Meanwhile: test_a_quick_look_is_taken_where_it_costs_less_than_the_frame.
@pytest.mark.parametrize("family", marked(["colon", "rough"], ci=["colon"], slow=["rough"]))
def test_a_frame_that_is_not_rendered_shows_too_few_highlights(family):
    plan = Plan(recipe(family))
    session = Session(plan.draw(0).scene)
    answers = []
    for attempt in range(6):
        drawn = plan.draw(0, attempt).scene
        shown = sum(highlight.isolated for highlight in render_view(session, drawn).highlights)
        for least in (1, shown, shown + 1):
            answers.append(shows_isolated(session, drawn, least))
            assert answers[-1] == (shown >= least), (attempt, least)
    assert set(answers) == {True, False}


# Which frames have a quick look ---------------------------------------------------------------------------------------

DISC = {"source": {"type": "disc", "radius_mm": 0.5}}


@pytest.mark.parametrize(
    ("samples", "depth", "light", "quick"),
    [
        (16, 2, DISC, False),
        (4, 2, DISC, False),
        (1, 2, DISC, False),
        (17, 2, DISC, True),
        (4, 3, DISC, True),
        (4, 2, {}, True),
    ],
)
def test_a_quick_look_is_taken_where_it_costs_less_than_the_frame(samples, depth, light, quick):
    render = {"samples_per_pixel": samples, "path_depth": depth}
    drawn = scene_from_dict({"surface": ROUGH, "rig": {"lights": [{**LIGHT, **light}]}, "render": render})
    assert (quick_look(drawn) is not None) is quick


def test_the_quick_look_of_a_wide_source_takes_as_many_points_as_that_many_samples():
    """A control: datasets keep their draws where the renderer's numbers change, and this says that they have."""
    assert lighting.FIXED == lighting.DRAWN * DEAR_SAMPLES


@pytest.mark.parametrize("tries", [pytest.param(8, marks=pytest.mark.ci), 2])
def test_wide_sources_are_judged_by_the_frame_that_is_kept(tries, monkeypatch):
    bands = [{"slope_deg": 3.0, "wavelength_mm": 2.0}]
    wide = {"rig.lights": [{**LIGHT, **DISC}], "render.samples_per_pixel": 4, "surface.relief": {"bands": bands}}
    tilts = {"surface.tilt_deg": {"low": 0.0, "high": 30.0}}
    described = {"name": "wide", "samples": 2, "seed": 1, "tries": tries, "estimators": ["cone_axis"]}
    described["families"] = [{"scene": "sphere", "set": SET | wide, "per_sample": tilts}]
    plan = Plan(validate(Dataset, described | {"splits": {"train": 1, "validation": 0, "test": 0}}, "wide"))

    def by_geometry(*asked, rendered):
        assert not rendered, "looked at twice"
        return shows_isolated(*asked, rendered=False)

    monkeypatch.setattr("simtest.dataset.maker.shows_isolated", by_geometry)
    maker, session, attempts = Maker(plan), Session(plan.draw(0).scene, colour_variant()), []
    for index in range(2):
        sample = maker.make(index)
        # Each draw's whole frame, until one shows a highlight.
        shown = []
        while len(shown) < tries and not any(shown):
            shown.append(render_view(session, plan.draw(index, len(shown)).scene).isolated)
        assert sample.meta["attempt"] == len(shown) - 1
        assert sum(bool(truth["isolated"]) for truth in sample.meta["highlights"]) == shown[-1]
        attempts.append((len(shown) - 1, shown[-1]))
    assert attempts == {8: [(3, 1), (0, 1)], 2: [(1, 0), (0, 1)]}[tries]


# Whatever the process did before: other scenes, orders, threads, load -----------------------------------------------

KEPT = 3


def tiny(**values):
    return load_dataset("tiny", {"samples": 6, "samples_per_anatomy": 1, **values})


def tissue(**values):
    described = {"name": "tissue", "samples": 4, "samples_per_anatomy": 2, "seed": 3, "tries": 2, **values}
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis"]}
    families = [{"scene": "tissue_stomach", "set": SET, "per_sample": VIEWS}]
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


@pytest.mark.slow
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


CODE = """
import hashlib, json
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import load_scene
settings = {"camera.width": 96, "camera.height": 80, "camera.fx": 90.0, "camera.fy": 90.0, "surface.radius_mm": 11.731,
            "surface.tilt_deg": 5.4321, "sensor.noise_sigma": 0.0, "sensor.full_well": 8000.0}
scene = load_scene("sphere", settings)
view = render_view(Session(scene), scene)
light = view.light
dark = float(light[light > 0].min())
hashes = [hashlib.sha256(image.tobytes()).hexdigest() for image in (light, view.frame(1))]
print(json.dumps([*hashes, dark]))
"""


@pytest.mark.slow
def test_light_and_noise_are_the_same_with_one_thread_and_with_two():
    """Down to light that single precision barely holds."""
    one, two = (
        json.loads(
            subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120, check=True,
                           env={**os.environ, "SIMTEST_THREADS": threads}).stdout
        )
        for threads in ("1", "2")
    )  # fmt: skip
    assert one == two
    # The scene holds light so faint that it matters.
    assert two[2] < 1e-37
