"""Mitsuba's shape of a surface."""

from typing import Any

import numpy as np

from simtest.rendering.mitsuba_values import MitsubaDict
from simtest.surfaces import Shape, TriangleMesh


def make_shape(mi: Any, shape: Shape, bsdf: MitsubaDict) -> Any:
    """Make a shape for `mi.load_dict`: a description of an analytic shape, or a mesh with the given vertex normals."""
    if shape.mesh is not None:
        return _make_mesh(mi, shape.mesh, bsdf)
    plugin = {"plane": "rectangle", "sphere": "sphere", "cylinder": "cylinder"}[shape.kind]
    transform = mi.ScalarTransform4f(shape.to_model.tolist())
    return {"type": plugin, "to_world": transform, "flip_normals": shape.flip, "bsdf": bsdf}


def _make_mesh(mi: Any, mesh: TriangleMesh, bsdf: MitsubaDict) -> Any:
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh("surface", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = flat(mesh.vertices, np.float32)
    parameters["faces"] = flat(mesh.faces, np.uint32)
    parameters.update()
    # Mitsuba recomputes the normals from the triangles when positions change, so the exact ones are set afterwards.
    parameters["vertex_normals"] = flat(mesh.normals, np.float32)
    parameters.update()
    return made


def flat(values: Any, dtype: Any) -> Any:
    """Flatten an array row by row into 32-bit numbers, as Mitsuba stores buffers."""
    return np.ascontiguousarray(values, dtype=dtype).ravel()
