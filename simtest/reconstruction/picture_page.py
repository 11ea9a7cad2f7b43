"""The page of a picture: its highlights one by one, to zoom and click; one file that needs nothing else."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages.html import environment, script_json
from simtest.pages.style import colours

MAX_PICTURE_BYTES = 1_200_000
ARROW_PX = 60


def write_picture_page(path: Path, document: dict[str, Any], picture: npt.NDArray[np.float32]) -> None:
    """Write the page.

    Parameters
    ----------
    path : Path
        The HTML file.
    document : dict
        As in normals.json.
    picture : ndarray of float32, shape (H, W) or (H, W, 3)
        In [0, 1], as encoded, RGB.
    """
    from markupsafe import Markup

    spots = document["specularities"]
    height, width = picture.shape[:2]
    template = environment().get_template("picture.html.j2")
    html = template.render(
        title=Path(document["image"]).name,
        width=width,
        height=height,
        count=len(spots),
        warnings=document["warnings"],
        reference=document.get("reference"),
        picture=_data_address(picture),
        data=Markup(script_json(_page_data(document))),
    )
    path.write_text(html, encoding="utf-8")


def _data_address(picture: npt.NDArray[np.float32]) -> str:
    """Give the picture as a JPEG's data address, of lower quality where it would be large."""
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    values = values if values.ndim == 2 else cv2.cvtColor(values, cv2.COLOR_RGB2BGR)
    data = b""
    for quality in (92, 80, 65, 45):
        data = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MAX_PICTURE_BYTES:
            break
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def _page_data(document: dict[str, Any]) -> dict[str, Any]:
    """Give what the page's script shows: outlines, ellipses, normals and numbers."""
    spots = document["specularities"]
    palette = colours(name for spot in spots for name in spot["estimates"])
    return {
        "spots": [_spot(spot, palette) for spot in spots],
        "others": [
            {"kind": other["kind"], "outline": other["outline"], "peak": other["peak_px"], "score": other["score"]}
            for other in document.get("other_highlights", ())
        ],
        "colours": palette,
        "view": (document.get("view") or {}).get("outline"),
    }


def _spot(spot: dict[str, Any], palette: dict[str, str]) -> dict[str, Any]:
    x, y, w, h = spot["box_px"]
    return {
        "id": spot["id"],
        "peak": spot["peak_px"] or [x + w / 2, y + h / 2],
        "size": max(w, h),
        "kind": spot.get("kind"),
        "score": spot.get("score"),
        "best": spot["best"],
        "track": spot.get("track"),
        "rows": [_row(name, result, palette, spot) for name, result in spot["estimates"].items()],
    }


def _row(name: str, result: dict[str, Any], palette: dict[str, str], spot: dict[str, Any]) -> dict[str, Any]:
    if result["status"] != "ok":
        return {"name": name, "colour": palette[name], "status": result["status"], "detail": result["detail"]}
    errors = ((spot.get("reference") or {}).get("errors") or {}).get(name)
    return {
        "name": name,
        "colour": palette[name],
        "status": "ok",
        "normals": _rounded(result["candidates"], 4),
        "margin": result["choice_margin"],
        "look": result["look_px"],
        "isophotes": [_rounded(isophote["points"], 1) for isophote in result["isophotes"]],
        "curves": [_rounded(curve, 1) for curve in result["curves"]],
        "deviation": _deviation(result["covariance"]),
        "flags": result["flags"],
        "error": None if errors is None else errors["error_deg"],
    }


def _rounded(points: Sequence[Sequence[float]], digits: int) -> list[list[float]]:
    return [[round(float(v), digits) for v in point] for point in points]


def _deviation(covariance: Sequence[Sequence[float]] | None) -> float | None:
    """Give the standard deviation of a normal, deg: the square root of the covariance's trace."""
    if covariance is None:
        return None
    return float(np.degrees(np.sqrt(max(covariance[0][0] + covariance[1][1], 0.0))))
