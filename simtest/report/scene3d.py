"""Scenes in 3D: a surface, lights and normals, of a kept frame or of a scene, to be turned in a frame of a page."""

import base64
import json
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZipFile

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.pages.style import LIGHT, NEUTRAL, colours, estimator_order, number
from simtest.report.gallery import anchor
from simtest.report.run_folder import Run
from simtest.runtime.arrays import AnyArray, Array, IntArray
from simtest.validation.kept_frames import KeptItem

CAMERA, TRUE, TRUE_BASE = "camera", "true normal", "true normal of the base"
SIGHTLINE, EVERYWHERE = "sightline from the camera", "true normals of the surface"
TRUE_COLOUR = "#C9A800"
_COLOURS = {EVERYWHERE: "#5E8FBF", SIGHTLINE: NEUTRAL, CAMERA: NEUTRAL, TRUE: TRUE_COLOUR, TRUE_BASE: "#8A7A2E"}
CURVATURE_COLOURS = ("#053061", "#2166ac", "#4393c3", "#92c5de", "#d1e5f0", "#f7f7f7", "#fddbc7", "#f4a582", "#d6604d",
                     "#b2182b", "#67001f")  # fmt: skip
"""From concave to convex: blue to red."""

CURVATURE_QUANTILE, CURVATURE_ROOM = 0.97, 1.4
"""Curvature's colours end at this quantile of its size, times the factor: a few sharp edges must not take them all, and
a surface of one curvature must not get the darkest one."""

_GRID, _NORMALS = 72, 9  # samples of the surface along the longer side, and of the normals that are drawn all over it
_OCCLUSION = 1.25  # factor between the distances of neighbouring samples beyond which there is an edge
_THICK = 1 / 500  # radius of the thinnest line over the size of the scene
_UNSIGNED_BYTE, _UNSIGNED_INT, _FLOAT = 5121, 5125, 5126  # component types of glTF
_EYE = np.array([1.5, -1.14, -1.68])  # direction in which the viewer stands: behind the camera and above it


@dataclass(frozen=True)
class Content:
    """A scene, camera frame: a surface, light positions, and line segments by name."""

    vertices: Array  # samples of the visible surface, shape (V, 3)
    faces: IntArray  # triangles between them, shape (F, 3)
    curvature: Array  # of the base: principal one of larger size, convex to the camera positive, shape (V,) or (0,)
    normal: Array  # unit normals of the fine surface, shape (V, 3), or (0, 3) without a relief
    colour: Array  # of the tissue, sRGB from 0 to 1, shape (V, 3), or (0, 3) without one
    lit: Array  # the surface as an eye sees it under its lights, sRGB from 0 to 1, shape (V, 3)
    lights: Array  # shape (L, 3)
    names: AnyArray  # `CAMERA`, `TRUE`, ... or an estimator, shape (S,)
    starts: Array  # shape (S, 3)
    ends: Array

    def save(self, path: Path) -> None:
        """Write the arrays to a NumPy archive."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "Content":
        """Read what `save` wrote."""
        with np.load(path) as archive:
            return cls(**{field.name: archive[field.name] for field in fields(cls)})


class Part(NamedTuple):
    """A part of a scene in a page, which can be hidden."""

    node: str  # name in the frame
    name: str
    colour: str  # "" for a surface
    shown: bool = True


def estimators(content: Content) -> list[str]:
    """Return the estimators whose normals are shown, in the palette's order."""
    return estimator_order(set(content.names.tolist()) - set(_COLOURS))


def line_colours(content: Content) -> dict[str, str]:
    """Return the colour of each kind of lines that a scene has, in the order of its legend."""
    every = {**_COLOURS, **colours(estimators(content))}
    return {name: colour for name, colour in every.items() if (content.names == name).any()}


def curvature_limit(curvature: Array) -> float:
    """Return the curvature at which its colours end."""
    finite = np.abs(curvature[np.isfinite(curvature)])
    return max(CURVATURE_ROOM * float(np.quantile(finite, CURVATURE_QUANTILE)), 1e-4) if finite.size else 1.0


