"""Sparse normals as constraints that a reconstruction of the surface can take: constraints.json and constraints.npz."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.reconstruction.description import SpecularityRecord
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.spec import describe_camera

VERSION = 1

ABOUT = (
    "For constraint i the surface point on the ray depth * sightline[i] through pixel[i] has the unit normal "
    "normal[i], which faces the camera. Camera frame: x right, y down, z forward; pixel centres at integer + 0.5. "
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


@dataclass(frozen=True)
class Constraints:
    """The constraints of a picture."""

    image: str
    camera: Camera
    constraints: list[Constraint]

    @classmethod
    def of(cls, image: str, camera: Camera, spots: Sequence[SpecularityRecord]) -> "Constraints":
        """Take the best normal of each specularity that has one and a sightline."""
        made = [
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
            )
            for spot in spots
            if spot.best is not None and spot.sightline is not None and (best := spot.best_estimate) is not None
        ]
        return cls(image, camera, made)

    def to_json(self) -> JsonObject:
        """Return the content of constraints.json."""
        about = {"version": VERSION, "about": ABOUT, "image": self.image}
        return {**about, "camera": describe_camera(self.camera), "constraints": self.constraints}

    def arrays(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return the content of constraints.npz: no pickles, a row a constraint, and K (3, 3).

        id (N,), pixel (N, 2), sightline and normal (N, 3), basis (N, 2, 3), covariance (N, 2, 2), candidates (N, 2, 3)
        with NaN where there is no second, estimator (N,) as text.
        """
        every = self.constraints
        stacked = {}
        for name, shape in SHAPES.items():
            rows = [getattr(constraint, name) for constraint in every]
            filled = [np.full(shape, np.nan) if row is None else row for row in rows]
            stacked[name] = np.array(filled, dtype=float).reshape(-1, *shape)
        candidates = np.full((len(every), 2, 3), np.nan)
        for pair, constraint in zip(candidates, every, strict=True):
            pair[: len(constraint.candidates)] = constraint.candidates[:2]
        return {
            "version": np.array(VERSION),
            "id": np.array([constraint.id for constraint in every], dtype=int),
            **stacked,
            "candidates": candidates,
            "estimator": np.array([constraint.estimator for constraint in every], dtype=str),
            "K": self.camera.K,
        }
