"""Writes a scene as a Mitsuba XML file with its mesh, which Mitsuba itself loads and renders to the same picture."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.rendering import backend, elements
from simtest.rendering.backend import mi
from simtest.rendering.built_scene import make_shape
from simtest.rendering.kernel_values import MitsubaDict
from simtest.runtime import provenance
from simtest.runtime.arrays import Array
from simtest.runtime.files import make_folder, write_atomically, written_together
from simtest.spec import Scene
from simtest.spec.lights import CosineProfile, DiscSource, LightSpec
from simtest.spec.spec_model import Spec
from simtest.surfaces import Shape, SurfaceModel, make_surface

SCENE_FILE, MESH_FILE = "scene.xml", "surface.ply"

SAMPLES = 64
"""Samples a pixel where one ray through its centre is not enough: several lights, or light that bounces."""

MITSUBA_FROM_CAMERA = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's cameras look along z too, but with x to the left and y up."""

CLIP = (1e-4, 1e4)
"""Nearest and farthest distance that is rendered, over the surface's own scale."""

VIEW_MARGIN = 1.05
"""Half-size of an exported plane over the farthest point that is seen of it."""

MAX_DISC_DEPTH_MM = 1e-6
"""How far in front of the camera's plane a disc may lie: rounding, and nothing else."""

_CAMERA_KEYS = frozenset({"width", "height", "fx", "fy", "cx", "cy", "skew"})
# A preset's lights stand in `lights`; the seed draws the positions that are rendered.
_RIG_KEYS = frozenset(
    {"lights", "preset", "count", "radius_mm", "azimuth_deg", "axial_mm", "power", "each", "seed", "emission_known"}
)
_LIGHT_KEYS = frozenset({"position_mm", "offset_mm", "azimuth_deg", "power", "direction", "position_error_mm"})
_DISC_KEYS = _LIGHT_KEYS | {"source", "profile"}


def export_scene(scene: Scene, out: Path, variant: str | None = None) -> list[Path]:
    """Write a scene for Mitsuba: scene.xml and, for surfaces that are meshes, surface.ply (see `simtest.export`).

    The world is the surface's model frame, mm. What belongs to the sensor (noise, exposure) is left out.
    """
    # Check before anything is written.
    for key, value, why in _inexpressible(scene):
        raise InputError(f"scene {scene.name}: {key} = {value!r}: cannot be exported; {why}")
    backend.load(variant)
    elements.register(str(mi.variant()))
    surface = make_surface(scene.surface, None, scene.camera.moved, scene.deformation, scene.time_s)
    shape = _cut_to_view(surface.shape(), surface, scene.camera.model())
    text = _xml(scene, surface, shape)
    make_folder(out)
    names = (MESH_FILE, SCENE_FILE) if shape.mesh else (SCENE_FILE,)
    with written_together(out, names) as new:
        if shape.mesh:
            mesh = make_shape(shape, {"type": "diffuse"})
            # By way of memory, since Mitsuba does not tell which of the system's errors it met.
            stream = mi.MemoryStream()
            mesh.write_ply(stream)
            write_atomically(new / MESH_FILE, lambda part: part.write_bytes(stream.raw_buffer()))
        write_atomically(new / SCENE_FILE, lambda part: part.write_text(text, encoding="utf-8"))
    return [out / name for name in reversed(names)]


def _inexpressible(scene: Scene) -> Iterator[tuple[str, Any, str]]:
    """Yield key, value and reason of everything that Mitsuba's camera and lights cannot express."""
    camera, relief, albedo = scene.camera, scene.surface.relief, scene.albedo
    square = f"Mitsuba's camera has square pixels: must equal camera.fy = {camera.fy:g}"
    unknown = "Mitsuba does not know simtest's"
    parts: list[tuple[bool, str, Any, str]] = [
        (camera.fx != camera.fy, "camera.fx", camera.fx, square),
        (camera.skew != 0, "camera.skew", camera.skew, "Mitsuba's camera has no skew: must be 0"),
        *((True, f"instruments.{index}.present", True, f"{unknown} instruments: must be false")
          for index in scene.shown_instruments),
        (relief is not None, "surface.relief", relief and relief.model_dump(exclude_defaults=True),
         f"{unknown} relief: must be left out"),
        (scene.render.ambient, "render.ambient", True, f"{unknown} estimate: must be false; path_depth traces it"),
        (scene.translucency is not None, "reflectance.translucency", "a table",
         "it acts on simtest's picture: must be left out"),
        (albedo is not None, "reflectance.albedo", albedo and albedo.preset,
         "Mitsuba has no such pattern: must be left out"),
    ]  # fmt: skip
    yield from (part[1:] for part in parts if part[0])
    yield from _beyond(camera, _CAMERA_KEYS, "camera", "Mitsuba's perspective camera")
    yield from _beyond(scene.rig, _RIG_KEYS, "rig", "Mitsuba's point light")
    for i, light in enumerate(scene.rig.lights):
        path = f"rig.lights.{i}"
        if light.source is None:
            yield from _beyond(light, _LIGHT_KEYS, path, "Mitsuba's point light")
        else:
            yield from _beyond(light, _DISC_KEYS, path, "Mitsuba's area light")
            yield from _beyond_disc(scene, i, path)


