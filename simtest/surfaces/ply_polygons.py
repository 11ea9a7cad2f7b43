"""Binary PLY files whose faces have unlike numbers of corners; trimesh reads those with like ones, and text."""

from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Literal

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Array, IntArray
from simtest.surfaces.ply_header import NUMPY_TYPES, Element, read_header

_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_mixed_polygons(path: Path) -> tuple[Array, IntArray] | None:
    """Read a binary PLY file that mixes triangles with larger polygons, which become fans of triangles.

    Parameters
    ----------
    path : Path
        A PLY file whose header `simtest.surfaces.ply_header.check_ply` has accepted.

    Returns
    -------
    tuple of ndarray, or None
        Vertices, shape (V, 3), and faces, shape (F, 3); None for text, and where all faces have like numbers of
        corners.
    """
    kind, elements, start = read_header(path)
    if kind not in _BYTE_ORDERS:
        return None
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        return _read(path, data, _BYTE_ORDERS[kind], elements, start)


def _read(path: Path, data: mmap, order: str, elements: list[Element], start: int) -> tuple[Array, IntArray] | None:
    """Read the elements that follow the header."""
    vertices = None
    for element in elements:
        if element.name == "face":
            found = _corners(data, start, element, order)
            return None if found is None or vertices is None else (vertices, _fans(data, *found))
        dtype = _row(element, order)
        if dtype is None:
            return None
        if len(data) < start + element.count * dtype.itemsize:
            raise InputError(f"{path}: ends within its {element.name} elements: it is cut short")
        if element.name == "vertex":
            rows = np.frombuffer(data, dtype, element.count, start)
            vertices = np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64)
            del rows  # or the file could not be closed
        start += element.count * dtype.itemsize
    return None


def _row(element: Element, order: str) -> np.dtype | None:
    """Return the layout of an element without lists; None with one."""
    if any(kind.startswith("list") for kind in element.properties.values()):
        return None
    return np.dtype([(name, order + NUMPY_TYPES[kind]) for name, kind in element.properties.items()])


def _corners(data: mmap, start: int, faces: Element, order: str) -> tuple[IntArray, IntArray, np.dtype] | None:
    """Return where each face's corners begin, their number, and their type; None where all have the same number.

    None also where a face has several lists, or the file ends before its last face: trimesh tells what is wrong.
    """
    before = after = 0
    length = corner = None
    for kind in faces.properties.values():
        words = kind.split()
        if words[0] != "list":
            size = np.dtype(NUMPY_TYPES[kind]).itemsize
            before, after = before + size * (length is None), after + size * (length is not None)
        elif length is None:
            length, corner = (np.dtype(order + NUMPY_TYPES[word]) for word in words[1:])
        else:
            return None
    if length is None or corner is None or length.kind == "f":
        return None
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
        own = begins[counts == count]
        raw = octets[own[:, None] + np.arange(count * corner.itemsize)]
        polygons = raw.reshape(-1).view(corner).reshape(-1, count).astype(np.int64)
        parts += [polygons[:, [0, k, k + 1]] for k in range(1, count - 1)]
    return np.concatenate(parts)
