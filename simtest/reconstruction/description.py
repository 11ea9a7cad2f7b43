"""What was reconstructed, as normals.json, normals.csv and normals.ply hold it."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simtest.detection.blobs import Highlight
from simtest.errors import Failure
from simtest.estimators.protocol import Estimate, EstimatedCurvature, drawable
from simtest.geometry import Camera, KannalaBrandt
from simtest.reconstruction.pipeline import Specularity

BEST = ("bisector", "curved", "cone_axis", "brightest_point")
"""Estimators whose normal is the best one, in this order: that which knows the lights, that which follows the isophotes
to the peak, that which averages them, and the one that needs none. `circle_pose` takes a curved surface for a plane."""

UNSOUND = frozenset({"saturated", "missing_isovalues", "ambiguous_light"})
"""With these flags `curved` and `bisector`, which follow the isophotes to the peak, give way to the next."""


def best_of(estimates: dict[str, Estimate | Failure]) -> str | None:
    """Give the name of the estimator whose normal is the best one; None where all failed."""
    answered = [name for name in BEST if isinstance(estimates.get(name), Estimate)]
    for name in answered:
        result = estimates[name]
        assert isinstance(result, Estimate)
        if name in ("bisector", "curved") and UNSOUND & set(result.flags):
            continue
        return name
    return answered[0] if answered else next((n for n, e in estimates.items() if isinstance(e, Estimate)), None)


def describe(
    index: int, specularity: Specularity, camera: Camera, highlight: Highlight | None = None
) -> dict[str, Any]:
    """Describe a specularity for normals.json: its region, and each estimator's result or reason of failure."""
    results = {name: _entry(result, specularity, camera) for name, result in specularity.estimates.items()}
    peak = None if isinstance(specularity.patch, Failure) else specularity.patch.peak_px.tolist()
    entry = {"id": index, "box_px": list(specularity.region.box), "peak_px": peak}
    sightline = None if peak is None else camera.unproject(peak)
    # A lens sees no direction beyond its fold.
    entry["sightline"] = None if sightline is None or not np.isfinite(sightline).all() else sightline.tolist()
    if highlight is not None:
        entry |= describe_highlight(highlight)
    return {**entry, "best": best_of(specularity.estimates), "estimates": results}


def describe_highlight(highlight: Highlight) -> dict[str, Any]:
    """Describe what the detection says of a highlight."""
    return {
        "kind": str(highlight.kind),
        "score": highlight.score,
        "area_px": highlight.area_px,
        "specular_peak": highlight.region.contrast,
        "shape": {
            "axis_ratio": highlight.axis_ratio,
            "residual": highlight.residual,
            "wander": highlight.wander,
            "tint": highlight.tint,
            "clutter": highlight.clutter,
        },
        "outline": np.round(highlight.outline, 2).tolist(),
    }


