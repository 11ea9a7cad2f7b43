"""Figures of a certificate as text, for the terminal and the page."""

from collections.abc import Mapping, Sequence
from typing import Any

COLUMNS = ("median", "mean", "p95", "score", "answered", "refused", "missed", "coverage", "verdict", "95 % axis",
           "energy")  # fmt: skip
"""Headings of `part_cells`; errors, axis and score are in deg."""

NONE = "–"


def part_cells(told: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the figures of a part as cells of a row, in the order of `COLUMNS`."""
    uncertainty = told["uncertainty"]
    return (
        spanned(told["median_deg"], told["median_interval"]),
        degrees(told["mean_deg"]),
        degrees(told["p95_deg"]),
        spanned(told["score_deg"], told["score_interval"]),
        f"{told['answered']} of {told['n']}",
        str(sum(told["refused"].values())),
        str(told["missed"]),
        coverage(uncertainty),
        uncertainty["verdict"],
        degrees(uncertainty["semi_axis_deg"]),
        degrees(uncertainty["energy_deg"]),
    )


def degrees(value: float | None) -> str:
    """Return an angle with three significant digits, deg."""
    return NONE if value is None else f"{value:.3g}"


def spanned(value: float | None, interval: Sequence[float] | None) -> str:
    """Return a value with its interval."""
    if value is None or interval is None:
        return degrees(value)
    return f"{degrees(value)} ({degrees(interval[0])} to {degrees(interval[1])})"


def coverage(told: Mapping[str, Any]) -> str:
    """Return the coverage with its interval, %."""
    if told["coverage"] is None:
        return NONE
    low, high = told["interval"]
    return f"{100 * told['coverage']:.1f} % ({100 * low:.0f} to {100 * high:.0f}) of {told['n']}"


def refusals(parts: Mapping[str, Any]) -> list[str]:
    """Return a line for each part with refusals: how many for which reason."""
    return [
        f"{part}: refused {', '.join(f'{count} {reason}' for reason, count in told['refused'].items())}"
        for part, told in parts.items()
        if told["refused"]
    ]
