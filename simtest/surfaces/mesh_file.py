"""Mesh files: PLY, OBJ, STL and VTK read and repaired, with errors of one line; PLY, OBJ and STL written.

VTK files are read in a process of their own: VTK takes the whole process with it where a file lies about its sizes.
"""

import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from simtest.errors import InputError, SimtestError
from simtest.geometry.vectors import dot
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import check_limit, limit, require_plain, write_atomically
from simtest.runtime.processes import call_apart
from simtest.surfaces.model import TriangleMesh
from simtest.surfaces.triangles import edge_uses

HEADER_BYTES = 65536
NUMPY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_DIGITS = 18


@dataclass
class Element:
    """An element of a PLY file: its name, how many there are, and NumPy's type of each property, or of a list both."""

    name: str
    count: int
    properties: dict[str, tuple[str, ...]] = field(default_factory=dict)


def read_header(path: Path) -> tuple[str, list[Element], int]:
    """Return byte order, empty of text, elements and length of a PLY file's header; `InputError` if it is malformed."""
    where = str(path)
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{where}: no PLY file; it must begin with ply, and its header end with end_header")
    kind, elements = "", list[Element]()
    # Not by splitlines: in Latin-1 it also ends lines at bytes of UTF-8 text, such as 0x85 of a capital A with a ring.
    for line in head[: end.start()].decode("latin-1").split("\n")[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", *words]:
                kind = words[0] if words else ""
            case ["element", name, count] if count.isdecimal() and len(count) <= _MOST_DIGITS:
                elements.append(Element(name, int(count)))
            case ["property", "list", *types, name] if elements and len(types) == 2 and NUMPY_TYPES.keys() >= {*types}:
                elements[-1].properties[name] = tuple(NUMPY_TYPES[kind] for kind in types)
            case ["property", number, name] if elements and number in NUMPY_TYPES:
                elements[-1].properties[name] = (NUMPY_TYPES[number],)
            case [first, *_]:
                forms = {"element": "element NAME COUNT", "property": "property TYPE NAME of a known type"}
                wanted = forms.get(first, "an element, property or comment")
                raise InputError(f"{where}: header line {line.rstrip(chr(13))!r:.60}: must be {wanted}")
    if kind not in BYTE_ORDERS:
        raise InputError(f"{where}: format {kind!r:.40}: must be one of {', '.join(BYTE_ORDERS)}")
    return BYTE_ORDERS[kind], elements, end.end()


def check_ply(path: Path, size: int) -> tuple[int, int]:
    """Return vertices and faces that the header of a PLY file announces, if its bytes can hold them.

    Checked before any memory is asked for. Raises `InputError` if the header is malformed, there is no vertex or face
    in it, there are more faces than allowed, or the file ends before the announced ones.
    """
    where = str(path)
    order, elements, start = read_header(path)
    by_name = {element.name: element for element in elements}
    for name in ("vertex", "face"):
        if name not in by_name:
            raise InputError(f"{where}: its header has no element {name}; a mesh has vertices and faces")
    vertex, face = by_name["vertex"], by_name["face"]
    for needed in "xyz":
        if needed not in vertex.properties:
            raise InputError(f"{where}: its vertices have no property {needed}; they need x, y and z")
    if not {"vertex_indices", "vertex_index"} & face.properties.keys() and face.count:
        raise InputError(f"{where}: its faces have no list of vertices; property list uchar int vertex_indices is it")
    # Ten vertices a face would be a strange mesh, and ten faces a vertex too.
    check_limit("mesh_faces", vertex.count / 3, path, "vertices over 3", "decimate the mesh")
    check_limit("mesh_faces", face.count, path, "faces", "decimate the mesh")
    # A number of a text takes two bytes at least, with what separates it from the next. Of a list its length counts: a
    # face has three corners at least, but a list may be empty.
    least = sum(
        element.count * sum(_size(types[0]) if order else 2 for types in element.properties.values())
        for element in elements
    )
    if size - start + 1 < least:
        announced = f"{vertex.count} vertex elements and {face.count} face elements"
        raise InputError(
            f"{where}: {size - start} bytes follow the header; {announced} take {least} at least: it is cut short"
        )
    return vertex.count, face.count


def _size(kind: str) -> int:
    return np.dtype(kind).itemsize


def read_mixed_polygons(path: Path) -> tuple[Array, IntArray] | None:
    """Read a binary PLY file that mixes triangles with larger polygons, which become fans of triangles.

    The header is one that `check_ply` has accepted. Returns vertices and faces; None for text, and where all faces have
    like numbers of corners. Raises `InputError` if the file ends before its faces.
    """
    order, elements, start = read_header(path)
    if not order:
        return None
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        vertices = None
        for element in elements:
            if element.name == "face":
                corners = _corners(data, start, element, order)
                return None if corners is None or vertices is None else (vertices, _fans(data, *corners))
            if any(len(types) > 1 for types in element.properties.values()):
                return None
            row = np.dtype([(name, order + kind) for name, (kind,) in element.properties.items()])
            if len(data) < start + element.count * row.itemsize:
                raise InputError(f"{path}: ends within its {element.name} elements: it is cut short")
            if element.name == "vertex":
                rows = np.frombuffer(data, row, element.count, start)
                vertices = np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64)
                del rows  # or the file could not be closed
            start += element.count * row.itemsize
    return None


