"""Writing radiance with Mitsuba's own image library."""

from pathlib import Path

import numpy as np

from simtest.rendering import backend
from simtest.rendering.frames import FloatImage


def write_exr(path: Path, image: FloatImage, variant: str | None = None) -> None:
    """Write a float32 OpenEXR file.

    Parameters
    ----------
    path : Path
        Ends in .exr.
    image : ndarray of float32, shape (H, W) or (H, W, 3)
        Linear values.
    variant : str, optional
        Mitsuba variant.
    """
    mi = backend.load(variant)
    bitmap = mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))
    bitmap.write(str(path))
