"""The misfit between normal and bisector on the exact surface, with its derivative along the image's axes, closed."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import Array
from simtest.surfaces.model import shape_operator
from simtest.surfaces.relief_field import normal_derivative

if TYPE_CHECKING:
    from simtest.rendering.session import Session

DIFFERENCE_PX = 1e-2
"""Pixel positions are moved by this to find how sightlines turn: a lens has no closed derivative."""


@dataclass(frozen=True)
class Misfit:
    """Misfit between normal and bisector at pixel positions.

    Parameters
    ----------
    w : ndarray, shape (N, 2)
        Its components across the sightline.
    jacobian : ndarray, shape (N, 2, 2)
        Their derivatives along the image's axes, 1/px.
    length : ndarray, shape (N,)
        Of the whole misfit, rad: abs(tau) of theory.md section 7.
    """

    w: Array
    jacobian: Array
    length: Array

    def newton_steps(self) -> Array:
        """Return the steps to the zeros of the linear misfit, shape (N, 2), px; NaN where there is none."""
        (a, b), (c, d) = self.jacobian[:, 0].T, self.jacobian[:, 1].T
        determinant = a * d - b * c
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = np.where(np.abs(determinant) > LEAST_DETERMINANT, determinant, np.nan)
        first, second = self.w.T
        return np.stack([b * second - d * first, c * first - a * second], axis=1) / determinant[:, None]


LEAST_DETERMINANT = 1e-18
"""A Jacobian of less, 1/px^2, is singular."""


def exact_misfit(
    session: "Session", points_px: Array, lights: Array, fine: bool = True, faceted: bool = False
) -> Misfit:
    """Compute the exact misfit at pixel positions and its derivative, in the model frame.

    Parameters
    ----------
    session : Session
        At its scene.
    points_px : ndarray, shape (N, 2)
        Pixel positions.
    lights : ndarray, shape (3,) or (N, 3)
        Light of all positions, or of each; camera frame, mm.
    fine : bool
        Whether the normal is that of the relief, where there is one, instead of the base's.
    faceted : bool
        Whether the normals of a user's mesh change as they do within its triangles, instead of by the fitted
        curvatures: the former leads Newton's method to its zeros, the latter is the truth.
    """
    origins, r, turns = _sightlines(session, points_px)
    hits = session.exact_hits(origins, r)
    base = session.surface.points(origins, r, hits)
    N, position, relief = base.normal, base.position, session.surface.relief
    plane, derivative = session.surface.motion(base, hits) if faceted else (N, shape_operator(base))
    normal = N
    if fine and relief is not None:
        jets = relief.jets(np.where(base.valid[:, None], position, 0.0))
        normal, derivative = normal_derivative(N, derivative, jets)
    # Bisector of the directions to camera and light.
    towards = session.to_model(np.atleast_2d(lights)) - position
    reach = _length(towards)
    towards /= reach
    both = towards - r
    size = _length(both)
    bisector = both / size
    gap = normal - bisector
    # Derivatives along the image's axes: of the point on its plane, of the normal, of the bisector.
    first, second = tangent_basis(-r)
    columns = []
    for turn in turns:
        slant = _dot(plane, turn) / _dot(plane, r)
        moved = base.distance[:, None] * (turn - r * slant)
        bent = np.einsum("nij,nj->ni", derivative, moved)
        swing = -(moved - towards * _dot(towards, moved)) / reach - turn
        swing = (swing - bisector * _dot(bisector, swing)) / size
        change = bent - swing
        columns.append(np.stack([np.einsum("ni,ni->n", e, change) for e in (first, second)], axis=1))
    w = np.stack([np.einsum("ni,ni->n", e, gap) for e in (first, second)], axis=1)
    return Misfit(w, np.stack(columns, axis=-1), _length(gap)[:, 0])


def _sightlines(session: "Session", points_px: Array) -> tuple[Array, Array, list[Array]]:
    """Return origins and directions of pixel positions, model frame, and how the directions turn along both axes."""
    moves = DIFFERENCE_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    origins, all_directions = session.sightlines.in_model((points_px + moves[:, None]).reshape(-1, 2))
    r, right, left, down, up = all_directions.reshape(5, -1, 3)
    return origins[: len(r)], r, [(right - left) / (2 * DIFFERENCE_PX), (down - up) / (2 * DIFFERENCE_PX)]


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b)[:, None])


def _length(vectors: Array) -> Array:
    return np.sqrt(_dot(vectors, vectors))
