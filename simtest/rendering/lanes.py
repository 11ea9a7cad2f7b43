"""Arrays of NumPy as lanes of a kernel."""

from typing import Any

import numpy as np
import numpy.typing as npt

ALIGNMENT = 64
"""Bytes. Dr.Jit reads NumPy's memory in place, and compiles one kernel for aligned memory and another for the rest."""


def lanes(kind: Any, values: npt.NDArray[Any], dtype: Any) -> Any:
    """Return an array, shape (N,), as a Dr.Jit array of a kind, such as mitsuba.Float64, whose elements are `dtype`.

    The memory is aligned, whatever NumPy's is: the same kernels serve every call, and every process finds them on disk.
    """
    size = len(values) * np.dtype(dtype).itemsize
    room = np.empty(size + ALIGNMENT, dtype=np.uint8)
    first = -room.ctypes.data % ALIGNMENT
    aligned = room[first : first + size].view(dtype)
    aligned[:] = values
    return kind(aligned)
