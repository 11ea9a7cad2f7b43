"""Light of more than one bounce: the first bounce is sampled here, Mitsuba's path integrator follows it."""

from typing import Any

import numpy as np


class Bounces:
    """Inter-reflections of a scene.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    scene : mitsuba.Scene
        Holds the surface and the lights.
    path_depth : int
        Up to path_depth - 1 bounces; more than 2.
    seed : int
        Of the samples.
    """

    def __init__(self, mi: Any, scene: Any, path_depth: int, seed: int) -> None:
        self.mi, self.scene, self.seed = mi, scene, seed
        self._integrator = mi.load_dict({"type": "path", "max_depth": path_depth - 1, "rr_depth": path_depth})

    def radiance(self, si: Any, count: int, block: int, sample: int) -> Any:
        """Sample the radiance, mitsuba.Spectrum, that `count` surface points send back after two or more bounces.

        `block` is the index of the launch in the frame, `sample` that of the sample in each pixel: each pair has its
        own random numbers.
        """
        import drjit as dr

        mi = self.mi
        sampler = mi.load_dict({"type": "independent"})
        branch = np.random.SeedSequence(self.seed, spawn_key=(sample, block))
        salt = mi.UInt32(int(branch.generate_state(1)[0]))
        # Opaque: a literal seed would compile another kernel for each sample.
        dr.make_opaque(salt)
        sampler.seed(salt, count)
        bs, weight = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
        active = si.is_valid() & dr.any(weight > 0)
        bounced = mi.RayDifferential3f(si.spawn_ray(si.to_world(bs.wo)))
        incoming, _, _ = self._integrator.sample(self.scene, sampler, bounced, None, active)
        return dr.select(active, weight * incoming, 0)
