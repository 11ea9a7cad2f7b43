"""Direct light in closed form: intensity over squared distance times f cos(theta), of the lobe and of the base."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from simtest.rendering import emission
from simtest.rendering.albedo import AlbedoKernel
from simtest.rendering.hits import Hit
from simtest.rendering.light_points import DRAWN, Draw, Drawer, point
from simtest.rendering.lobes import channel_mean
from simtest.rendering.rays import Lanes
from simtest.spec.lights import Rig, is_at_camera


class Reflecting(Protocol):
    """What direct light is reflected by: `Material`, or the metal of instruments."""

    def painted(self, hit: Hit) -> AbstractContextManager[None]:
        """Let the base have its albedo at a hit, computed once for all lights."""

    def towards(self, mi: Any, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base towards a direction of the model frame."""


@dataclass(frozen=True)
class Material:
    """A surface's reflectance in two parts.

    Parameters
    ----------
    bsdf : mitsuba.BSDF
        The whole.
    base : mitsuba.BSDF or None
        The same without its specular part; None where the whole evaluates its parts separately (components 0 and 1).
    albedo : AlbedoKernel or None
        Of tissue, whose BSDF has an `albedo_at`; None where the albedo is the BSDF's own.
    """

    bsdf: Any
    base: Any
    albedo: AlbedoKernel | None = None

    @contextmanager
    def painted(self, hit: Hit) -> Iterator[None]:
        """Let the BSDF's base have the albedo of tissue at a hit; nothing where the albedo is the BSDF's own."""
        if self.albedo is None:
            yield
            return
        albedo, own = self.albedo.of(hit.base, hit.base.is_valid()), self.bsdf.albedo_at
        self.bsdf.albedo_at = lambda si, active: albedo
        try:
            yield
        finally:
            self.bsdf.albedo_at = own

    def parts(self, mi: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base."""
        import drjit as dr

        if self.base is None:
            lobe, base = (mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.All, part) for part in (0, 1))
            return self.bsdf.eval(lobe, si, wo, active), self.bsdf.eval(base, si, wo, active)
        # No component is the lobe alone: it is the difference between the whole and the base.
        context = mi.BSDFContext()
        base = self.base.eval(context, si, wo, active)
        return dr.maximum(self.bsdf.eval(context, si, wo, active) - base, 0), base

    def towards(self, mi: Any, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base towards a direction of the model frame.

        On a relief the lobe follows the fine normal, and the base that of the surface that diffuse light sees.
        """
        lobe, base = self.parts(mi, hit.fine, hit.fine.to_local(direction), active)
        if hit.diffuse is not hit.fine:
            base = self.parts(mi, hit.diffuse, hit.diffuse.to_local(direction), active)[1]
        return lobe, base


class DirectLight:
    """The lights of a rig, as a kernel evaluates them.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    rig : Rig
        The lights.
    poses : list of LightPose
        Of the lights, model frame.
    """

    def __init__(self, mi: Any, rig: Rig, poses: list[emission.LightPose]) -> None:
        import drjit as dr

        self.mi = mi
        self.kinds = [emission.kind_of(light) for light in rig.lights]
        # A point at the camera reaches every point that the camera sees: no shadow rays. The rest of a source that
        # lies about the camera does not.
        self.shadows = [
            not is_at_camera(position) or light.source is not None
            for light, position in zip(rig.lights, rig.true_mm(), strict=True)
        ]
        self.values = [emission.parameters(mi, light, pose) for light, pose in zip(rig.lights, poses, strict=True)]
        # Opaque, so that a moved light compiles no new kernel.
        dr.make_opaque(self.values)

    def drawer(self, lanes: Lanes | None, samples: int = 1) -> Drawer | None:
        """Return what draws points of the sources of finite size for the pixels of a launch; None if all are points."""
        return Drawer(self.mi, lanes, samples) if any(kind.source != "point" for kind in self.kinds) else None

    def radiance(self, scene: Any, material: Reflecting, hit: Hit, draw: Draw | None) -> tuple[Any, Any]:
        """Compute the radiance off the lobe and the base, mitsuba.Spectrum, at surface points, with shadow rays.

        `draw` says which points of sources of finite size are taken; None where all are points.
        """
        with material.painted(hit):
            return self._of_lights(scene, material, hit, draw)

    def _of_lights(self, scene: Any, material: Reflecting, hit: Hit, draw: Draw | None) -> tuple[Any, Any]:
        specular, diffuse = self.mi.Spectrum(0), self.mi.Spectrum(0)
        for i, kind in enumerate(self.kinds):
            if kind.source == "point":
                shaded = scene if self.shadows[i] else None
                lobe, base = self._from(i, shaded, material, hit, self.values[i]["position"])
            else:
                assert draw is not None
                spread = self._fixed if draw.shifts is None else self._drawn
                lobe, base = spread(i, scene, material, hit, draw)
            specular += lobe
            diffuse += base
        return specular, diffuse

    def _from(self, i: int, scene: Any | None, material: Reflecting, hit: Hit, position: Any) -> tuple[Any, Any]:
        """Compute the radiance by the light of an index from a position; shadow rays only if there is a scene."""
        import drjit as dr

        mi, si, kind, values = self.mi, hit.base, self.kinds[i], self.values[i]
        towards = position - si.p
        squared = dr.squared_norm(towards)
        direction = towards * dr.rsqrt(squared)
        active = si.is_valid() & (squared > 0)
        if scene is not None:
            # Shadow rays of neighbouring pixels are as coherent as their sightlines.
            active &= ~scene.ray_test(si.spawn_ray_to(position), True, active)
        arriving = values["intensity"] * (emission.factor(mi, kind, values, -direction) / squared)
        lobe, base = material.towards(mi, hit, direction, active)
        return dr.select(active, arriving * lobe, 0), dr.select(active, arriving * base, 0)

    def _fixed(self, i: int, scene: Any, material: Reflecting, hit: Hit, draw: Draw) -> tuple[Any, Any]:
        """Compute the mean radiance over the fixed points of a source, with a shadow ray to each.

        Fewer rays would leave steps in penumbrae, since all pixels have the same points.
        """
        import drjit as dr

        mi, kind, values = self.mi, self.kinds[i], self.values[i]

        def step(number: Any, specular: Any, diffuse: Any) -> tuple[Any, Any, Any]:
            position, weight = point(mi, kind.source, values, *draw.square(mi, kind.source, number, i))
            lobe, base = self._from(i, scene, material, hit, position)
            return number + 1, specular + weight * lobe, diffuse + weight * base

        start, end = (mi.UInt32(0), mi.Spectrum(0), mi.Spectrum(0)), mi.UInt32(draw.total)
        _, specular, diffuse = dr.while_loop(start, lambda number, *_: number < end, step)
        return specular / draw.total, diffuse / draw.total

    def _drawn(self, i: int, scene: Any, material: Reflecting, hit: Hit, draw: Draw) -> tuple[Any, Any]:
        """Compute the mean radiance over a sample's points of a source, with one shadow ray to one of them.

        The point is chosen in proportion to the radiance that it causes. Then the whole is without bias, and without
        noise where all points are seen or none. Where some are seen, lobe and base lose the same share.
        """
        import drjit as dr

        mi, si, kind, values = self.mi, hit.base, self.kinds[i], self.values[i]
        specular, diffuse, whole = mi.Spectrum(0), mi.Spectrum(0), mi.Float(0)
        reached = []
        for number in range(DRAWN):
            position, weight = point(mi, kind.source, values, *draw.square(mi, kind.source, mi.UInt32(number), i))
            lobe, base = self._from(i, None, material, hit, position)
            specular += weight * lobe
            diffuse += weight * base
            whole += weight * channel_mean(lobe + base)
            reached.append((position, mi.Float(whole)))
        # The shadow ray's target: the first point up to which the share of the choice has come together.
        share, (target, _) = draw.choice(mi, i) * whole, reached[-1]
        for position, sum_so_far in reached[-2::-1]:
            target = dr.select(share < sum_so_far, position, target)
        active = si.is_valid() & (whole > 0)
        seen = active & ~scene.ray_test(si.spawn_ray_to(target), True, active)
        scale = dr.select(seen, 1 / mi.Float(DRAWN), 0)
        return specular * scale, diffuse * scale
