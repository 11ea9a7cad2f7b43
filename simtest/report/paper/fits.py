"""Straight lines through means, and where the texture's window begins to cut the isophote."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.geometry.isocurves import isophote_radius

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """A least-squares line.

    Parameters
    ----------
    slope, error : float
        Slope and its standard error, from the means' standard errors; NaN where one of these is unknown.
    worst : float
        Largest distance of a mean from the line.
    """

    slope: float
    error: float
    worst: float


def line(x: Array, y: Array, error: Array | None = None) -> Line:
    """Fit a line to means by ordinary least squares; points without a finite mean are left out.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        At least two of different x.
    error : ndarray, shape (n,), optional
        Standard errors of y, independent.
    """
    known = np.isfinite(y)
    x, y = x[known], y[known]
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    slope = float(weights @ y)
    worst = float(np.abs(y - y.mean() - slope * (x - x.mean())).max())
    spread = float("nan") if error is None else float(np.sqrt(np.sum((weights * error[known]) ** 2)))
    return Line(slope, spread, worst)


def offset_inside_window(fixed: Mapping[str, Any]) -> float:
    """Give the light offset up to which the isophote's circle stays inside a window at the camera's foot.

    The BP lies at most eps V_Z / (2 V_Z - eps / 2) from the foot (the light at its lowest), and the isophote's radius
    about it is close to r-.

    Parameters
    ----------
    fixed : mapping
        `isovalue`, `exponent`, `height` and `size` of the sweep.

    Returns
    -------
    float
        Texture units.
    """
    height = float(fixed["height"])
    room = fixed["size"] / 2 - isophote_radius(fixed["isovalue"], fixed["exponent"], height)
    return max(0.0, 2 * height * room / (height + room / 2))
