"""A rendering session: the Mitsuba scene is built once and updated from frame to frame.

A session goes through the same stages for every scene: load the surface, set the camera, build the Mitsuba scene if its
structure is new, and write the values that may differ. Then it renders radiance and labels, and casts single rays for
the ground truth.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.errors import InputError
from simtest.rendering import adaptive, backend, emission, phong, tissue
from simtest.rendering.albedo import AlbedoKernel
from simtest.rendering.built_scene import BuiltScene, build
from simtest.rendering.camera_motion import mean_over
from simtest.rendering.direct import Material
from simtest.rendering.frames import Frame, HighlightPoint, MisfitMaps, Radiance, TruthMaps
from simtest.rendering.hit_refinement import Refinement
from simtest.rendering.indirect import Bounces
from simtest.rendering.instrument_kernel import InstrumentKernel
from simtest.rendering.instruments import Cover, cover_of, place
from simtest.rendering.integrate import Progress, Tracer, as_radiance
from simtest.rendering.materials import compiled_form
from simtest.rendering.mesh_edges import MeshEdges
from simtest.rendering.placement_checks import check_camera, check_lights, check_motion
from simtest.rendering.rays import Sightlines
from simtest.rendering.relief_kernel import ReliefKernel
from simtest.rendering.rest_map import rest_map
from simtest.rendering.session_truth import SessionTruth
from simtest.rendering.shape_labels import ShapeLabels, as_labels
from simtest.runtime.arrays import Array, Image
from simtest.spec.camera import Motion
from simtest.spec.reflectance import Translucency
from simtest.spec.scene import Scene
from simtest.surfaces import SurfaceModel, make_surface

if TYPE_CHECKING:
    from simtest.surfaces.tissue_pattern import TissuePattern


class Session(SessionTruth):
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
        self._mitsuba = backend.load(backend.requested_variant(variant, coloured=scene.is_coloured))
        self.variant = str(self._mitsuba.variant())
        self.plugin = phong.register(self.mi, self.variant)
        tissue.register(self.mi, self.variant)
        emission.register(self.mi, self.variant)
        self.rebuilds = 0
        self._instruments: InstrumentKernel | None = None
        self._cover: Cover | None = None
        self._labelled = labelled
        self._albedo: AlbedoKernel | None = None
        self._load_surface(scene)
        self._set_camera(scene)
        self._built = self._build(self._structure())
        self.update(scene)

    @property
    def mi(self) -> Any:
        """The mitsuba module, set to this session's variant, which another session may have changed."""
        if self._mitsuba.variant() != self.variant:
            self._mitsuba.set_variant(self.variant)
        return self._mitsuba

    def update(self, scene: Scene) -> None:
        """Move to another scene; update only what changed, and rebuild only another structure."""
        before = self.scene
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
        if self._labelled:
            self._shape_labels()
        # Values.
        self._write_values()
        try:
            self._instruments, self._cover = place(self), None
        except InputError:
            # Back to where it was, unless it is being made.
            if scene is not before:
                self.update(before)
            raise

    def _load_surface(self, scene: Scene) -> None:
        # A malformed surface raises here, and the session stays at its scene.
        moment = scene.deformation, scene.time_s
        surface = make_surface(scene.surface, scene.film_level, scene.camera.moved, *moment)
        check_camera(scene, surface)
        check_lights(scene, surface)
        check_motion(scene, surface)
        self._shape = surface.shape()
        # Relief and colour are looked up where the tissue is at rest.
        self._rest = rest_map(self.mi, surface)
        self._relief = None if surface.relief is None else ReliefKernel(self.mi, surface.relief, self._rest)
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
        self.sightlines = Sightlines(self.mi, self.camera, self.surface.model_from_camera)
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
        material = compiled_form(self.scene.reflectance)
        relief = None if self._relief is None else self._relief.key
        lights = tuple(emission.kind_of(light) for light in self.scene.rig.lights)
        return self._shape.key, relief, material, self._pattern is not None, lights

    def _build(self, key: tuple[Any, ...]) -> BuiltScene:
        self.rebuilds += 1
        return build(self.mi, key, self._shape, self.scene.reflectance, self.scene.rig.lights, self.plugin)

    def _write_values(self) -> None:
        """Write the values that may differ between scenes of one structure into the Mitsuba scene."""
        self._built.write(self.mi, self._shape, self.scene.reflectance)
        self._place_lights(self.surface.model_from_camera)
        # The pattern of the tissue, unless it is there.
        if self._albedo is None or self._albedo.pattern is not self._pattern:
            self._albedo = AlbedoKernel(self.mi, self._pattern) if self._pattern else None
        if self._albedo is not None:
            self._albedo.rest = self._rest
            self._built.let_bounces_find(self._albedo)

    def _place_lights(self, model_from_camera: Array) -> None:
        self._light = self._built.place_lights(self.mi, self.scene.rig, model_from_camera)

    # Radiance ----------------------------------------------------------------------------------------------------

    def radiance(self, progress: Progress | None = None) -> Radiance:
        """Render the frame; `progress` is called after each launch, and what it raises stops the frame only.

        With one sample a pixel the radiance is that on the ray through each pixel's centre, with more the mean over the
        pixel's area; where the camera moves the mean over the exposure. The same scene and seed give the same bytes.
        """
        return self._render(None, progress)[0]

    def frame(self, progress: Progress | None = None) -> Frame:
        """Render the frame with the labels of the rendered shape, in one pass where it has one sample a pixel.

        The exact truth that `truth` computes afterwards starts from the same hits. See `radiance` for `progress`.
        """
        radiance = self.labelled_radiance(progress)
        labels, cover = as_labels(self._labels), self.cover()
        return Frame(radiance, labels if cover is None else cover.labels(labels))

    def labelled_radiance(self, progress: Progress | None = None) -> Radiance:
        """Render the radiance of `frame`, and trace its labels.

        The labels are kept while surface and camera stay: a frame of more samples takes them over.
        """
        kept = self._labels if self.scene.render.samples_per_pixel > 1 else []
        radiance, channels = self._render(None if kept else self._shape_labels(), progress)
        self._centre = self._labels = kept or channels
        return radiance

    def _shape_labels(self) -> ShapeLabels:
        if self._built.labels is None:
            operators = self.surface.vertex_shape_operators()
            self._built.labels = ShapeLabels(self.mi, self._built.scene.shapes()[0], operators)
        return self._built.labels

    def _render(self, labels: ShapeLabels | None, progress: Progress | None) -> tuple[Radiance, list[Any]]:
        effort, tracer = self.scene.render, self._tracer()
        # Direct light is traced here; a path depth above 2 adds bounces.
        bounces = None
        if effort.path_depth > 2:
            bounces = Bounces(self.mi, self._built.scene, effort.path_depth, effort.seed)
        if (motion := self.scene.camera.moving) is not None:
            parts = self._mean_over(motion, bounces, progress)
            channels = tracer.centres(None, False, labels)[1] if labels else []
        elif effort.samples_per_pixel == 1:
            parts, channels = tracer.centres(bounces, True, labels, progress)
        elif adaptive.applies(self.scene):
            parts, self._centre = self._adaptive(tracer).render(progress)
            channels = tracer.relabelled(self._centre, labels) if labels else []
        else:
            parts = tracer.mean(effort.samples_per_pixel, effort.seed, bounces, progress)
            channels = tracer.centres(None, False, labels)[1] if labels else []
        own = len(parts) // tracer.layers
        radiance = as_radiance(parts[:own])
        if self.scene.translucency is not None:
            radiance = self._translucent(radiance, channels, self.scene.translucency)
        if self._instruments is not None:
            # Metal in front of the surface; nothing spreads below it.
            metal = as_radiance(parts[own:])
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
            return self._tracer(Sightlines(self.mi, self.camera, pose))

        try:
            return mean_over(motion, self.scene.render, at, bounces, progress)
        finally:
            self._place_lights(middle)

    def _adaptive(self, tracer: Tracer) -> adaptive.Adaptive:
        built, mesh = self._built, self._shape.mesh
        if built.edges is None and mesh is not None:
            built.edges = MeshEdges(self.mi, built.scene, mesh)
        labels = ShapeLabels(self.mi, built.scene.shapes()[0], None, curved=False)
        return adaptive.Adaptive(tracer, self.scene, labels, self._shape, built.edges)

    def _translucent(self, radiance: Radiance, channels: list[Image], spec: Translucency) -> Radiance:
        """Return radiance whose diffuse part has spread below the surface."""
        # Imported here: smooth scenes do not need its fits.
        from simtest.rendering.subsurface import spread

        if channels:
            self._centre = channels
        labels, cover = as_labels(self._centre_hits()), self.cover()
        depth = labels.depth if cover is None else np.where(cover.seen, np.float32(np.nan), labels.depth)
        diffuse = spread(radiance.diffuse, depth, labels.normal_base, self.camera, spec)
        return replace(radiance, diffuse=diffuse)

    def _tracer(self, sightlines: Sightlines | None = None) -> Tracer:
        """Return what traces the scene, by default from the camera's own pose."""
        built, sightlines = self._built, sightlines or self.sightlines
        material = Material(built.scene.shapes()[0].bsdf(), built.base, self._albedo)
        refinement = Refinement(self.mi, self._shape)
        kernel = self._instruments
        return Tracer(self.mi, built.scene, sightlines, self._light, material, refinement, self._relief, kernel)

    def _centre_hits(self) -> list[Image]:
        """Return the labels of the last frame, or else trace them without curvatures, which the truth does not need."""
        if not self._centre:
            labels = ShapeLabels(self.mi, self._built.scene.shapes()[0], None, curved=False)
            self._centre = self._tracer().centres(None, False, labels)[1]
        return self._centre

    def cover(self) -> Cover | None:
        """Return what instruments cover of the frame; None in a scene without instruments."""
        if self._cover is None and self._instruments is not None:
            self._cover = cover_of(self, self._instruments, self._centre_hits()[0])
        return self._cover
