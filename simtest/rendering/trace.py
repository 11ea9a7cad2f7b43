"""Traces a frame: one ray through each pixel's centre, or several samples a pixel, in launches of bounded size.

A frame of one sample is traced row by row, so that nothing has to be sorted; the same kernel computes its labels.
Several samples are traced in tiles of 4 x 4 pixels and summed in registers: memory does not grow with their number.
Over an exposure with a moving camera the samples are shared out over the steps of the motion.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from simtest.rendering.backend import dr, mi
from simtest.rendering.frames import Radiance
from simtest.rendering.instruments import Blockers, InstrumentKernel
from simtest.rendering.kernel_values import channels, to_kernel
from simtest.rendering.lighting import DirectLight, Drawer, LightDraw, Material
from simtest.rendering.rays import TILE, Hit, HitRefinement, Lanes, Pixels, Rays, Sightlines, in_tiles, make_hit, untile
from simtest.rendering.tissue_kernels import ReliefKernel
from simtest.rendering.truth import CHANNELS, ShapeLabels
from simtest.runtime.arrays import Array, Image
from simtest.spec.camera import Motion
from simtest.spec.scene import Effort


class Bounces:
    """Inter-reflections of a scene: the first bounce is sampled here, Mitsuba's path integrator follows it.

    There are up to path_depth - 1 bounces, path_depth being more than 2; the seed is that of the samples.
    """

    def __init__(self, scene: Any, path_depth: int, seed: int) -> None:
        self.scene, self.seed = scene, seed
        self._integrator = mi.load_dict({"type": "path", "max_depth": path_depth - 1, "rr_depth": path_depth})

    def radiance(self, si: Any, count: int, block: int, sample: int) -> Any:
        """Sample the radiance, mitsuba.Spectrum, that `count` surface points send back after two or more bounces.

        `block` is the index of the launch in the frame, `sample` that of the sample in each pixel: each pair has its
        own random numbers.
        """
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


Progress = Callable[[int, int, str], None]
"""Called with samples traced, samples in all, and what is done; may raise to stop."""

Tell = Callable[[int], None]

LANES = 2**22
"""Pixels of one launch: they bound the memory. Another number changes the noise of bounces, and nothing else."""

RAYS = 2**24
"""Samples of one launch: some tenths of a second on two cores, so that a frame can be stopped between launches."""

SMALLEST_NORMAL = np.finfo(np.float32).tiny
"""Of single precision; what is smaller is subnormal."""

SUMMED = 64
"""Samples of a pixel that are summed in single precision; these sums are added in double precision."""

Sums = npt.NDArray[np.float64]


class Labelling(Protocol):
    """Computes labels at hits; see `ShapeLabels`."""

    def trace(self, preliminary: Any, hit: Hit, rays: Rays, rotation: Any, relief: ReliefKernel | None) -> list[Any]:
        """Return channels, mitsuba.Float."""


@dataclass(frozen=True)
class Tracer:
    """Traces one scene."""

    scene: Any  # Holds one surface and the lights (the latter for further bounces)
    sightlines: Sightlines  # Of the camera
    light: DirectLight  # The rig
    material: Material  # The surface's
    refinement: HitRefinement  # Solves the hits again in double precision
    relief: ReliefKernel | None  # The surface's relief
    instruments: InstrumentKernel | None = None  # What stands before the surface

    @property
    def layers(self) -> int:
        """How many sets of channels the radiance has: that of the surface, and that of instruments if there are any."""
        return 1 if self.instruments is None else 2

    @property
    def blockers(self) -> Any:
        """What shadow rays ask: the scene's surface, and the instruments if there are any."""
        return self.scene if self.instruments is None else Blockers(self.scene, self.instruments)

    def hit(self, x: Any, y: Any, bent: bool = False) -> tuple[Rays, Any, Hit]:
        """Trace pixel positions; return rays, hits and surface points, if `bent` with the normals' derivatives."""
        rays = self.sightlines.rays(x, y)
        preliminary = self.scene.ray_intersect_preliminary(rays.traced, True, rays.active)
        return rays, preliminary, self._points(rays, preliminary, bent)

    def _points(self, rays: Rays, preliminary: Any, bent: bool) -> Hit:
        """Return the surface points of hits."""
        flags = mi.RayFlags.All | mi.RayFlags.dNSdUV if bent else mi.RayFlags.All
        si = preliminary.compute_surface_interaction(rays.traced, +flags, rays.active)
        self.refinement.apply(rays.origin, rays.direction, si)
        return make_hit(si, self.relief, bent)

    def _direct(self, rays: Rays, hit: Hit, draw: LightDraw | None) -> list[Any]:
        """Compute the channels of direct light off lobe and base, then of metal; each is 0 behind the other."""
        blockers = self.blockers
        with self.material.painted(hit):
            tissue = self.light.radiance(blockers, self.material, hit, draw)
        if self.instruments is None:
            return [channel for part in tissue for channel in part]
        ahead, metal = self.instruments.hit(rays)
        in_front = ahead.base.t < hit.base.t

        def shine(specular: Any, diffuse: Any) -> tuple[Any, Any]:
            return self.light.radiance(blockers, metal, ahead, draw)

        # A branch, since few pixels see metal.
        dark = mi.Spectrum(0), mi.Spectrum(0)
        metallic = dr.if_stmt(dark, in_front, shine, lambda specular, diffuse: (specular, diffuse))
        seen = [dr.select(in_front, 0, channel) for part in tissue for channel in part]
        return seen + [dr.select(in_front, channel, 0) for part in metallic for channel in part]

    # One sample --------------------------------------------------------------------------------------------------

    def centres(
        self,
        bounces: Bounces | None,
        radiance: bool,
        labels: Labelling | None,
        progress: Progress | None = None,
        sample: int = 0,
    ) -> tuple[list[Image], list[Image]]:
        """Trace the ray through each pixel's centre; `progress` is called after each launch.

        `sample` counts the times that this is done for one frame: bounces draw other numbers each time. Returns
        channels, shape (H, W), of the radiance, with bounces if there are any, and of the labels; empty where not asked
        for.
        """
        camera = self.sightlines.camera
        pixels = camera.width * camera.height
        rows: list[list[Image]] = []
        count_of_parts = 0
        for block, (first, count) in enumerate(blocks_of(pixels)):
            lanes = self.sightlines.lanes(first, count, False, 0)
            rays, preliminary, hit = self.hit(*self.sightlines.centre(lanes), labels is not None)
            # Radiance and labels of one launch go into one kernel.
            draw = self.light.fixed_points()
            parts = self._direct(rays, hit, draw) if radiance else []
            if bounces is not None:
                parts = [*parts, *bounces.radiance(hit.fine, count, block, sample)]
            count_of_parts = len(parts)
            if labels is not None:
                parts = parts + labels.trace(preliminary, hit, rays, self.sightlines.camera_from_model, self.relief)
            rows.append(evaluate(parts, count))
            if progress:
                progress(first + count, pixels, "rendering")
        maps = self._maps(rows)
        return maps[:count_of_parts], maps[count_of_parts:]

    def relabelled(self, channels: list[Image], labels: ShapeLabels) -> list[Image]:
        """Compute labels, as `centres` does, from other labels of the same hits: nothing is traced."""
        last = self.sightlines.camera_from_model, self.relief
        return self.at_centres(channels, lambda preliminary, hit, rays, _: labels.trace(preliminary, hit, rays, *last))

    def at_centres(self, channels: list[Image], compute: Callable[[Any, Hit, Rays, int], list[Any]]) -> list[Image]:
        """Compute other channels, shape (H, W), of the hits that the labels' tell; the last argument counts pixels."""
        camera = self.sightlines.camera
        depth, face, *place = (channels[CHANNELS.index(name)].ravel() for name in ("depth", "face", "second", "third"))
        rows: list[list[Image]] = []
        for first, count in blocks_of(camera.width * camera.height):
            launch = slice(first, first + count)
            preliminary = dr.zeros(mi.PreliminaryIntersection3f, count)
            preliminary.t = to_kernel(mi.Float, np.nan_to_num(depth[launch], nan=np.inf), np.float32)
            preliminary.prim_index = to_kernel(mi.UInt32, face[launch].view(np.uint32), np.uint32)
            preliminary.prim_uv = mi.Point2f(*(to_kernel(mi.Float, share[launch], np.float32) for share in place))
            preliminary.shape, preliminary.valid = mi.ShapePtr(self.scene.shapes()[0]), preliminary.t < dr.inf
            rays = self.sightlines.rays(*self.sightlines.centre(self.sightlines.lanes(first, count, False, 0)))
            rows.append(evaluate(compute(preliminary, self._points(rays, preliminary, True), rays, first), count))
        return self._maps(rows)

    def _maps(self, rows: list[list[Image]]) -> list[Image]:
        """Make maps, shape (H, W), of the channels of launches, row after row."""
        shape = (self.sightlines.camera.height, self.sightlines.camera.width)
        whole = rows[0] if len(rows) == 1 else [np.concatenate(pieces) for pieces in zip(*rows, strict=True)]
        return [channel.reshape(shape) for channel in whole]

    # Several samples ---------------------------------------------------------------------------------------------

    def mean(
        self,
        samples: int,
        seed: int,
        bounces: Bounces | None,
        progress: Progress | None = None,
        numbers: range | None = None,
    ) -> list[Image]:
        """Compute the channels, shape (H, W) each, of the mean radiance over the pixels' area.

        `samples` is the number for each pixel, `seed` draws their positions; `progress` is called after each launch.
        `numbers` are those of the samples that are traced, one after the other; default all.
        """
        numbers = range(samples) if numbers is None else numbers
        camera = self.sightlines.camera
        if camera.seen is not None and bounces is None:
            # Pixels outside of the view are dark; bounces draw their numbers by place among all.
            pixels = in_tiles(camera.seen)
            tell = _share_of(progress, len(pixels) * len(numbers))
            channels = self.means_at(pixels, samples, seed, tell, numbers)
            whole = np.zeros((len(channels), camera.height * camera.width), dtype=channels.dtype)
            whole[:, pixels] = channels
            return list(whole.reshape(-1, camera.height, camera.width))
        # Of the frame in whole tiles.
        height, width = (-(-size // TILE) * TILE for size in (camera.height, camera.width))
        # Trace: sums over the samples of each block of pixels.
        blocks = list(blocks_of(height * width))
        lanes = ((self.sightlines.lanes(first, count, True, seed), count) for first, count in blocks)
        channels = self._means(lanes, samples, numbers, bounces, _share_of(progress, height * width * len(numbers)))
        # Arrange: from tiles to rows, without what lies beyond the frame.
        maps = untile(channels, (height, width))
        return [np.ascontiguousarray(channel[: camera.height, : camera.width]) for channel in maps]

    def means_at(
        self, pixels: Pixels, samples: int, seed: int, tell: Tell | None = None, numbers: range | None = None
    ) -> Image:
        """Compute channels, shape (C, N), of `mean` at some pixels by number; `tell` gets the samples traced."""
        blocks = ((self.sightlines.lanes_of(pixels[first : first + count], seed), count)
                  for first, count in blocks_of(len(pixels)))  # fmt: skip
        return self._means(blocks, samples, numbers or range(samples), None, tell)

    def _means(
        self,
        blocks: Iterable[tuple[Lanes, int]],
        samples: int,
        numbers: range,
        bounces: Bounces | None,
        tell: Tell | None,
    ) -> Image:
        """Compute channels, shape (C, N), of the mean over samples, by number of `samples`, of blocks of lanes."""
        means: list[Image] = []
        traced = 0
        # Bounces draw new random numbers for each sample, other cameras unproject on the host: one sample a launch.
        looped = bounces is None and self.sightlines.in_kernel
        for block, (lanes, count) in enumerate(blocks):
            drawer = self.light.drawer(lanes, samples)
            sums: Sums | None = None
            step = max(1, min(SUMMED, RAYS // count)) if looped else 1
            for start in numbers[::step]:
                stop = min(start + step, numbers.stop)
                number, end = mi.UInt32(start), mi.UInt32(stop)
                dr.make_opaque(number, end)
                if looped:
                    parts = self._looped(lanes, drawer, number, end)
                else:
                    hit, parts = self._sample(lanes, drawer, number)
                if bounces is not None:
                    parts = [*parts, *bounces.radiance(hit.fine, count, block, start)]
                added = np.stack(evaluate(parts, count)).astype(np.float64)
                sums = added if sums is None else sums + added
                traced += count * (stop - start)
                if tell:
                    tell(traced)
            assert sums is not None
            means.append((sums / len(numbers)).astype(np.float32))
        return np.concatenate(means, axis=1)

    def _looped(self, lanes: Lanes, drawer: Drawer | None, start: Any, end: Any) -> list[Any]:
        """Sum direct light over samples by a loop inside the kernel."""

        def step(number: Any, *sums: Any) -> tuple[Any, ...]:
            parts = self._sample(lanes, drawer, number)[1]
            return number + 1, *(total + part for total, part in zip(sums, parts, strict=True))

        zeros = [mi.Float(0) for _ in range(2 * self.layers * channels())]
        return list(dr.while_loop((start, *zeros), lambda number, *_: number < end, step)[1:])

    def _sample(self, lanes: Lanes, drawer: Drawer | None, number: Any) -> tuple[Hit, list[Any]]:
        """Trace the sample of one number of each pixel; return where, and the channels of direct light."""
        rays, _, hit = self.hit(*self.sightlines.sample(lanes, number))
        return hit, self._direct(rays, hit, None if drawer is None else drawer.at(number))


def blocks_of(pixels: int) -> Iterator[tuple[int, int]]:
    """Split a number of pixels into runs: first, count."""
    for first in range(0, pixels, LANES):
        yield first, min(LANES, pixels - first)


def _share_of(progress: Progress | None, total: int) -> Tell | None:
    """Return what tells `progress` how many samples of a total have been traced."""
    return progress and (lambda traced: progress(traced, total, "rendering"))


def evaluate(values: list[Any], count: int) -> list[Image]:
    """Compute all channels in one kernel; a constant one is broadcast."""
    # Together: evaluated one by one, each would trace the rays again.
    dr.eval(values)
    arrays = [np.array(value, dtype=np.float32) for value in values]
    return [array if array.shape == (count,) else np.full(count, array) for array in arrays]


def as_radiance(parts: list[Image]) -> Radiance:
    """Make a `Radiance` from the channels of the lobe, of the base and, if there are any, of further bounces."""
    width = 1 if len(parts) in (2, 3) else 3

    def image(first: int) -> Image:
        planes = parts[first * width : (first + 1) * width]
        if not planes:
            planes = [np.zeros_like(parts[0])] * width
        pixels = planes[0] if width == 1 else np.stack(planes, axis=-1)
        # Dr.Jit's own threads flush subnormal numbers to 0, a process of one thread does not. Left in the frame, they
        # make its noise depend on the number of threads: a Poisson count of mean 0 draws nothing.
        return np.where(np.abs(pixels) < SMALLEST_NORMAL, np.float32(0), pixels)

    return Radiance(image(0), image(1), image(2))


TracerAt = Callable[[Array], Tracer]
"""Returns a tracer whose camera and lights stand at a pose, middle_from_moment."""


def mean_over(
    motion: Motion, effort: Effort, tracer_at: TracerAt, bounces: Bounces | None, progress: Progress | None
) -> list[Image]:
    """Return the channels, shape (H, W) each, of the mean radiance over an exposure.

    With one sample a pixel each step traces the rays through the pixels' centres; no noise is added. `progress` is
    called after each launch.
    """
    # As many samples at all steps, so that each moment has the same weight.
    each = -(-effort.samples_per_pixel // motion.steps)
    sums: list[Array] = []
    for step, pose in enumerate(motion.poses()):
        tracer, told = tracer_at(pose), _part(progress, step, motion.steps)
        if effort.samples_per_pixel == 1:
            parts, _ = tracer.centres(bounces, True, None, told, sample=step)
        else:
            numbers = range(step * each, (step + 1) * each)
            parts = tracer.mean(each * motion.steps, effort.seed, bounces, told, numbers)
        # In double precision, so that the mean of equal frames is that frame.
        sums = sums or [np.zeros(part.shape) for part in parts]
        for total, part in zip(sums, parts, strict=True):
            total += part
    return [(total / motion.steps).astype(np.float32) for total in sums]


def _part(progress: Progress | None, step: int, steps: int) -> Progress | None:
    """Return what tells `progress` of one step's launches as of a part of all."""
    return progress and (lambda done, total, what: progress(step * total + done, steps * total, what))
