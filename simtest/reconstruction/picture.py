"""Reconstruction from a picture file: reading it, and writing the normals in formats that others read."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.reconstruction.constraints import write_constraints
from simtest.reconstruction.description import arrows_ply, ply, rows, write_csv
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.picture_page import write_picture_page
from simtest.reconstruction.single import Options, reconstruct_values
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, write_atomically, write_json
from simtest.spec import describe_camera

FRAME = "camera: x right, y down, z forward; normals are unit and face the camera"
NOTHING = "no specularity found that stands out of the noise and has the shape of a highlight; try --all or --roi"


MANY = 10
"""Above so many specularities normals.json is written on one line: most of it are outlines."""


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


def parse_roi(text: str) -> tuple[int, int, int, int]:
    """Give a region of interest from "x,y,w,h"."""
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--roi {text}: must be x,y,w,h, four integers in px") from None
    return x, y, width, height


def write_document(
    out: Path, document: dict[str, Any], picture: npt.NDArray[np.float32], camera: Camera, depth: list[float] | None
) -> list[Path]:
    """Write what was reconstructed in a picture, its overlay and its page; return the files.

    Parameters
    ----------
    out : Path
        Folder, made if need be.
    document : dict
        As `picture_document` makes it.
    picture : ndarray of float32, shape (H, W) or (H, W, 3)
        The picture.
    camera : Camera
        Its camera.
    depth : list of float, optional
        Depth of each specularity's arrow, mm; default 1.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
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
