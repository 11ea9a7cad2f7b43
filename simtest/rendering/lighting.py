"""The direct light that a surface reflects, in closed form, and which points of its sources are asked for."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from simtest.rendering.backend import dr, mi
from simtest.rendering.elements.lights import LightPose, factor, kind_of, parameters, point
from simtest.rendering.kernel_values import channel_mean
from simtest.rendering.rays import Hit, Lanes
from simtest.rendering.tissue_kernels import AlbedoKernel, ReliefKernel
from simtest.spec.lights import Rig, is_at_camera

DRAWN = 4
"""Points of each source at each of a pixel's samples."""

FIXED = 64
"""Points of each source where a pixel has one sample, the same in all pixels: the picture has no noise."""

_GOLDEN = 0x9E3779B9
"""The golden ratio as a share of 2^32: its multiples beside equal steps cover the square evenly (Vogel's spiral)."""

_SILVER = 0x6A09E667
"""The root of 2 the same way, for the choice of a shadow ray's target."""


@dataclass(frozen=True)
class LightDraw:
    """Which points of the sources a sample of each pixel takes: some of one spiral over all samples of the pixel."""

    # first, step: Number of the first point, and from one to the next; the latter is the number of samples
    first: Any
    step: Any
    total: Any  # Points of all samples of the pixel together
    # Random shifts of the pixel's points and choices, shares of 2^32; None for the fixed points
    shifts: tuple[Any, Any, Any] | None

    def square(self, kind: str, number: Any, light: int) -> tuple[Any, Any]:
        """Return u and v in [0, 1) of a sample's point by number, for a light by index; even in v around a ring."""
        index = self.first + number * self.step
        if self.shifts is None:
            # Pairs of opposite points, so that the centroid is exact: where it is off the highlight moves.
            pair, opposite = index >> 1, (index & 1) << 31
            even, turn = (2 * mi.Float(pair) + 1) / self.total, pair * mi.UInt32(_GOLDEN)
            if kind == "ring":
                return _share(turn), even / 2 + _share(opposite)
            return even, _share(turn + opposite)
        # Lights get other points each, else their errors would add up.
        along = _share(self.shifts[0] + mi.UInt32(light * _GOLDEN & 0xFFFFFFFF))
        turn = index * mi.UInt32(_GOLDEN) + self.shifts[1] + mi.UInt32(light * _SILVER & 0xFFFFFFFF)
        even = (mi.Float(index) + along) / self.total
        return (_share(turn), even) if kind == "ring" else (even, _share(turn))

    def choice(self, light: int) -> Any:
        """Return a number in [0, 1), mitsuba.Float, to choose one of the points by."""
        assert self.shifts is not None
        return _share(self.shifts[2] + (self.first + mi.UInt32(light)) * mi.UInt32(_SILVER))


def _share(number: Any) -> Any:
    """Return a share of 2^32 as a number in [0, 1); single precision holds 24 bits."""
    return mi.Float(number >> 8) * 2.0**-24


class Drawer:
    """Draws of one launch's samples, of so many for each pixel; without lanes the fixed points."""

    def __init__(self, lanes: Lanes | None, samples: int) -> None:
        self._shifts = None
        self._step = mi.UInt32(1 if lanes is None else samples)
        self._total = mi.Float(FIXED if lanes is None else DRAWN * samples)
        dr.make_opaque(self._step, self._total)
        if lanes is not None:
            # Other numbers than those of the places in the pixel, from the same seed. The golden ratio's field is not
            # that of the places' recurrence: place and point are independent of each other.
            first = mi.sample_tea_32(lanes.shift_x, lanes.shift_y)
            self._shifts = (*first, mi.sample_tea_32(*first)[0])

    def at(self, number: Any) -> LightDraw:
        """Return the draw of a pixel's sample by its number."""
        return LightDraw(mi.UInt32(number), self._step, self._total, self._shifts)


