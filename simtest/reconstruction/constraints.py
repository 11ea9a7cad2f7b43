"""Sparse normals as constraints that a reconstruction of the surface can take: constraints.json and constraints.npz."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry.vectors import tangent_basis
from simtest.reconstruction.description import PictureRecord, SpecularityRecord
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.spec import describe_camera

VERSION = 1

ABOUT = (
    "For constraint i the surface point on the ray depth * sightline[i] through pixel[i] has the unit normal "
    "normal[i], which faces the camera; target[i] says whether it is that of the fine surface with its relief, or of "
    "the base without. Camera frame: x right, y down, z forward; pixel centres at integer + 0.5. "
    "covariance[i] is that of the normal, rad^2, in its tangent basis[i] (two unit vectors); NaN (null) where the "
    "estimator gives none. "
    "candidates[i] holds all normals that the data allow."
)

SHAPES = {"pixel": (2,), "sightline": (3,), "normal": (3,), "basis": (2, 3), "covariance": (2, 2)}
"""Of what constraints.npz stacks."""


@dataclass(frozen=True)
class Constraint:
    """The best normal of a specularity (see `ABOUT`), with the candidates of `circle_pose` where it has any."""

    id: int
    track: int | None
    pixel: Array | None
    sightline: Array
    normal: Array
    basis: Array
    covariance: Array | None
    estimator: str
    candidates: Array
    score: float | None
    flags: tuple[str, ...]
    target: str


def constraints_of(spots: Sequence[SpecularityRecord]) -> list[Constraint]:
    """Return the best normal of each specularity that has one and a sightline."""
    return [
        Constraint(
            id=spot.id,
            track=spot.track,
            pixel=spot.peak_px,
            sightline=spot.sightline,
            normal=best.normal,
            basis=np.concatenate(tangent_basis(best.normal[None])),
            covariance=best.covariance,
            estimator=spot.best,
            candidates=spot.normals.get("circle_pose", best).candidates,
            score=spot.score,
            flags=best.flags,
            target=best.target,
        )
        for spot in spots
        if spot.best is not None and spot.sightline is not None and (best := spot.best_estimate) is not None
    ]


def constraints_json(record: PictureRecord) -> JsonObject:
    """Return the content of constraints.json."""
    about = {"version": VERSION, "about": ABOUT, "image": record.image, "camera": describe_camera(record.camera)}
    return {**about, "constraints": constraints_of(record.specularities)}


def constraints_arrays(record: PictureRecord) -> dict[str, npt.NDArray[np.generic]]:
    """Return the content of constraints.npz: no pickles, a row a constraint, and K (3, 3).

    id (N,), pixel (N, 2), sightline and normal (N, 3), basis (N, 2, 3), covariance (N, 2, 2), candidates (N, 2, 3) with
    NaN where there is no second, estimator and target (N,) as text.
    """
    made = constraints_of(record.specularities)
    stacked = {}
    for name, shape in SHAPES.items():
        rows = [getattr(constraint, name) for constraint in made]
        filled = [np.full(shape, np.nan) if row is None else row for row in rows]
        stacked[name] = np.array(filled, dtype=float).reshape(-1, *shape)
    candidates = np.full((len(made), 2, 3), np.nan)
    for pair, constraint in zip(candidates, made, strict=True):
        pair[: len(constraint.candidates)] = constraint.candidates[:2]
    ids, estimators, targets = (
        [getattr(constraint, name) for constraint in made] for name in ("id", "estimator", "target")
    )
    return {
        "version": np.array(VERSION),
        "id": np.array(ids, dtype=int),
        **stacked,
        "candidates": candidates,
        "estimator": np.array(estimators, dtype=str),
        "target": np.array(targets, dtype=str),
        "K": record.camera.K,
    }