def _corners(data: mmap, start: int, faces: Element, order: str) -> tuple[IntArray, IntArray, np.dtype] | None:
    """Return where each face's corners begin, their number, and their type; None where all have the same number.

    None also where a face has several lists, or the file ends before its last face: trimesh tells what is wrong.
    """
    types = list(faces.properties.values())
    lists = [i for i, kinds in enumerate(types) if len(kinds) > 1]
    if len(lists) != 1 or types[lists[0]][0][0] == "f":
        return None
    length, corner = (np.dtype(order + kind) for kind in types[lists[0]])
    before, after = (sum(_size(kind) for (kind,) in some) for some in (types[: lists[0]], types[lists[0] + 1 :]))
    if _are_alike(data, start, faces.count, before, after, length, corner):
        return None
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    begins, counts, at = np.empty(faces.count, np.int64), np.empty(faces.count, np.int64), start
    for i in range(faces.count):
        at += before + length.itemsize
        # An empty slice, beyond the end, is a face without corners.
        counts[i] = count = int.from_bytes(data[at - length.itemsize : at], byte_order)
        begins[i] = at
        at += count * corner.itemsize + after
        if at > len(data):
            return None
    return None if len(np.unique(counts)) < 2 else (begins, counts, corner)


def _are_alike(data: mmap, start: int, count: int, before: int, after: int, length: np.dtype, corner: np.dtype) -> bool:
    """Return whether all faces have as many corners as the first; told without a loop over millions of faces."""
    if count == 0 or start + before + length.itemsize > len(data):
        return True
    first = int(np.frombuffer(data, length, 1, start + before)[0])
    stride = before + length.itemsize + first * corner.itemsize + after
    if first < 0 or start + count * stride > len(data):
        return False
    lengths = np.ndarray((count,), length, data, start + before, (stride,))
    return bool((lengths == first).all())


def _fans(data: mmap, begins: IntArray, counts: IntArray, corner: np.dtype) -> IntArray:
    """Cut polygons into triangles that share the first corner."""
    octets, parts = np.frombuffer(data, np.uint8), []
    for count in np.unique(counts[counts >= 3]):
        starts = begins[counts == count]
        raw = octets[starts[:, None] + np.arange(count * corner.itemsize)]
        polygons = raw.reshape(-1).view(corner).reshape(-1, count).astype(np.int64)
        parts += [polygons[:, [0, k, k + 1]] for k in range(1, count - 1)]
    return np.concatenate(parts)


