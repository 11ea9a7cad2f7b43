"""What is written of a picture: normals.json, a table, oriented points, overlay, constraints and the page."""

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.estimators import Estimate
from simtest.estimators.budget import MISPLACED
from simtest.estimators.protocol import CalibratedRegion
from simtest.geometry import BrownConrady, Camera
from simtest.geometry.vectors import deviation_deg, tangent_basis
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.page import write_picture_page
from simtest.reconstruction.records import Specularities, Specularity
from simtest.runtime.arrays import Array, Image
from simtest.runtime.files import JsonObject, make_folder, write_atomically, write_json, written_together

MANY = 10
"""Above this many specularities normals.json is written on one line, since most of it is outlines."""

COLUMNS = (
    "specularity", "estimator", "status", "candidate", "normal_x", "normal_y", "normal_z", "look_x_px", "look_y_px",
    "axis_ratio", "flags", "best", "choice_margin", "cov_11", "cov_12", "cov_22", "peak_x_px", "peak_y_px", "kind",
    "score", "target", "deviation_deg", "organ_deviation_deg",
)  # fmt: skip

REGION_COLUMNS = tuple(field.name for field in fields(CalibratedRegion))
"""Further ones where a core's calibration is given."""

FILES = ("normals.json", "normals.csv", "normals.ply", "overlay.png", "constraints.npz", "index.html")


def write_outputs(
    out: Path, found: Specularities, picture: Image, depth_mm: Sequence[float] | None = None
) -> list[Path]:
    """Write what was reconstructed in a picture, its overlay and its page; return the files.

    The folder is made if need be; `InputError` is raised where it cannot be written,
    `SimtestError` where its disk is full. A specularity's points stand at its depth, mm, by default at 1.
    """
    depths = [1.0] * len(found) if depth_mm is None else depth_mm
    arrays = constraints_arrays(found)
    points = normals_ply(found, found.camera, depths)
    entries = found.to_json()
    make_folder(out)
    with written_together(out, FILES) as new:
        write_json(new / "normals.json", entries, compact=len(found) > MANY)
        spots = entries["specularities"]
        columns = columns_of(spots)
        write_atomically(new / "normals.csv", lambda part: write_csv(part, columns, normals_rows(spots, columns)))
        write_atomically(new / "normals.ply", lambda part: part.write_text(points, encoding="ascii"))
        # In memory: OpenCV does not tell which of the system's errors it met.
        overlay = cv2.imencode(".png", draw_overlay(picture, found))[1].tobytes()
        write_atomically(new / "overlay.png", lambda part: part.write_bytes(overlay))
        write_atomically(new / "constraints.npz", lambda part: np.savez(part, allow_pickle=False, **arrays))
        write_atomically(new / "index.html", lambda part: write_picture_page(part, found, picture))
    return [out / name for name in FILES]


def columns_of(entries: Sequence[JsonObject]) -> tuple[str, ...]:
    """Return the columns of a table of entries of ``specularities``."""
    held = any(REGION_COLUMNS[0] in each for entry in entries for each in entry["estimates"].values())
    return (*COLUMNS, *REGION_COLUMNS) if held else COLUMNS


def normals_rows(entries: Iterable[JsonObject], columns: Sequence[str] = COLUMNS) -> Iterator[tuple[object, ...]]:
    """Yield a row of the columns for each entry of ``specularities``, estimator and candidate, 0 the proposed one."""
    others = columns[len(COLUMNS) :]
    for entry in entries:
        peak = (None, None) if entry["peak_px"] is None else (float(v) for v in entry["peak_px"])
        judged = (*peak, entry.get("kind"), entry.get("score"))
        for name, each in entry["estimates"].items():
            start, best = (entry["id"], name, each["status"]), int(name == entry["best"])
            covariance, deviation, organ = (None,) * 3, None, None
            if each["status"] != "ok":
                # candidate, normal, look and axis ratio; then margin
                yield (*start, *(None,) * 7, "", best, None, *covariance, *judged, None, deviation, organ,
                       *(None,) * len(others))  # fmt: skip
                continue
            if each["covariance"] is not None:
                matrix = np.array(each["covariance"])
                covariance, deviation = matrix[np.triu_indices(2)].tolist(), deviation_deg(matrix)
            if each["organ_covariance"] is not None:
                organ = deviation_deg(np.array(each["organ_covariance"]))
            shape = (*each["look_px"], each["axis_ratio"], ";".join(each["flags"]), best, each["choice_margin"])
            for k, normal in enumerate(np.array(each["candidates"]).tolist()):
                yield (*start, k, *normal, *shape, *covariance, *judged, each["target"], deviation, organ,
                       *map(each.get, others))  # fmt: skip


