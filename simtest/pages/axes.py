"""Axes of charts: scales, ranges and ticks, the same in both media."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array

Tick = tuple[float, str]
_STRETCH = 0.01
_STRETCHED_TICKS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Axis:
    """An axis of a panel.

    The scale "stretched" is asinh(x / 0.01), near-logarithmic on both sides of zero; both media draw at `to_axis(x)`.
    """

    title: str  # name and unit
    scale: Literal["linear", "log", "stretched"] = "linear"
    limits: tuple[float, float] | None = None  # ends in data units; default: from the marks
    named: tuple[Tick, ...] | None = None  # ticks with their texts, empty for none; default: by the scale

    def to_axis(self, values: npt.ArrayLike) -> Array:
        """Return the drawing coordinates of data values, same shape."""
        data = np.asarray(values, dtype=float)
        return np.arcsinh(data / _STRETCH) if self.scale == "stretched" else data

    def from_axis(self, coordinates: npt.ArrayLike) -> Array:
        """Return the data values at drawing coordinates, same shape."""
        data = np.asarray(coordinates, dtype=float)
        return np.sinh(data) * _STRETCH if self.scale == "stretched" else data

    def visible(self, values: Array) -> Array:
        """Return the values that the axis can show; NaN for the others."""
        return np.where(values > 0, values, np.nan) if self.scale == "log" else values

    def ends(self, values: Iterable[npt.ArrayLike]) -> tuple[float, float]:
        """Return the ends of the axis in drawing coordinates: its limits, or those of the values with a margin."""
        if self.limits:
            return self.limits
        shown = finite(self.visible(finite(values)))
        if not shown.size:
            return (0.1, 1.0) if self.scale == "log" else (0.0, 1.0)
        low, high = (float(v) for v in self.to_axis([shown.min(), shown.max()]))
        if self.scale == "log":
            return low / 1.3, high * 1.3
        margin = 0.05 * (high - low or 1.0)
        return low - margin, high + margin

    def ticks(self, low: float, high: float) -> list[Tick] | None:
        """Return ticks between two ends, drawing coordinates first; None leaves them to the medium."""
        if self.named is not None:
            return list(self.named)
        if self.scale == "linear":
            return None
        if self.scale == "log":
            # Values between the powers of ten are named where there are few powers.
            digits = (1, 2, 5) if high < 100 * low else (1,)
            values = [float(f"{digit}e{power}") for power in range(-9, 10) for digit in digits]
            return [(value, _power(value)) for value in values if low <= value <= high]
        values = [*(-tick for tick in reversed(_STRETCHED_TICKS)), 0.0, *_STRETCHED_TICKS]
        ticks = [(float(self.to_axis(value)), f"{value:g}".replace("-", "−")) for value in values]
        return [(at, text) for at, text in ticks if low <= at <= high]

    def minor_ticks(self, low: float, high: float) -> list[float]:
        """Return ticks without texts between those of a log axis."""
        if self.scale != "log" or self.named is not None:
            return []
        values = [digit * 10.0**power for power in range(-9, 10) for digit in range(2, 10)]
        return [value for value in values if low <= value <= high]


def _power(value: float) -> str:
    """Write a tick of a log axis: very small and very large ones as powers of ten."""
    if 1e-4 < value < 1e5:
        return f"{value:g}"
    digit, power = f"{value:.0e}".split("e")
    return ("" if digit == "1" else f"{digit}·") + "10" + str(int(power)).translate(_SUPERSCRIPTS)


def even_ticks(low: float, high: float, most: int) -> list[Tick]:
    """Return ticks of a linear axis at multiples of 1, 2, 2.5 or 5 times a power of ten, with at most so many gaps."""
    low, high = min(low, high), max(low, high)
    if not high > low:
        return [(low, f"{low:g}")]
    least = (high - low) / max(most, 1)
    power = 10.0 ** np.floor(np.log10(least))
    step = next(factor * power for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if factor * power >= least * (1 - 1e-9))
    first, last = np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6)
    values = [float(number) * step + 0.0 for number in np.arange(first, last + 1)]  # not -0
    # As many decimals as tell neighbours apart.
    decimals = next((n for n in range(9) if abs(step * 10**n - round(step * 10**n)) < 1e-6 * step * 10**n), None)
    if decimals is None or max(map(abs, values), default=0.0) >= 1e6:
        return [(value, f"{value:.6g}") for value in values]
    return [(value, f"{value:.{decimals}f}") for value in values]


def finite(values: Iterable[npt.ArrayLike]) -> Array:
    """Return the finite values of several arrays, flattened."""
    parts = [np.asarray(part, dtype=float).ravel() for part in values]
    data = np.concatenate(parts) if parts else np.empty(0)
    return data[np.isfinite(data)]


def log_range(arrays: Sequence[npt.ArrayLike]) -> tuple[float, float]:
    """Return a range for a logarithmic axis from the positive values, with a margin; laws may leave it."""
    values = finite(arrays)
    values = values[values > 0]
    if not values.size:
        return 0.1, 100.0
    return float(values.min()) / 1.6, float(values.max()) * 1.6


def curvature_axis(values: npt.ArrayLike, title: str) -> Axis:
    """Return the axis for curvature: stretched where the values span more than a factor of ten, else linear.

    The smallest twentieth and the largest do not count: among the many highlights of anatomies there are always some.
    """
    size = np.abs(finite([values]))
    size = size[size > 1e-9]
    wide = size.size > 1 and np.quantile(size, 0.95) / np.quantile(size, 0.05) > 10
    return Axis(title, "stretched" if wide else "linear")
