"""What the header of a PLY file announces: how many vertices and faces, and how many bytes they must take."""

import re
from dataclasses import dataclass, field
from pathlib import Path

from simtest.errors import InputError
from simtest.runtime.files import check_limit

HEADER_BYTES = 65536
NUMPY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
SIZES = {name: int(kind[1]) for name, kind in NUMPY_TYPES.items()}
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
_MOST_DIGITS = 18


@dataclass
class Element:
    """An element: its name, how many there are, its properties by name, and the bytes that each takes at least."""

    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)
    bytes: int = 0
    words: int = 0


def check_ply(path: Path, size: int) -> tuple[int, int]:
    """Check that a PLY file can hold what its header announces, before any memory is asked for.

    Parameters
    ----------
    path : Path
        A plain file.
    size : int
        Its bytes.

    Returns
    -------
    tuple of int
        Vertices and faces that the header announces.
    """
    where = str(path)
    kind, elements, start = read_header(path)
    found = {element.name: element for element in elements}
    # what a mesh needs
    for name, properties in (("vertex", ("x", "y", "z")), ("face", ())):
        if name not in found:
            raise InputError(f"{where}: its header has no element {name}; a mesh has vertices and faces")
        for needed in properties:
            if needed not in found[name].properties:
                raise InputError(f"{where}: its vertices have no property {needed}; they need x, y and z")
    if not {"vertex_indices", "vertex_index"} & found["face"].properties.keys() and found["face"].count:
        raise InputError(f"{where}: its faces have no list of vertices; property list uchar int vertex_indices is it")
    for name, element in found.items():
        # Ten vertices a face would be a strange mesh, and ten faces a vertex too.
        if name in ("vertex", "face"):
            check_limit(
                "mesh_faces",
                element.count / (1 if name == "face" else 3),
                path,
                "faces" if name == "face" else "vertices over 3",
                "decimate the mesh",
            )
    # A number of a text takes two bytes at least, with what separates it from the next.
    each = {e.name: (2 * e.words if kind == "ascii" else e.bytes) for e in elements}
    least = sum(element.count * each[element.name] for element in elements)
    held = size - start
    if held + 1 < least:
        announced = " and ".join(f"{found[name].count} {name} elements" for name in ("vertex", "face"))
        raise InputError(f"{where}: {held} bytes follow the header; {announced} take {least} at least: it is cut short")
    return found["vertex"].count, found["face"].count


def read_header(path: Path) -> tuple[str, list[Element], int]:
    """Return format, elements and length in bytes of a PLY file's header; raise `InputError` if it is malformed."""
    where = str(path)
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{where}: no PLY file; it must begin with ply, and its header end with end_header")
    return *_parse(head[: end.start()].decode("latin-1"), where), end.end()


def _parse(text: str, where: str) -> tuple[str, list[Element]]:
    """Return the format and the elements that a header announces."""
    kind, elements = "", list[Element]()
    # Not by splitlines: in Latin-1 it also ends lines at bytes of UTF-8 text, such as 0x85 of a capital A with a ring.
    for line in (line.rstrip("\r") for line in text.split("\n")[1:]):
        words = line.split()
        match words[:1]:
            case ["format"]:
                kind = words[1] if len(words) > 1 else ""
            case ["element"]:
                if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > _MOST_DIGITS:
                    raise InputError(f"{where}: header line {line!r:.60}: must be element NAME COUNT")
                elements.append(Element(words[1], int(words[2])))
            case ["property"]:
                _add_property(elements, words, line, where)
            case ["comment"] | ["obj_info"] | []:
                pass
            case _:
                raise InputError(f"{where}: header line {line!r:.60}: must be an element, property or comment")
    if kind not in FORMATS:
        raise InputError(f"{where}: format {kind!r}: must be one of {', '.join(FORMATS)}")
    return kind, elements


def _add_property(elements: list[Element], words: list[str], line: str, where: str) -> None:
    """Add a line's property to the last element."""
    is_list = words[1:2] == ["list"]
    types = words[2:4] if is_list else words[1:2]
    if not elements or len(words) != (5 if is_list else 3) or any(name not in SIZES for name in types):
        raise InputError(f"{where}: header line {line!r:.60}: must be property TYPE NAME of a known type")
    last = elements[-1]
    last.properties[words[-1]] = " ".join(words[1:-1])
    # Of a list its length; a face has three corners at least, but a list may be empty.
    last.bytes += SIZES[types[0]]
    last.words += 1
