"""Files of endoscopes' calibrations: OCamCalib, C3VD, Vicalib, EndoMapper's photometric XML.

In all the centre of the first pixel is (0, 0), in simtest (0.5, 0.5): the centre gains half a pixel (Calibu's detector,
in Vicalib, fits circles at whole pixel numbers). OCamCalib and C3VD hold Scaramuzza's model and differ in everything
else. C3VD names x before y and has a0 > 0: the polynomial is along the viewing direction. OCamCalib names row before
column and has a0 < 0: its z axis points backwards. Vicalib's XML (Calibu) holds EndoMapper's geometrical calibrations.

In EndoMapper's photometric calibration (EM_Dataset-PhotometricCalibration) a pixel holds
(gain V sigma e^(-mu (1 - cos a)) / d^2 times the surface's reflectance)^(1 / gamma) (Batlle, Montiel and Tardos 2022):
a is the angle at the light between its principal direction D and the surface, d its distance, and V = cos^k of the
angle from the optical axis. Gain and sigma scale all pixels alike and are not read. Positions are metres in the camera
frame.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.polynomial import Polynomial

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.spec.camera_formats.common import (
    Table,
    json_object,
    number,
    numbers,
    of_text,
    parse_xml,
    plain_table,
    syntax,
    within,
)

C3VD_KEYS = ("width", "height", "cx", "cy", "a0", "a2", "a3", "a4", "c", "d", "e")

LONGEST = 1e6
"""Of a focal length, px."""

MOST_APART = 5.0
"""px by which OCamCalib's two polynomials may differ; the inverse one is a fit to the other."""

VICALIB_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "calibu_fu_fv_u0_v0": ("", ()),
    "calibu_fu_fv_u0_v0_k1_k2": ("brown_conrady", ("k1", "k2")),
    "calibu_fu_fv_u0_v0_k1_k2_k3": ("brown_conrady", ("k1", "k2", "k3")),
    "calibu_fu_fv_u0_v0_rational6": ("brown_conrady", ("k1", "k2", "k3", "k4", "k5", "k6")),
    "calibu_fu_fv_u0_v0_kb4": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
    "ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g": ("scaramuzza", ()),
}
"""The lens of each camera type, and its parameters after the focal lengths and the principal point."""

AXES = {"right": (1.0, 0.0, 0.0), "down": (0.0, 1.0, 0.0), "forward": (0.0, 0.0, 1.0)}

Tables = dict[str, dict[str, Any]]

MM = 1000.0

STEP_DEG = 0.5
"""Of the table of the light's spread: with mu = 10, linear interpolation is off by 1e-4."""

FARTHEST_MM = 1000.0

MOST_SPREAD = 1000.0


def scaramuzza_table(
    size: Sequence[float], centre: Sequence[float], mapping: Sequence[float], stretch: Sequence[float]
) -> Table:
    """Return the table of a `CameraSpec` of Scaramuzza's model with x before y and z along the viewing direction.

    `mapping` is a0, a2, a3, a4 for radii in px, `stretch` c, d, e of the matrix ((c, d), (e, 1)); the centre has pixel
    centres at integer + 0.5.
    """
    a0, a2, a3, a4 = mapping
    if not a0 > 0:
        raise InputError(f"a0 = {a0:g}: must be > 0, since z points along the viewing direction")
    if not a0 <= LONGEST:
        raise InputError(f"a0 = {a0:g}: must be at most {LONGEST:g} px")
    lens = {"k2": a2 * a0, "k3": a3 * a0**2, "k4": a4 * a0**3, **dict(zip("cde", stretch, strict=True))}
    return plain_table([int(side) for side in size], (a0, a0), centre, distortion={"type": "scaramuzza", **lens})


@of_text()
def read_c3vd(text: str) -> dict[str, Table]:
    """Read the parameters of C3VD: JSON, or lines ``key = value`` as in its config.ini.

    The published Python loader takes c, d, e as ((c, d), (e, 1)), which is the model's definition; so does this. Raises
    `InputError` if the file is malformed, or a parameter is missing.
    """
    data = json_object(text) if text.lstrip().startswith("{") else _lines(text)
    missing = next((key for key in C3VD_KEYS if key not in data), None)
    if missing is not None:
        raise InputError(f"{missing}: missing{suggestion(missing, data)}; must give {', '.join(C3VD_KEYS)}")
    told = {key: number(data[key], key, whole=key in ("width", "height")) for key in C3VD_KEYS}
    if number(data.get("a1", 0.0), "a1") != 0:
        raise InputError(f"a1 = {data['a1']}: must be 0, as in Scaramuzza's model")
    width, height, cx, cy, *lens = told.values()
    return {"": scaramuzza_table((width, height), (cx + PIXEL_CENTRE, cy + PIXEL_CENTRE), lens[:4], lens[4:])}


