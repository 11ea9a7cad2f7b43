"""Mesh files: PLY, OBJ, STL and VTK read, with errors of one line; PLY, OBJ and STL written."""

import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from simtest.errors import InputError, SimtestError
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import check_limit, limit, require_plain, write_atomically
from simtest.surfaces.model import TriangleMesh
from simtest.surfaces.ply_header import check_ply
from simtest.surfaces.ply_polygons import read_mixed_polygons
from simtest.surfaces.repair import Repairs, repair
from simtest.surfaces.vtk_file import check_indices, read_vtk

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
        raise InputError(f"{path}: not a readable {suffix[1:].upper()} mesh ({_told(error)})") from error
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
    """Guess the unit of a mesh whose largest extent, in the file's unit, is hardly that of an organ in mm.

    The answer is such as "metres, 214 mm"; empty if no other unit is likelier than mm.
    """
    low, high = ORGAN_RANGE_MM
    if extent >= 10.0 and extent <= high:
        return ""
    for unit, factor in (("centimetres", 10.0), ("metres", 1e3), ("micrometres", 1e-3)):
        if low <= factor * extent <= high:
            return f"{unit}, {factor * extent:.3g} mm"
    return ""


def _check_file(path: Path, suffix: str) -> tuple[int, int]:
    """Check what can be checked without reading the file: kind, size, and what its header announces.

    Returns the vertices and faces that the file must hold at least.
    """
    announced = (0, 0)
    size = require_plain(path, "mesh_bytes", "a mesh", "decimate the mesh").stat().st_size
    if size == 0:
        raise InputError(f"{path}: 0 bytes; a mesh of at least {MIN_FACES} faces is needed")
    with path.open("rb") as file:
        head = file.read(4096)
    if suffix == ".ply":
        announced = check_ply(path, size)
    if suffix == ".stl":
        _check_stl(path, head, size)
    # OBJ is text, which its reader would make a hundred million words of before it finds nothing in them.
    if suffix == ".obj" and b"\0" in head:
        raise InputError(f"{path}: no OBJ file; it is no text")
    if suffix == ".obj":
        _check_obj(path)
    if suffix == ".vtk":
        _check_vtk(path, head, size)
    is_text = suffix == ".obj" or (suffix == ".stl" and size != 84 + 50 * int.from_bytes(head[80:84], "little"))
    if is_text and size > LARGE_BYTES:
        _check_large_text(path, size, b"endfacet" if suffix == ".stl" else b"\nf")
    return announced


def _check_large_text(path: Path, size: int, word: bytes) -> None:
    """Raise `InputError` where a large file of text holds too many or too few of a word, of which each face has one."""
    count, end = 0, b""
    with path.open("rb") as file:
        # By pieces, since readers keep all of the text in memory; a word may stand across two of them.
        while piece := file.read(2**20):
            piece = end + piece.lower()
            count += piece.count(word)
            end = piece[1 - len(word) :]
    check_limit("mesh_faces", count, path, "faces", "decimate the mesh")
    if size > MOST_BYTES_PER_FACE * count:
        raise InputError(f"{path}: {count} faces in {size} bytes; must be {MOST_BYTES_PER_FACE} bytes a face at most")


def _check_stl(path: Path, head: bytes, size: int) -> None:
    """Raise `InputError` where an STL file ends before its last face, or announces too many of them."""
    count = int.from_bytes(head[80:84], "little")
    if size >= 84 and size == 84 + 50 * count:
        check_limit("mesh_faces", count, path, "faces", "decimate the mesh")
    elif head[:5].lower() == b"solid" and b"facet" in head.lower():
        # A header of a binary file may begin so too.
        with path.open("rb") as file:
            file.seek(max(0, size - _END_BYTES))
            end = file.read().lower()
        if b"endsolid" not in end:
            raise InputError(f"{path}: has no line endsolid: it is cut short")
    elif 84 <= size < 84 + 50 * count and count <= limit("mesh_faces"):
        # Four letters of a text would be more than that.
        held = (size - 84) // 50
        raise InputError(f"{path}: holds {held} of the {count} faces that it announces: it is cut short")


def _check_obj(path: Path) -> None:
    """Raise `InputError` where a face names vertex 0, which its reader takes for the last one."""
    with path.open("rb") as file:
        # By pieces that end with a line, unless that is longer than any line of a mesh.
        while piece := file.read(2**20) + file.readline(2**20):
            if wrong := _ZERO_INDEX.search(piece):
                line = wrong[0].decode("latin-1").strip()
                raise InputError(f"{path}: {line!s:.60}: vertex 0; the first vertex of an OBJ file is 1")


def _check_vtk(path: Path, head: bytes, size: int) -> None:
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


def _told(error: Exception) -> str:
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
    """Write a mesh; single precision in PLY and STL, the same bytes for the same mesh.

    Parameters
    ----------
    path : Path
        The suffix selects the format: PLY holds vertex normals and attributes, OBJ vertex normals, STL neither.
    mesh : TriangleMesh
        mm.
    attributes : mapping, optional
        Numbers at the vertices by name, each of shape (V,), for PLY.
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
