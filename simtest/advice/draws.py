"""What differs from frame to frame of an advice: form, pose, relief and film of the wall, drawn evenly."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simtest.advice.organs import Surroundings
from simtest.advice.scope import Interval
from simtest.errors import InputError
from simtest.runtime.seeds import Stage, generator
from simtest.spec import Scene
from simtest.validation.cases import RELIEF_SEED

SURFACE = "surface."
"""Begins the key paths of a wall's form and pose."""

TRIES = 200
"""Walls that are drawn for a frame until one leaves camera and lights in free space."""

Values = dict[str, list[Any]]
"""Values of all frames by key path."""


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

    A wall that bends towards the camera, and is tilted, may reach it.

    Parameters
    ----------
    values : dict
        Of all frames (`drawn_values`).
    scene : Scene
        Scene of the frames.
    distances_mm : sequence of float
        Distance of each frame.
    random : mapping
        Ends of what is drawn, by key path.
    seed : int
        Of the advice.
    """
    forms = [key for key in values if key.startswith(SURFACE) and not key.startswith("surface.relief")]
    made = {key: list(column) for key, column in values.items()}
    for i, distance in enumerate(distances_mm):
        rng = generator(seed, "advice", "placed", i, Stage.SWEEP)
        for _ in range(TRIES):
            form = {key.removeprefix(SURFACE): made[key][i] for key in forms}
            if _stands_free(scene, {**form, "distance_mm": distance}):
                break
            for key in forms:
                made[key][i] = _at(random[key], rng.uniform())
        else:
            raise InputError(
                f"--distances: at {distance:g} mm no wall of {TRIES} leaves camera and lights in free space; "
                "the nearest distance must be larger, or the lights nearer to the camera"
            )
    return made


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
