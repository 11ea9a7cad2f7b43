"""Arrays of NumPy as lanes of a kernel, and back, so that one kernel serves any number of lanes.

Dr.Jit's own conversions of arrays of vectors bake the length into kernels: each new number of rays compiles others.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

ALIGNMENT = 64
"""Bytes. Dr.Jit reads NumPy's memory in place, and compiles one kernel for aligned memory and another for the rest."""


def to_kernel(kind: Any, values: npt.NDArray[Any], dtype: npt.DTypeLike) -> Any:
    """Return an array, shape (N,), as a Dr.Jit array of a kind, such as mitsuba.Float64, whose elements are `dtype`.

    The memory is aligned, whatever NumPy's is: the same kernels serve every call, and every process finds them on disk.
    """
    size = len(values) * np.dtype(dtype).itemsize
    room = np.empty(size + ALIGNMENT, dtype=np.uint8)
    first = -room.ctypes.data % ALIGNMENT
    aligned = room[first : first + size].view(dtype)
    aligned[:] = values
    return kind(aligned)


def vectors_to_kernel(kind: Any, component: Any, values: npt.NDArray[Any], dtype: npt.DTypeLike) -> Any:
    """Return an array, shape (N, k), as Dr.Jit vectors of a kind, such as mitsuba.Point3f, of a kind of component."""
    return kind(*(to_kernel(component, part, dtype) for part in values.T))


def vectors_from_kernel(vector: Any, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return Dr.Jit vectors of k components, which are evaluated, as an array, shape (N, k)."""
    return np.stack([np.array(part, dtype=dtype) for part in vector], axis=1)
