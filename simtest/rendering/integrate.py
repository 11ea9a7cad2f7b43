"""Radiance along given rays: direct light in closed form, further bounces by Mitsuba's path integrator."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.geometry.camera import Camera
from simtest.rendering.frames import Array, Radiance
from simtest.rendering.refine import Refinement

Rays = Callable[[Array], tuple[Array, Array]]


@dataclass
class Tracer:
    """Traces rays in one Mitsuba scene lit by point lights.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    scene : mitsuba.Scene
        Holds one surface and the lights (the latter for further bounces).
    diffuse_bsdf : mitsuba.BSDF
        The surface's material without its specular part.
    lights : ndarray, shape (L, 3)
        Positions in the model frame, mm.
    powers : list of float
        Radiant intensities.
    shadows : list of bool
        Whether a light's shadow rays are traced (not needed where it is at the camera).
    refinement : Refinement
        Solves the hits again in double precision.
    """

    mi: Any
    scene: Any
    diffuse_bsdf: Any
    lights: Array
    powers: list[float]
    shadows: list[bool]
    refinement: Refinement

    def __post_init__(self) -> None:
        # Opaque, so that a moved light does not compile a new kernel.
        import drjit as dr

        self._places = [self.mi.Point3f(*place.tolist()) for place in self.lights]
        self._powers = [self.mi.Float(power) for power in self.powers]
        dr.make_opaque(self._places, self._powers)

    def trace(self, origins: Array, directions: Array, path_depth: int, seed: int) -> tuple[Array, Array, Array]:
        """Give the radiance towards the rays' origins.

        Parameters
        ----------
        origins, directions : ndarray, shape (N, 3)
            Model frame, mm; unit directions.
        path_depth : int
            2: direct light alone; more: up to path_depth - 1 bounces.
        seed : int
            For the bounces.

        Returns
        -------
        specular, diffuse, indirect : ndarray, shape (N, C)
            C channels of the variant.
        """
        import drjit as dr

        mi = self.mi
        ray = mi.Ray3f(
            mi.Point3f(np.ascontiguousarray(origins.T, dtype=np.float32)),
            mi.Vector3f(np.ascontiguousarray(directions.T, dtype=np.float32)),
        )
        si = self.scene.ray_intersect(ray)
        origin, direction = (mi.Vector3d(np.ascontiguousarray(part.T)) for part in (origins, directions))
        self.refinement.apply(origin, direction, si)
        total, diffuse = self._direct(si)
        indirect = mi.Spectrum(0)
        if path_depth > 2:
            indirect = self._indirect(si, len(directions), path_depth, seed)
        specular = dr.maximum(total - diffuse, 0)
        dr.eval(specular, diffuse, indirect)
        specular, diffuse, indirect = (
            np.broadcast_to(np.array(part, dtype=np.float64).T, (len(directions), dr.size_v(mi.Spectrum)))
            for part in (specular, diffuse, indirect)
        )
        return specular, diffuse, indirect

    def _direct(self, si: Any) -> tuple[Any, Any]:
        """Sum over the lights: intensity over squared distance times f cos(theta), whole and of the diffuse base."""
        import drjit as dr

        mi = self.mi
        bsdf, context = si.bsdf(), mi.BSDFContext()
        total, diffuse = mi.Spectrum(0), mi.Spectrum(0)
        for place, power, shadow in zip(self._places, self._powers, self.shadows, strict=True):
            towards = place - si.p
            squared = dr.squared_norm(towards)
            wo = si.to_local(towards * dr.rsqrt(squared))
            active = si.is_valid()
            if shadow:
                active &= ~self.scene.ray_test(si.spawn_ray_to(place), active)
            falloff = dr.select(active, power / squared, 0)
            total += falloff * bsdf.eval(context, si, wo, active)
            diffuse += falloff * self.diffuse_bsdf.eval(context, si, wo, active)
        return total, diffuse

    def _indirect(self, si: Any, count: int, path_depth: int, seed: int) -> Any:
        """Sample one bounce off the surface and follow it with Mitsuba's path integrator."""
        import drjit as dr

        mi = self.mi
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, count)
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
        bounced = si.spawn_ray(si.to_world(sample.wo))
        integrator = mi.load_dict({"type": "path", "max_depth": path_depth - 1, "rr_depth": path_depth})
        active = si.is_valid() & dr.any(weight > 0)
        incoming, _, _ = integrator.sample(self.scene, sampler, mi.RayDifferential3f(bounced), None, active)
        return dr.select(active, weight * incoming, 0)


def render(tracer: Tracer, rays: Rays, camera: Camera, samples: int, path_depth: int, seed: int) -> Radiance:
    """Render a frame.

    Parameters
    ----------
    tracer : Tracer
        The scene.
    rays : callable
        From pixel positions, shape (N, 2), to origins and directions in the model frame.
    camera : Camera
        For the frame's size.
    samples : int
        1: through the pixels' centres; more: uniform over each pixel.
    path_depth, seed : int
        See `Tracer.trace`.

    Returns
    -------
    Radiance
    """
    centres = camera.pixel_centres().reshape(-1, 2)
    generator = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(samples,))))
    sums: list[Any] = [0.0, 0.0, 0.0]
    for _ in range(samples):
        points = centres if samples == 1 else centres + generator.uniform(-0.5, 0.5, centres.shape)
        traced = tracer.trace(*rays(points), path_depth, int(generator.integers(2**32)))
        sums = [total + part for total, part in zip(sums, traced, strict=True)]
    shape = (camera.height, camera.width, -1)
    parts = [np.asarray(total / samples, dtype=np.float32).reshape(shape) for total in sums]
    if parts[0].shape[2] == 1:
        parts = [part[:, :, 0] for part in parts]
    return Radiance(*parts)
