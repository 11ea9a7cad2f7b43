"""Linear RGB values as the active variant holds them."""

from collections.abc import Sequence
from typing import Any


def channels(mi: Any) -> int:
    """Give the number of channels of the variant: 1 or 3."""
    return 3 if mi.Spectrum is mi.Color3f else 1


def spectrum(mi: Any, colour: Sequence[float]) -> Any:
    """Give three linear RGB values as Mitsuba takes them: as they are, or in mono variants their luminance."""
    if channels(mi) == 3:
        return mi.Color3f(*colour)
    return float(mi.luminance(mi.ScalarColor3f(*colour))[0])
