"""Reconstruction from a picture file: reading it, and writing the normals in formats that others read."""

import csv
import json
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest import provenance
from simtest.calibration import Calibration, Response
from simtest.errors import Failure, InputError
from simtest.estimators.base import EstimatedCurvature, drawable
from simtest.files import make_folder, write_atomically, write_json
from simtest.geometry import Camera, KannalaBrandt
from simtest.reconstruction import DEFAULT_ESTIMATORS, Specularity, reconstruct
from simtest.spec import describe_camera, load_calibration

MAX_PIXELS = 100_000_000


def read_picture(path: Path) -> npt.NDArray[np.float32]:
    """Read a picture of 8 or 16 bits as intensities in [0, 1].

    The values are as they are encoded.

    Parameters
    ----------
    path : Path
        PNG, JPEG, BMP or TIFF; grey, RGB or RGBA (alpha is ignored).

    Returns
    -------
    ndarray of float32, shape (H, W) or (H, W, 3)

    Raises
    ------
    InputError
        If the file is missing, no picture, or too large.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; must be a picture (PNG, JPEG, BMP, TIFF)")
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error as error:
        raise InputError(f"{path}: cannot be decoded ({str(error).splitlines()[0][:120]})") from error
    if picture is None:
        raise InputError(f"{path}: no picture ({data.size} bytes); must be PNG, JPEG, BMP or TIFF")
    if picture.shape[0] * picture.shape[1] > MAX_PIXELS:
        raise InputError(f"{path}: {picture.shape[1]} x {picture.shape[0]} px; at most {MAX_PIXELS} px are allowed")
    if picture.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: pixels are {picture.dtype}; must be 8 or 16 bits")
    scaled = picture.astype(np.float32) / np.float32(np.iinfo(picture.dtype).max)
    return scaled if scaled.ndim == 2 else np.ascontiguousarray(scaled[:, :, 2::-1])


def reconstruct_picture(
    image: Path,
    out: Path,
    camera_file: Path | None = None,
    fov_deg: float | None = None,
    estimators: Sequence[str] | None = None,
    roi: str | None = None,
    encoding: str | None = None,
    every: bool = False,
) -> tuple[int, list[Path]]:
    """Reconstruct the normals of a picture and write them.

    Parameters
    ----------
    image : Path
        The picture.
    out : Path
        Folder, made if need be.
    camera_file : Path, optional
        Calibration or camera file; this or `fov_deg` must be given, not both.
    fov_deg : float, optional
        Horizontal field of view, deg.
    estimators : sequence of str, optional
        Names; default all three of the package.
    roi : str, optional
        "x,y,w,h" in px; default: detected.
    encoding : {"srgb", "linear"}, optional
        How the picture's values are encoded, where the calibration does not state the response; default sRGB.
        Isophotes are those of linear values.
    every : bool
        Take peaks too that the border cuts or whose shape is not that of one point highlight.

    Returns
    -------
    count : int
        Specularities found.
    files : list of Path
        normals.json, normals.csv, normals.ply, overlay.png.

    Raises
    ------
    InputError
        If the input is malformed or the folder cannot be written.
    """
    if (camera_file is None) == (fov_deg is None):
        raise InputError("--camera or --fov: exactly one of them must be given")
    picture = read_picture(image)
    height, width = picture.shape[:2]
    cautions = []
    if camera_file is not None:
        calibration = load_calibration(camera_file)
    else:
        assert fov_deg is not None
        calibration = Calibration(Camera.from_fov(fov_deg, width, height))
        cautions.append(f"no calibration: all angles depend on the field of view of {fov_deg:g} deg being right")
        warnings.warn(cautions[-1], stacklevel=2)
    calibration, camera = _completed(calibration, encoding), calibration.camera
    names = list(estimators or DEFAULT_ESTIMATORS)
    found = reconstruct(
        picture, calibration, names, roi=_parse_roi(roi) if roi is not None else None, isolated=not every
    )
    if not found:
        cautions.append(
            "no specularity found that stands out of the noise and has the shape of a highlight; try --all or --roi"
        )
        warnings.warn(cautions[-1], stacklevel=2)
    document = {
        "image": str(image),
        "camera": describe_camera(camera),
        "encoding": calibration.response.kind if calibration.response else "linear",
        "warnings": cautions,
        "frame": "camera: x right, y down, z forward; normals are unit and face the camera",
        "specularities": [describe(i, specularity, camera) for i, specularity in enumerate(found)],
        "provenance": provenance.environment(),
    }
    return len(found), _write(out, document, picture, camera)


def _completed(calibration: Calibration, encoding: str | None) -> Calibration:
    """Add what every picture has: an encoding, and a largest value, at which it is clipped."""
    if calibration.response is not None and encoding is not None:
        raise InputError(f"--encoding {encoding}: the calibration states the response; give one of them")
    response = calibration.response or (Response() if encoding == "linear" else Response("srgb"))
    level = 1.0 if calibration.saturation_level is None else calibration.saturation_level
    return replace(calibration, response=response, saturation_level=level)


def _parse_roi(text: str) -> tuple[int, int, int, int]:
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--roi {text}: must be x,y,w,h, four integers in px") from None
    return x, y, width, height


def describe(index: int, specularity: Specularity, camera: Camera) -> dict[str, Any]:
    """Describe a specularity for normals.json: its region, and each estimator's result or reason of failure."""
    results: dict[str, Any] = {}
    for name, result in specularity.estimates.items():
        if isinstance(result, Failure):
            results[name] = {"status": str(result.reason), "detail": result.detail}
            continue
        results[name] = {
            "status": "ok",
            "normal": result.normal.tolist(),
            "candidates": result.candidates.tolist(),
            "look_px": [float(v) if np.isfinite(v) else None for v in result.look_px],
            "axis_ratio": result.axis_ratio,
            "isovalues": [isophote.isovalue for isophote in result.isophotes],
            "covariance": None if result.covariance is None else result.covariance.tolist(),
            "curvature": None if result.curvature is None else _curvature_entry(result.curvature),
            "flags": list(result.flags),
            "isophotes": [
                {"t": t, "points": np.round(points, 3).tolist()} for t, points in result.contours(specularity.patch)
            ],
            "ellipses": [i.conic.image.tolist() for i in result.isophotes if i.conic is not None],
            "cones": [isophote.cone.tolist() for isophote in result.isophotes],
            "curves": [drawable(isophote.ellipse_px(camera)) for isophote in result.isophotes],
        }
    peak = None if isinstance(specularity.patch, Failure) else specularity.patch.peak_px.tolist()
    return {"id": index, "box_px": list(specularity.region.box), "peak_px": peak, "estimates": results}