SLIVER = 1e-14
"""Area over the squared extent below which rounding decides the direction of a face."""

MAX_CROSSING_FACES = 1_000_000
"""Above this many faces self-intersections are not searched for (about 5 s and 2 GB at the limit)."""


@dataclass(frozen=True)
class Repairs:
    """Counts of what was repaired."""

    # Vertices at the position of another; the three that each triangle of an STL file has of its own do not count
    merged_vertices: int = 0
    # repeated_faces, faces_without_area: Faces left out
    repeated_faces: int = 0
    faces_without_area: int = 0
    reversed_faces: int = 0  # Faces turned so that neighbours wind the same way
    turned_pieces: int = 0  # Whole pieces that were inside out

    def sentences(self, lumen: bool = False) -> Iterator[str]:
        """Yield a sentence for each repair; for a lumen, faces may wind inward or outward."""
        if self.merged_vertices:
            yield f"merged {_many(self.merged_vertices, 'repeated vertex', 'repeated vertices')}"
        if self.faces_without_area:
            yield f"left out {_many(self.faces_without_area, 'face without area', 'faces without area')}"
        if self.repeated_faces:
            yield f"left out {_many(self.repeated_faces, 'repeated face', 'repeated faces')}"
        if self.reversed_faces:
            yield f"reversed {_many(self.reversed_faces, 'face that winds', 'faces that wind')} against the neighbours"
        if self.turned_pieces and not lumen:
            yield f"turned {_many(self.turned_pieces, 'piece that was', 'pieces that were')} inside out"


@dataclass(frozen=True)
class Condition:
    """Faults of the repaired mesh that are left as they are."""

    pieces: int  # Connected pieces
    open_edges: int  # Edges of one face; 0 for a watertight mesh
    non_manifold_edges: int  # Edges of more than two faces
    crossing_faces: int | None  # Faces that cut through another; None if they were not searched for

    @property
    def watertight(self) -> bool:
        """Whether each edge belongs to two faces."""
        return self.open_edges == 0 and self.non_manifold_edges == 0

    def to_json(self) -> dict[str, int | bool | None]:
        """Return the fields, and whether the mesh is watertight."""
        return {"watertight": self.watertight, **asdict(self)}


def _many(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"


def repair(vertices: Array, faces: IntArray, soup: bool = False) -> tuple[Array, IntArray, Repairs]:
    """Repair what can be repaired without a guess at the shape.

    `soup` says that by the file's format each face has its own vertices, so that merging them is no repair. Vertices
    are used, and none repeated; the winding is consistent within each piece, with outward normals: positive volume
    about the piece's centroid.
    """
    import trimesh  # slow to import

    # vertices
    used = len(np.unique(faces))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    merged = 0 if soup else used - len(np.unique(mesh.faces))
    before = len(mesh.faces)
    # Faces without area, relative to the extent, and repeated faces
    mesh.update_faces(mesh.area_faces > SLIVER * float(np.ptp(vertices, axis=0).max()) ** 2)
    flat = before - len(mesh.faces)
    before = len(mesh.faces)
    mesh.update_faces(mesh.unique_faces())
    repeated = before - len(mesh.faces)
    mesh.remove_unreferenced_vertices()
    # winding
    points = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    triangles = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    if not len(triangles):
        return points, triangles, Repairs(merged, repeated, flat)
    triangles, against, turned = _outward(points, triangles)
    return points, triangles, Repairs(merged, repeated, flat, against, turned)


def _outward(vertices: Array, faces: IntArray) -> tuple[IntArray, int, int]:
    """Make the winding consistent within each connected piece, and the normals of each piece point outward.

    Returns the faces, how many of them wound against the majority of their piece, and how many pieces pointed inward.
    """
    import igl

    oriented, piece = igl.bfs_orient(faces)
    piece = np.asarray(piece).ravel()
    count = int(piece.max()) + 1
    corners = vertices[oriented]
    # Volumes about each piece's own centroid, so that an open piece has a meaningful sign.
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, c, count) for c in corners.mean(axis=1).T], axis=1) / size[:, None]
    a, b, c = (corners[:, i] - middle[piece] for i in range(3))
    volume = np.bincount(piece, dot(a, np.cross(b, c)), count)
    # Pieces of negative volume are inside out.
    outward = np.where((volume[piece] < 0)[:, None], oriented[:, ::-1], oriented)
    # A face and its reverse differ by an odd permutation: compare the corner that follows the smallest.
    given, now = (np.take_along_axis(f, (f.argmin(axis=1)[:, None] + 1) % 3, axis=1)[:, 0] for f in (faces, outward))
    inward = np.bincount(piece, given != now, count)
    turned = inward > size / 2
    against = np.where(turned, size - inward, inward).sum()
    return np.ascontiguousarray(outward, dtype=np.int64), int(against), int(turned.sum())


