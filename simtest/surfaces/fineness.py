"""How fine a mesh must be for the highlights on it (docs/concepts/theory.md, section 3)."""

import math
from typing import overload

import numpy as np

from simtest.conventions import EDGES_PER_HALF_WIDTH
from simtest.errors import InputError
from simtest.runtime.arrays import Array

DEFAULT_EXPONENT = 200.0
"""Phong exponent of the shipped anatomy scene."""

ISOVALUE = 0.5
"""Level at which half-widths are taken: the middle of the default isovalues."""

LEAST_STRETCH = 0.25
"""Below this |1 + d k| there is no isolated highlight (docs/concepts/theory.md, section 6)."""


def phong_concentration(exponent: float) -> float:
    """Return c = -(log f)''(0) of Phong's lobe as a function of the angle between normal and view: 4 n."""
    return 4.0 * exponent


def ggx_concentration(alpha: float) -> float:
    """Return c = -(log f)''(0) of the GGX lobe under a light at the camera.

    The half vector is the view direction, so that f ~ (alpha^2 + (1 - alpha^2) sin^2)^-2, c = 4 (1/alpha^2 - 1);
    masking and Fresnel reflection add a term of order 1.
    """
    return 4.0 * (1.0 / alpha**2 - 1.0)


@overload
def half_width(distance_mm: float, concentration: float, curvature: float) -> float: ...
@overload
def half_width(distance_mm: float, concentration: float, curvature: Array) -> Array: ...
def half_width(distance_mm: float, concentration: float, curvature: float | Array) -> float | Array:
    """Return the half-width of a highlight on the surface at `ISOVALUE`, mm: d sqrt(-2 ln t / c) / |1 + d k|.

    Parameters
    ----------
    distance_mm : float
        Distance d of camera and light, mm.
    concentration : float
        c of the lobe.
    curvature : float or ndarray
        k across the highlight, 1/mm, convex towards the camera positive.
    """
    angle = math.sqrt(-2.0 * math.log(ISOVALUE) / concentration)
    return distance_mm * angle / np.maximum(np.abs(1.0 + distance_mm * curvature), LEAST_STRETCH)


def needed_edge(distance_mm: float, concentration: float, k_min: Array, k_max: Array) -> Array:
    """Return the edge length that a surface needs at each of its points, mm, shape (N,).

    Parameters
    ----------
    distance_mm, concentration : float
        See `half_width`.
    k_min, k_max : ndarray, shape (N,)
        Principal curvatures, 1/mm.
    """
    narrow = np.minimum(half_width(distance_mm, concentration, k_min), half_width(distance_mm, concentration, k_max))
    return np.asarray(narrow / EDGES_PER_HALF_WIDTH)


def concentration(exponent: float | None, alpha: float | None) -> float:
    """Return c of a lobe from a Phong exponent or a GGX roughness; by default that of `DEFAULT_EXPONENT`."""
    if exponent is not None and alpha is not None:
        raise InputError("--exponent and --roughness: only one of them may be given")
    if alpha is not None:
        if not 0 < alpha < 1:
            raise InputError(f"--roughness {alpha:g}: must be between 0 and 1")
        return ggx_concentration(alpha)
    exponent = DEFAULT_EXPONENT if exponent is None else exponent
    if not 0 < exponent <= 1e5:
        raise InputError(f"--exponent {exponent:g}: must be greater than 0 and at most 100000")
    return phong_concentration(exponent)
