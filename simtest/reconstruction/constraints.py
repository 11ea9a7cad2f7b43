"""Sparse normals as constraints that a reconstruction of the surface can take: constraints.json and constraints.npz."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.reconstruction.description import SpecularityRecord, Vector
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


@dataclass(frozen=True)
class Constraint:
    """The best normal of a specularity (see `ABOUT`), with the candidates of `circle_pose` where it has any."""

    id: int
    track: int | None
    pixel: Vector | None
    sightline: Vector
    normal: Vector
    basis: list[Vector]
    covariance: list[Vector] | None
    estimator: str
    candidates: list[Vector]
    score: float | None
    flags: list[str]


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
                normal=best.normal.tolist(),
                basis=np.concatenate(tangent_basis(best.normal[None])).tolist(),
                covariance=None if best.covariance is None else best.covariance.tolist(),
                estimator=spot.best,
                candidates=spot.normals.get("circle_pose", best).candidates.tolist(),
                score=None if spot.highlight is None else spot.highlight.score,
                flags=list(best.flags),
            )
            for spot in spots
            if spot.best and spot.sightline and (best := spot.best_estimate)
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
        candidates = np.full((len(every), 2, 3), np.nan)
        for pair, constraint in zip(candidates, every, strict=True):
            given = np.array(constraint.candidates, dtype=float)[:2]
            pair[: len(given)] = given
        unknown = [[np.nan] * 2] * 2
        return {
            "version": np.array(VERSION),
            "id": np.array([c.id for c in every], dtype=int),
            "pixel": np.array([c.pixel for c in every], dtype=float).reshape(-1, 2),
            "sightline": np.array([c.sightline for c in every], dtype=float).reshape(-1, 3),
            "normal": np.array([c.normal for c in every], dtype=float).reshape(-1, 3),
            "basis": np.array([c.basis for c in every], dtype=float).reshape(-1, 2, 3),
            "covariance": np.array([c.covariance or unknown for c in every], dtype=float).reshape(-1, 2, 2),
            "candidates": candidates,
            "estimator": np.array([c.estimator for c in every], dtype=str),
            "K": self.camera.K,
        }
