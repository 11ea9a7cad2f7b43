"""Laws of seeds: what is drawn hangs on its experiment, setting, realisation and stage, and on no other."""

import itertools
from hashlib import blake2b

import numpy as np

from simtest.runtime import seeds
from simtest.runtime.seeds import Stage
from simtest.spec import Experiment
from simtest.validation.cases import Case, expand
from tests.laws.law import Law, law

REALISATIONS = 4
RELIEF = {"bands": [{"slope_deg": 3.0, "wavelength_mm": 2.0}]}


def branches() -> list[Law]:
    """Count the seeds of two experiments' settings and realisations that are the same: none may be."""
    cases = [(own, case) for own in _experiments() for case in expand(own)]
    made = []
    for name, draw in (("noise", _noise), ("relief", _relief), ("rig", _rig), ("drawn", _drawn), ("render", _render)):
        found = [draw(own, case, number) for own, case in cases for number in range(REALISATIONS)]
        shared = len(found) - len(set(found))
        about = "the same in two realisations, settings, experiments or runs of another seed"
        made.append(law("seeds", f"{name}_shared", "", shared, 0, n=len(found), about=about))
        again = [draw(own, case, number) for own, case in cases for number in range(REALISATIONS)]
        made.append(
            law("seeds", f"{name}_changed", "", sum(map(_differ, found, again)), 0, n=len(found), about="drawn twice")
        )
    return [*made, *_tree()]


def _tree() -> list[Law]:
    """Compare branches of the seed tree with NumPy's seed sequences and a hash, put together by hand."""
    names = ("e", "plane, sigma=0.1 | part 0")
    keys = [int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little") for name in names]
    found, wanted = [], []
    for realisation, stage in itertools.product((0, 3), Stage):
        by_hand = np.random.SeedSequence(7, spawn_key=(*keys, realisation, int(stage)))
        wanted.append(int(by_hand.generate_state(1, np.uint64)[0]) // 2)
        found.append(seeds.integer(7, *names, realisation, stage))
    apart = len(found) - len(set(found))
    differ = sum(a != b for a, b in zip(found, wanted, strict=True))
    about = "SeedSequence of seed, hashed names, realisation and stage"
    return [
        law("seeds", "stages_shared", "", apart, 0, n=len(found), about="two stages of one realisation on one branch"),
        law("seeds", "tree_changed", "", differ, 0, n=len(found), about=about),
    ]


def _experiments() -> list[Experiment]:
    """Return experiments that differ in name or seed alone, of two settings each, all of which draws something."""
    small = {"camera.width": 64, "camera.height": 64, "sensor.noise_sigma": 0.1, "surface.relief": RELIEF}
    loose = {
        "rig.lights.0.position_mm": [1.0, 0.0, 0.0],
        "rig.lights.0.position_error_mm": 0.1,
        "render.samples_per_pixel": 2,
    }
    group = {
        "scene": "plane", "label": "plane", "set": {**small, **loose}, "sweep": [{"surface.tilt_deg": [5.0, 10.0]}],
        "random": {"surface.azimuth_deg": {"low": 0.0, "high": 90.0}},
    }  # fmt: skip
    return [
        Experiment(name=name, seed=seed, realisations=REALISATIONS, groups=[group])
        for name, seed in (("first", 0), ("first", 1), ("second", 0))
    ]


def _noise(experiment: Experiment, case: Case, number: int) -> float:
    return case.noise_seed(experiment, number)


def _relief(experiment: Experiment, case: Case, number: int) -> float:
    relief = case.scene(experiment, number)[0].surface.relief
    return -1 if relief is None else relief.seed


def _rig(experiment: Experiment, case: Case, number: int) -> float:
    return case.scene(experiment, number)[0].rig.seed


def _drawn(experiment: Experiment, case: Case, number: int) -> float:
    return case.scene(experiment, number)[1]["surface.azimuth_deg"]


def _render(experiment: Experiment, case: Case, number: int) -> float:
    return case.scene(experiment, number)[0].render.seed


def _differ(first: float, second: float) -> bool:
    return first != second