def grid_triangles(position: Array, occlusion: float) -> IntArray:
    """Join neighbouring samples of a surface, shape (h, w, 3), camera frame, NaN where there is none.

    Where the distances of neighbours differ by more than the factor `occlusion`, they lie on both sides of an edge and
    stay apart. Returns the triangles' corners, shape (n, 3), as indices into the samples that are a surface.
    """
    valid = np.isfinite(position).all(axis=-1)
    index = np.where(valid, np.cumsum(valid).reshape(valid.shape) - 1, -1)
    distance = np.linalg.norm(position, axis=-1)
    corners = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    a, b, c, d = (index[corner].ravel() for corner in corners)
    depth = np.stack([distance[corner].ravel() for corner in corners])
    with np.errstate(invalid="ignore"):
        whole = (np.stack([a, b, c, d]) >= 0).all(axis=0) & (depth.max(axis=0) < occlusion * depth.min(axis=0))
    return np.concatenate([np.stack([a, c, b], axis=1)[whole], np.stack([b, c, d], axis=1)[whole]])


# Kept frames ---------------------------------------------------------------------------------------------------------


class KeptScene(NamedTuple):
    """The scene of a kept frame."""

    title: str
    content: Content
    unit: str


def kept_scene(run: Run) -> KeptScene | None:
    """Return the scene of the kept frame that most estimators answered, the most curved of these.

    Returns None where no frame has a surface.
    """
    ranked = sorted(run.gallery, key=_interest, reverse=True)
    usable = (item for item in ranked if np.isfinite(item.position).all(axis=-1).sum() >= 16)
    chosen = next(usable, None)
    if chosen is None:
        return None
    content, setting = _content(chosen), chosen.meta.setting
    title = setting if setting.startswith(chosen.title) else f"{chosen.title}: {setting}"
    return None if content is None else KeptScene(title, content, chosen.meta.length_unit)


def _interest(item: KeptItem) -> tuple[int, float]:
    answered = {estimate.estimator for estimate in item.meta.estimates if estimate.status == "ok"}
    sizes = (abs(size) for truth in item.meta.truth for size in (truth.kd_min, truth.kd_max) if size)
    return len(answered), min(max(sizes, default=0.0), 2.0)


