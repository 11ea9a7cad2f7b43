"""Figure 1 of the article: specular isocurves on the plane, in units of abs(V_Z)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from skimage.measure import find_contours

from simtest.geometry.isocurves import brightest_point, isocurve_radii, on_isophote_branch, specular_isocurve

Array = npt.NDArray[np.float64]

KAPPA = 0.55
"""The article's value."""

OFFSET_LIGHT = (1.2, 0.0, 1.0)
"""A light that is not at the camera's place, abs(V_Z)."""

REACH = 3.6
"""Half-width of the drawn part of the plane, abs(V_Z)."""

_SAMPLES = 721
_POINTS = 241
_CURVE = 200
_LIMITS = (1e-3, 0.999)


@dataclass(frozen=True)
class Branch:
    """One closed curve of the quartic, with whether it is the isophote (cos beta = tau, not -tau)."""

    points: Array
    is_isophote: bool


@dataclass(frozen=True)
class IsocurveFigure:
    """The parts of Figure 1; lengths over abs(V_Z).

    Parameters
    ----------
    inner, outer : float
        r- and r+ at `KAPPA`.
    together : tuple of Branch
        With the light at the camera: the two circles.
    apart : tuple of Branch
        With the light at `OFFSET_LIGHT`.
    bp : ndarray, shape (2,)
        The brightest point of the latter.
    kappa, inner_of_kappa, outer_of_kappa : ndarray, shape (m,)
        The radii against kappa.
    """

    inner: float
    outer: float
    together: tuple[Branch, ...]
    apart: tuple[Branch, ...]
    bp: Array
    kappa: Array
    inner_of_kappa: Array
    outer_of_kappa: Array


def isocurve_figure() -> IsocurveFigure:
    """Compute Figure 1."""
    inner, outer = (float(r) for r in isocurve_radii(KAPPA, 1.0))
    angle = np.linspace(0, 2 * np.pi, _POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    camera, light = np.array([0.0, 0.0, 1.0]), np.array(OFFSET_LIGHT)
    bp = brightest_point(light, camera)
    values = np.linspace(*_LIMITS, _CURVE)
    return IsocurveFigure(
        inner, outer, (Branch(inner * circle, True), Branch(outer * circle, False)),
        _quartic(light, camera), bp, values, *isocurve_radii(values, 1.0),
    )  # fmt: skip


def _quartic(light: Array, camera: Array) -> tuple[Branch, ...]:
    """Trace the zeros of Q and tell its branches apart."""
    side = np.linspace(-REACH, REACH, _SAMPLES)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    branches = []
    for contour in find_contours(specular_isocurve(grid, light, camera, np.sqrt(1 - KAPPA)), 0.0):
        points = -REACH + contour[:, ::-1] * (side[1] - side[0])
        branches.append(Branch(points, bool(on_isophote_branch(points, light, camera).all())))
    return tuple(sorted(branches, key=lambda branch: not branch.is_isophote))
