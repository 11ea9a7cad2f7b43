"""A rendering session: the Mitsuba scene is built once and updated from frame to frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.anatomy import RayHits, SurfaceModel, SurfacePoints, make_surface
from simtest.geometry.camera import Camera
from simtest.rendering import backend, highlights, integrate, phong
from simtest.rendering.frames import Array, Radiance, TrueHighlight, TruthMaps
from simtest.rendering.materials import bsdf_dict, parameter_updates
from simtest.rendering.refine import Refinement
from simtest.rendering.shapes import make_shape
from simtest.spec.scene import Scene
from simtest.spec.surface import AnatomySurface

COLOCATED_MM = 1e-9
"""A light nearer to the camera than this sees what the camera sees: no shadow rays."""

FINE_STRIDE_PX = 2
"""Seeds' grid for anatomies, whose highlights are small and many."""

COARSE_STRIDE_PX = 4
"""Seeds' grid for analytic surfaces."""


@dataclass
class _Built:
    """The Mitsuba objects of a scene's structure."""

    key: tuple[Any, ...]
    scene: Any
    parameters: Any
    diffuse_bsdf: Any


class Session:
    """Renders scenes of like structure without rebuilding.

    Parameters
    ----------
    scene : Scene
        The first scene.
    variant : str, optional
        Mitsuba variant; default by `simtest.rendering.backend.requested_variant`.

    Attributes
    ----------
    rebuilds : int
        How many times the Mitsuba scene was built.

    Raises
    ------
    BackendError
        If the rendering backend cannot be used.
    InputError
        If the surface's file is malformed or the camera lies on the wrong side.
    """

    def __init__(self, scene: Scene, variant: str | None = None) -> None:
        self.mi = backend.load(variant)
        self.variant = str(self.mi.variant())
        self.plugin = phong.register(self.mi, self.variant)
        self.rebuilds = 0
        self._built: _Built | None = None
        self._truth: TruthMaps | None = None
        self._load_surface(scene)
        self.update(scene)

    def update(self, scene: Scene) -> None:
        """Move to another scene; only what changed is updated, and only another structure is rebuilt.

        Parameters
        ----------
        scene : Scene
            The next scene.
        """
        if scene.surface != self.scene.surface:
            self._load_surface(scene)
        elif scene.camera != self.scene.camera:
            self._truth = None  # of another camera
        self.scene: Scene = scene
        self.camera: Camera = scene.camera.model()
        updates = parameter_updates(scene.reflectance)
        fixed = (
            scene.reflectance
            if updates is None
            else (type(updates), scene.reflectance.diffuse, scene.reflectance.colour)
        )
        normalised = getattr(scene.reflectance, "normalised", None)
        key = (self._shape.key, fixed, normalised, len(scene.rig.lights))
        if self._built is None or self._built.key != key:
            self._built = self._build(key)
        self._apply(self._built)

    def _load_surface(self, scene: Scene) -> None:
        # A malformed surface raises here and leaves the session at its scene.
        surface = make_surface(scene.surface)
        self._shape = surface.shape()
        self.surface: SurfaceModel = surface
        self.scene = scene
        self._truth = None

    def _build(self, key: tuple[Any, ...]) -> _Built:
        self.rebuilds += 1
        reflectance = self.scene.reflectance
        shape = make_shape(self.mi, self._shape, bsdf_dict(reflectance, self.plugin, diffuse_only=False))
        lights = {
            f"light_{i}": {"type": "point", "intensity": {"type": "uniform", "value": 1.0}}
            for i in range(len(self.scene.rig.lights))
        }
        # Without optimize=False Mitsuba merges equal objects: two lights of one power, or a light and a texture,
        # would share a parameter, and an update of one would change both.
        scene = self.mi.load_dict({"type": "scene", "surface": shape, **lights}, optimize=False)
        diffuse = self.mi.load_dict(bsdf_dict(reflectance, self.plugin, diffuse_only=True))
        return _Built(key, scene, self.mi.traverse(scene), diffuse)

    def _apply(self, built: _Built) -> None:
        """Write the values that may differ between scenes of one structure into the Mitsuba scene."""
        parameters = built.parameters
        if "to_model" in self._shape.parameters:
            matrix = self._shape.parameters["to_model"]
            self._set(parameters, "surface.to_world", self.mi.AffineTransform4f(matrix.tolist()))
        for i, light in enumerate(self.scene.rig.lights):
            place = self.to_model(np.array([light.place_mm]))[0]
            self._set(parameters, f"light_{i}.position", self.mi.Point3f(*place.tolist()))
            self._set(parameters, f"light_{i}.intensity.value", light.power)
        for name, value in (parameter_updates(self.scene.reflectance) or {}).items():
            self._set(parameters, f"bsdf.{name}", value)
        parameters.update()

    def _set(self, parameters: Any, suffix: str, value: Any) -> None:
        """Assign the one parameter whose path ends in `suffix`; Mitsuba names paths by its own rules."""
        paths = [path for path in parameters.keys() if path.endswith(suffix)]  # noqa: SIM118 - no plain dict
        assert len(paths) == 1, (suffix, list(parameters.keys()))
        parameters[paths[0]] = value

    # Frames ------------------------------------------------------------------------------------------------------

    def to_model(self, points: Array) -> Array:
        """Transform points, shape (N, 3), from the camera frame to the model frame, mm."""
        pose = self.surface.model_from_camera
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    def _rays(self, points_px: Array) -> tuple[Array, Array]:
        """Give the rays of pixels, shape (N, 2), in the model frame, unit directions."""
        pose = self.surface.model_from_camera
        directions = self.camera.unproject(points_px) @ pose[:3, :3].T
        return np.broadcast_to(pose[:3, 3], directions.shape), directions

    # Radiance ----------------------------------------------------------------------------------------------------

    def radiance(self) -> Radiance:
        """Render the frame.

        Returns
        -------
        Radiance
            With one sample a pixel: the value on the ray through each pixel's centre; with more: the mean over the
            pixel's area. The same scene and seed give the same bytes.
        """
        assert self._built is not None
        shadows = [float(np.linalg.norm(light.place_mm)) > COLOCATED_MM for light in self.scene.rig.lights]
        lights = self.to_model(np.array([light.place_mm for light in self.scene.rig.lights]))
        powers = [light.power for light in self.scene.rig.lights]
        refinement = Refinement(self.mi, self._shape)
        tracer = integrate.Tracer(
            self.mi, self._built.scene, self._built.diffuse_bsdf, lights, powers, shadows, refinement
        )
        effort = self.scene.render
        return integrate.render(
            tracer, self._rays, self.camera, effort.samples_per_pixel, effort.path_depth, effort.seed
        )

    # Ground truth ------------------------------------------------------------------------------------------------

    def cast(self, points_px: Array) -> tuple[SurfacePoints, Array, Array]:
        """Cast rays through pixels onto the exact surface.

        Parameters
        ----------
        points_px : ndarray, shape (N, 2)
            Pixel positions.

        Returns
        -------
        points : SurfacePoints
            Exact, in the camera frame.
        shading_normal, geometric_normal : ndarray, shape (N, 3)
            Normals of the rendered shape, camera frame; NaN where the ray misses.
        """
        assert self._built is not None
        origins, directions = self._rays(points_px)
        hits, shading, geometric = self._hits(origins, directions)
        exact = self.surface.points(np.asarray(origins), directions, hits)
        rotation = self.surface.model_from_camera[:3, :3]
        centre = self.surface.model_from_camera[:3, 3]
        points = SurfacePoints(
            distance=exact.distance,
            position=(exact.position - centre) @ rotation,
            normal=exact.normal @ rotation,
            k_min=exact.k_min,
            k_max=exact.k_max,
            direction_min=exact.direction_min @ rotation,
            direction_max=exact.direction_max @ rotation,
            valid=exact.valid,
        )
        return points, shading @ rotation, geometric @ rotation

    def _hits(self, origins: Array, directions: Array) -> tuple[RayHits, Array, Array]:
        assert self._built is not None
        if not len(origins):
            # Dr.Jit ends the process on a kernel without rays.
            none = np.empty((0, 3))
            return RayHits(np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 2))), none, none
        mi = self.mi
        ray = mi.Ray3f(_point(mi, origins), mi.Vector3f(_point(mi, directions)))
        preliminary = self._built.scene.ray_intersect_preliminary(ray)
        si = preliminary.compute_surface_interaction(ray)
        import drjit as dr

        valid = si.is_valid()
        normals = (mi.Vector3f(si.sh_frame.n), mi.Vector3f(si.n))
        dr.eval(preliminary.t, preliminary.prim_uv, preliminary.prim_index, *normals, valid)
        missed = ~np.array(valid)
        distance = np.where(missed, np.inf, np.array(preliminary.t, dtype=np.float64))
        face = np.where(missed, 0, np.array(preliminary.prim_index, dtype=np.int64))
        barycentric = np.where(missed[:, None], 0.0, np.array(preliminary.prim_uv, dtype=np.float64).T)
        shading, geometric = (np.array(n, dtype=np.float64).T for n in normals)
        facing = np.where(np.einsum("ij,ij->i", geometric, directions) > 0, -1.0, 1.0)[:, None]
        if self._shape.kind == "mesh":
            geometric = geometric * facing
        for normal in (shading, geometric):
            normal[missed] = np.nan
        return RayHits(distance, face, barycentric), shading, geometric

    def truth(self, stride: int = 1) -> TruthMaps:
        """Give the ground truth at the centre of every pixel, or of every `stride`-th along both axes.

        Returns
        -------
        TruthMaps
            The full maps are kept while surface and camera stay.
        """
        if stride != 1:
            return self._cast_maps(stride)
        if self._truth is None:
            self._truth = self._cast_maps(1)
        return self._truth

    def _cast_maps(self, stride: int) -> TruthMaps:
        centres = self.camera.pixel_centres()[::stride, ::stride]
        size = centres.shape[:2]
        points, shading, geometric = self.cast(centres.reshape(-1, 2))
        return TruthMaps(
            depth=points.distance.reshape(size),
            position=points.position.reshape(*size, 3),
            normal=points.normal.reshape(*size, 3),
            shading_normal=shading.reshape(*size, 3),
            geometric_normal=geometric.reshape(*size, 3),
            k_min=points.k_min.reshape(size),
            k_max=points.k_max.reshape(size),
            direction_min=points.direction_min.reshape(*size, 3),
            direction_max=points.direction_max.reshape(*size, 3),
            mask=points.valid.reshape(size),
        )

    def lit(self, positions: Array, light: int) -> Any:
        """Tell which points, shape (N, 3), camera frame, mm, a light reaches without being blocked."""
        assert self._built is not None
        place = np.array([self.scene.rig.lights[light].place_mm])
        if np.linalg.norm(place) <= COLOCATED_MM:
            return np.ones(len(positions), dtype=bool)
        towards = positions - place
        distance = np.linalg.norm(towards, axis=1)
        pose = self.surface.model_from_camera
        origins = np.broadcast_to(self.to_model(place), positions.shape)
        hits, _, _ = self._hits(origins, (towards / distance[:, None]) @ pose[:3, :3].T)
        # A blocker stands clearly before the point; the point's own triangle does not count.
        return hits.distance > distance * (1 - 1e-3)

    def highlights(self, radiance: Radiance) -> list[TrueHighlight]:
        """Find the true highlights of every light in view.

        Parameters
        ----------
        radiance : Radiance
            The same frame's.

        Returns
        -------
        list of TrueHighlight
            The brightest first.
        """
        is_anatomy = isinstance(self.scene.surface, AnatomySurface)
        return highlights.find(self, radiance, stride=FINE_STRIDE_PX if is_anatomy else COARSE_STRIDE_PX)


def _point(mi: Any, values: Array) -> Any:
    return mi.Point3f(np.ascontiguousarray(values.T, dtype=np.float32))