def _content(item: KeptItem) -> Content | None:
    # The surface, thinned.
    step = max(1, -(-max(item.position.shape[:2]) // _GRID))
    position = item.position[::step, ::step].astype(float)
    normal = item.normal[::step, ::step].astype(float)
    valid = np.isfinite(position).all(axis=-1)
    triangles = grid_triangles(position, _OCCLUSION)
    if not len(triangles):
        return None
    vertices = position[valid]
    # Normals as long as the surface is far away.
    reach = 0.12 * float(np.median(np.linalg.norm(vertices, axis=1)))
    rows, columns = (np.linspace(0, n - 1, min(n, _NORMALS + 2)).round().astype(int)[1:-1] for n in valid.shape)
    sampled = np.zeros_like(valid)
    sampled[np.ix_(rows, columns)] = True
    sampled &= valid & np.isfinite(normal).all(axis=-1)
    lines = [(EVERYWHERE, start, start + reach * along)
             for start, along in zip(position[sampled], normal[sampled], strict=True)]  # fmt: skip
    lines += _at_highlights(item, 2.5 * reach)
    names, starts, ends = zip(*lines, strict=True) if lines else ((), np.empty((0, 3)), np.empty((0, 3)))
    curvature, none = item.pictures.get("curvature"), np.empty((0, 3))
    return Content(
        vertices, triangles,
        np.empty(0) if curvature is None else curvature[::step, ::step].astype(float)[valid], none, none,
        np.repeat(np.sqrt(_intensity(item, valid.shape, step)[valid])[:, None], 3, axis=1),
        np.array(item.meta.lights, dtype=float).reshape(-1, 3), np.array(names), np.array(starts), np.array(ends),
    )  # fmt: skip


def _intensity(item: KeptItem, shape: tuple[int, ...], step: int) -> Array:
    frame = item.frame if item.frame.ndim == 2 else item.frame.mean(axis=-1)
    rows, columns = item.position.shape[:2]
    y = ((np.arange(shape[0]) * step + PIXEL_CENTRE) / rows * frame.shape[0]).astype(int)
    x = ((np.arange(shape[1]) * step + PIXEL_CENTRE) / columns * frame.shape[1]).astype(int)
    return np.clip(frame[np.ix_(y, x)], 0, 1).astype(float)


def _at_highlights(item: KeptItem, reach: float) -> list[tuple[str, Array, Array]]:
    """Return the lines at the highlights: true normals, those of all candidates of each estimator, and sightlines."""
    true = [(np.array(t.position), np.array(t.normal)) for t in item.meta.truth if t.position and t.normal]
    # The true normal is longer, so that it shows where an estimate lies on top of it.
    lines = [(TRUE, point, point + 1.4 * reach * normal) for point, normal in true]
    for estimate in item.meta.estimates:
        point = anchor(item, estimate)
        if point is not None:
            lines += [(estimate.estimator, point, point + reach * np.array(normal)) for normal in estimate.normals]
    return lines + [(SIGHTLINE, np.zeros(3), point) for point, _ in true]


# Frames of pages -----------------------------------------------------------------------------------------------------


class _Mesh(NamedTuple):
    """Triangles with a colour at each vertex."""

    vertices: Array  # shape (V, 3)
    faces: IntArray  # shape (F, 3)
    colours: Array  # sRGB from 0 to 1, shape (V, 3), or (3,) for all


def framed(content: Content, surface: str) -> tuple[str, list[Part]]:
    """Return the HTML of a frame that turns a scene, and the parts that its page can hide.

    `surface` is which colours of the surface are shown first: "lit", or "curvature" where it is known.
    """
    meshes: list[_Mesh] = []
    parts: list[Part] = []

    def add(mesh: _Mesh, name: str, colour: str, shown: bool = True) -> None:
        parts.append(Part(f"part{len(parts)}", name, colour, shown))
        meshes.append(mesh)

    is_curved = surface == "curvature" and content.curvature.size > 0
    add(_Mesh(content.vertices, content.faces, content.lit), "surface: lit", "", not is_curved)
    if content.curvature.size:
        limit = number(curvature_limit(content.curvature), 2)
        name = f"surface: curvature from −{limit} (blue) to {limit} (red)"
        add(_Mesh(content.vertices, content.faces, _shades(content.curvature)), name, "", is_curved)
    size = float(np.linalg.norm(np.ptp(content.vertices, axis=0)))
    for rank, (name, colour) in enumerate(line_colours(content).items()):
        own = content.names == name
        # Each kind is thicker than the one before, so that all show where they lie on each other.
        radius = size * _THICK * (1 if name in (CAMERA, SIGHTLINE, EVERYWHERE) else 1 + 0.3 * rank)
        shown = "field of view" if name == CAMERA else name
        add(_rods(content.starts[own], content.ends[own], radius, colour), shown, colour)
    for name, points, colour in (("camera", np.zeros((1, 3)), NEUTRAL), ("light", content.lights, LIGHT)):
        if len(points):
            add(_balls(points, 6 * _THICK * size, colour), name, colour)
    glb = _glb([part.node for part in parts], meshes)
    return _viewer_page().replace("$B64GLTF", base64.b64encode(glb).decode()), parts


def _viewer_page() -> str:
    """Return trimesh's viewer, which holds three.js; to import trimesh for it would take 0.3 s of a page's 2."""
    folder = Path(*find_spec("trimesh").submodule_search_locations)  # type: ignore[union-attr, misc]
    with ZipFile(folder / "resources" / "templates" / "viewer.zip") as archive:
        return archive.read("viewer.html.template").decode()


def _glb(names: list[str], meshes: list[_Mesh]) -> bytes:
    """Return meshes as nodes of a binary glTF 2.0 file, with the camera that sees all of them."""
    chunks: dict[bytes, int] = {}  # with the accessor of each
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []

    def stored(array: AnyArray, component: int, kind: str, **more: Any) -> int:
        """Append an array, a row an element, unless it is there already; return its accessor."""
        data = array.tobytes()
        if data not in chunks:
            views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(data)})
            chunks[data] = len(accessors)
            accessors.append(
                {"bufferView": chunks[data], "componentType": component, "count": len(array), "type": kind, **more}
            )
        return chunks[data]

    def primitive(mesh: _Mesh) -> dict[str, Any]:
        vertices = mesh.vertices.astype("<f4")
        limits = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
        colours = np.full((len(vertices), 4), 255, dtype=np.uint8)
        colours[:, :3] = np.rint(255 * mesh.colours)
        attributes = {
            "POSITION": stored(vertices, _FLOAT, "VEC3", **limits),
            "COLOR_0": stored(colours, _UNSIGNED_BYTE, "VEC4", normalized=True),
        }
        return {"attributes": attributes, "indices": stored(mesh.faces.ravel().astype("<u4"), _UNSIGNED_INT, "SCALAR")}

    lens = {"type": "perspective", "perspective": {"aspectRatio": 4 / 3, "yfov": np.deg2rad(45), "znear": 0.01}}
    # glTF keeps matrices by columns.
    camera = {"name": "viewer", "camera": 0, "matrix": _viewer(meshes).T.ravel().tolist()}
    content = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": list(range(len(meshes) + 1))}],
        "nodes": [{"name": name, "mesh": i} for i, name in enumerate(names)] + [camera],
        "meshes": [{"primitives": [primitive(mesh)]} for mesh in meshes],
        "accessors": accessors, "bufferViews": views, "cameras": [lens],
        "buffers": [{"byteLength": sum(map(len, chunks))}],
    }  # fmt: skip
    text = json.dumps(content).encode()
    pieces = ((b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", b"".join(chunks)))
    body = b"".join(len(piece).to_bytes(4, "little") + kind + piece for kind, piece in pieces)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def _shades(curvature: Array) -> Array:
    """Return the colours of curvatures, shape (V, 3)."""
    limit = curvature_limit(curvature)
    at = np.clip(np.nan_to_num(curvature) / limit, -1, 1)
    stops = np.array([_hexadecimal(colour) for colour in CURVATURE_COLOURS])
    return np.stack([np.interp(at, np.linspace(-1, 1, len(stops)), side) for side in stops.T], axis=1)


def _balls(centres: Array, radius: float, colour: str) -> _Mesh:
    theta, phi = np.linspace(0, np.pi, 7)[:, None], np.linspace(0, 2 * np.pi, 13)
    one = np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=-1
    )
    vertices, faces = one.reshape(-1, 3), grid_triangles(one, _OCCLUSION)
    every = faces + len(vertices) * np.arange(len(centres))[:, None, None]
    return _Mesh((centres[:, None] + radius * vertices).reshape(-1, 3), every.reshape(-1, 3), _hexadecimal(colour))


def _rods(starts: Array, ends: Array, radius: float, colour: str) -> _Mesh:
    """Return lines as six-sided rods: browsers draw lines of one px alone."""
    along = ends - starts
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    helper = np.eye(3)[np.abs(along).argmin(axis=1)]
    across = np.cross(along, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(along, across)
    turns = np.linspace(0, 2 * np.pi, 6, endpoint=False)[:, None, None]
    rim = radius * (np.cos(turns) * across + np.sin(turns) * other)
    vertices = np.concatenate([starts + rim, ends + rim]).transpose(1, 0, 2)
    i, j = np.arange(6), (np.arange(6) + 1) % 6
    one = np.concatenate([np.stack([i, j, i + 6], axis=1), np.stack([j, j + 6, i + 6], axis=1)])
    faces = (one + 12 * np.arange(len(starts))[:, None, None]).reshape(-1, 3)
    return _Mesh(vertices.reshape(-1, 3), faces, _hexadecimal(colour))


def _viewer(meshes: list[_Mesh]) -> Array:
    """Return the pose of the viewer, who sees the whole scene, y upwards and looking along -z as in OpenGL."""
    back = _EYE / np.linalg.norm(_EYE)
    right = np.cross([0.0, -1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0)
    pose[:3, 3] = (low + high) / 2 + 0.78 * np.linalg.norm(high - low) * back
    return pose


def _hexadecimal(colour: str) -> Array:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
