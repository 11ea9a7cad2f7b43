"""Seeds of glints led to their zeros in one launch, on the rendered shape with its relief, in single precision.

Most seeds share a zero, or have none. The kernel tells them apart before the exact surface is asked, whose points cost
a hundred times more.
"""

from typing import Any

import numpy as np

from simtest.rendering.misfit_grid import misfit_and_turn
from simtest.rendering.rays import Sightlines
from simtest.rendering.relief_kernel import ReliefKernel
from simtest.runtime.arrays import Array

STEPS = 10
NEAR = 2e-2
"""A seed whose least misfit, rad, is larger strays. Triangles and rounding move a zero by less, and may hide a close
pair of them: the exact surface decides."""


def lead(
    mi: Any, scene: Any, sightlines: Sightlines, relief: ReliefKernel, seeds: Array, light: Array, max_step_px: float
) -> Array:
    """Lead seeds, shape (N, 2), px, by Newton's steps to where the misfit for a light is least; drop those that stray.

    The light is in the model frame, mm. The camera's sightlines must be those of a pinhole, which the kernel knows.
    """
    import drjit as dr

    if not len(seeds):
        return seeds
    x, y = (mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in seeds.T)
    source, limit = mi.Vector3f(*light.tolist()), mi.Float(max_step_px)
    number, going = mi.UInt32(0), dr.full(mi.Bool, True, len(seeds))
    best = (mi.Float(x), mi.Float(y), dr.full(mi.Float, dr.inf, len(seeds)))
    dr.make_opaque(source, limit, number)
    model_from_camera = sightlines.camera_from_model.T

    def step(number: Any, x: Any, y: Any, best: tuple[Any, ...], going: Any) -> tuple[Any, ...]:
        rays = sightlines.rays(x, y)
        si = scene.ray_intersect_preliminary(rays.traced, False, going).compute_surface_interaction(
            rays.traced, +(mi.RayFlags.All | mi.RayFlags.dNSdUV), going
        )
        jets = relief.jets(rays.traced.o + rays.traced.d * si.t, si.is_valid(), True)
        across = mi.coordinate_system(-rays.sightline)
        basis = tuple(model_from_camera @ axis for axis in across)
        *_, first, second, length = misfit_and_turn(mi, rays.traced, basis, si, source, jets)
        # The best position so far.
        going &= si.is_valid() & dr.isfinite(length)
        better = going & (length < best[2])
        best = tuple(dr.select(better, new, old) for new, old in zip((x, y, length), best, strict=True))
        to_x, to_y = sightlines.project(rays.sightline + across[0] * first + across[1] * second)
        dx, dy = to_x - x, to_y - y
        share = dr.minimum(1, limit * dr.rsqrt(dr.maximum(dx * dx + dy * dy, 1e-12)))
        going &= dr.isfinite(dx) & dr.isfinite(dy)
        x, y = dr.select(going, x + share * dx, x), dr.select(going, y + share * dy, y)
        return number + 1, x, y, best, going

    state = (number, x, y, best, going)
    _, _, _, best, _ = dr.while_loop(state, lambda number, *_: number < STEPS, step)
    dr.eval(best)
    kept = np.array(best[2]) < NEAR
    return np.stack([np.array(best[0]), np.array(best[1])], axis=1)[kept].astype(np.float64)
