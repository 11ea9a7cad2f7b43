"""A camera as it stands in the files that simtest writes; without the models that read it, which are slower to load."""

from dataclasses import asdict
from typing import NotRequired, TypedDict

from simtest.geometry.camera import Camera
from simtest.geometry.lenses import lens_name
from simtest.spec.toml_files import toml_tables, toml_value


class CameraTable(TypedDict):
    """A camera as the nested table that `CameraSpec` reads."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float
    distortion: NotRequired[dict[str, str | float]]
    view_mask: NotRequired[dict[str, float]]


class CameraDescription(TypedDict):
    """A camera in the JSON files that simtest writes."""

    width: int
    height: int
    K: list[list[float]]
    pixel_centres: str
    distortion: NotRequired[dict[str, str | float]]
    view_mask: NotRequired[dict[str, float]]


def camera_table(camera: Camera) -> CameraTable:
    """Return a camera as the nested table that `CameraSpec` reads; lens and view mask only if there are any."""
    table: CameraTable = {
        "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx, "cy": camera.cy, "skew": camera.skew,
    }  # fmt: skip
    if camera.distortion is not None:
        table["distortion"] = {"type": lens_name(camera.distortion), **asdict(camera.distortion)}
    if camera.view_mask is not None:
        table["view_mask"] = {name: value for name, value in asdict(camera.view_mask).items() if value is not None}
    return table


def describe_camera(camera: Camera) -> CameraDescription:
    """Return a camera as simtest's JSON files describe it: size, K, and lens and view mask if there are any."""
    table = camera_table(camera)
    described: CameraDescription = {
        "width": camera.width, "height": camera.height, "K": camera.K.tolist(), "pixel_centres": "integer + 0.5",
    }  # fmt: skip
    if "distortion" in table:
        described["distortion"] = table["distortion"]
    if "view_mask" in table:
        described["view_mask"] = table["view_mask"]
    return described


def camera_toml(camera: Camera) -> str:
    """Return a camera as the text of simtest's own TOML file."""
    table = camera_table(camera)
    inner = {key: value for key, value in table.items() if isinstance(value, dict)}
    lens = {
        "brown_conrady": "Brown-Conrady",
        "kannala_brandt": "Kannala-Brandt",
        "scaramuzza": "Scaramuzza",
    }
    kind = f"{lens[inner['distortion']['type']]} camera" if "distortion" in inner else "Pinhole camera"
    lines = [f"# {kind}; pixel centres at integer + 0.5."]
    lines += [f"{key} = {toml_value(value)}" for key, value in table.items() if key not in inner]
    return "\n".join([*lines, "", toml_tables(inner)] if inner else [*lines, ""])