def examine(vertices: Array, faces: IntArray) -> Condition:
    """Find the faults of a mesh from `repair`; the search for self-intersections takes longest."""
    import igl
    from igl import predicates

    _, uses = edge_uses(faces)
    # Connected by shared vertices: two pieces that touch in one vertex count as one.
    pieces = int(np.max(igl.vertex_components(faces))) + 1
    crossing = None
    if len(faces) <= MAX_CROSSING_FACES:
        crossed, pairs, _ = predicates.find_self_intersections(vertices, faces)
        crossing = len(np.unique(pairs)) if crossed else 0
    return Condition(pieces, int((uses == 1).sum()), int((uses > 2).sum()), crossing)


MESH_SUFFIXES = (".ply", ".obj", ".stl", ".vtk")
WRITTEN_SUFFIXES = (".ply", ".obj", ".stl")

MIN_FACES = 4
"""A tetrahedron is the smallest surface with an inside."""

LEAST_SOUND = 0.5
"""A file of whose faces a smaller share has an area was not written so."""

LARGE_BYTES = 100_000_000
"""Files of text beyond it are searched for faces before they are read."""

_END_BYTES = 65_536
"""At the end of an STL file of text, among which its last line is looked for."""

MOST_BYTES_PER_FACE = 2000
"""Of a large file of text: an STL file takes about 250, an OBJ file with its vertices less."""

EXTENT_RANGE_MM = (1.0, 1e5)
"""Largest extent that is plausible; a mesh in metres falls below it."""

ORGAN_RANGE_MM = (60.0, 2000.0)
"""Largest extent of a liver, a colon or a large piece of one: for a guess at another unit."""


_ZERO_INDEX = re.compile(rb"^[ \t]*f[ \t](?:[^\r\n#]*[ \t])?0+(?=[/ \t\r\n]|\Z)", re.MULTILINE)
"""Beginning of a face's line in an OBJ file, up to a vertex 0."""


