"""Numbers on their way into kernels and out: arrays as lanes, colours of the variant, powers of a cosine.

Dr.Jit's own conversions of arrays of vectors bake the length into kernels: each new number of rays compiles others.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.rendering.backend import dr, mi

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


MitsubaDict = dict[str, Any]
"""What `mi.load_dict` takes, or values by Mitsuba's parameter path: text, numbers and Mitsuba's own objects, nested."""


def channels() -> int:
    """Return the number of channels of the variant: 1 or 3."""
    return 3 if mi.Spectrum is mi.Color3f else 1


def spectrum(colour: Sequence[float]) -> Any:
    """Return three linear RGB values as they are, or in mono variants their luminance."""
    if channels() == 3:
        return mi.Color3f(*colour)
    return float(mi.luminance(mi.ScalarColor3f(*colour))[0])


def log_cosine(first: Any, second: Any) -> tuple[Any, Any]:
    """Compute log cos(beta) of two unit vectors, 0 where beta is 90 deg or more, and whether it is less.

    With t = tan(beta/2) = |a - b|/|a + b|, log cos(beta) = -2 artanh(t^2). A dot product loses the digits that matter
    next to 1: the relative error of its k-th power would be k eps, that of this form is sqrt(k) eps within the lobe.
    """
    squared = dr.squared_norm(first - second) / dr.squared_norm(first + second)
    ahead = squared < 1
    return -2 * dr.atanh(dr.select(ahead, squared, 0)), ahead


def channel_mean(spectrum: Any) -> Any:
    """Return the mean of a spectrum's channels.

    `drjit.mean` multiplies by the length of the launch and divides by it again, and keeps both in the kernel, so that
    each other length compiles another kernel.
    """
    return sum(spectrum) / len(spectrum)
