"""Straight lines through means, and where the texture's window begins to cut the isophote."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from simtest.report.paper.sweeps import Value
from simtest.runtime.arrays import Array
from simtest.validation.paper.isocurves import isophote_radius


class Line(NamedTuple):
    """A least-squares line."""

    slope: float
    error: float  # standard error of the slope, from the means'; NaN where one of these is unknown
    worst: float  # largest distance of a mean from the line


def line(x: Array, y: Array, error: Array | None = None) -> Line:
    """Fit a line to means at two x or more by ordinary least squares; `error` are their standard errors, independent.

    Points without a finite mean are left out.
    """
    known = np.isfinite(y)
    x, y = x[known], y[known]
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    slope = float(weights @ y)
    worst = float(np.abs(y - y.mean() - slope * (x - x.mean())).max())
    spread = float("nan") if error is None else float(np.sqrt(np.sum((weights * error[known]) ** 2)))
    return Line(slope, spread, worst)


def offset_inside_window(fixed: Mapping[str, Value]) -> float:
    """Return the light offset, texture units, up to which the isophote stays inside a window at the camera's foot.

    `fixed` are the sweep's parameters: isovalue, exponent, height and size. The BP lies at most
    eps V_Z / (2 V_Z - eps / 2) from the foot (the light at its lowest), and the isophote's radius about it is close to
    r-.
    """
    isovalue, exponent, height, size = (float(fixed[name] or 0) for name in ("isovalue", "exponent", "height", "size"))
    room = size / 2 - isophote_radius(isovalue, exponent, height)
    return max(0.0, 2 * height * room / (height + room / 2))
