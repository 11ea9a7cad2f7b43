"""Scaramuzza's omnidirectional cameras: OCamCalib's calib_results.txt, and the parameters of C3VD.

In both files the centre of the first pixel is (0, 0), in simtest (0.5, 0.5): the centre gains half a pixel. They differ
in everything else. C3VD names x before y and has a0 > 0: the polynomial is along the viewing direction. OCamCalib names
row before column and has a0 < 0: its z axis points backwards.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.spec.camera_formats.common import Table, number, numbers, read_json
from simtest.spec.toml_files import read_text

C3VD_KEYS = ("width", "height", "cx", "cy", "a0", "a2", "a3", "a4", "c", "d", "e")
LONGEST = 1e6
"""Of a focal length, px."""

MOST_APART = 5.0
"""px by which OCamCalib's two polynomials may differ; the inverse one is a fit to the other."""


def scaramuzza_table(
    size: Sequence[float],
    centre: Sequence[float],
    mapping: Sequence[float],
    stretch: Sequence[float],
    where: str,
) -> Table:
    """Return the table of a `CameraSpec` of Scaramuzza's model with x before y and z along the viewing direction.

    Parameters
    ----------
    size : sequence of float
        Width and height, px.
    centre : sequence of float
        cx and cy, px, pixel centres at integer + 0.5.
    mapping : sequence of float
        a0, a2, a3, a4 for radii in px: px, 1/px, 1/px^2, 1/px^3.
    stretch : sequence of float
        c, d, e of the matrix ((c, d), (e, 1)).
    where : str
        The file, for messages.
    """
    a0, a2, a3, a4 = mapping
    if not a0 > 0:
        raise InputError(f"{where}: a0 = {a0:g}: must be > 0, since z points along the viewing direction")
    if not a0 <= LONGEST:
        raise InputError(f"{where}: a0 = {a0:g}: must be at most {LONGEST:g} px")
    lens = {"k2": a2 * a0, "k3": a3 * a0**2, "k4": a4 * a0**3, **dict(zip("cde", stretch, strict=True))}
    return {
        "width": int(size[0]), "height": int(size[1]), "fx": a0, "fy": a0, "cx": centre[0], "cy": centre[1],
        "distortion": {"type": "scaramuzza", **lens},
    }  # fmt: skip


# C3VD -------------------------------------------------------------------------------------------------------------


def read_c3vd(path: Path) -> dict[str, Table]:
    """Read the parameters of C3VD: JSON, or lines ``key = value`` as in its config.ini.

    The published Python loader takes c, d, e as ((c, d), (e, 1)), which is the model's definition; so does this.
    """
    where = str(path)
    text = read_text(path, "camera")
    data = read_json(path) if text.lstrip().startswith("{") else _lines(text, where)
    missing = next((key for key in C3VD_KEYS if key not in data), None)
    if missing is not None:
        raise InputError(f"{where}: {missing}: missing{suggestion(missing, data)}; must give {', '.join(C3VD_KEYS)}")
    told = {key: number(data[key], where, key, whole=key in ("width", "height")) for key in C3VD_KEYS}
    if number(data.get("a1", 0.0), where, "a1") != 0:
        raise InputError(f"{where}: a1 = {data['a1']}: must be 0, as in Scaramuzza's model")
    return {
        "": scaramuzza_table(
            (told["width"], told["height"]),
            (told["cx"] + PIXEL_CENTRE, told["cy"] + PIXEL_CENTRE),
            [told[key] for key in ("a0", "a2", "a3", "a4")],
            [told[key] for key in "cde"],
            where,
        )
    }


def _lines(text: str, where: str) -> Mapping[str, Any]:
    """Return what lines of ``key = value`` or ``key: value`` say; comments begin with ; or #."""
    data: dict[str, Any] = {}
    for count, line in enumerate(text.splitlines(), 1):
        content = re.split(r"[;#]", line, maxsplit=1)[0].strip()
        if not content or content.startswith("["):
            continue
        found = re.fullmatch(r"(\w+)\s*[=:]\s*(.*)", content)
        if not found:
            raise InputError(f"{where}: line {count}: {content!s:.60}: must be key = value")
        if found[1] in data:
            raise InputError(f"{where}: line {count}: {found[1]!s:.40} is given twice")
        data[found[1]] = found[2].strip()
    return data


# OCamCalib --------------------------------------------------------------------------------------------------------


def read_ocamcalib(path: Path) -> dict[str, Table]:
    """Read calib_results.txt: both polynomials, centre, affine parameters, size.

    The direct polynomial, from pixels to directions, is the model; the inverse one, a fit to it, is only compared.
    """
    where = str(path)
    rows = [line.split() for line in read_text(path, "camera").splitlines()]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    if len(rows) < 5:
        raise InputError(f"{where}: {len(rows)} lines of numbers; must be 5: two polynomials, centre, c d e, size")
    direct, back = _polynomial(rows[0], where, "direct polynomial"), _polynomial(rows[1], where, "inverse polynomial")
    row, column = numbers(rows[2], where, "centre (row, column)", 2)
    c, d, e = numbers(rows[3], where, "affine parameters c d e", 3)
    height, width = (number(word, where, "size (height, width)", whole=True) for word in _pair(rows[4], where))
    if any(direct[5:]) or len(direct) < 1 or (len(direct) > 1 and direct[1] != 0):
        raise InputError(f"{where}: direct polynomial: must have the terms a0, a2, a3, a4 alone")
    a0, _, a2, a3, a4 = (*direct, 0.0, 0.0, 0.0, 0.0)[:5]
    if not a0 < 0:
        raise InputError(f"{where}: direct polynomial: a0 = {a0:g}: must be < 0, since OCamCalib's z points backwards")
    if not c > 0:
        raise InputError(f"{where}: affine parameters: c = {c:g}: must be > 0")
    _check_inverse(direct, back, min(width, height) / 4, where)
    # From (row, column) to (x, y) the matrix ((c, d), (e, 1)) becomes ((1, e), (d, c)), c times ((1/c, e/c), (d/c, 1)).
    table = scaramuzza_table(
        (width, height),
        (column + PIXEL_CENTRE, row + PIXEL_CENTRE),
        (-a0, -a2, -a3, -a4),
        (1 / c, e / c, d / c),
        where,
    )
    return {"": table | {"fx": -a0 * c, "fy": -a0 * c}}


def _pair(row: list[str], where: str) -> list[str]:
    if len(row) != 2:
        raise InputError(f"{where}: size: {len(row)} values; must be 2, height and width")
    return row


def _polynomial(row: list[str], where: str, name: str) -> list[float]:
    """Return the coefficients of a line that begins with their number."""
    count = number(row[0], where, f"{name}: number of coefficients", whole=True)
    if count != len(row) - 1 or count < 1:
        raise InputError(f"{where}: {name}: says {count:g} coefficients and holds {len(row) - 1}; must be as many")
    return numbers(row[1:], where, name, len(row) - 1)


def _check_inverse(direct: list[float], back: list[float], most: float, where: str) -> None:
    """Raise `InputError` where the inverse polynomial does not lead back from radii up to `most`, px."""
    radius = np.linspace(0.1, 1.0, 10) * most
    # world2cam takes the angle from the image plane, which is negative in front of the camera.
    apart = np.abs(Polynomial(back)(np.arctan2(Polynomial(direct)(radius), radius)) - radius).max()
    if not apart <= MOST_APART:
        raise InputError(
            f"{where}: the two polynomials differ by {apart:.3g} px; must be each other's inverse within "
            f"{MOST_APART:g} px"
        )
