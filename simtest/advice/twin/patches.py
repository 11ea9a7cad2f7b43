"""The tissue that twins are made of: a pool of quadric patches with relief and pattern, and draws of a view of one.

The pool is fixed, so that its reliefs and patterns are made once and then read from the user's cache. What differs
between twins is the view of a patch, the lights, the film's lobe and the camera chain.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.advice.twin.tissue import ANY, Tissue
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer

POOL = 16
"""Patches in the pool."""

POOL_SEED = 230_601
"""Of the pool; no study draws its frames from it."""

ANCHOR_MM = 40.0
"""Depth of a patch's anchor in the view that its surface keys state; the camera is then moved to its own view."""

REACH_MM = 10.0
"""The point of a patch that a twin looks at lies within so much of the anchor along each axis, mm."""

MOST_TILT_DEG = 35.0
"""Largest angle between the base's normal and the reversed sightline at that point: highlights farther out are rare."""

LEAST_GAIN = 0.2
"""Smallest abs(1 + d k) of the base at that point: nearer to 0 a wall shows a streak, not highlights. 1 + d k is
negative where the wall bends around the camera, as the far wall of a lumen does."""


@dataclass(frozen=True)
class TissuePatch:
    """A patch of tissue.

    Parameters
    ----------
    k_per_mm : tuple of float
        Principal curvatures of its base at the anchor, 1/mm, convex positive.
    surface : dict
        Table `surface` of a scene.
    """

    k_per_mm: tuple[float, float]
    surface: dict[str, Any]

    def points(self, u: float, v: float) -> tuple[Array, Array]:
        """Return a point of the base and its normal, shape (3,) each, mm, in the patch's own frame."""
        k1, k2 = self.k_per_mm
        normal = np.array([k1 * u, k2 * v, 1.0])
        return np.array([u, v, -(k1 * u * u + k2 * v * v) / 2]), normal / np.linalg.norm(normal)


def make_pool(count: int = POOL, tissue: Tissue = ANY) -> list[TissuePatch]:
    """Return the pool of a tissue: the first `count` patches."""
    return [_patch(number, tissue) for number in range(count)]


def _patch(number: int, tissue: Tissue) -> TissuePatch:
    """Draw a patch: curvature of a fold, a lumen or a body, and a relief as the tissue has."""
    rng = from_integer(POOL_SEED + number)
    k1, k2 = tissue.draw_curvatures(rng)
    surface = {
        "type": "quadric", "distance_mm": ANCHOR_MM, "k1_per_mm": k1, "k2_per_mm": k2,
        "relief": {"seed": number, "bands": [band.draw(rng) for band in tissue.bands]},
    }  # fmt: skip
    return TissuePatch((k1, k2), surface)


def look_at(
    patch: TissuePatch, rng: np.random.Generator, sightline: Array, distance: float, tries: int = 20
) -> dict[str, tuple[float, float, float]] | None:
    """Draw a view of a patch in which a sightline meets it at a distance.

    Parameters
    ----------
    patch : TissuePatch
        Its anchor stands at (0, 0, `ANCHOR_MM`), its normal (0, 0, -1), before the camera is moved.
    rng : numpy.random.Generator
        Draws the point looked at, the tilt of the base there, and the turn about the normal.
    sightline : ndarray, shape (3,)
        Unit, camera frame.
    distance : float
        Along it, mm.
    tries : int
        Draws of a point before the patch is given up.

    Returns
    -------
    dict or None
        Table `camera.moved` of a scene; None where no drawn point lies well in view of the camera.
    """
    for _ in range(tries):
        u, v = rng.uniform(-REACH_MM, REACH_MM, 2)
        point, normal = patch.points(float(u), float(v))
        if min(abs(1 + distance * k) for k in patch.k_per_mm) < LEAST_GAIN:
            return None
        # Even in solid angle about the reversed sightline.
        tilt = math.acos(rng.uniform(math.cos(math.radians(MOST_TILT_DEG)), 1.0))
        leaned = _turned(-sightline, _across(sightline, float(rng.uniform(0, 2 * math.pi))), tilt)
        # patch_from_moved: takes the leaned normal to the patch's, with any turn about it.
        rotation = _frame(normal, float(rng.uniform(0, 2 * math.pi))) @ _frame(leaned, 0.0).T
        centre = point - rotation @ (distance * sightline)
        k1, k2 = patch.k_per_mm
        if centre[2] + (k1 * centre[0] ** 2 + k2 * centre[1] ** 2) / 2 > 0.3 * distance:
            return _moved(rotation, centre)
    return None


def _moved(rotation: Array, centre: Array) -> dict[str, tuple[float, float, float]]:
    """Return the motion from the view that the surface keys state, from the camera's pose in the patch's frame."""
    # unmoved_from_patch: x to the right stays, the patch's z points back at the camera.
    turn = np.diag([1.0, -1.0, -1.0])
    R = turn @ rotation
    t = turn @ centre + np.array([0.0, 0.0, ANCHOR_MM])
    angle = math.acos(float(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        # A half turn, or none.
        axis = np.sqrt(np.maximum((np.diag(R) + 1) / 2, 0)) if angle > 1 else np.array([1.0, 0.0, 0.0])
        length = float(np.linalg.norm(axis))
    turned = np.degrees(angle) * axis / length
    x, y, z = t.tolist()
    rx, ry, rz = turned.tolist()
    return {"translation_mm": (x, y, z), "rotation_deg": (rx, ry, rz)}


def _frame(normal: Array, spin: float) -> Array:
    """Return a rotation whose third column is a unit vector."""
    first = _across(normal, spin)
    return np.stack([first, np.cross(normal, first), normal], axis=1)


def _across(direction: Array, spin: float) -> Array:
    """Return a unit vector perpendicular to a unit direction, turned about it by an angle, rad."""
    least = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first)
    return np.asarray(math.cos(spin) * first + math.sin(spin) * np.cross(direction, first))


def _turned(direction: Array, axis: Array, angle: float) -> Array:
    """Return a unit direction turned about an axis perpendicular to it, rad."""
    return np.asarray(math.cos(angle) * direction + math.sin(angle) * np.cross(axis, direction))
