"""A camera as it stands in the files that simtest writes, and in figures.

Without the models that read it, which are slower to load.
"""

from dataclasses import asdict
from typing import Any, NotRequired, TypedDict, cast

import numpy as np

from simtest.geometry.camera import FOV_EXTENTS, Camera, field_of_view
from simtest.spec.toml_files import toml_tables, toml_value


class CameraDescription(TypedDict):
    """A camera in the JSON files that simtest writes."""

    width: int
    height: int
    K: list[list[float]]
    pixel_centres: str
    distortion: NotRequired[dict[str, str | float]]
    view_mask: NotRequired[dict[str, float]]


def camera_table(camera: Camera) -> dict[str, Any]:
    """Return a camera as the nested table that `CameraSpec` reads; lens and view mask only if there are any."""
    table = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "skew")}
    if camera.distortion is not None:
        table["distortion"] = {"type": camera.distortion.type, **asdict(camera.distortion)}
    if camera.view_mask is not None:
        table["view_mask"] = {name: value for name, value in asdict(camera.view_mask).items() if value is not None}
    return table


def describe_camera(camera: Camera) -> CameraDescription:
    """Return a camera as simtest's JSON files describe it: size, K, and lens and view mask if there are any."""
    table = camera_table(camera)
    described = {
        "width": camera.width, "height": camera.height, "K": camera.K.tolist(), "pixel_centres": "integer + 0.5",
    }  # fmt: skip
    parts = {name: table[name] for name in ("distortion", "view_mask") if name in table}
    return cast(CameraDescription, described | parts)


def camera_toml(camera: Camera) -> str:
    """Return a camera as the text of simtest's own TOML file."""
    table = camera_table(camera)
    inner = {key: value for key, value in table.items() if isinstance(value, dict)}
    lens = camera.distortion
    kind = f"{lens.type.title().replace('_', '-')} camera" if lens is not None else "Pinhole camera"
    lines = [f"# {kind}; pixel centres at integer + 0.5."]
    lines += [f"{key} = {toml_value(value)}" for key, value in table.items() if key not in inner]
    return "\n".join([*lines, "", toml_tables(inner)] if inner else [*lines, ""])


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
        "lens": "pinhole" if camera.distortion is None else camera.distortion.type,
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
