"""Vicalib's XML (Calibu), in which EndoMapper holds its geometrical calibrations.

The centre of the first pixel is (0, 0), in simtest (0.5, 0.5): Calibu's detector fits circles at whole pixel numbers.
So the principal point gains half a pixel.
"""

import re
from pathlib import Path
from xml.etree import ElementTree

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.spec.camera_formats.common import Table, number, numbers, read_xml
from simtest.spec.camera_formats.omnidirectional import scaramuzza_table

FOCAL = ("fx", "fy", "cx", "cy")
MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "calibu_fu_fv_u0_v0": ("", ()),
    "calibu_fu_fv_u0_v0_k1_k2": ("brown_conrady", ("k1", "k2")),
    "calibu_fu_fv_u0_v0_k1_k2_k3": ("brown_conrady", ("k1", "k2", "k3")),
    "calibu_fu_fv_u0_v0_rational6": ("brown_conrady", ("k1", "k2", "k3", "k4", "k5", "k6")),
    "calibu_fu_fv_u0_v0_kb4": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
    "ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g": ("scaramuzza", ()),
}
"""The lens of each camera type, and its parameters after the focal lengths and the principal point."""

AXES = {"right": (1.0, 0.0, 0.0), "down": (0.0, 1.0, 0.0), "forward": (0.0, 0.0, 1.0)}


def read_cameras(path: Path) -> dict[str, Table]:
    """Read the cameras of a rig, by their index; raise `InputError` where the file is malformed."""
    where, root = str(path), read_xml(path)
    cameras: dict[str, Table] = {}
    for i, element in enumerate(root.iter("camera_model")):
        name = element.get("index") or str(i)
        if name in cameras:
            raise InputError(f"{where}: camera index {name} is given twice")
        cameras[name] = _camera(element, f"{where}: camera {name}")
    return cameras


def _camera(element: ElementTree.Element, at: str) -> Table:
    kind = element.get("type") or ""
    if kind not in MODELS:
        raise InputError(
            f"{at}: type = {kind!r:.60}: simtest lacks it; must be one of {', '.join(MODELS)}{suggestion(kind, MODELS)}"
        )
    for axis, wanted in AXES.items():
        found = element.find(axis)
        if found is not None and values(found, at, axis, 3) != list(wanted):
            raise InputError(f"{at}: {axis} = {' '.join((found.text or '').split())!s:.40}: must be {list(wanted)}")
    width, height = (int(number(text_of(element, key, at), at, key, whole=True)) for key in ("width", "height"))
    params = element.find("params")
    if params is None:
        raise InputError(f"{at}: params: missing; must be a list of numbers")
    lens, names = MODELS[kind]
    if lens == "scaramuzza":
        cx, cy, *mapping, e, f, g = values(params, at, "params", 9)
        return scaramuzza_table((width, height), (cx + PIXEL_CENTRE, cy + PIXEL_CENTRE), mapping, (e, f, g), at)
    told = dict(zip((*FOCAL, *names), values(params, at, "params", 4 + len(names)), strict=True))
    table: Table = {"width": width, "height": height, "fx": told["fx"], "fy": told["fy"]}
    table |= {key: told[key] + PIXEL_CENTRE for key in ("cx", "cy")}
    if lens:
        table["distortion"] = {"type": lens, **{key: told[key] for key in names}}
    return table


def text_of(element: ElementTree.Element, key: str, at: str) -> str:
    """Return the text of a child; raise `InputError` where there is none."""
    found = element.find(key)
    if found is None or not (found.text or "").strip():
        raise InputError(f"{at}: {key}: missing")
    return (found.text or "").strip()


def values(element: ElementTree.Element, at: str, name: str, count: int) -> list[float]:
    """Return the numbers of a text such as ``[ 1; 2; 3 ]``."""
    words = re.split(r"[;,\s]+", (element.text or "").strip().strip("[]").strip())
    return numbers([word for word in words if word], at, name, count)
