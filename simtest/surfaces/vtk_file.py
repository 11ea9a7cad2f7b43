"""VTK files, read in a process of its own: VTK takes the whole process with it where a file lies about its sizes."""

from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.processes import call_apart

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
