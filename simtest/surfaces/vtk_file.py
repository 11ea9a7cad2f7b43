"""VTK files, read in a process of its own: VTK takes the whole process with it where a file lies about its sizes.

python -m simtest.surfaces.vtk_file MESH.vtk OUT.npz
"""

import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from simtest.errors import InputError, SimtestError
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.machine_errors import disk_problem, machine_problem
from simtest.runtime.resources import shown

TIMEOUT_S = 300
REFUSED = 3
"""Exit code of a file that is refused; the last line of the output says why."""
FAILED = 4
"""Exit code where the machine lacks memory or room on its disk; the last line of the output says which."""


def read_vtk(path: Path) -> tuple[Array, IntArray]:
    """Read a PolyData or an UnstructuredGrid as triangles.

    Returns
    -------
    vertices : ndarray, shape (V, 3)
        In the file's unit.
    faces : ndarray of int, shape (F, 3)

    Raises
    ------
    InputError
        If the file is no such mesh, or VTK breaks down over it.
    SimtestError
        If memory, or the disk of temporary files, does not hold it.
    """
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "mesh.npz"
        # -P: no file of the current folder may stand in for a package.
        command = [sys.executable, "-P", "-m", "simtest.surfaces.vtk_file", str(path.absolute()), str(made)]
        try:
            child = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise InputError(f"{shown(path)}: not read within {TIMEOUT_S} s; must be a smaller VTK mesh") from None
        if child.returncode == 0:
            with np.load(made, allow_pickle=False) as arrays:
                return arrays["vertices"], arrays["faces"]
    # What the machine did is no damage of the file.
    if child.returncode == -signal.SIGKILL:
        raise SimtestError(f"{shown(path)}: VTK was killed while it read the file, mostly for want of memory")
    if child.returncode == FAILED:
        raise SimtestError(f"{shown(path)}: {(child.stdout.strip().splitlines() or ['not read'])[-1]}")
    said = (child.stdout.strip().splitlines() or [""])[-1] if child.returncode == REFUSED else ""
    raise InputError(f"{shown(path)}: {said or 'damaged: VTK breaks down over its points or cells'}")


def _triangles(path: str) -> tuple[Array, IntArray]:
    """Read a file in this process; raise `InputError` where its content is no mesh."""
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    vtkObject.GlobalWarningDisplayOff()
    data = pyvista.read(path)
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


def main() -> int:
    """Read a file and store its arrays; print why that cannot be."""
    try:
        vertices, faces = _triangles(sys.argv[1])
    except InputError as error:
        print(error)
        return REFUSED
    except MemoryError as error:
        print(machine_problem(error))
        return FAILED
    except Exception as error:
        # The reader raises whatever it runs into; the file is at fault.
        print(f"not a readable VTK mesh ({' '.join(str(error).split())[:160] or type(error).__name__})")
        return REFUSED
    try:
        np.savez(sys.argv[2], vertices=vertices, faces=faces)
    except OSError as error:
        print(f"its triangles cannot be stored ({disk_problem(error, Path(sys.argv[2])) or error})")
        return FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main())