def _curvature_entry(curvature: EstimatedCurvature) -> dict[str, Any]:
    return {
        "directions": curvature.directions.tolist(),
        "axis_ratio": curvature.axis_ratio,
        "gains": None if curvature.hypotheses is None else curvature.hypotheses.tolist(),
    }


def _write(out: Path, document: dict[str, Any], picture: npt.NDArray[np.float32], camera: Camera) -> list[Path]:
    # Imported here: matplotlib is slow to load and reading alone does not need it.
    from simtest.report.overlay import draw_overlay

    files = [out / name for name in ("normals.json", "normals.csv", "normals.ply", "overlay.png")]
    make_folder(out)
    try:
        write_json(files[0], document)
        write_atomically(files[1], lambda part: _write_csv(part, document))
        write_atomically(files[2], lambda part: part.write_text(_ply(document, camera), encoding="ascii"))
        write_atomically(files[3], lambda part: draw_overlay(part, picture, camera, document["specularities"]))
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from error
    return files


def _rows(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {"specularity": spot["id"], "estimator": name, **result}
        for spot in document["specularities"]
        for name, result in spot["estimates"].items()
    ]


def _write_csv(path: Path, document: dict[str, Any]) -> None:
    columns = ["specularity", "estimator", "status", "candidate", "normal_x", "normal_y", "normal_z", "look_x_px",
               "look_y_px", "axis_ratio", "flags"]  # fmt: skip
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore")
        writer.writeheader()
        for row in _rows(document):
            for k, normal in enumerate(row.get("candidates", [None])):
                xyz = dict(zip(("normal_x", "normal_y", "normal_z"), normal or (), strict=False))
                look = dict(zip(("look_x_px", "look_y_px"), row.get("look_px", ()), strict=False))
                flags = ";".join(row.get("flags", ()))
                writer.writerow({**row, **xyz, **look, "flags": flags, "candidate": k if normal else ""})


def _ply(document: dict[str, Any], camera: Camera) -> str:
    """Give the proposed normals as oriented points on the sightlines they look along (PLY, ASCII).

    The points are at unit depth; through a fisheye, which sees sideways and backwards too, at unit distance.
    """
    fisheye = isinstance(camera.distortion, KannalaBrandt)
    lines, names = [], sorted({row["estimator"] for row in _rows(document)})
    for row in _rows(document):
        if row["status"] == "ok" and None not in row["look_px"]:
            ray = camera.unproject(row["look_px"])
            values = [*(ray if fisheye else ray / ray[2]).tolist(), *row["normal"]]
            lines.append(
                " ".join(f"{v:.9g}" for v in values) + f" {row['specularity']} {names.index(row['estimator'])}"
            )
    header = [
        "ply", "format ascii 1.0", f"comment estimators by number: {json.dumps(names)}", f"element vertex {len(lines)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        "property int specularity", "property int estimator", "end_header",
    ]  # fmt: skip
    return "\n".join([*header, *lines]) + "\n"
