"""Sparse normals as constraints that a reconstruction of the surface can take: constraints.json and constraints.npz."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from simtest.geometry.vectors import tangent_basis
from simtest.runtime.files import write_atomically, write_json

VERSION = 1

ABOUT = (
    "For constraint i the surface point on the ray depth * sightline[i] through pixel[i] has the unit normal "
    "normal[i], which faces the camera. Camera frame: x right, y down, z forward; pixel centres at integer + 0.5. "
    "covariance[i] is that of the normal, rad^2, in its tangent basis[i] (two unit vectors); NaN (null) where the "
    "estimator gives none. "
    "candidates[i] holds all normals that the data allow."
)


def constraints(document: dict[str, Any]) -> dict[str, Any]:
    """Give the constraints of a document of normals: the best normal of each specularity that has one."""
    made = []
    for spot in document["specularities"]:
        result = spot["estimates"].get(spot["best"]) if spot["best"] else None
        if result is None or result["status"] != "ok" or spot["sightline"] is None:
            continue
        published = spot["estimates"].get("circle_pose", {})
        made.append(
            {
                "id": spot["id"],
                "track": spot.get("track"),
                "pixel": spot["peak_px"],
                "sightline": spot["sightline"],
                "normal": result["normal"],
                "basis": np.concatenate(tangent_basis(np.array([result["normal"]]))).tolist(),
                "covariance": result["covariance"],
                "estimator": spot["best"],
                "candidates": published.get("candidates", result["candidates"]),
                "score": spot.get("score"),
                "flags": result["flags"],
            }
        )
    return {"version": VERSION, "about": ABOUT, "image": document["image"], "camera": document["camera"],
            "constraints": made}  # fmt: skip


def write_constraints(json_file: Path, npz_file: Path, document: dict[str, Any]) -> None:
    """Write the constraints twice: as JSON, and as arrays without pickles.

    The arrays: id (N,), pixel (N, 2), sightline and normal (N, 3), basis (N, 2, 3), covariance (N, 2, 2), candidates
    (N, 2, 3) with NaN where there is no second, estimator (N,) as text, and K (3, 3).
    """
    described = constraints(document)
    write_json(json_file, described)
    write_atomically(npz_file, lambda part: np.savez(part, **arrays(described)))


def arrays(described: dict[str, Any]) -> dict[str, Any]:
    """Give constraints as arrays (see `write_constraints`)."""
    entries = described["constraints"]

    def stacked(give: Callable[[dict[str, Any]], Any], shape: tuple[int, ...]) -> np.ndarray:
        return np.array([give(entry) for entry in entries], dtype=float).reshape(-1, *shape)

    def both(entry: dict[str, Any]) -> np.ndarray:
        pair = np.full((2, 3), np.nan)
        given = np.array(entry["candidates"], dtype=float)[:2]
        pair[: len(given)] = given
        return pair

    unknown = np.full((2, 2), np.nan)
    return {
        "version": np.array(VERSION),
        "id": np.array([entry["id"] for entry in entries], dtype=int),
        "pixel": stacked(lambda e: e["pixel"], (2,)),
        "sightline": stacked(lambda e: e["sightline"], (3,)),
        "normal": stacked(lambda e: e["normal"], (3,)),
        "basis": stacked(lambda e: e["basis"], (2, 3)),
        "covariance": stacked(lambda e: e["covariance"] or unknown, (2, 2)),
        "candidates": stacked(both, (2, 3)),
        "estimator": np.array([entry["estimator"] for entry in entries], dtype=str),
        "K": np.array(described["camera"]["K"]),
    }
