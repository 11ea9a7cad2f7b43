"""A rendering session: the Mitsuba scene is built once and updated from frame to frame.

A session goes through the same stages for every scene: load the surface, set the camera, build the Mitsuba scene if its
structure is new, and write the values that may differ. Then it renders radiance and labels, and casts single rays for
the ground truth.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from simtest.errors import InputError
from simtest.rendering import adaptive, ambient, backend, elements, highlights, truth
from simtest.rendering.backend import mi
from simtest.rendering.built_scene import BuiltScene, build
from simtest.rendering.elements.lights import kind_of
from simtest.rendering.frames import Frame, HighlightPoint, Maps, MisfitMaps, Radiance, Real, TruthMaps
from simtest.rendering.instruments import Cover, InstrumentKernel, cover_of, place, shade
from simtest.rendering.kernel_values import to_kernel
from simtest.rendering.lighting import Material
from simtest.rendering.misfits import trace_misfits, trace_tiles
from simtest.rendering.placement_checks import check_camera, check_lights, check_motion
from simtest.rendering.rays import HitRefinement, Sightlines
from simtest.rendering.tissue_kernels import AlbedoKernel, ReliefKernel, RestMap
from simtest.rendering.trace import Bounces, Progress, Tracer, as_radiance, evaluate, mean_over
from simtest.rendering.truth import ShapeLabels, as_hits, as_labels
from simtest.rendering.tube_kernel import TubeKernel
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.camera import Motion
from simtest.spec.reflectance import Translucency
from simtest.spec.scene import Scene
from simtest.surfaces import RayHits, SurfaceModel, SurfacePoints, make_surface
from simtest.surfaces.deformation import DeformedSurface

if TYPE_CHECKING:
    from simtest.surfaces.tissue_pattern import TissuePattern


P = ParamSpec("P")
T = TypeVar("T")


def _at_its_variant(method: Callable[Concatenate["Session", P], T]) -> Callable[Concatenate["Session", P], T]:
    """Let a method run with Mitsuba set to the session's variant, which another session may have changed."""

    @functools.wraps(method)
    def entered(self: "Session", *args: P.args, **kwargs: P.kwargs) -> T:
        self.mi  # noqa: B018 - sets the variant
        return method(self, *args, **kwargs)

    return entered


