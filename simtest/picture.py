"""Reconstruction from a picture file: reading it, and writing the normals in formats that others read."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest import provenance
from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.files import make_folder, write_atomically, write_json
from simtest.geometry import Camera
from simtest.imaging.constraints import write_constraints
from simtest.imaging.depth import depths_at
from simtest.imaging.description import arrows_ply, ply, rows, write_csv
from simtest.imaging.reading import read_picture
from simtest.imaging.reference import Reference, comparison, load_reference
from simtest.imaging.single import Options, check_camera_given, completed, read_camera, reconstruct_values
from simtest.report.overlay import draw_overlay
from simtest.report.picture_page import write_picture_page
from simtest.spec import describe_camera

__all__ = ["Extras", "read_picture", "reconstruct_picture"]

FRAME = "camera: x right, y down, z forward; normals are unit and face the camera"
NOTHING = "no specularity found that stands out of the noise and has the shape of a highlight; try --all or --roi"


MANY = 10
"""Above so many specularities normals.json is written on one line: most of it are outlines."""


@dataclass(frozen=True)
class Extras:
    """What else a picture is reconstructed with.

    Parameters
    ----------
    reference : Path, optional
        Mesh in mm, or a depth map, to compare with.
    pose : Path, optional
        camera_from_model of the mesh.
    depth : str, optional
        Depth of the arrows: a number in mm, or a depth map.
    depth_scale_mm : float, optional
        mm of one step of an integer depth map.
    """

    reference: Path | None = None
    pose: Path | None = None
    depth: str | None = None
    depth_scale_mm: float | None = None


def reconstruct_picture(
    image: Path,
    out: Path,
    camera_file: Path | None = None,
    fov_deg: float | None = None,
    estimators: Sequence[str] | None = None,
    roi: str | None = None,
    encoding: str | None = None,
    every: bool = False,
    detector: str = "auto",
    smoothing_px: float | None = None,
    extras: Extras | None = None,
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
        Names; default those of the package that need no more than the calibration states.
    roi : str, optional
        "x,y,w,h" in px; default: detected.
    encoding : {"srgb", "linear"}, optional
        How the picture's values are encoded, where the calibration does not state the response; default sRGB.
        Isophotes are those of linear values.
    every : bool
        Take peaks too that the border cuts or whose shape is not that of one point highlight.
    detector : {"auto", "colour", "peaks"}
        How highlights are found (`Options`).
    smoothing_px : float, optional
        Standard deviation of the Gaussian smoothing, px.
    extras : Extras, optional
        Reference surface and depths.

    Returns
    -------
    count : int
        Specularities found.
    files : list of Path
        normals.json, normals.csv, normals.ply, overlay.png, and the others.

    Raises
    ------
    InputError
        If the input is malformed or the folder cannot be written.
    """
    box = parse_roi(roi) if roi is not None else None
    options = Options(None if estimators is None else tuple(estimators), box, encoding, every, detector, smoothing_px)
    check_camera_given(camera_file, fov_deg)
    picture = read_picture(image)
    height, width = picture.shape[:2]
    calibration, cautions = read_camera(camera_file, fov_deg, (width, height))
    for caution in cautions:
        warnings.warn(caution, stacklevel=2)
    calibration = completed(calibration, encoding)
    reference = _reference(extras, calibration.camera)
    document = picture_document(image, picture, calibration, options, cautions)
    spots = document["specularities"]
    if not spots:
        document["warnings"].append(NOTHING)
        warnings.warn(NOTHING, stacklevel=2)
    depth = None
    if extras is not None and extras.depth is not None:
        looks = [spot["peak_px"] for spot in spots]
        depth = depths_at(extras.depth, looks, (width, height), extras.depth_scale_mm)
    if reference is not None:
        document["reference"] = comparison(spots, calibration.camera, reference)
    return len(spots), _write(out, document, picture, calibration.camera, depth)


def picture_document(
    image: Path | str, picture: npt.NDArray[np.float32], calibration: Calibration, options: Options,
    cautions: Sequence[str] = (),
) -> dict[str, Any]:  # fmt: skip
    """Reconstruct a picture and give what normals.json holds."""
    result = reconstruct_values(picture, calibration, options)
    camera = calibration.camera
    return {
        "image": str(image),
        "camera": describe_camera(camera),
        "encoding": calibration.response.kind if calibration.response else "linear",
        "detector": result.detector,
        "view": result.view,
        "warnings": list(cautions),
        "frame": FRAME,
        "specularities": result.spots,
        "other_highlights": result.others,
        "provenance": provenance.environment(),
    }


def _reference(extras: Extras | None, camera: Camera) -> Reference | None:
    if extras is None or extras.reference is None:
        if extras is not None and extras.pose is not None:
            raise InputError("--camera-from-model: needs --reference, the mesh that it places")
        return None
    return load_reference(extras.reference, extras.pose, camera, extras.depth_scale_mm)


def parse_roi(text: str) -> tuple[int, int, int, int]:
    """Give a region of interest from "x,y,w,h"."""
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--roi {text}: must be x,y,w,h, four integers in px") from None
    return x, y, width, height


def _write(
    out: Path, document: dict[str, Any], picture: npt.NDArray[np.float32], camera: Camera, depth: list[float] | None
) -> list[Path]:
    names = ("normals.json", "normals.csv", "normals.ply", "overlay.png", "arrows.ply", "constraints.json",
             "constraints.npz", "index.html")  # fmt: skip
    files = [out / name for name in names]
    spots = document["specularities"]
    make_folder(out)
    try:
        write_json(files[0], document, compact=len(spots) > MANY)
        write_atomically(files[1], lambda part: write_csv(part, rows(spots)))
        write_atomically(files[2], lambda part: part.write_text(ply(spots, camera, depth), encoding="ascii"))
        write_atomically(files[3], lambda part: cv2.imwrite(str(part), draw_overlay(picture, spots)))
        write_atomically(files[4], lambda part: part.write_text(arrows_ply(spots, camera, depth), encoding="ascii"))
        write_constraints(files[5], files[6], document)
        write_atomically(files[7], lambda part: write_picture_page(part, document, picture))
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from error
    return files
