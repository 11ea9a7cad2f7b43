"""How much a spot looks like a highlight: a score, not a probability."""

from collections.abc import Mapping

from simtest.calibration import Frame
from simtest.detection.detector import Highlight
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry import Patch

LEAST_SCORE = 0.2
"""A spot with a smaller score has no best normal, unless its user sets another threshold."""


def highlight_score(
    patch: Patch, highlight: Highlight | None, frame: Frame, estimates: Mapping[str, Estimate | Failure]
) -> float | None:
    """Return how much a spot looks like a highlight, in [0, 1]; None where nothing tells."""
    height = patch.peak_value
    return height / (height + 10 * (patch.noise_at_peak or 0.0)) if height > 0 else None
