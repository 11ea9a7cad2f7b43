"""Every seed changes its draw: the same seed draws the same, another seed or number draws another.

That of a relief is in test_relief.py, since a relief takes long to draw.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from simtest.advice.plan import Question, drawn_values, surroundings
from simtest.advice.scope import read_scope
from simtest.advice.twin.scenes import make_pool
from simtest.bench.suite import CaseSpec, pooled
from simtest.dataset.plan import Plan
from simtest.realism.compare import distances
from simtest.realism.fitting.bank import FrameMaker
from simtest.reconstruction.statistics import COLUMNS
from simtest.runtime.resources import data_root
from simtest.runtime.seeds import Stage, from_integer, generator, integer
from simtest.simulation.sensor import capture
from simtest.spec import Experiment, load_dataset, scene_from_dict
from simtest.spec.lights import Rig
from simtest.spec.reflectance import TissueColour
from simtest.spec.sensor import Sensor
from simtest.surfaces import make_surface, poses
from simtest.surfaces.liver import Body
from simtest.surfaces.recipe import load_recipe
from simtest.surfaces.tube import Tube
from simtest.surfaces.vessels import grow_vessels, surface_patch
from simtest.validation import motion
from simtest.validation.cases import expand

BAND = {"slope_deg": 3.0, "wavelength_mm": 1.0}
PLANE = {"surface": {"type": "plane"}, "camera": {"width": 48, "height": 40, "fx": 40.0, "fy": 40.0}}
DRAWN = {
    **PLANE,
    "surface": {"type": "plane", "relief": {"bands": [BAND]}},
    "rig": {"lights": [{"offset_mm": 1.0, "position_error_mm": 0.2}]},
    "render": {"samples_per_pixel": 4},
}


def case_scene(seed, realisation=0):
    """Return what hangs on chance of a scene of an experiment: noise, swept value, samples, lights, relief."""
    random = {"surface.tilt_deg": {"low": 0.0, "high": 30.0}}
    experiment = Experiment(name="e", seed=seed, groups=[{"scene": "plane", "set": DRAWN, "random": random}])
    (case,) = expand(experiment)
    scene, drawn = case.scene(experiment, realisation)
    relief = scene.surface.relief.seed
    return case.noise_seed(experiment, realisation), *drawn.values(), scene.render.seed, scene.rig.seed, relief


def motion_seeds(seed, number=0):
    """Return the seeds of the noise of further views: they are drawn after the errors of their poses."""
    views = {"views": {"length_mm": 2.0, "translation_error": 0.1}}
    experiment = Experiment(name="e", seed=seed, groups=[{"scene": "plane", "set": {**PLANE, **views}}])
    (case,) = expand(experiment)
    scene = case.scene(experiment, number)[0]
    noise, told = [], []

    def frame(of):
        noise.append(of)
        return np.zeros((40, 48), np.float32)

    def told_pose(*given):
        told.append(original(*given))
        return told[-1]

    original, motion.told_pose = motion.told_pose, told_pose
    try:
        dark = SimpleNamespace(frame=frame, full_scale=0.0)
        further = [motion.FurtherView(moved, dark) for moved in scene.views.moved()]
        motion.with_motion(experiment, case, number, SimpleNamespace(scene=scene), further, [])
    finally:
        motion.told_pose = original
    return *noise, *(pose[0, 3] for pose in told)


def sample(seed, index=0):
    """Return what hangs on chance of a sample, whatever its family."""
    drawn = Plan(load_dataset("tiny", {"seed": seed})).draw(index)
    keys = ("surface.tilt_deg", "surface.azimuth_deg", "sensor.noise_sigma")
    return drawn.scene.sensor.seed, drawn.scene.render.seed, *(drawn.values[key] for key in keys)


def redrawn_sensor(seed, index=0, chain=1):
    """Return the noise of a further picture of one radiance, of which `simtest fit` takes several."""
    dataset = load_dataset("tiny", {"seed": seed})
    drawn = Plan(load_dataset("tiny")).draw(0)
    sensor = FrameMaker._redrawn(SimpleNamespace(dataset=dataset), index, chain, drawn)[1].sensor
    return sensor.seed, sensor.noise_sigma


def benchmark_values(seed):
    draw = {"surface.tilt_deg": {"low": 0.0, "high": 30.0}, "surface.k1_per_mm": {"kind": "normal", "high": 0.1}}
    case = CaseSpec.model_validate({"part": "p", "name": "c", "draws": 3, "draw": draw})
    return sum(pooled(seed, "e", case).values(), ())


def advice_values(seed):
    question = Question(read_scope("laparoscope"), "liver", (20.0, 60.0), frames=40)
    return tuple(value for column in drawn_values(surroundings(question), seed, 3, 2).values() for value in column)


def realism_interval(seed):
    random = np.random.default_rng(0)
    sides = [{f"{i}": {name: random.normal(size=9) for name in COLUMNS} for i in range(6)} for _ in range(2)]
    return distances(*sides, seed=seed)[0].interval


def anatomy(name):
    def values(seed):
        recipe = load_recipe(data_root("meshes") / f"{name}.toml", {"seed": seed})
        if name == "liver":
            return tuple(Body(recipe).normals(np.array([[40.0, 30.0, 20.0]]))[0])
        return tuple(fold.depth for fold in Tube(recipe)._folds[:2])

    return values


def lumen(number, label="a"):
    surface = SimpleNamespace(
        sites=lambda rng: rng.normal(size=(50, 3)),
        clearance=lambda points: 20 - np.linalg.norm(points, axis=1),
        probe=SimpleNamespace(cast=lambda origins, directions: np.full(len(origins), 20.0)),
    )
    return tuple(poses.lumen_pose(label, number, surface)[:3, 3])


def organ(number, label="a"):
    def targets(rng, count):
        normals = rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return 10 * normals, normals

    def outside(points, directions=None):
        return np.linalg.norm(points, axis=1) - 10

    surface = SimpleNamespace(clearance=outside, probe=SimpleNamespace(cast=outside, targets=targets))
    return tuple(poses.organ_pose(label, number, surface)[:3, 3])


def vessels(seed):
    surface = make_surface(scene_from_dict(PLANE).surface)
    return tuple(grow_vessels(surface_patch(surface), TissueColour().vessels, seed).position[:50, :2].mean(axis=0))


def noise(seed, **sensor):
    light = np.full((8, 8), 0.5, np.float32)
    return tuple(capture(light, 1.0, Sensor.model_validate(sensor), from_integer(seed)).ravel())


def lights(seed):
    rig = Rig.model_validate({**DRAWN["rig"], "seed": seed})
    return tuple(rig.true_mm().ravel())


BRANCH = ("e", "c", 0, Stage.SENSOR)
DRAWS = {
    "tree": lambda seed: (integer(seed, *BRANCH), generator(seed, *BRANCH).random(), from_integer(seed).random()),
    "tree, experiment": lambda seed: (integer(0, f"{seed}", *BRANCH[1:]),),
    "tree, case": lambda seed: (integer(0, "e", f"{seed}", *BRANCH[2:]),),
    "tree, realisation": lambda seed: (integer(0, "e", "c", seed, Stage.SENSOR),),
    "tree, stage": lambda seed: (integer(0, "e", "c", 0, list(Stage)[seed]),),
    "experiment": case_scene,
    "realisation": lambda number: case_scene(0, number),
    "motion": motion_seeds,
    "motion, realisation": lambda number: motion_seeds(0, number),
    "dataset": sample,
    "dataset, sample": lambda index: sample(0, index),
    "fitted recipe": redrawn_sensor,
    "fitted recipe, sample": lambda index: redrawn_sensor(0, index),
    "fitted recipe, picture": lambda chain: redrawn_sensor(0, 0, chain),
    "benchmark": benchmark_values,
    "advice": advice_values,
    "realism": realism_interval,
    "colon": anatomy("colon"),
    "liver": anatomy("liver"),
    "viewpoint in a lumen": lumen,
    "viewpoint in a lumen, surface": lambda number: lumen(0, f"{number}"),
    "viewpoint of an organ": organ,
    "vessels": vessels,
    "lights": lights,
    "patch of tissue": lambda number: make_pool(number + 1)[number].k_per_mm,
    "white noise": lambda seed: noise(seed, noise_sigma=0.1),
    "shot noise": lambda seed: noise(seed, full_well=1000.0)[:8],
    "read noise": lambda seed: noise(seed, full_well=1e9, read_noise=1e6),
}
"""What a seed, or a number, draws: each value must change with it (of shot noise's few counts one may repeat)."""


@pytest.mark.parametrize("name", DRAWS)
def test_a_seed_changes_its_draw(name):
    draw = DRAWS[name]
    first, again, other = draw(1), draw(1), draw(2)
    assert first == again
    assert len(first) == len(other) > 0
    same = [one == two for one, two in zip(first, other, strict=True)]
    assert not any(same) or (name == "shot noise" and not all(same))