def read_mesh(path: str | Path) -> tuple[Array, IntArray, Repairs]:
    """Read a PLY, OBJ, STL or VTK file (PolyData, UnstructuredGrid), in mm, and repair what can be repaired safely.

    Equal vertices are merged; faces without area, repeated faces and vertices without a face are left out; polygons are
    cut into triangles; the winding is made consistent within each piece, normals outward.

    Returns
    -------
    vertices : ndarray, shape (V, 3)
        mm.
    faces : ndarray of int, shape (F, 3)
    repairs : Repairs
        What was repaired.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InputError(f"{path}: unknown suffix {path.suffix!r}; allowed: {', '.join(MESH_SUFFIXES)}")
    announced = _check_file(path, suffix)
    try:
        with _quiet():
            mixed = read_mixed_polygons(path) if suffix == ".ply" else None
            vertices, faces = mixed or (read_vtk(path) if suffix == ".vtk" else _load_trimesh(path))
    except SimtestError:
        raise
    except Exception as error:
        # The readers raise whatever their parser runs into; the file is at fault, not the program.
        raise InputError(f"{path}: not a readable {suffix[1:].upper()} mesh ({_reason(error)})") from error
    # Its reader says nothing of lines that are missing.
    held = (len(vertices), len(faces))
    if held[0] < announced[0] or held[1] < announced[1]:
        raise InputError(
            f"{path}: holds {held[0]} vertices and {held[1]} faces, but its header announces {announced[0]} and "
            f"{announced[1]}: it is cut short, or a line is malformed"
        )
    _check_arrays(path, vertices, faces)
    count = len(faces)
    with _quiet():
        vertices, faces, repairs = repair(vertices, faces, soup=suffix == ".stl")
    if len(faces) < MIN_FACES:
        raise InputError(f"{path}: {len(faces)} of {count} faces have an area; at least {MIN_FACES} needed")
    if len(faces) < LEAST_SOUND * count:
        raise InputError(f"{path}: {len(faces)} of {count} faces have an area: it is damaged or cut short")
    return vertices, faces, repairs


def other_unit(extent: float) -> str:
    """Return a likelier unit than mm by the largest extent, such as "metres, 214 mm"; empty if there is none."""
    low, high = ORGAN_RANGE_MM
    if extent >= 10.0 and extent <= high:
        return ""
    for unit, factor in (("centimetres", 10.0), ("metres", 1e3), ("micrometres", 1e-3)):
        if low <= factor * extent <= high:
            return f"{unit}, {factor * extent:.3g} mm"
    return ""


def _check_file(path: Path, suffix: str) -> tuple[int, int]:
    """Check what can be checked without a reader; return the vertices and faces that the file must hold at least."""
    size = require_plain(path, "mesh_bytes", "a mesh", "decimate the mesh").stat().st_size
    if size == 0:
        raise InputError(f"{path}: 0 bytes; a mesh of at least {MIN_FACES} faces is needed")
    if suffix == ".ply":
        return check_ply(path, size)
    with path.open("rb") as file:
        head = file.read(4096)
        {".stl": _check_stl, ".obj": _check_obj, ".vtk": _check_vtk}[suffix](path, file, head, size)
        is_text = suffix == ".obj" or (suffix == ".stl" and size != 84 + 50 * _announced(head))
        if is_text and size > LARGE_BYTES:
            _check_large_text(path, file, size, b"endfacet" if suffix == ".stl" else b"\nf")
    return 0, 0


def _check_large_text(path: Path, file: BinaryIO, size: int, word: bytes) -> None:
    """Raise `InputError` where a large file of text holds too many or too few of a word, of which each face has one."""
    count, end = 0, b""
    file.seek(0)
    # By pieces, since readers keep all of the text in memory; a word may stand across two of them.
    while piece := file.read(2**20):
        piece = end + piece.lower()
        count += piece.count(word)
        end = piece[1 - len(word) :]
    check_limit("mesh_faces", count, path, "faces", "decimate the mesh")
    if size > MOST_BYTES_PER_FACE * count:
        raise InputError(f"{path}: {count} faces in {size} bytes; must be {MOST_BYTES_PER_FACE} bytes a face at most")


def _announced(head: bytes) -> int:
    """Return how many faces a binary STL file announces."""
    return int.from_bytes(head[80:84], "little")


def _check_stl(path: Path, file: BinaryIO, head: bytes, size: int) -> None:
    """Raise `InputError` where an STL file ends before its last face, or announces too many of them."""
    count = _announced(head)
    if size >= 84 and size == 84 + 50 * count:
        check_limit("mesh_faces", count, path, "faces", "decimate the mesh")
    elif head[:5].lower() == b"solid" and b"facet" in head.lower():
        # A header of a binary file may begin so too.
        file.seek(max(0, size - _END_BYTES))
        if b"endsolid" not in file.read().lower():
            raise InputError(f"{path}: has no line endsolid: it is cut short")
    elif 84 <= size < 84 + 50 * count and count <= limit("mesh_faces"):
        # Four letters of a text would be more than that.
        held = (size - 84) // 50
        raise InputError(f"{path}: holds {held} of the {count} faces that it announces: it is cut short")


def _check_obj(path: Path, file: BinaryIO, head: bytes, _: int) -> None:
    """Raise `InputError` where a file is no text, or a face names vertex 0, which its reader takes for the last one."""
    # Its reader would make a hundred million words of it before it finds nothing in them.
    if b"\0" in head:
        raise InputError(f"{path}: no OBJ file; it is no text")
    file.seek(0)
    # By pieces that end with a line, unless that is longer than any line of a mesh.
    while piece := file.read(2**20) + file.readline(2**20):
        if wrong := _ZERO_INDEX.search(piece):
            line = wrong[0].decode("latin-1").strip()
            raise InputError(f"{path}: {line!s:.60}: vertex 0; the first vertex of an OBJ file is 1")


def _check_vtk(path: Path, _: BinaryIO, head: bytes, size: int) -> None:
    """Raise `InputError` where a VTK file is none, or announces more points or cells than it has bytes."""
    if not head.startswith((b"# vtk DataFile", b"<?xml", b"<VTKFile")):
        raise InputError(f"{path}: no VTK file; its first line must be # vtk DataFile Version ...")
    for name, count in re.findall(rb"^(POINTS|POLYGONS|CELLS|TRIANGLE_STRIPS)\s+(-?\d{1,18})\b", head, re.MULTILINE):
        if not 0 <= int(count) <= size:
            raise InputError(f"{path}: {name.decode()} {int(count)}: the file has {size} bytes, too few for them")


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the mesh libraries: their messages go into our one line."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


def _load_trimesh(path: Path) -> tuple[Array, IntArray]:
    import trimesh  # slow to import

    kind = path.suffix[1:].lower()
    options = {"skip_materials": True} if kind == "obj" else {}
    loaded = trimesh.load(path, file_type=kind, process=False, **options)
    # An OBJ file may hold several objects.
    if isinstance(loaded, trimesh.Scene):
        parts = [part for part in loaded.geometry.values() if isinstance(part, trimesh.Trimesh)]
        if not parts:
            raise InputError(f"{path}: no faces; at least {MIN_FACES} triangles are needed")
        loaded = trimesh.util.concatenate(parts)
    vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    return vertices, np.asarray(getattr(loaded, "faces", np.empty((0, 3))), dtype=np.int64)


MEMORY_BYTES, MEMORY_PER_BYTE = 4e9, 40
"""What VTK may take, in all and for each byte of the file.