def _beyond_disc(scene: Scene, index: int, path: str) -> Iterator[tuple[str, Any, str]]:
    """Yield what a source of finite size has beyond Mitsuba's disc, which is Lambertian, a body, and in sight."""
    light, profile = scene.rig.lights[index], scene.rig.lights[index].profile
    if not isinstance(light.source, DiscSource):
        yield f"{path}.source.type", light.source and light.source.type, 'Mitsuba\'s area lights here are discs: "disc"'
        return
    if not isinstance(profile, CosineProfile) or profile.power != 1:
        shown = profile.power if isinstance(profile, CosineProfile) else profile.type
        yield f"{path}.profile", shown, 'Mitsuba\'s area light is Lambertian: must be { type = "cosine", power = 1.0 }'
    # A disc behind the camera's centre cannot be seen; one in front might, and might hide the tissue.
    depth = (light.source.rim() @ light.across + scene.rig.true_mm()[index])[:, 2].max()
    if depth > MAX_DISC_DEPTH_MM:
        why = "Mitsuba's disc is a body that the camera could see: must nowhere lie in front of the camera (z > 0)"
        yield f"{path}.source", f"disc up to z = {depth:.3g} mm", why


def _beyond(spec: Spec, known: frozenset[str], path: str, what: str) -> Iterator[tuple[str, Any, str]]:
    """Yield what a part of the scene sets beyond the exported keys: it is refused rather than left out."""
    for name, field in type(spec).model_fields.items():
        default = field.get_default(call_default_factory=True, validated_data={})
        value = getattr(spec, name)
        if name not in known and value != default:
            yield (
                f"{path}.{name}",
                value,
                f"{what} does not know it: must be {'left out' if default is None else repr(default)}",
            )


def _cut_to_view(shape: Shape, surface: SurfaceModel, camera: Camera) -> Shape:
    """Cut a plane to what the camera sees, where that is finite.

    Mitsuba interpolates the hit between the rectangle's corners. Those of simtest's plane lie so far out that a per
    mille of the radiance would be lost; a plane neither shades nor lights itself, so the rest is not missed.
    """
    if shape.kind != "plane":
        return shape
    # Where the sightlines of the frame's corners meet the plane z = 0.
    pose = surface.model_from_camera
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    directions = camera.unproject(corners) @ pose[:3, :3].T
    if (directions[:, 2] >= 0).any():
        return shape
    seen = pose[:2, 3] - pose[2, 3] / directions[:, 2:] * directions[:, :2]
    whole = shape.to_model
    reach = min(VIEW_MARGIN * float(np.abs(seen).max()), whole[0, 0])
    return replace(shape, to_model=np.diag([reach, reach, 1.0, 1.0]))


def _sensor(scene: Scene, surface: SurfaceModel, shape: Shape) -> MitsubaDict:
    camera = scene.camera.model()
    # Clipping planes by the size of the scene.
    if shape.mesh:
        scale = float(np.linalg.norm(np.ptp(shape.mesh.vertices, axis=0)))
    else:
        scale = float(np.linalg.norm(surface.model_from_camera[:3, 3]))
    near, far = (scale * share for share in CLIP)
    # One stratum without jitter: the ray through the pixel's centre.
    centres = {"type": "stratified", "sample_count": 1, "jitter": False}
    samples, seed = scene.render.samples_per_pixel, scene.render.seed
    spread = {"type": "independent", "sample_count": samples if samples > 1 else SAMPLES, "seed": seed}
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(camera.width / (2 * camera.fx))),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
        "near_clip": near,
        "far_clip": far,
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": centres if _through_centres(scene) else spread,
    }


