"""A camera in figures: its fields of view, and what its lens does at the corners of the picture."""

from typing import Any

import numpy as np

from simtest.geometry.camera import FOV_EXTENTS, Camera, field_of_view
from simtest.geometry.lenses import lens_name
from simtest.spec.camera_tables import describe_camera

PLACES = {
    "left": (0.0, 0.5), "right": (1.0, 0.5), "top": (0.5, 0.0), "bottom": (0.5, 1.0),
    "upper left": (0.0, 0.0), "upper right": (1.0, 0.0), "lower left": (0.0, 1.0), "lower right": (1.0, 1.0),
}  # fmt: skip
"""Points of the picture's border, as shares of its width and height."""


def camera_summary(camera: Camera) -> dict[str, Any]:
    """Return a camera's description, its lens, its fields of view, deg, and its `border`.

    The border lists middles of sides and corners: the pixel, the angle between its sightline and the optical axis, deg,
    and by how many px the lens moves it from where a pinhole of the same K would image that sightline. Both are None
    where the lens has no sightline, the latter also from 90 deg on, and both outside the view mask.
    """
    return {
        **describe_camera(camera),
        "lens": "pinhole" if camera.distortion is None else lens_name(camera.distortion),
        "fov_deg": {across: _finite(field_of_view(camera, across)) for across in FOV_EXTENTS},
        "border": [_at(camera, name, x * camera.width, y * camera.height) for name, (x, y) in PLACES.items()],
    }


def _at(camera: Camera, name: str, x: float, y: float) -> dict[str, Any]:
    """Describe what the lens does at a pixel."""
    pixel = np.array([x, y])
    seen = bool(camera.contains(pixel))
    ray = camera.unproject(pixel)
    angle = float(np.degrees(np.arctan2(np.hypot(ray[0], ray[1]), ray[2])))
    straight = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.skew)
    moved = float(np.linalg.norm(straight.project(ray) - pixel))
    return {
        "at": name, "pixel": [x, y], "in_view": seen, "angle_deg": _finite(angle) if seen else None,
        "moved_px": _finite(moved) if seen else None,
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
