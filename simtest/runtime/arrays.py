"""Array types of all packages, each by what it holds; shapes and units stand where an array is used."""

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Geometry: points, normals, curvatures, conics."""

Image = npt.NDArray[np.float32]
"""Radiance, frames and label images."""

Picture = npt.NDArray[np.uint8]
"""Encoded pixels, 8 bits a channel."""

Mask = npt.NDArray[np.bool_]

Index = npt.NDArray[np.intp]
"""Positions in other arrays, as NumPy returns them."""

IntArray = npt.NDArray[np.int64]
"""Indices, faces, counts."""

AnyArray = npt.NDArray[Any]
"""Arrays of several dtypes, as in a sample of a dataset."""