def _lines(text: str) -> Mapping[str, Any]:
    """Return what lines of ``key = value`` or ``key: value`` say; comments begin with ; or #."""
    data: dict[str, Any] = {}
    for count, line in enumerate(text.splitlines(), 1):
        content = re.split(r"[;#]", line, maxsplit=1)[0].strip()
        if not content or content.startswith("["):
            continue
        found = re.fullmatch(r"(\w+)\s*[=:]\s*(.*)", content)
        if not found:
            raise InputError(f"line {count}: {content}: must be key = value")
        if found[1] in data:
            raise InputError(f"line {count}: {found[1]} is given twice")
        data[found[1]] = found[2].strip()
    return data


@of_text()
def read_ocamcalib(text: str) -> dict[str, Table]:
    """Read calib_results.txt: both polynomials, centre, affine parameters, size.

    The direct polynomial, from pixels to directions, is the model; the inverse one, a fit to it, is only compared.
    """
    rows = [line.split() for line in text.splitlines()]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    if len(rows) < 5:
        raise InputError(f"{len(rows)} lines of numbers; must be 5: two polynomials, centre, c d e, size")
    direct, back = _polynomial(rows[0], "direct polynomial"), _polynomial(rows[1], "inverse polynomial")
    row, column = numbers(rows[2], "centre (row, column)", 2)
    c, d, e = numbers(rows[3], "affine parameters c d e", 3)
    if len(rows[4]) != 2:
        raise InputError(f"size: {len(rows[4])} values; must be 2, height and width")
    height, width = (number(word, "size (height, width)", whole=True) for word in rows[4])
    if any(direct[5:]) or (len(direct) > 1 and direct[1] != 0):
        raise InputError("direct polynomial: must have the terms a0, a2, a3, a4 alone")
    a0, _, a2, a3, a4 = (*direct, 0.0, 0.0, 0.0, 0.0)[:5]
    if not a0 < 0:
        raise InputError(f"direct polynomial: a0 = {a0:g}: must be < 0, since OCamCalib's z points backwards")
    if not c > 0:
        raise InputError(f"affine parameters: c = {c:g}: must be > 0")
    _check_inverse(direct, back, min(width, height) / 4)
    # From (row, column) to (x, y) the matrix ((c, d), (e, 1)) becomes ((1, e), (d, c)), c times ((1/c, e/c), (d/c, 1)).
    centre, mapping = (column + PIXEL_CENTRE, row + PIXEL_CENTRE), (-a0, -a2, -a3, -a4)
    table = scaramuzza_table((width, height), centre, mapping, (1 / c, e / c, d / c))
    return {"": table | {"fx": -a0 * c, "fy": -a0 * c}}


def _polynomial(row: list[str], name: str) -> list[float]:
    """Return the coefficients of a line that begins with their number."""
    count = number(row[0], f"{name}: number of coefficients", whole=True)
    if count != len(row) - 1 or count < 1:
        raise InputError(f"{name}: says {count:g} coefficients and holds {len(row) - 1}; must be as many")
    return numbers(row[1:], name, len(row) - 1)


def _check_inverse(direct: list[float], back: list[float], most: float) -> None:
    """Raise `InputError` where the inverse polynomial does not lead back from radii up to `most`, px."""
    radius = np.linspace(0.1, 1.0, 10) * most
    # world2cam takes the angle from the image plane, which is negative in front of the camera.
    apart = np.abs(Polynomial(back)(np.arctan2(Polynomial(direct)(radius), radius)) - radius).max()
    if not apart <= MOST_APART:
        raise InputError(
            f"the two polynomials differ by {apart:.3g} px; must be each other's inverse within {MOST_APART:g} px"
        )


@of_text()
def read_vicalib(text: str) -> dict[str, Table]:
    """Read the cameras of a rig, by their index; raise `InputError` where the file is malformed."""
    cameras: dict[str, Table] = {}
    with syntax("XML"):
        root = parse_xml(text)
    for i, element in enumerate(root.iter("camera_model")):
        name = element.get("index") or str(i)
        if name in cameras:
            raise InputError(f"camera index {name} is given twice")
        with within(f"camera {name}"):
            cameras[name] = _vicalib_camera(element)
    return cameras