class Session:
    """Renders scenes of the same structure without rebuilding.

    Parameters
    ----------
    scene : Scene
        The first scene.
    variant : str, optional
        Mitsuba variant; default by `simtest.rendering.backend.requested_variant`.
    labelled : bool
        Whether to prepare for `frame` when a scene is built, rather than at the first call.

    Attributes
    ----------
    rebuilds : int
        How many times the Mitsuba scene was built.
    """

    def __init__(self, scene: Scene, variant: str | None = None, labelled: bool = False) -> None:
        loaded = backend.load(backend.requested_variant(variant, coloured=scene.is_coloured))
        self.variant = str(loaded.variant())
        elements.register(self.variant)
        self.rebuilds = 0
        self._instruments: InstrumentKernel | None = None
        self._cover: Cover | None = None
        self._labelled = labelled
        self._albedo: AlbedoKernel | None = None
        self._load_surface(scene)
        self._set_camera(scene)
        self._built = self._build(self._structure())
        self._move(scene)

    @property
    def mi(self) -> Any:
        """The mitsuba module, set to this session's variant, which another session may have changed."""
        if mi.variant() != self.variant:
            mi.set_variant(self.variant)
        return mi

    @_at_its_variant
    def update(self, scene: Scene) -> None:
        """Move to another scene; update only what changed, and rebuild only another structure."""
        if scene != self.scene or not self._settled:
            self._move(scene)

    @_at_its_variant
    def _move(self, scene: Scene) -> None:
        before = self.scene
        # Whatever ends this early, the next update writes all again.
        self._settled = False
        # Surface, camera and lights: refused here if they are not sound.
        if scene.placement != self.scene.placement:
            self._load_surface(scene)
            self._set_camera(scene)
        else:
            if scene.rig != self.scene.rig:
                check_lights(scene, self.surface)
            if (scene.rig, scene.camera.motion) != (self.scene.rig, self.scene.camera.motion):
                check_motion(scene, self.surface)
            if scene.rig != self.scene.rig:
                self._forget_misfits()
            # All truth is that of the middle of the exposure.
            if scene.camera.still != self._camera_spec:
                self._set_camera(scene)
            if scene.albedo != self.scene.albedo:
                self._set_tissue(scene)
        self.scene: Scene = scene
        key = self._structure()
        if self._built.key != key:
            self._built = self._build(key)
        self._write_values()
        # Of the mesh as it is written now.
        if self._labelled:
            self._shape_labels()
        try:
            self._instruments, self._cover = place(self), None
        except InputError:
            # Back to where it was, unless it is being made.
            if scene is not before:
                self._move(before)
            raise
        self._settled = True

    def _load_surface(self, scene: Scene) -> None:
        # A malformed surface raises here, and the session stays at its scene.
        moment = scene.deformation, scene.time_s
        surface = make_surface(scene.surface, scene.film_level, scene.camera.moved, *moment, scene.film_patches)
        check_camera(scene, surface)
        check_lights(scene, surface)
        check_motion(scene, surface)
        self._shape = surface.shape()
        # Relief and colour are looked up where the tissue is at rest.
        self._rest = RestMap(surface) if isinstance(surface, DeformedSurface) else None
        self._relief = None if surface.relief is None else ReliefKernel(surface.relief, self._rest)
        self._film = self._relief if self._relief is not None and self._relief.is_patchy else None
        self.surface: SurfaceModel = surface
        self._set_tissue(scene)
        self.scene = scene
        self._forget()

    def _set_tissue(self, scene: Scene) -> None:
        self._pattern: TissuePattern | None = None
        if scene.albedo is not None:
            # Imported here: it loads more of SciPy, which other scenes do not need.
            from simtest.surfaces.tissue_pattern import make_pattern

            self._pattern = make_pattern(self.surface.at_rest, scene.albedo)

    def _set_camera(self, scene: Scene) -> None:
        self._camera_spec, self.camera = scene.camera.still, scene.camera.model()
        self.sightlines = Sightlines(self.camera, self.surface.model_from_camera)
        self._forget()

    def _forget(self) -> None:
        self._truth: TruthMaps | None = None
        self._centre: list[Image] = []
        self._labels: list[Image] = []
        self._forget_misfits()

    def _forget_misfits(self) -> None:
        # What depends on surface, camera and rig alone.
        self._misfits: MisfitMaps | None = None
        self._highlights: dict[bool, list[HighlightPoint]] = {}

    def _structure(self) -> tuple[Any, ...]:
        """Return everything of the scene that is compiled into the kernels."""
        relief = None if self._relief is None else self._relief.key
        lights = tuple(kind_of(light) for light in self.scene.rig.lights)
        return self._shape.key, relief, self.scene.reflectance.compiled, self._pattern is not None, lights

    def _build(self, key: tuple[Any, ...]) -> BuiltScene:
        self.rebuilds += 1
        return build(key, self._shape, self.scene.reflectance, self.scene.rig.lights)

    def _write_values(self) -> None:
        """Write the values that may differ between scenes of one structure into the Mitsuba scene."""
        self._built.write(self._shape, self.scene.reflectance)
        self._place_lights(self.surface.model_from_camera)
        # The pattern of the tissue, unless it is there.
        if self._albedo is None or self._albedo.pattern is not self._pattern:
            self._albedo = AlbedoKernel(self._pattern) if self._pattern else None
        if self._albedo is not None:
            self._albedo.rest = self._rest
        self._built.let_bounces_find(self._albedo, self._film)

    def _place_lights(self, model_from_camera: Array) -> None:
        self._light = self._built.place_lights(self.scene.rig, model_from_camera)

    # Radiance ----------------------------------------------------------------------------------------------------

    @_at_its_variant
    def radiance(self, progress: Progress | None = None) -> Radiance:
        """Render the frame; `progress` is called after each launch, and what it raises stops the frame only.

        With one sample a pixel the radiance is that on the ray through each pixel's centre, with more the mean over the
        pixel's area; where the camera moves the mean over the exposure. The same scene and seed give the same bytes.
        """
        return self._render(None, progress)[0]

    @_at_its_variant
    def frame(self, progress: Progress | None = None) -> Frame:
        """Render the frame with the labels of the rendered shape, in one pass where it has one sample a pixel.

        The exact truth that `truth` computes afterwards starts from the same hits. See `radiance` for `progress`.
        """
        radiance = self.labelled_radiance(progress)
        labels, cover = self._with_polyps(as_labels(self._labels), self._labels), self.cover()
        return Frame(radiance, labels if cover is None else cover.over(labels))

    @_at_its_variant
    def labelled_radiance(self, progress: Progress | None = None) -> Radiance:
        """Render the radiance of `frame`, and trace its labels, or keep them while surface and camera stay."""
        kept = self._labels if self.scene.render.samples_per_pixel > 1 else []
        radiance, channels = self._render(None if kept else self._shape_labels(), progress)
        self._centre = self._labels = kept or channels
        return radiance

    def _shape_labels(self) -> ShapeLabels:
        if self._built.labels is None:
            operators = self.surface.vertex_shape_operators()
            self._built.labels = ShapeLabels(self._built.scene.shapes()[0], operators)
        return self._built.labels

    def _render(self, labels: ShapeLabels | None, progress: Progress | None) -> tuple[Radiance, list[Any]]:
        effort, tracer = self.scene.render, self._tracer()
        # Direct light is traced here; a path depth above 2 adds bounces.
        bounces = Bounces(self._built.scene, effort.path_depth, effort.seed) if effort.path_depth > 2 else None
        channels: list[Image] = []
        if (motion := self.scene.camera.moving) is not None:
            parts = self._mean_over(motion, bounces, progress)
        elif effort.samples_per_pixel == 1:
            parts, channels = tracer.centres(bounces, True, labels, progress)
        elif adaptive.applies(self.scene):
            edges = self._built.mesh_edges()
            parts, self._centre = adaptive.render(tracer, self.scene, self._shape, edges, progress)
            channels = tracer.relabelled(self._centre, labels) if labels else []
        else:
            parts = tracer.mean(effort.samples_per_pixel, effort.seed, bounces, progress)
        if labels and not channels:
            channels = tracer.centres(None, False, labels)[1]
        per_layer = len(parts) // tracer.layers
        radiance = as_radiance(parts[:per_layer])
        if channels:
            self._centre = channels
        if effort.ambient:
            sent = as_radiance(2 * ambient.scattered(tracer, self._centre_hits())).diffuse
            if (cover := self.cover()) is not None:
                sent[cover.seen] = 0
            radiance = replace(radiance, diffuse=radiance.diffuse + sent)
        if self.scene.translucency is not None:
            radiance = self._translucent(radiance, self.scene.translucency)
        if self._instruments is not None:
            # Metal in front of the surface; nothing spreads below it.
            metal = as_radiance(parts[per_layer:])
            radiance = replace(
                radiance, specular=radiance.specular + metal.specular, diffuse=radiance.diffuse + metal.diffuse
            )
        return radiance, channels

    def _mean_over(self, motion: Motion, bounces: Bounces | None, progress: Progress | None) -> list[Image]:
        """Render the mean over an exposure; camera and lights stand at its middle again afterwards."""
        middle = self.surface.model_from_camera

        def at(middle_from_moment: Array) -> Tracer:
            pose = middle @ middle_from_moment
            self._place_lights(pose)
            return self._tracer(Sightlines(self.camera, pose))

        try:
            return mean_over(motion, self.scene.render, at, bounces, progress)
        finally:
            self._place_lights(middle)

    def _translucent(self, radiance: Radiance, spec: Translucency) -> Radiance:
        """Return radiance whose diffuse part has spread below the surface."""
        # Imported here: smooth scenes do not need its fits.
        from simtest.rendering.subsurface import spread

        labels, cover = as_labels(self._centre_hits()), self.cover()
        depth = labels.depth if cover is None else np.where(cover.seen, np.float32(np.nan), labels.depth)
        diffuse = spread(radiance.diffuse, depth, labels.normal_base, self.camera, spec)
        return replace(radiance, diffuse=diffuse)

    def _tracer(self, sightlines: Sightlines | None = None) -> Tracer:
        """Return what traces the scene, by default from the camera's own pose."""
        built, sightlines = self._built, sightlines or self.sightlines
        material = Material(built.scene.shapes()[0].bsdf(), built.base, self._albedo, self._film)
        refinement = HitRefinement(self._shape)
        kernel = self._instruments
        return Tracer(built.scene, sightlines, self._light, material, refinement, self._relief, kernel)

    def _centre_hits(self) -> list[Image]:
        """Return the labels of the last frame, or else trace them without curvatures, which the truth does not need."""
        if not self._centre:
            labels = ShapeLabels(self._built.scene.shapes()[0], None, curved=False)
            self._centre = self._tracer().centres(None, False, labels)[1]
        return self._centre

    @_at_its_variant
    def cover(self) -> Cover | None:
        """Return what instruments cover of the frame; None in a scene without instruments."""
        if self._cover is None and self._instruments is not None:
            self._cover = cover_of(self, self._instruments, self._centre_hits()[0])
        return self._cover

    @_at_its_variant
    def debris(self) -> Image | None:
        """Return the shares that stool and bile cover at the pixels' centres, shape (2, H, W); None without debris."""
        if self._albedo is None or self._albedo.pattern.debris is None:
            return None
        pixels = np.moveaxis(self.camera.pixel_centres(), 2, 0)
        base = self._tracer().hit(*(to_kernel(mi.Float, axis.ravel(), np.float32) for axis in pixels))[2].base
        shares = evaluate([*self._albedo.covers(base, base.is_valid())], pixels[0].size)
        covers, cover = np.reshape(shares, pixels.shape), self.cover()
        return covers if cover is None else np.where(cover.seen, np.float32(0), covers)

    # Truth -------------------------------------------------------------------------------------------------------

    def to_model(self, points: Array) -> Array:
        """Transform points, shape (N, 3), from the camera frame to the model frame, mm."""
        pose = self.surface.model_from_camera
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    @_at_its_variant
    def exact_points(self, points_px: Array, fine: bool = True) -> SurfacePoints:
        """Return the exact points at pixel positions, shape (N, 2), camera frame, of the fine surface or the base."""
        rays = self.sightlines.in_model(points_px)
        return truth.solve(self.surface, *rays, self.exact_hits(*rays), fine)

    @_at_its_variant
    def base_points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the exact points of the base, model frame, on rays of the model frame (see `exact_hits`)."""
        return truth.base_points(self.surface, self._tube(), origins, directions, hits)

    def _tube(self) -> TubeKernel | None:
        """Return the kernel of the surface's chart, None without one."""
        if (chart := self.surface.chart) is None:
            return None
        if self._built.tube is None:
            self._built.tube = TubeKernel(chart)
        return self._built.tube

    @_at_its_variant
    def exact_hits(self, origins: Array, directions: Array) -> RayHits:
        """Return the hits from which exact points start, of rays of the model frame, shape (N, 3)."""
        return truth.trace_starts(self._built.scene, origins, directions)

    @_at_its_variant
    def misfits(self, stride: int = 1) -> MisfitMaps:
        """Return the misfits of all lights at every `stride`-th pixel; of all pixels they are kept while these stay.

        They depend on surface, camera and rig alone.
        """
        if stride > 1:
            return trace_misfits(self._tracer(), self.scene.rig.true_mm(), stride)
        if self._misfits is None:
            self._misfits = trace_misfits(self._tracer(), self.scene.rig.true_mm(), 1)
        return self._misfits

    @_at_its_variant
    def tile_misfits(self, lights: IntArray, division: int, corners: IntArray, size: int) -> Image:
        """Return the fine misfit in tiles of divided pixels, each of its light by index (see `trace_tiles`)."""
        return trace_tiles(self._tracer(), self.scene.rig.true_mm()[lights], division, corners, size)

    @_at_its_variant
    def truth(self, stride: int = 1) -> TruthMaps:
        """Return the truth at the centre of every `stride`-th pixel along both axes; of all pixels it is kept."""
        if stride == 1 and self._truth is None:
            self._truth = self._solve_maps(1)
        maps = self._truth if stride == 1 else None
        maps, cover = maps or self._solve_maps(stride), self.cover()
        return maps if cover is None else cover.every(stride).over(maps)

    def _solve_maps(self, stride: int) -> TruthMaps:
        # Hits like those of a frame's labels: the truth must not depend on whether a frame was rendered before.
        centres = self.camera.pixel_centres()[::stride, ::stride]
        channels = [channel[::stride, ::stride] for channel in self._centre_hits()]
        hits, shading, geometric = as_hits(channels)
        rays = self.sightlines.in_view(centres.reshape(-1, 2))
        points = truth.solve_frame(self.surface, self._tube(), *rays, hits)
        return self._with_polyps(truth.truth_maps(points, shading, geometric, centres.shape[:2]), channels)

    def _with_polyps(self, maps: Maps[Real], channels: list[Image]) -> Maps[Real]:
        """Return maps with the polyps of the surface, where it has any; `channels` are those of the centres' hits."""
        if not (rest := self.surface.at_rest).polyps:
            return maps
        numbers = rest.polyp_at(as_hits(channels)[0]).reshape(maps.mask.shape)
        return replace(maps, polyp=np.where(maps.mask, numbers, np.uint8(0)))

    @_at_its_variant
    def depths(self) -> Array:
        """Return the distances of `truth`, shape (H, W), mm, without instruments, at a fraction of its cost."""
        if self._truth is not None:
            return self._truth.depth
        rays = self.sightlines.in_view(self.camera.pixel_centres().reshape(-1, 2))
        distance = truth.frame_distances(self.surface, self._tube(), *rays, as_hits(self._centre_hits())[0])
        return distance.reshape(self.camera.height, self.camera.width)

    @_at_its_variant
    def exact_distances(self, origins: Array, directions: Array) -> Array:
        """Return how far along rays of the model frame, shape (N, 3), the exact surface lies, mm; NaN: it does not."""
        return self.surface.distances(origins, directions, self.exact_hits(origins, directions))

    @_at_its_variant
    def blocked(self, origins: Array, directions: Array, reach: Array) -> Mask:
        """Return which rays, shape (N, 3), model frame, meet the rendered shape before `reach`, shape (N,), mm."""
        return truth.trace_blocked(self._built.scene, origins, directions, reach)

    @_at_its_variant
    def lobe_at(self, points: Sequence[HighlightPoint]) -> Array:
        """Compute the direct light off the lobe at highlight points, shape (N,), mean of the channels.

        The normal is the exact one: the rendered triangles' misses the peak of a lobe that is narrower than a pixel. It
        is 0 where a highlight is the pixels' mean alone: over a relief that no part of the frame resolves, or over the
        camera's motion.
        """
        if not points or self.is_unresolved or self.scene.camera.moving is not None:
            return np.zeros(len(points))
        tracer, rotation = self._tracer(), self.surface.model_from_camera[:3, :3]
        pixels, normals = np.array([point.bp_px for point in points]), np.array([point.normal for point in points])
        rays, _, hit = tracer.hit(*(to_kernel(mi.Float, axis, np.float32) for axis in pixels.T))
        fine = mi.SurfaceInteraction3f(hit.fine)
        fine.sh_frame = mi.Frame3f(mi.Normal3f((normals @ rotation.T).T.astype(np.float32)))
        fine.wi = fine.to_local(-rays.traced.d)
        seen = replace(hit, fine=fine)
        lobe, _ = tracer.light.radiance(tracer.blockers, tracer.material, seen, tracer.light.fixed_points())
        return np.mean(evaluate([*lobe], len(points)), axis=0, dtype=float)

    @_at_its_variant
    def highlights(self, radiance: Radiance | None = None) -> list[HighlightPoint]:
        """Find the highlight points of every light in view, the brightest first, with the frame's radiance.

        On a surface with relief these are its glints (theory.md 7.1). Where no part of the frame resolves the relief it
        acts as roughness, and the highlight points are the base's. Without a `radiance` theirs is 0, and they stand in
        no order.
        """
        return self._found(self.is_unresolved, radiance)

    @property
    @_at_its_variant
    def is_unresolved(self) -> bool:
        """Whether the surface has a relief that no part of the frame resolves, so that it acts as roughness."""
        return self.surface.relief is not None and not highlights.is_resolved(self)

    @_at_its_variant
    def base_highlights(self, radiance: Radiance | None = None) -> list[HighlightPoint]:
        """Find the highlight points of the base, without the relief: the centres of the clouds of glints."""
        return self._found(True, radiance)

    def _found(self, base: bool, radiance: Radiance | None) -> list[HighlightPoint]:
        """Return the highlight points of the base or of the fine surface, searched for once."""
        if base not in self._highlights:
            self._highlights[base] = highlights.search(self, base)
        points = self._highlights[base]
        if self._instruments is not None:
            points = shade(self, self._instruments, points)
        return list(points) if radiance is None else highlights.lit_by(radiance, points)