def write_csv(path: Path, columns: Sequence[str], table: Iterable[Sequence[object]]) -> None:
    """Write rows as CSV; what is None stays empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(table)


def normals_ply(spots: Sequence[Specularity], camera: Camera, depths_mm: Sequence[float]) -> str:
    """Return the proposed normals as oriented points on the sightlines that they look along (PLY, ASCII).

    The points are at the depth of their specularity; through a fisheye, which sees sideways and backwards too, at that
    distance.
    """
    # Estimators are numbered by name, so that the file does not depend on the order in which they ran.
    lines, names = [], sorted({name for spot in spots for name in spot.estimates})
    is_perspective = camera.distortion is None or isinstance(camera.distortion, BrownConrady)
    for spot, depth in zip(spots, depths_mm, strict=True):
        for name, result in spot.normals.items():
            ray = camera.unproject(result.look_px)
            # Depth is along the optical axis of a perspective lens, along the sightline of one that sees sideways.
            point = depth * (ray / ray[2] if is_perspective else ray)
            if np.isfinite(point).all():
                values = [*point.tolist(), *result.normal.tolist()]
                lines.append(" ".join(f"{v:.9g}" for v in values) + f" {spot.id} {names.index(name)}")
    header = [
        "ply", "format ascii 1.0", f"comment estimators by number: {json.dumps(names)}", f"element vertex {len(lines)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        "property int specularity", "property int estimator", "end_header",
    ]  # fmt: skip
    return "\n".join([*header, *lines]) + "\n"


VERSION = 2


def constraints_arrays(found: Specularities) -> dict[str, npt.NDArray[np.generic]]:
    """Return the content of constraints.npz: no pickles, K (3, 3), and a row a best normal that looks along a ray.

    The normal and its covariance are those of the surface at the highlight's brightest point, wherever that is; the
    pixel, at which the best normal looks, is where it is estimated. Of the surface on the sightline through that pixel
    the normal is the same, with `covariance_at_pixel`. docs/howto/pictures.md lists the arrays.
    """
    answered = ((spot, spot.best, best) for spot in found if (best := spot.best_estimate) is not None)
    made = [each for each in answered if np.isfinite(found.camera.unproject(each[2].look_px)).all()]
    pixels = np.array([best.look_px for _, _, best in made], dtype=float).reshape(-1, 2)
    normals = np.array([best.normal for _, _, best in made], dtype=float).reshape(-1, 3)
    stated, at_pixel = np.full((2, len(made), 2, 2), np.nan)
    candidates = np.full((len(made), 2, 3), np.nan)
    for i, (spot, _, best) in enumerate(made):
        if best.covariance is not None:
            stated[i] = best.covariance
        at_pixel[i] = _at_pixel(spot, best)
        listed = spot.normals.get("circle_pose", best).candidates[:2]
        candidates[i, : len(listed)] = listed
    return {
        "version": np.array(VERSION),
        "id": np.array([spot.id for spot, _, _ in made], dtype=int),
        "pixel": pixels,
        "sightline": found.camera.unproject(pixels),
        "normal": normals,
        "basis": np.stack(tangent_basis(normals), axis=1),
        "covariance": stated,
        "covariance_at_pixel": at_pixel,
        "candidates": candidates,
        "estimator": np.array([name for _, name, _ in made], dtype=str),
        "target": np.array([best.target for _, _, best in made], dtype=str),
        "K": found.camera.K,
    }


def _at_pixel(spot: Specularity, best: Estimate) -> Array:
    """Return the covariance of a normal as that of the surface on the ray through the look pixel; NaN if not known.

    Where the brightest point is misplaced by an angle w, the surface's normal turns by d k w from there to the ray, and
    the estimate by -w: together (1 + d k) w.
    """
    curvatures = (each.curvature for each in spot.normals.values())
    known = next((each for each in curvatures if each is not None and each.hypotheses is not None), None)
    if best.budget is None or known is None or known.hypotheses is None:
        return np.full((2, 2), np.nan)
    axes = known.directions @ np.concatenate(tangent_basis(best.normal[None])).T
    M = axes.T @ np.diag(np.abs(known.hypotheses).max(axis=0)) @ axes
    parts = [M @ part @ M.T if name in MISPLACED else part for name, part in best.budget.items()]
    return np.asarray(np.sum(parts, axis=0))