def _vicalib_camera(element: ElementTree.Element) -> Table:
    kind = element.get("type") or ""
    if kind not in VICALIB_MODELS:
        raise InputError(
            f"type = {kind!r:.60}: simtest lacks it; must be one of {', '.join(VICALIB_MODELS)}"
            f"{suggestion(kind, VICALIB_MODELS)}"
        )
    for axis, wanted in AXES.items():
        found = element.find(axis)
        if found is not None and values(found, axis, 3) != list(wanted):
            raise InputError(f"{axis} = {' '.join((found.text or '').split())}: must be {list(wanted)}")
    width, height = (int(number(text_of(element, key), key, whole=True)) for key in ("width", "height"))
    params = element.find("params")
    if params is None:
        raise InputError("params: missing; must be a list of numbers")
    lens, names = VICALIB_MODELS[kind]
    if lens == "scaramuzza":
        cx, cy, *mapping, e, f, g = values(params, "params", 9)
        return scaramuzza_table((width, height), (cx + PIXEL_CENTRE, cy + PIXEL_CENTRE), mapping, (e, f, g))
    fx, fy, cx, cy, *told = values(params, "params", 4 + len(names))
    distortion = {"type": lens, **dict(zip(names, told, strict=True))} if lens else None
    return plain_table((width, height), (fx, fy), (cx, cy), PIXEL_CENTRE, distortion=distortion)


def text_of(element: ElementTree.Element, key: str) -> str:
    """Return the text of a child; raise `InputError` where there is none."""
    found = element.find(key)
    if found is None or not (found.text or "").strip():
        raise InputError(f"{key}: missing")
    return (found.text or "").strip()


def values(element: ElementTree.Element, name: str, count: int) -> list[float]:
    """Return the numbers of a text such as ``[ 1; 2; 3 ]``."""
    words = re.split(r"[;,\s]+", (element.text or "").strip().strip("[]").strip())
    return numbers([word for word in words if word], name, count)


@of_text()
def read_photometric(text: str) -> Tables:
    """Read a photometric calibration as tables of a calibration file: response, vignetting, emission, rig.

    Several lights must spread their light alike.
    """
    with syntax("XML"):
        root = parse_xml(text)
    tables: Tables = {}
    cameras = root.findall("camera")
    if len(cameras) > 1:
        raise InputError(f"holds {len(cameras)} cameras; must be one")
    model = cameras[0].find("camera_model") if cameras else None
    if model is not None:
        with within("camera"):
            tables |= _lens_and_response(model)
    lights = []
    for i, element in enumerate(root.findall("light/light_model")):
        with within(f"light {i}"):
            lights.append(_light(element))
    if lights:
        tables |= _rig(lights)
    if not tables:
        raise InputError("holds neither a camera_model nor a light_model; must hold one of them")
    return tables


def _lens_and_response(model: ElementTree.Element) -> Tables:
    _check_type(model, "gamma")
    gamma = _number(model, "gamma", 0.1, 10)
    power = _number(model, "vignetting", 0, 1000) if model.find("vignetting") is not None else 0.0
    return {"response": {"type": "gamma", "gamma": gamma}, "vignetting": {"type": "cosine", "power": power}}


def _light(model: ElementTree.Element) -> dict[str, Any]:
    """Return the spread, position, mm, and direction of a light."""
    _check_type(model, "sls")
    mu = _number(model, "mu", 0, MOST_SPREAD)
    _number(model, "sigma")
    told = {}
    for key in ("P", "D"):
        element = model.find(key)
        if element is None:
            raise InputError(f"{key}: missing; must be [ x; y; z ]")
        told[key] = np.array(values(element, key, 3))
    position, length = told["P"] * MM, float(np.linalg.norm(told["D"]))
    if not np.abs(position).max() <= FARTHEST_MM:
        raise InputError(f"P = {told['P'].tolist()}: must be metres, within 1 m of the camera")
    if not abs(length - 1) <= 0.01:
        raise InputError(f"D has length {length:.3g}; must be a unit vector")
    return {"mu": mu, "position": position.round(9).tolist(), "direction": (told["D"] / length).tolist()}


def _rig(lights: list[dict[str, Any]]) -> Tables:
    """Return where the lights are and how they emit."""
    first = lights[0]
    for light in lights[1:]:
        if light["mu"] != first["mu"] or not np.allclose(light["direction"], first["direction"], atol=1e-3):
            raise InputError("lights of different mu or D; must spread their light alike")
    angles = np.arange(0.0, 180 + STEP_DEG, STEP_DEG)
    emission = {
        "type": "table", "angle_deg": angles.tolist(),
        "value": [math.exp(-first["mu"] * (1 - math.cos(math.radians(angle)))) for angle in angles],
        "direction": first["direction"],
    }  # fmt: skip
    return {"emission": emission, "rig": {"lights_mm": [light["position"] for light in lights]}}


def _check_type(model: ElementTree.Element, known: str) -> None:
    if (kind := model.get("type")) != known:
        raise InputError(f"type = {kind!r:.40}: simtest lacks it; must be '{known}'")


def _number(model: ElementTree.Element, key: str, least: float = -math.inf, most: float = math.inf) -> float:
    """Return a number, in brackets or not."""
    value = number(text_of(model, key).strip("[] "), key)
    if not least <= value <= most:
        raise InputError(f"{key} = {value:g}: must be {least:g} to {most:g}")
    return value