def _entry(result: Estimate | Failure, specularity: Specularity, camera: Camera) -> dict[str, Any]:
    if isinstance(result, Failure):
        return {"status": str(result.reason), "detail": result.detail}
    return {
        "status": "ok",
        "normal": result.normal.tolist(),
        "candidates": result.candidates.tolist(),
        "choice_margin": result.choice_margin,
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


def _curvature_entry(curvature: EstimatedCurvature) -> dict[str, Any]:
    return {
        "directions": curvature.directions.tolist(),
        "axis_ratio": curvature.axis_ratio,
        "gains": None if curvature.hypotheses is None else curvature.hypotheses.tolist(),
    }


COLUMNS = (
    "specularity", "estimator", "status", "candidate", "normal_x", "normal_y", "normal_z", "look_x_px", "look_y_px",
    "axis_ratio", "flags", "best", "choice_margin", "cov_11", "cov_12", "cov_22", "peak_x_px", "peak_y_px", "kind",
    "score",
)  # fmt: skip


def rows(spots: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give a row for each specularity, estimator and candidate normal; candidate 0 is the proposed one."""
    made = []
    for spot in spots:
        peak = spot["peak_px"] or (None, None)
        common = {"specularity": spot["id"], "peak_x_px": peak[0], "peak_y_px": peak[1],
                  "kind": spot.get("kind"), "score": spot.get("score")}  # fmt: skip
        for name, result in spot["estimates"].items():
            for k, normal in enumerate(result.get("candidates", [None])):
                row = {**common, **result, "estimator": name, "best": int(name == spot["best"])}
                row["candidate"] = k if normal else ""
                row |= dict(zip(("normal_x", "normal_y", "normal_z"), normal or (), strict=False))
                row |= dict(zip(("look_x_px", "look_y_px"), result.get("look_px", ()), strict=False))
                if result.get("covariance"):
                    (a, b), (_, c) = result["covariance"]
                    row |= {"cov_11": a, "cov_12": b, "cov_22": c}
                row["flags"] = ";".join(result.get("flags", ()))
                made.append({column: row.get(column) for column in COLUMNS})
    return made


def write_csv(path: Path, table: Sequence[dict[str, Any]], columns: Sequence[str] = COLUMNS) -> None:
    """Write rows as CSV; what is None stays empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(table)


def ply(spots: Sequence[dict[str, Any]], camera: Camera, depth_mm: Sequence[float] | None = None) -> str:
    """Give the proposed normals as oriented points on the sightlines they look along (PLY, ASCII).

    The points are at the depth given for each specularity, else at unit depth; through a fisheye, which sees sideways
    and backwards too, the same as distances.
    """
    fisheye = isinstance(camera.distortion, KannalaBrandt)
    lines, names = [], sorted({name for spot in spots for name in spot["estimates"]})
    for i, spot in enumerate(spots):
        for name, result in spot["estimates"].items():
            if result["status"] != "ok" or None in result["look_px"]:
                continue
            ray = camera.unproject(result["look_px"])
            depth = 1.0 if depth_mm is None else depth_mm[i]
            place = depth * (ray if fisheye else ray / ray[2])
            if np.isfinite(place).all():
                values = [*place.tolist(), *result["normal"]]
                lines.append(" ".join(f"{v:.9g}" for v in values) + f" {spot['id']} {names.index(name)}")
    header = [
        "ply", "format ascii 1.0", f"comment estimators by number: {json.dumps(names)}", f"element vertex {len(lines)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        "property int specularity", "property int estimator", "end_header",
    ]  # fmt: skip
    return "\n".join([*header, *lines]) + "\n"


ARROW_SIDES = 6


def arrows_ply(spots: Sequence[dict[str, Any]], camera: Camera, depth_mm: Sequence[float] | None = None) -> str:
    """Give the best normal of each specularity as an arrow of triangles, a tenth of its distance long (PLY, ASCII)."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for i, spot in enumerate(spots):
        result = spot["estimates"].get(spot["best"]) if spot["best"] else None
        if result is None or None in result["look_px"]:
            continue
        ray = camera.unproject(result["look_px"])
        fisheye = isinstance(camera.distortion, KannalaBrandt)
        place = (1.0 if depth_mm is None else depth_mm[i]) * (ray if fisheye else ray / ray[2])
        if np.isfinite(place).all():
            _add_arrow(vertices, faces, place, np.array(result["normal"]), 0.1 * float(np.linalg.norm(place)))
    header = [
        "ply", "format ascii 1.0", f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in "xyz"), f"element face {len(faces)}",
        "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    body = [" ".join(f"{v:.7g}" for v in vertex) for vertex in vertices]
    return "\n".join([*header, *body, *(f"3 {a} {b} {c}" for a, b, c in faces)]) + "\n"


def _add_arrow(
    vertices: list[list[float]], faces: list[tuple[int, int, int]], start: np.ndarray, along: np.ndarray, length: float
) -> None:
    """Add a shaft and a head: rings of `ARROW_SIDES` points, joined, and a tip."""
    side = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(along, side)
    phase = 2 * np.pi * np.arange(ARROW_SIDES) / ARROW_SIDES
    around = np.cos(phase)[:, None] * side + np.sin(phase)[:, None] * other
    first = len(vertices)
    for at, radius in ((0.0, 0.03), (0.7, 0.03), (0.7, 0.09)):
        vertices += (start + length * (at * along + radius * around)).tolist()
    vertices.append((start + length * along).tolist())
    n = ARROW_SIDES
    for i in range(n):
        j = (i + 1) % n
        for ring in (0, n):
            a, b, c, d = (first + ring + k for k in (i, j, n + i, n + j))
            faces += [(a, b, d), (a, d, c)]
        faces.append((first + 2 * n + i, first + 2 * n + j, first + 3 * n))
