"""Fields of view: the angle that a camera's picture spans, and the focal length that gives a stated one."""

from typing import Literal, get_args

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.distortion import Distortion
from simtest.runtime.arrays import Array

FovExtent = Literal["width", "height", "diagonal"]

FOV_EXTENTS: tuple[FovExtent, ...] = get_args(FovExtent)

WIDEST = 1e7
"""Focal length up to which one is sought, over the picture's diagonal."""

STEPS = 200
"""Of the bisection; 120 reach the last digit."""


def field_of_view(camera: Camera, across: FovExtent = "width") -> float:
    """Return the angle, deg, that a camera's picture spans across its width, height or diagonal.

    It is the sum of the angles from the optical axis at the two ends: of the line through the principal point, or of
    the diagonal from the upper left corner. NaN where the lens images nothing at an end.
    """
    ends = _ends(camera.width, camera.height, (camera.cx, camera.cy), across)
    return float(np.degrees(_angles(camera.unproject(ends + np.array([camera.cx, camera.cy])))))


def focal_of_view(
    fov_deg: float,
    size: tuple[int, int],
    centre: tuple[float, float],
    lens: Distortion | None = None,
    across: FovExtent = "width",
) -> float:
    """Return the focal length, px, of a camera with square pixels that has a stated field of view.

    Parameters
    ----------
    fov_deg : float
        As `field_of_view` gives it.
    size : (int, int)
        Width and height of the picture, px.
    centre : (float, float)
        Principal point, px.
    lens : Distortion, optional
        The lens, whose field it is; default a pinhole.
    across : {"width", "height", "diagonal"}
        What the angle spans.
    """
    wanted, ends = np.radians(fov_deg), _ends(*size, centre, across)
    lengths = np.linalg.norm(ends, axis=1)
    if lens is None and lengths[0] == lengths[1] and 0 < wanted < np.pi:
        return float(lengths[0] / np.tan(wanted / 2))

    def spans(focal: float) -> float:
        """Return the angle at a focal length; inf where the lens folds over before an end of the picture."""
        m = ends / focal
        angle = _angles(np.column_stack([m, [1.0, 1.0]]) if lens is None else lens.undistort(m))
        return float(angle) if np.isfinite(angle) else np.inf

    # The angle falls as the focal length grows.
    low, high = np.log(lengths.max() * 1e-6), np.log(lengths.max() * WIDEST)
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if spans(float(np.exp(middle))) > wanted else (low, middle)
    focal = float(np.exp(high))
    if not abs(spans(focal) - wanted) <= 1e-9 * wanted:
        most = np.degrees(np.pi if lens is None else 2 * lens.limit_angle)
        raise InputError(
            f"fov_deg = {fov_deg:g}: this lens cannot span that angle across the {across}; must be below {most:.4g} "
            "deg, where it ends or folds over"
        )
    return focal


def _ends(width: int, height: int, centre: tuple[float, float], across: FovExtent) -> Array:
    """Return the two ends of an extent, shape (2, 2), px from the principal point."""
    cx, cy = centre
    ends = {
        "width": [[-cx, 0.0], [width - cx, 0.0]],
        "height": [[0.0, -cy], [0.0, height - cy]],
        "diagonal": [[-cx, -cy], [width - cx, height - cy]],
    }
    return np.array(ends[across])


def _angles(rays: Array) -> Array:
    """Return the sum of the angles between two rays, shape (2, 3), and the optical axis, rad."""
    return np.asarray(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]).sum())
