"""The experiment behind an advice: frames of an organ's wall at evenly spaced distances, as a file to run again."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.advice.scope import Interval, Scope
from simtest.advice.tissue import ORGANS, Organ, Surroundings, is_smooth, wall
from simtest.errors import InputError
from simtest.geometry.checks import check_integer, check_number
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import write_atomically
from simtest.runtime.seeds import Stage, generator
from simtest.spec import Experiment, Scene, load_experiment, load_scene
from simtest.spec.toml_files import toml_value
from simtest.validation.cases import RELIEF_SEED

ESTIMATORS = ("curved", "cone_axis", "brightest_point", "bisector", "cloud")

DISTANCES = 8
"""Distances at which the wall stands: the middles of so many equal parts of the range."""

LEAST_FRAMES, MOST_FRAMES = 32, 200
"""Of the default number of frames."""

MOST_ASKED = 10_000
"""Frames that may be asked for."""

BUDGET_S = 140.0
"""Processor time of the frames, about."""

ROUGH_S, SMOOTH_S = (0.6, 5.0), (0.35, 2.5)
"""Processor time of a frame of a wall with relief, and of one without: so much, and so much more a million pixels."""

SAMPLES = 4
"""Rays a pixel."""

FARTHEST_MM = 500.0
MOST_BOUND_DEG = 30.0
MOST_SEED = 2**63 - 1

SURFACE = "surface."
"""Begins the key paths of a wall's form and pose."""

TRIES = 200
"""Walls that are drawn for a frame until one leaves camera and lights in free space."""

Values = dict[str, list[Any]]
"""Values of all frames by key path."""


@dataclass(frozen=True)
class Question:
    """What is asked."""

    scope: Scope
    organ: str = "colon"  # one of `ORGANS`
    distances_mm: Interval = (20.0, 60.0)  # range of the wall's distance along the optical axis
    bound_deg: float = 5.0  # error beyond which a method counts as broken
    frames: int | None = None  # default as many as `BUDGET_S` allows
    seed: int = 0  # of everything that is drawn

    def __post_init__(self) -> None:
        if self.organ not in ORGANS:
            known = ", ".join(ORGANS)
            raise InputError(f"--organ {self.organ}: unknown; organs: {known}{suggestion(self.organ, ORGANS)}")
        near, far = self.distances_mm
        for value in (near, far):
            check_number("--distances", value, above=0)
        if not near < far <= FARTHEST_MM:
            raise InputError(
                f"--distances {near:g},{far:g}: must be the nearest and the farthest, in this order, up to "
                f"{FARTHEST_MM:g} mm"
            )
        deepest = float(self.scope.deepest_light_mm)
        if deepest >= near:
            raise InputError(
                f"--distances {near:g},{far:g}: a light lies {deepest:g} mm in front of the camera, inside the tissue; "
                "the nearest distance must be larger"
            )
        check_number("--bound", self.bound_deg, above=0)
        check_integer("--seed", self.seed, 0, MOST_SEED)
        if self.bound_deg > MOST_BOUND_DEG:
            raise InputError(f"--bound {self.bound_deg:g}: must be at most {MOST_BOUND_DEG:g} deg")
        if self.frames is not None and not DISTANCES <= self.frames <= MOST_ASKED:
            raise InputError(f"--frames {self.frames}: must be {DISTANCES} to {MOST_ASKED}")

    @property
    def kind(self) -> Organ:
        """The organ."""
        return ORGANS[self.organ]

    @property
    def per_distance(self) -> int:
        """Frames at each distance: as many at each, so that there are at least as many in all as asked for."""
        return math.ceil((self.frames or affordable(self)) / DISTANCES)

    @property
    def middle_mm(self) -> float:
        """Middle of the distances, mm."""
        return sum(self.distances_mm) / 2

    @property
    def view_mm(self) -> float:
        """About how much of the nearest wall is in view, mm."""
        return round(self.distances_mm[0] * min(self.scope.size) / self.scope.focal_px, 3)

    @property
    def title(self) -> str:
        """What is asked, as one phrase."""
        near, far = self.distances_mm
        return f"{self.scope.name}, {self.organ}, {near:g} to {far:g} mm"


def affordable(question: Question) -> int:
    """Return how many frames `BUDGET_S` allows: large pictures and rough walls take longer."""
    width, height = question.scope.size
    each, megapixel = SMOOTH_S if is_smooth(question.kind, question.scope.relief) else ROUGH_S
    frames = BUDGET_S / (each + megapixel * width * height / 1e6)
    return int(min(max(frames, LEAST_FRAMES), MOST_FRAMES)) // DISTANCES * DISTANCES


def distances_of(question: Question) -> list[float]:
    """Return the distances at which the wall stands, mm."""
    near, far = question.distances_mm
    return [round(near + (far - near) * (i + 0.5) / DISTANCES, 6) for i in range(DISTANCES)]


def surroundings(question: Question) -> Surroundings:
    """Return what the frames set of the surface, and what is drawn for each of them."""
    return wall(question.kind, question.scope.relief, question.view_mm)