A point takes at least 6 bytes of a file, and a few arrays of 24 bytes in memory; a face likewise."""


def read_vtk(path: Path) -> tuple[Array, IntArray]:
    """Read a PolyData or an UnstructuredGrid as triangles: vertices, in the file's unit, and faces."""
    memory = MEMORY_BYTES + MEMORY_PER_BYTE * path.stat().st_size
    return call_apart(_triangles, path, memory, "VTK mesh", "damaged: VTK breaks down over its points or cells")


def _triangles(path: str) -> tuple[Array, IntArray]:
    """Read a file in this process; raise `InputError` where its content is no mesh."""
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    # VTK fills what is missing with zeros, or leaves it as it finds it, and goes on.
    with pyvista.VtkErrorCatcher(send_to_logging=False) as caught:
        data = pyvista.read(path)
    if any(event.kind == "ERROR" or "Error reading" in event.alert for event in caught.events):
        raise InputError("holds fewer points or cells than it announces: it is cut short or damaged")
    if isinstance(data, pyvista.UnstructuredGrid):
        check_indices(np.asarray(data.cell_connectivity), data.n_points)
        data = data.extract_surface(algorithm="dataset_surface")
    if not isinstance(data, pyvista.PolyData):
        raise InputError(f"a VTK {type(data).__name__}; allowed: PolyData, UnstructuredGrid")
    # VTK's filters trust the indices, so they are checked first.
    for cells in (data.GetPolys(), data.GetStrips()):
        check_indices(pyvista.convert_array(cells.GetConnectivityArray()), data.n_points)
    data = data.triangulate()
    return np.array(data.points, dtype=np.float64), np.asarray(data.faces, dtype=np.int64).reshape(-1, 4)[:, 1:]


