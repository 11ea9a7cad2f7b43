"""The exact truth of a session's scene: points on rays, maps, and highlight points of every light in view."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from simtest.geometry import Camera
from simtest.rendering import block_truth, found_highlights, glints
from simtest.rendering import exact_points as exact
from simtest.rendering.built_scene import BuiltScene
from simtest.rendering.frames import HighlightPoint, MisfitMaps, Radiance, TruthMaps
from simtest.rendering.instrument_kernel import InstrumentKernel
from simtest.rendering.instruments import Cover, shade
from simtest.rendering.integrate import Tracer, evaluate
from simtest.rendering.kernel_arrays import to_kernel
from simtest.rendering.misfit_grid import MisfitGrid, trace_grid
from simtest.rendering.misfit_maps import trace_misfits, trace_tiles
from simtest.rendering.rays import Sightlines
from simtest.rendering.relief_kernel import ReliefKernel
from simtest.rendering.shape_labels import as_hits
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.lights import is_at_camera
from simtest.spec.scene import Scene
from simtest.surfaces import RayHits, Shape, SurfaceModel, SurfacePoints

if TYPE_CHECKING:
    from simtest.rendering.session import Session


class SessionTruth:
    """What a session tells of its scene beside the picture; `Session` loads, builds and updates the scene.

    Attributes
    ----------
    scene, surface, camera, sightlines
        Those that the session stands at.
    """

    scene: Scene
    surface: SurfaceModel
    camera: Camera
    sightlines: Sightlines
    _built: BuiltScene
    _shape: Shape
    _relief: ReliefKernel | None
    _instruments: InstrumentKernel | None
    _truth: TruthMaps | None
    _misfits: MisfitMaps | None
    _highlights: dict[bool, list[HighlightPoint]]

    @property
    def mi(self) -> Any:
        """The mitsuba module, set to this session's variant."""
        raise NotImplementedError

    @property
    def _whole(self) -> "Session":
        """The session that this is a part of."""
        return cast("Session", self)

    def cover(self) -> Cover | None:
        """Return what instruments cover of the frame; None in a scene without instruments."""
        raise NotImplementedError

    def _centre_hits(self) -> list[Image]:
        """Return the labels of the last frame, or else trace them."""
        raise NotImplementedError

    def _tracer(self, sightlines: Sightlines | None = None) -> Tracer:
        """Return what traces the scene."""
        raise NotImplementedError

    def to_model(self, points: Array) -> Array:
        """Transform points, shape (N, 3), from the camera frame to the model frame, mm."""
        pose = self.surface.model_from_camera
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    def cast(self, points_px: Array) -> tuple[SurfacePoints, Array, Array]:
        """Cast rays through pixel positions, shape (N, 2), onto the exact surface.

        Returns
        -------
        points : SurfacePoints
            Exact, in the camera frame.
        shading_normal, geometric_normal : ndarray, shape (N, 3)
            Normals of the rendered shape, camera frame, without its relief; NaN where the ray misses.
        """
        return self._cast(*self.sightlines.in_model(points_px))

    def _cast(
        self, origins: Array, directions: Array, relief: ReliefKernel | None = None
    ) -> tuple[SurfacePoints, Array, Array]:
        """Cast rays of the model frame (see `cast`); a NaN direction hits nothing.

        With a `relief` the shading normals follow it; the exact points always do.
        """
        hits, shading, geometric = self._hits(origins, directions, relief)
        rotation = self.surface.model_from_camera[:3, :3]
        return exact.solve(self.surface, origins, directions, hits), shading @ rotation, geometric @ rotation

    def _hits(
        self, origins: Array, directions: Array, relief: ReliefKernel | None = None
    ) -> tuple[RayHits, Array, Array]:
        return exact.trace_hits(self.mi, self._built.scene, self._shape, origins, directions, relief)

    def exact_points(self, points_px: Array, fine: bool = True) -> SurfacePoints:
        """Return the exact points at pixel positions, shape (N, 2), camera frame, of the fine surface or the base."""
        rays = self.sightlines.in_model(points_px)
        return exact.solve(self.surface, *rays, self.exact_hits(*rays), fine)

    def exact_hits(self, origins: Array, directions: Array) -> RayHits:
        """Return the hits from which exact points start, of rays of the model frame, shape (N, 3)."""
        return exact.trace_starts(self.mi, self._built.scene, origins, directions)

    def misfit_grid(self, stride: int) -> MisfitGrid:
        """Return the misfits of all lights, without the relief, at the centres of every `stride`-th pixel."""
        lights = self.to_model(self.scene.rig.true_mm())
        return trace_grid(self.mi, self._built.scene, self.sightlines, lights, stride)

    def misfits(self) -> MisfitMaps:
        """Return the misfits of all lights at the centres of pixels; they are kept while surface, camera, rig stay."""
        if self._misfits is None:
            self._misfits = trace_misfits(self._tracer(), self.scene.rig.true_mm())
        return self._misfits

    def tile_misfits(self, light: int, division: int, corners: IntArray, size: int) -> Image:
        """Return the fine misfit of one light in tiles of divided pixels (see `misfit_maps.trace_tiles`)."""
        return trace_tiles(self._tracer(), self.scene.rig.true_mm()[light], division, corners, size)

    def truth(self, stride: int = 1) -> TruthMaps:
        """Return the ground truth at the centre of every pixel, or of every `stride`-th along both axes.

        The full maps are kept while surface and camera stay.
        """
        if stride == 1 and self._truth is None:
            self._truth = self._cast_maps(1)
        maps = self._truth if stride == 1 else None
        maps, cover = maps or self._cast_maps(stride), self.cover()
        return maps if cover is None else cover.truth(maps, stride)

    def _cast_maps(self, stride: int) -> TruthMaps:
        centres = self.camera.pixel_centres()[::stride, ::stride]
        pixels = centres.reshape(-1, 2)
        if stride == 1:
            # Hits like those of a frame's labels: the truth must not depend on whether a frame was rendered before.
            hits, shading, geometric = as_hits(self._centre_hits())
            points = block_truth.solve(self.mi, self.surface, *self.sightlines.in_view(pixels), hits)
        else:
            points, shading, geometric = self._cast(*self.sightlines.in_view(pixels), self._relief)
        return exact.truth_maps(points, shading, geometric, centres.shape[:2])

    def depths(self) -> Array:
        """Return the exact distance of the surface at each pixel's centre, shape (H, W), mm; NaN off the surface.

        The values are those of `truth`, without instruments, at a fraction of its cost.
        """
        if self._truth is not None:
            return self._truth.depth
        rays = self.sightlines.in_view(self.camera.pixel_centres().reshape(-1, 2))
        distance = block_truth.distances(self.mi, self.surface, *rays, as_hits(self._centre_hits())[0])
        return distance.reshape(self.camera.height, self.camera.width)

    def exact_distances(self, origins: Array, directions: Array) -> Array:
        """Return how far along rays of the model frame, shape (N, 3), the exact surface lies, mm; NaN: it does not."""
        return self.surface.distances(origins, directions, self.exact_hits(origins, directions))

    def blocked(self, origins: Array, directions: Array, reach: Array) -> Mask:
        """Return which rays, shape (N, 3), model frame, meet the rendered shape before `reach`, shape (N,), mm."""
        return exact.trace_blocked(self.mi, self._built.scene, origins, directions, reach)

    def lit(self, positions: Array, light: int) -> Any:
        """Return which points, shape (N, 3), camera frame, mm, a light emits towards and reaches unblocked."""
        source = self.scene.rig.true_mm()[light]
        towards = positions - source
        distance = np.linalg.norm(towards, axis=1)
        directions = towards / distance[:, None]
        emitted = self.scene.rig.lights[light].factor(directions) > 0
        # A light at the camera reaches all that is seen.
        if is_at_camera(source):
            return emitted
        # Shadow rays from the light.
        pose = self.surface.model_from_camera
        origins = np.broadcast_to(self.to_model(source[None]), positions.shape)
        hits = self.exact_hits(origins, directions @ pose[:3, :3].T)
        # A blocker stands clearly in front of the point; the point's own triangle does not count.
        return emitted & (hits.distance > distance * (1 - 1e-3))

    def lobe_at(self, points: Sequence[HighlightPoint]) -> Array:
        """Compute the direct light off the lobe at highlight points, shape (N,), mean of the channels.

        The normal is the exact one: the rendered triangles' misses the peak of a lobe that is narrower than a pixel. It
        is 0 where a highlight is the pixels' mean alone: over a relief that no part of the frame resolves, or over the
        camera's motion.
        """
        if not points or self.is_unresolved or self.scene.camera.moving is not None:
            return np.zeros(len(points))
        mi, tracer, rotation = self.mi, self._tracer(), self.surface.model_from_camera[:3, :3]
        pixels, normals = np.array([point.bp_px for point in points]), np.array([point.normal for point in points])
        rays, _, hit = tracer.hit(*(to_kernel(mi.Float, axis, np.float32) for axis in pixels.T))
        fine = mi.SurfaceInteraction3f(hit.fine)
        fine.sh_frame = mi.Frame3f(mi.Normal3f((normals @ rotation.T).T.astype(np.float32)))
        fine.wi = fine.to_local(-rays.traced.d)
        drawer = tracer.light.drawer(None)
        draw = None if drawer is None else drawer.at(0)
        lobe, _ = tracer.light.radiance(tracer.scene, tracer.material, replace(hit, fine=fine), draw)
        return np.mean(evaluate([*lobe], len(points)), axis=0, dtype=float)

    def highlights(self, radiance: Radiance | None = None) -> list[HighlightPoint]:
        """Find the highlight points of every light in view, the brightest first, with the frame's radiance.

        On a surface with relief these are its glints (theory.md 7.1). Where no part of the frame resolves the relief it
        acts as roughness, and the highlight points are the base's. Without a `radiance` theirs is 0, and they stand in
        no order.
        """
        return self._found(self.is_unresolved, radiance)

    @property
    def is_unresolved(self) -> bool:
        """Whether the surface has a relief that no part of the frame resolves, so that it acts as roughness."""
        return self.surface.relief is not None and not glints.is_resolved(self._whole)

    def base_highlights(self, radiance: Radiance | None = None) -> list[HighlightPoint]:
        """Find the highlight points of the base, without the relief: the centres of the clouds of glints."""
        return self._found(True, radiance)

    def _found(self, base: bool, radiance: Radiance | None) -> list[HighlightPoint]:
        """Return the highlight points of the base or of the fine surface, searched for once."""
        if base not in self._highlights:
            self._highlights[base] = found_highlights.search(self._whole, base)
        found = self._highlights[base]
        if self._instruments is not None:
            found = shade(self._whole, self._instruments, found)
        return list(found) if radiance is None else found_highlights.lit_by(radiance, found)