def main_experiment(question: Question) -> Experiment:
    """Return the experiment whose results are the expected errors; its name is that of its file."""
    around, scope = surroundings(question), question.scope
    near, far = question.distances_mm
    # The middle of the range with the standard deviation of an even spread over it.
    known = {"lobe": False, "distance_mm": question.middle_mm}
    known["distance_sd"] = round((far - near) / math.sqrt(12) / question.middle_mm, 6)
    held = {
        **around.set, "sensor": {"preset": question.kind.sensor}, **scope.tables,
        "render": {"samples_per_pixel": SAMPLES}, "known": known,
    }  # fmt: skip
    values = drawn_values(around, question.seed, question.per_distance, DISTANCES)
    # Each distance once, then all again.
    distances = distances_of(question) * question.per_distance
    values = in_free_space(values, load_scene(question.kind.scene, held), distances, around.random, question.seed)
    # Without an offset the bisector would be the cone's axis again.
    at_camera = bool(np.all(scope.offsets_mm == 0))
    group = {
        "scene": question.kind.scene, "label": question.organ,
        # Whatever is found gets an answer, not isolated highlights alone.
        "isolated": False,
        "set": held, "pool": [{"surface.distance_mm": distances} | values],
    }  # fmt: skip
    return Experiment.model_validate({
        "name": "experiment", "title": f"Advice: {question.title}", "realisations": 1, "seed": question.seed,
        "estimators": [name for name in ESTIMATORS if not (at_camera and name == "bisector")], "groups": [group],
    })  # fmt: skip


def write_experiment(experiment: Experiment, path: Path) -> Experiment:
    """Write the file of a `main_experiment`, and return what it reads back as: a run of it is a run of the same."""
    names = ("title", "realisations", "seed", "estimators")
    lines = [f"{name} = {toml_value(getattr(experiment, name))}\n" for name in names]
    for group in experiment.groups:
        lines.append(f"\n[[groups]]\nscene = {toml_value(group.scene)}\nlabel = {toml_value(group.label)}\n")
        lines.append(f"isolated = false\npool = [{', '.join(map(_inline, group.pool))}]\nset = {_inline(group.set)}\n")
    write_atomically(path, lambda part: part.write_text("".join(lines), encoding="utf-8"))
    return load_experiment(path)


def _inline(table: Mapping[str, Any]) -> str:
    """Return a table on one line with its keys quoted: a key path is one key here."""
    return "{" + ", ".join(f"{json.dumps(key)} = {toml_value(value)}" for key, value in table.items()) + "}"


# What differs from frame to frame ------------------------------------------------------------------------------------


def drawn_values(around: Surroundings, seed: int, count: int, distances: int) -> Values:
    """Return the drawn values of `count` frames at each of some distances, each distance once, then all again.

    At each distance a value takes one number from each of as many equal parts of its range as there are frames: a Latin
    hypercube [McKay, Beckman and Conover, Technometrics 21, 1979, 239], whose means vary less than those of independent
    draws. Frames at one distance have reliefs of their own. Those of different distances that follow each other share
    the noise that a relief is made of, but no wavelength, slope, form or pose: a noise takes as long as a small frame.
    """
    rng = generator(seed, "advice", "drawn", 0, Stage.SWEEP)
    values: Values = {}
    for key, ends in around.random.items():
        # Shape (frames at a distance, distances).
        parts = rng.permuted(np.repeat(np.arange(count)[:, None], distances, axis=1), axis=0)
        shares = (parts + rng.uniform(size=parts.shape)) / count
        values[key] = [_at(ends, share) for share in shares.ravel()]
    if "relief" in around.set["surface"]:
        values[RELIEF_SEED] = np.repeat(rng.integers(2**32, size=count), distances).tolist()
    return values


def _at(ends: Interval, share: float) -> float:
    low, high = ends
    return round(float(low + (high - low) * share), 9)


def in_free_space(
    values: Values, scene: Scene, distances_mm: Sequence[float], random: Mapping[str, Interval], seed: int
) -> Values:
    """Return values in which form and pose are drawn anew where the wall would hold the camera or touch a light.

    A wall that bends towards the camera, and is tilted, may reach it. `random` are the ends of what is drawn.
    """
    forms = [key for key in values if key.startswith(SURFACE) and not key.startswith("surface.relief")]
    free = {key: list(column) for key, column in values.items()}
    for i, distance in enumerate(distances_mm):
        rng = generator(seed, "advice", "placed", i, Stage.SWEEP)
        for _ in range(TRIES):
            form = {key.removeprefix(SURFACE): free[key][i] for key in forms}
            if _stands_free(scene, {**form, "distance_mm": distance}):
                break
            for key in forms:
                free[key][i] = _at(random[key], rng.uniform())
        else:
            raise InputError(
                f"--distances: at {distance:g} mm no wall of {TRIES} leaves camera and lights in free space; "
                "the nearest distance must be larger, or the lights nearer to the camera"
            )
    return free


def _stands_free(scene: Scene, form: Mapping[str, float]) -> bool:
    """Return whether camera and lights of a scene stand in free space before a wall of another form."""
    # Imported here: a plan that is read again needs neither.
    from simtest.rendering.placement_checks import check_camera, check_lights
    from simtest.surfaces import make_surface

    # Its relief moves no point.
    surface = make_surface(scene.surface.model_copy(update={**form, "relief": None}))
    try:
        check_camera(scene, surface)
        check_lights(scene, surface)
    except InputError:
        return False
    # Beyond a wall that is no closed body a light is merely unseen: here it would lie in the tissue.
    pose = surface.model_from_camera
    return bool((surface.clearance(scene.rig.true_mm() @ pose[:3, :3].T + pose[:3, 3]) > 0).all())