class Reflecting(Protocol):
    """What direct light is reflected by: `Material`, or the metal of instruments."""

    def towards(self, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base towards a direction of the model frame."""


@dataclass(frozen=True)
class Material:
    """A surface's reflectance in two parts."""

    bsdf: Any  # The whole
    # The same without its specular part; None where the whole evaluates its parts separately (components 0 and 1)
    base: Any
    # Of tissue, whose BSDF has an `albedo_at`; None where the albedo is the BSDF's own
    albedo: AlbedoKernel | None = None
    film: ReliefKernel | None = None  # Whose film is patchy; None where the roughness is the BSDF's own

    @contextmanager
    def painted(self, hit: Hit) -> Iterator[None]:
        """Let the BSDF have what varies over tissue at a hit, computed once for all lights; else its own."""
        found: dict[str, Any] = {}
        if self.albedo is not None:
            valid = hit.base.is_valid()
            found["albedo_at"] = self.albedo.of(hit.base, valid)
            if self.albedo.pattern.debris is not None:
                found["bare_at"] = 1 - self.albedo.covers(hit.base, valid)[0]
        if self.film is not None:
            jets = hit.jets or self.film.jets_at(hit.base)
            found["wet_at"] = self.film.wet(jets.gain)
        before = {name: getattr(self.bsdf, name) for name in found}
        for name, value in found.items():
            setattr(self.bsdf, name, lambda si, active, value=value: value)
        try:
            yield
        finally:
            for name, value in before.items():
                setattr(self.bsdf, name, value)

    def parts(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base."""
        if self.base is None:
            lobe, base = (mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.All, part) for part in (0, 1))
            return self.bsdf.eval(lobe, si, wo, active), self.bsdf.eval(base, si, wo, active)
        # No component is the lobe alone: it is the difference between the whole and the base.
        context = mi.BSDFContext()
        base = self.base.eval(context, si, wo, active)
        return dr.maximum(self.bsdf.eval(context, si, wo, active) - base, 0), base

    def towards(self, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base towards a direction of the model frame.

        On a relief the lobe follows the fine normal, and the base that of the surface that diffuse light sees.
        """
        lobe, base = self.parts(hit.fine, hit.fine.to_local(direction), active)
        if hit.diffuse is not hit.fine:
            base = self.parts(hit.diffuse, hit.diffuse.to_local(direction), active)[1]
        return lobe, base


class DirectLight:
    """The lights of a rig at their poses in the model frame, as a kernel evaluates them."""

    def __init__(self, rig: Rig, poses: list[LightPose]) -> None:
        self.kinds = [kind_of(light) for light in rig.lights]
        # A point at the camera reaches every point that the camera sees: no shadow rays. The rest of a source that
        # lies about the camera does not.
        self.shadows = [
            not is_at_camera(position) or light.source is not None
            for light, position in zip(rig.lights, rig.true_mm(), strict=True)
        ]
        self.values = [parameters(light, pose) for light, pose in zip(rig.lights, poses, strict=True)]
        # Opaque, so that a moved light compiles no new kernel.
        dr.make_opaque(self.values)

    def drawer(self, lanes: Lanes | None, samples: int = 1) -> Drawer | None:
        """Return what draws points of the sources of finite size for the pixels of a launch; None if all are points."""
        return Drawer(lanes, samples) if any(kind.source != "point" for kind in self.kinds) else None

    def fixed_points(self) -> LightDraw | None:
        """Return the draw of the sources' fixed points; None if all are points."""
        drawer = self.drawer(None)
        return None if drawer is None else drawer.at(0)

    def radiance(self, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw | None) -> tuple[Any, Any]:
        """Compute the radiance off lobe and base at surface points; `draw` chooses points of finite sources."""
        specular, diffuse = mi.Spectrum(0), mi.Spectrum(0)
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
        si, kind, values = hit.base, self.kinds[i], self.values[i]
        towards = position - si.p
        squared = dr.squared_norm(towards)
        direction = towards * dr.rsqrt(squared)
        active = si.is_valid() & (squared > 0)
        if scene is not None:
            # Shadow rays of neighbouring pixels are as coherent as their sightlines.
            active &= ~scene.ray_test(si.spawn_ray_to(position), True, active)
        arriving = values["intensity"] * (factor(kind, values, -direction) / squared)
        lobe, base = material.towards(hit, direction, active)
        return dr.select(active, arriving * lobe, 0), dr.select(active, arriving * base, 0)

    def _fixed(self, i: int, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw) -> tuple[Any, Any]:
        """Compute the mean radiance over the fixed points of a source, with a shadow ray to each.

        Fewer rays would leave steps in penumbrae, since all pixels have the same points.
        """
        kind, values = self.kinds[i], self.values[i]

        def step(number: Any, specular: Any, diffuse: Any) -> tuple[Any, Any, Any]:
            position, weight = point(kind.source, values, *draw.square(kind.source, number, i))
            lobe, base = self._from(i, scene, material, hit, position)
            return number + 1, specular + weight * lobe, diffuse + weight * base

        start, end = (mi.UInt32(0), mi.Spectrum(0), mi.Spectrum(0)), mi.UInt32(draw.total)
        _, specular, diffuse = dr.while_loop(start, lambda number, *_: number < end, step)
        return specular / draw.total, diffuse / draw.total

    def _drawn(self, i: int, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw) -> tuple[Any, Any]:
        """Compute the mean radiance over a sample's points of a source, with one shadow ray to one of them.

        The point is chosen in proportion to the radiance that it causes. Then the whole is without bias, and without
        noise where all points are seen or none. Where some are seen, lobe and base lose the same share.
        """
        si, kind, values = hit.base, self.kinds[i], self.values[i]
        specular, diffuse, whole = mi.Spectrum(0), mi.Spectrum(0), mi.Float(0)
        reached = []
        for number in range(DRAWN):
            position, weight = point(kind.source, values, *draw.square(kind.source, mi.UInt32(number), i))
            lobe, base = self._from(i, None, material, hit, position)
            specular += weight * lobe
            diffuse += weight * base
            whole += weight * channel_mean(lobe + base)
            reached.append((position, mi.Float(whole)))
        # The shadow ray's target: the first point up to which the share of the choice has come together.
        share, (target, _) = draw.choice(i) * whole, reached[-1]
        for position, sum_so_far in reached[-2::-1]:
            target = dr.select(share < sum_so_far, position, target)
        active = si.is_valid() & (whole > 0)
        seen = active & ~scene.ray_test(si.spawn_ray_to(target), True, active)
        scale = dr.select(seen, 1 / mi.Float(DRAWN), 0)
        return specular * scale, diffuse * scale