def _through_centres(scene: Scene) -> bool:
    """Return whether one ray through each pixel's centre renders the picture: one point light that does not bounce."""
    effort = scene.render
    points = len(scene.rig.lights) == 1 and scene.rig.lights[0].source is None
    return effort.samples_per_pixel == 1 and effort.path_depth == 2 and points


def _light(light: LightSpec, position: Array) -> MitsubaDict:
    """Describe a point light at a place of the model frame, or a disc; `_xml` writes the place of the latter."""
    if light.source is None:
        intensity = {"type": "uniform", "value": light.power}
        return {"type": "point", "position": position.tolist(), "intensity": intensity}
    # Of a Lambertian disc the radiance is the intensity along the axis over the area. It reflects nothing.
    radiance = {"type": "uniform", "value": light.power / light.source.area_mm2}
    return {
        "type": "disk",
        "emitter": {"type": "area", "radiance": radiance},
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
    }


def _xml(scene: Scene, surface: SurfaceModel, shape: Shape) -> str:
    # Describe.
    bsdf, effort, pose = scene.reflectance.kernel, scene.render, surface.model_from_camera
    lights = list(zip(scene.rig.lights, scene.rig.true_mm(), strict=True))
    described = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": effort.path_depth, "rr_depth": effort.path_depth},
        "sensor": _sensor(scene, surface, shape),
        "surface": {"type": "ply", "filename": MESH_FILE, "bsdf": bsdf} if shape.mesh else make_shape(shape, bsdf),
        **{f"light_{i}": _light(light, pose[:3, :3] @ at + pose[:3, 3]) for i, (light, at) in enumerate(lights)},
    }
    # Let Mitsuba write its XML.
    state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), described)
    for node in state.nodes:
        if node.props.plugin_name() in elements.REFLECTANCES:
            # Mitsuba does not know the kind of a plugin written in Python.
            node.type = mi.ObjectType.BSDF
    written = mi.parser.write_string(state, add_section_headers=True)
    # Replace the transforms, add the comment at the head. Mitsuba itself has just written this text.
    root = ET.fromstring(written, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))  # nosec B314
    _set_transform(root, "sensor", pose @ MITSUBA_FROM_CAMERA)
    # A mesh is stored in the model frame already.
    if not shape.mesh:
        _set_transform(root, "surface", shape.to_model)
    for i, (light, position) in enumerate(lights):
        if light.source is not None:
            columns = np.column_stack([light.source.radius_mm * light.across.T, light.axis, position])
            _set_transform(root, f"light_{i}", pose @ np.vstack([columns, [0, 0, 0, 1]]))
    root.insert(0, ET.Comment(_head(scene)))
    ET.indent(root, " " * 4)
    return ET.tostring(root, encoding="unicode") + "\n"


def _set_transform(root: ET.Element, name: str, world_from_local: Array) -> None:
    """Write an object's transform as a matrix: Mitsuba's writer decomposes it, wrongly where it is anisotropic."""
    element = root.find(f"*[@name='{name}']")
    assert element is not None
    for written in element.findall("transform"):
        element.remove(written)
    transform = ET.Element("transform", name="to_world")
    ET.SubElement(transform, "matrix", value=" ".join(repr(float(x)) for x in world_from_local.ravel()))
    element.insert(0, transform)


def _head(scene: Scene) -> str:
    """Return the comment at the file's head, in which XML allows no two hyphens in a row."""
    lines = [
        f'Scene "{scene.name}", written by simtest {provenance.version()}. World: model frame of the surface, mm.',
        "Without the sensor: no noise, no exposure, linear radiance.",
    ]
    if (name := scene.reflectance.kernel["type"]) in elements.REFLECTANCES:
        lines += [
            f'The reflectance "{name}" is a plugin of simtest. After mitsuba.set_variant and before loading:',
            "    from simtest.rendering.plugins import register; register()",
        ]
    if _through_centres(scene):
        lines.append("One ray through each pixel's centre: a sampler of one stratum without jitter.")
    elif scene.render.samples_per_pixel == 1:
        lines.append(f"simtest sends one ray through each pixel's centre; here {SAMPLES} spread over the pixel.")
    if any(light.source for light in scene.rig.lights):
        lines.append("Discs are bodies here, which block light and reflect none.")
    return "\n" + "\n".join(f"        {re.sub('-(?=-)', '- ', line)}" for line in lines) + "\n    "