def check_indices(indices: IntArray, count: int, where: str = "") -> None:
    """Raise `InputError` where a corner of a face, of shape (N,), is none of `count` vertices; `where` begins it."""
    if len(indices) and not (indices.min() >= 0 and indices.max() < count):
        wrong = indices.max() if indices.max() >= count else indices.min()
        raise InputError(f"{where}a face names vertex {wrong}; allowed: 0 to {count - 1}")


def _check_arrays(path: Path, vertices: Array, faces: IntArray) -> None:
    # shapes and counts
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or not len(vertices):
        raise InputError(f"{path}: no vertices; at least {MIN_FACES} are needed")
    if not faces.size:
        raise InputError(f"{path}: {len(vertices)} points and no faces; at least {MIN_FACES} triangles are needed")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"{path}: faces of {faces.shape[-1]} corners; triangles are needed")
    if len(faces) < MIN_FACES:
        raise InputError(f"{path}: {len(faces)} face{'s'[: len(faces) != 1]}; at least {MIN_FACES} are needed")
    check_limit("mesh_faces", len(faces), path, "faces", "decimate the mesh")
    # values
    check_indices(faces.ravel(), len(vertices), f"{path}: ")
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        values = ", ".join(f"{x:g}" for x in vertices[row])
        raise InputError(f"{path}: vertex {row} is ({values}); finite coordinates are needed")
    extent, (low, high) = float(np.ptp(vertices, axis=0).max()), EXTENT_RANGE_MM
    if not low <= extent <= high:
        unit = other_unit(extent)
        guess = f"; if the file is in {unit}, scale it" if unit else ""
        raise InputError(
            f"{path}: largest extent {extent:g} mm; allowed: {low:g} to {high:g} mm (lengths are in mm{guess})"
        )


def _reason(error: Exception) -> str:
    """Return what a reader ran into; a fault of its own, such as an index out of range, says nothing to a user."""
    lines = str(error).strip().splitlines()
    if isinstance(error, IndexError | KeyError | TypeError | AttributeError | AssertionError) or not lines:
        return "its elements do not fit what its header announces, or a line is cut short"
    return lines[0][:160]


# Writing -------------------------------------------------------------------------------------------------------------


def check_target(path: Path) -> None:
    """Raise `InputError` if no mesh can be written to a path; called before any work is done."""
    if path.suffix.lower() not in WRITTEN_SUFFIXES:
        raise InputError(f"--out {path}: suffix {path.suffix!r}; allowed: {', '.join(WRITTEN_SUFFIXES)}")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; must be a file")


def write_mesh(path: Path, mesh: TriangleMesh, attributes: Mapping[str, Array] | None = None) -> None:
    """Write a mesh, mm; single precision in PLY and STL, the same bytes for the same mesh.

    The suffix selects the format: PLY holds vertex normals and attributes, numbers at the vertices by name, OBJ vertex
    normals, STL neither. Raises `InputError` if the file cannot be written, `SimtestError` if its disk is full.
    """
    import trimesh  # slow to import

    check_target(path)
    built = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        for name, values in (attributes or {}).items():
            built.vertex_attributes[name] = values.astype("f4")
        data = built.export(file_type="ply", vertex_normal=True)
    elif suffix == ".obj":
        # Eight digits: single precision, like the others.
        data = built.export(file_type="obj", include_normals=True, digits=8, header=None).encode()
    else:
        data = built.export(file_type="stl")
    write_atomically(path, lambda part: part.write_bytes(data))
