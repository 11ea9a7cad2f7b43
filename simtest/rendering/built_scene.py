"""The Mitsuba objects of a scene's structure: built once, then only their values are written.

What is compiled into the kernels (shape, BSDF, kinds of lights) is the structure. Everything else is a parameter, which
costs less than a millisecond to write.
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.rendering.adaptive import MeshEdges
from simtest.rendering.backend import mi
from simtest.rendering.elements import lights as light_elements
from simtest.rendering.kernel_values import MitsubaDict, spectrum
from simtest.rendering.lighting import DirectLight
from simtest.rendering.tissue_kernels import AlbedoKernel, ReliefKernel
from simtest.rendering.truth import ShapeLabels
from simtest.rendering.tube_kernel import TubeKernel
from simtest.runtime.arrays import Array
from simtest.spec.lights import LightSpec, Rig
from simtest.spec.reflectance import Reflectance
from simtest.surfaces import Shape, TriangleMesh


def make_shape(shape: Shape, bsdf: MitsubaDict) -> Any:
    """Make a shape for `mi.load_dict`: a description of an analytic shape, or a mesh with the given vertex normals."""
    if shape.mesh is not None:
        return _make_mesh(shape.mesh, bsdf)
    plugin = {"plane": "rectangle", "sphere": "sphere", "cylinder": "cylinder"}[shape.kind]
    transform = mi.ScalarTransform4f(shape.to_model.tolist())
    return {"type": plugin, "to_world": transform, "flip_normals": shape.flip, "bsdf": bsdf}


def _make_mesh(mesh: TriangleMesh, bsdf: MitsubaDict) -> Any:
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    rendered = mi.Mesh("surface", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(rendered)
    parameters["vertex_positions"] = flat(mesh.vertices, np.float32)
    parameters["faces"] = flat(mesh.faces, np.uint32)
    parameters.update()
    # Mitsuba recomputes the normals from the triangles when positions change, so the exact ones are set afterwards.
    parameters["vertex_normals"] = flat(mesh.normals, np.float32)
    parameters.update()
    return rendered


def flat(values: Any, dtype: Any) -> Any:
    """Flatten an array row by row into 32-bit numbers, as Mitsuba stores buffers."""
    return np.ascontiguousarray(values, dtype=dtype).ravel()


@dataclass
class BuiltScene:
    """A built Mitsuba scene."""

    key: tuple[Any, ...]  # Its structure
    # scene, parameters: The Mitsuba scene with surface and lights, and its parameters
    scene: Any
    parameters: Any
    # base, base_parameters: The BSDF's base alone and its parameters; None where the BSDF evaluates its parts
    # separately
    base: Any
    base_parameters: Any
    labels: ShapeLabels | None = None  # What traces the labels of its shape; made when first needed
    edges: MeshEdges | None = None  # Of its mesh, see `mesh_edges`
    tube: TubeKernel | None = None  # Of its shape's chart; made when first needed
    mesh: TriangleMesh | None = None  # The mesh as it was written last

    def write(self, shape: Shape, reflectance: Reflectance) -> None:
        """Write pose and material of the surface."""
        # Shape.
        if shape.mesh is None:
            self._set("surface.to_world", mi.AffineTransform4f(shape.to_model.tolist()))
        elif not _same(shape.mesh, self.mesh):
            # Move the vertices; the triangles stay.
            self._set("surface.vertex_positions", flat(shape.mesh.vertices, np.float32))
            self.parameters.update()
            # Mitsuba has recomputed the normals from the triangles.
            self._set("surface.vertex_normals", flat(shape.mesh.normals, np.float32))
            self.parameters.update()
            self.mesh, self.labels, self.edges = shape.mesh, None, None
        # Material: the whole and its base alone.
        for name, given in reflectance.updates.items():
            value = spectrum(given) if isinstance(given, list) else given
            self._set(f"bsdf.{name}", value)
            if self.base is not None:
                self.base_parameters[name] = value
        if self.base is not None:
            self.base_parameters.update()

    def mesh_edges(self) -> MeshEdges | None:
        """Return the edges of the mesh, made when first needed; None of other shapes."""
        if self.edges is None and self.mesh is not None:
            self.edges = MeshEdges(self.scene, self.mesh)
        return self.edges

    def place_lights(self, rig: Rig, model_from_camera: Array) -> DirectLight:
        """Write the lights of a rig at a pose of the camera, and all set before; return their own kernel."""
        lights, rotation = rig.lights, model_from_camera[:3, :3]
        positions = rig.true_mm() @ rotation.T + model_from_camera[:3, 3]
        axes = np.array([light.axis for light in lights]) @ rotation.T
        poses = [
            light_elements.LightPose(position, axis, light.across @ rotation.T)
            for light, position, axis in zip(lights, positions, axes, strict=True)
        ]
        for i, light in enumerate(lights):
            for name, value in light_elements.emitter_values(light, poses[i]).items():
                self._set(f"light_{i}.{name}", value)
        self.parameters.update()
        return DirectLight(rig, poses)

    def let_bounces_find(self, albedo: AlbedoKernel | None, film: ReliefKernel | None) -> None:
        """Let bounced light find albedo and roughness of tissue by its own points, where they vary."""
        # Weak: what a BSDF holds, Mitsuba holds, and Python could not free it at its end.
        bsdf = self.scene.shapes()[0].bsdf()
        if albedo is not None:
            colour = weakref.proxy(albedo)
            bsdf.albedo_at = lambda si, active: colour.of(si, active)
            has_debris = albedo.pattern.debris is not None
            bsdf.bare_at = (lambda si, active: 1 - colour.covers(si, active)[0]) if has_debris else None
        if film is not None:
            relief = weakref.proxy(film)
            bsdf.wet_at = lambda si, active: relief.wet_at(si, active)

    def _set(self, suffix: str, value: Any) -> None:
        """Assign the one parameter whose path ends in `suffix`; Mitsuba names paths by its own rules."""
        paths = [path for path in self.parameters.keys() if path.endswith(suffix)]  # noqa: SIM118 - no plain dict
        assert len(paths) == 1, (suffix, list(self.parameters.keys()))
        self.parameters[paths[0]] = value


def build(key: tuple[Any, ...], shape: Shape, reflectance: Reflectance, lights: Sequence[LightSpec]) -> BuiltScene:
    """Build the Mitsuba scene of a structure."""
    surface = make_shape(shape, reflectance.kernel)
    kinds = [light_elements.kind_of(light) for light in lights]
    emitters = {f"light_{i}": light_elements.emitter_dict(kind) for i, kind in enumerate(kinds)}
    # Without optimize=False Mitsuba merges equal objects: two lights of one power, or a light and a texture,
    # would share a parameter, and an update of one would change both.
    scene = mi.load_dict({"type": "scene", "surface": surface, **emitters}, optimize=False)
    base = reflectance.base_kernel and mi.load_dict(reflectance.base_kernel, optimize=False)
    return BuiltScene(key, scene, mi.traverse(scene), base, base and mi.traverse(base), mesh=shape.mesh)


def _same(mesh: TriangleMesh, other: TriangleMesh | None) -> bool:
    """Return whether two meshes of the same triangles have the same vertices and normals."""
    if other is None or mesh is other:
        return mesh is other
    return np.array_equal(mesh.vertices, other.vertices) and np.array_equal(mesh.normals, other.normals)
