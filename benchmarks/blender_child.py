"""Render a scene with Cycles, once for each line on standard input; runs in an interpreter of its own that has bpy.

`python blender_child.py SCENE.npz [FILE.exr]` answers each line with processor and wall time of one render, s, as JSON;
with a file it renders once and writes all passes. Nothing of simtest is imported: bpy needs another NumPy.
"""

import json
import resource
import sys
import time
from typing import Any

import bpy
import numpy as np

PASSES = ("use_pass_z", "use_pass_normal", "use_pass_position", "use_pass_object_index")
WATTS = 4 * np.pi


def _mesh(given: Any) -> Any:
    """Return the object of the mesh, with its exact vertex normals."""
    mesh = bpy.data.meshes.new("surface")
    vertices, faces = given["vertices"], given["faces"]
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_smooth()
    mesh.normals_split_custom_set_from_vertices(given["normals"].tolist())
    made = bpy.data.objects.new("surface", mesh)
    made.pass_index = 1
    return made


def _material(given: Any) -> Any:
    """Return a white base below a lobe as wide as Phong's: a diffuse and a glossy closure, mixed."""
    material = bpy.data.materials.new("tissue")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, mix = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeMixShader")
    diffuse, glossy = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeBsdfAnisotropic")
    glossy.distribution = "BECKMANN"
    # Cycles squares the roughness; of that width is the microfacets' slope of a Phong exponent.
    glossy.inputs["Roughness"].default_value = float((2 / (given["exponent"] + 2)) ** 0.25)
    mix.inputs["Fac"].default_value = float(1 - given["diffuse"])
    links.new(diffuse.outputs[0], mix.inputs[1])
    links.new(glossy.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])
    return material


def _matrix(values: Any) -> Any:
    import mathutils

    return mathutils.Matrix(np.asarray(values, float).tolist())


def _build(given: Any) -> Any:
    """Make the scene: mesh, one point light, pinhole camera; direct light alone, box filter, no denoiser."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    surface = _mesh(given)
    surface.data.materials.append(_material(given))
    light = bpy.data.lights.new("light", "POINT")
    light.energy, light.shadow_soft_size = float(WATTS), 0.0
    lamp = bpy.data.objects.new("light", light)
    lamp.location = given["light"].tolist()
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.clip_start, lens.clip_end = "HORIZONTAL", 0.01, 1e4
    lens.angle = float(given["fov"])
    camera = bpy.data.objects.new("camera", lens)
    # Blender's cameras look along -z, y up.
    camera.matrix_world = _matrix(given["pose"] @ np.diag([1.0, -1.0, -1.0, 1.0]))
    for made in (surface, lamp, camera):
        scene.collection.objects.link(made)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = int(given["width"]), int(given["height"])
    scene.render.resolution_percentage = 100
    scene.render.use_compositing = scene.render.use_sequencer = False
    # What does not change from frame to frame is kept, the hierarchy of the triangles too.
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", int(given["threads"])
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", int(given["samples"]), 1
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 0
    cycles.pixel_filter_type, cycles.blur_glossy = "BOX", 0.0
    # The fastest way to sample one light.
    cycles.use_light_tree, cycles.direct_light_sampling_type = False, "NEXT_EVENT_ESTIMATION"
    # A dim light counts too.
    cycles.light_sampling_threshold = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    for name in PASSES:
        setattr(layer, name, bool(given["labelled"]))
    return scene


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main(path: str, picture: str | None = None) -> None:
    """Build the scene, then render as often as asked."""
    given = np.load(path)
    scene = _build(given)
    answers = sys.stdout
    if picture:
        scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
        scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        scene.render.image_settings.color_depth = "32"
        # One part that holds all passes; other programs read no other.
        scene.render.image_settings.use_exr_interleave = True
        scene.render.filepath = picture
        bpy.ops.render.render(write_still=True)
        return
    print("ready", file=answers, flush=True)
    for _ in sys.stdin:
        processor, wall = _used(), time.perf_counter()
        bpy.ops.render.render(write_still=False)
        print(json.dumps([_used() - processor, time.perf_counter() - wall]), file=answers, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
