"""The experiment behind an advice: frames of an organ's wall at evenly spaced distances, as a file to run again."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.advice.draws import drawn_values, in_free_space
from simtest.advice.organs import ORGANS, Organ, Surroundings, is_smooth, wall
from simtest.advice.scope import Interval, Scope
from simtest.errors import InputError
from simtest.geometry.checks import check_integer, check_number
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import write_atomically
from simtest.spec import Experiment, load_experiment, load_scene
from simtest.spec.toml_files import toml_value

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


@dataclass(frozen=True)
class Question:
    """What is asked.

    Parameters
    ----------
    scope : Scope
        Camera, lights and sensor.
    organ : str
        One of `ORGANS`.
    distances_mm : (float, float)
        Range of the wall's distance along the optical axis, mm.
    bound_deg : float
        Error beyond which a method counts as broken.
    frames : int, optional
        Frames; default as many as `BUDGET_S` allows.
    seed : int
        Of everything that is drawn.
    """

    scope: Scope
    organ: str = "colon"
    distances_mm: Interval = (20.0, 60.0)
    bound_deg: float = 5.0
    frames: int | None = None
    seed: int = 0

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


def estimators_of(scope: Scope) -> tuple[str, ...]:
    """Return the methods that are compared; without an offset the bisector would be the cone's axis again."""
    at_camera = bool(np.all(scope.offsets_mm == 0))
    return tuple(name for name in ESTIMATORS if not (at_camera and name == "bisector"))


def surroundings(question: Question) -> Surroundings:
    """Return what the frames set of the surface, and what is drawn for each of them."""
    return wall(question.kind, question.scope.relief, question.view_mm)


def main_experiment(question: Question) -> Experiment:
    """Return the experiment whose results are the expected errors; its name is that of its file."""
    around, told = surroundings(question), seen_through(question)
    values = drawn_values(around, question.seed, question.per_distance, DISTANCES)
    # Each distance once, then all again.
    distances = distances_of(question) * question.per_distance
    scene = load_scene(question.kind.scene, {**around.set, **told})
    values = in_free_space(values, scene, distances, around.random, question.seed)
    group = {
        "scene": question.kind.scene, "label": question.organ,
        # Whatever is found gets an answer, not isolated highlights alone.
        "isolated": False,
        "set": {**around.set, **told}, "pool": [{"surface.distance_mm": distances} | values],
    }  # fmt: skip
    return Experiment.model_validate({
        "name": "experiment", "title": f"Advice: {question.title}", "realisations": 1, "seed": question.seed,
        "estimators": estimators_of(question.scope), "groups": [group],
    })  # fmt: skip


def seen_through(question: Question) -> dict[str, Any]:
    """Return what is set of camera, lights, sensor, effort, and of what the methods are told."""
    near, far = question.distances_mm
    tables = {"sensor": {"preset": question.kind.sensor}, **question.scope.tables}
    # The middle of the range with the standard deviation of an even spread over it.
    known = {"lobe": False, "distance_mm": question.middle_mm}
    known["distance_sd"] = round((far - near) / math.sqrt(12) / question.middle_mm, 6)
    return {**tables, "render": {"samples_per_pixel": SAMPLES}, "known": known}


def write_experiment(experiment: Experiment, path: Path) -> Experiment:
    """Write an experiment's file, and return what it reads back as: a run of the file is a run of the same."""
    lines = [f"{name} = {toml_value(getattr(experiment, name))}\n" for name in ("title", "realisations", "seed")]
    lines.append(f"estimators = {toml_value(experiment.estimators)}\n")
    for group in experiment.groups:
        lines.append(f"\n[[groups]]\nscene = {toml_value(group.scene)}\nlabel = {toml_value(group.label)}\n")
        if group.realisations is not None:
            lines.append(f"realisations = {group.realisations}\n")
        if not group.isolated:
            lines.append("isolated = false\n")
        for name in ("sweep", "pool"):
            if tables := getattr(group, name):
                lines.append(f"{name} = [{', '.join(map(_inline, tables))}]\n")
        lines.append(f"set = {_inline(group.set)}\n")
        if group.random:
            lines.append(f"random = {_inline({key: d.model_dump() for key, d in group.random.items()})}\n")
    write_atomically(path, lambda part: part.write_text("".join(lines), encoding="utf-8"))
    return load_experiment(path)


def _inline(table: Mapping[str, Any]) -> str:
    """Return a table on one line with its keys quoted: a key path is one key here."""
    return "{" + ", ".join(f"{json.dumps(key)} = {toml_value(value)}" for key, value in table.items()) + "}"
