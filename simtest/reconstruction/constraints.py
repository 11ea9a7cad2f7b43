"""Sparse normals as constraints that a reconstruction of the surface can take: constraints.npz."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from simtest.estimators import Estimate
from simtest.estimators.budget import MISPLACED
from simtest.geometry.vectors import tangent_basis
from simtest.reconstruction.records import Specularities, Specularity
from simtest.runtime.arrays import Array

VERSION = 2


def constraints_arrays(found: Specularities) -> dict[str, npt.NDArray[np.generic]]:
    """Return the content of constraints.npz: no pickles, K (3, 3), and a row a best normal that looks along a ray.

    The normal and its covariance are those of the surface at the highlight's brightest point, wherever that is; the
    pixel, at which the best normal looks, is where it is estimated. Of the surface on the sightline through that pixel
    the normal is the same, with `covariance_at_pixel`. docs/howto/constraints.md lists the arrays.
    """
    made = [
        (spot, spot.best, best)
        for spot in found
        if spot.best is not None and (best := spot.best_estimate) is not None
        if np.isfinite(found.camera.unproject(best.look_px)).all()
    ]
    pixels = np.array([best.look_px for _, _, best in made], dtype=float).reshape(-1, 2)
    normals = np.array([best.normal for _, _, best in made], dtype=float).reshape(-1, 3)
    unknown = np.full((2, 2), np.nan)
    candidates = np.full((len(made), 2, 3), np.nan)
    for pair, (spot, _, best) in zip(candidates, made, strict=True):
        listed = spot.normals.get("circle_pose", best).candidates
        pair[: len(listed)] = listed[:2]
    return {
        "version": np.array(VERSION),
        "id": np.array([spot.id for spot, _, _ in made], dtype=int),
        "pixel": pixels,
        "sightline": found.camera.unproject(pixels),
        "normal": normals,
        "basis": np.stack(tangent_basis(normals), axis=1),
        "covariance": _stacked([unknown if best.covariance is None else best.covariance for _, _, best in made]),
        "covariance_at_pixel": _stacked([_at_pixel(spot, best) for spot, _, best in made]),
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


def _stacked(matrices: Sequence[Array]) -> Array:
    return np.array(matrices, dtype=float).reshape(-1, 2, 2)
