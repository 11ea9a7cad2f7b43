"""The mean radiance over an exposure during which the camera moves (`spec.motion`).

The pixel's samples are shared out over the steps of the motion, one after the other in their sequence: positions in the
pixel and moments together stay evenly spread, and the work that of a frame at rest.
"""

from collections.abc import Callable

import numpy as np

from simtest.rendering.indirect import Bounces
from simtest.rendering.integrate import Progress, Tracer
from simtest.runtime.arrays import Array, Image
from simtest.spec.camera import Motion
from simtest.spec.scene import Effort

TracerAt = Callable[[Array], Tracer]
"""Returns a tracer whose camera and lights stand at a pose, middle_from_moment."""


def samples_per_step(effort: Effort, motion: Motion) -> int:
    """Return the samples of a pixel at each step: as many at all steps, so that each moment has the same weight."""
    return -(-effort.samples_per_pixel // motion.steps)


def mean_over(
    motion: Motion, effort: Effort, tracer_at: TracerAt, bounces: Bounces | None, progress: Progress | None
) -> list[Image]:
    """Return the channels, shape (H, W) each, of the mean radiance over an exposure.

    With one sample a pixel each step traces the rays through the pixels' centres; no noise is added. `progress` is
    called after each launch.
    """
    each = samples_per_step(effort, motion)
    sums: list[Array] = []
    for step, pose in enumerate(motion.poses()):
        tracer, told = tracer_at(pose), _part(progress, step, motion.steps)
        if effort.samples_per_pixel == 1:
            parts, _ = tracer.centres(bounces, True, None, told, sample=step)
        else:
            own = range(step * each, (step + 1) * each)
            parts = tracer.mean(each * motion.steps, effort.seed, bounces, told, own)
        # In double precision, so that the mean of equal frames is that frame.
        sums = sums or [np.zeros(part.shape) for part in parts]
        for total, part in zip(sums, parts, strict=True):
            total += part
    return [(total / motion.steps).astype(np.float32) for total in sums]


def _part(progress: Progress | None, step: int, steps: int) -> Progress | None:
    """Return what tells `progress` of one step's launches as of a part of all."""
    return progress and (lambda done, total, what: progress(step * total + done, steps * total, what))
