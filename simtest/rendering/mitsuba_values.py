"""Values as Mitsuba takes them: descriptions for `mi.load_dict`, and colours of the active variant."""

from collections.abc import Sequence
from typing import Any

MitsubaDict = dict[str, Any]
"""What `mi.load_dict` takes, or values by Mitsuba's parameter path: text, numbers and Mitsuba's own objects, nested."""


def channels(mi: Any) -> int:
    """Return the number of channels of the variant: 1 or 3."""
    return 3 if mi.Spectrum is mi.Color3f else 1


def spectrum(mi: Any, colour: Sequence[float]) -> Any:
    """Return three linear RGB values as they are, or in mono variants their luminance."""
    if channels(mi) == 3:
        return mi.Color3f(*colour)
    return float(mi.luminance(mi.ScalarColor3f(*colour))[0])
