"""The networks that are compared, each trained twice: on smooth surfaces and on tissue."""

from collections.abc import Mapping
from pathlib import Path

from simtest.detection.colour import ColourDetector
from simtest.detection.detector import Detector
from simtest.estimators import AnyEstimator, load_estimators

SMOOTH, TISSUE = "smooth", "tissue"
TAUGHT = (SMOOTH, TISSUE)
"""What the two networks of a task were taught."""

CLASSICAL, COLOUR = ("bisector", "cloud"), "colour"

Pair = tuple[Path, Path]
"""Files of a task's network taught on smooth surfaces, and on tissue."""


def named(task: str, taught: str) -> str:
    """Return a network's name in tables."""
    return f"{task}, {taught}"


def estimators(spots: Pair | None, dense: Pair | None) -> Mapping[str, AnyEstimator]:
    """Return the networks that state normals, and the classical estimators beside them."""
    made: dict[str, AnyEstimator] = {}
    if spots:
        from simtest.estimators.learned_spot import LearnedSpot

        made |= {named("learned_spot", name): LearnedSpot(file) for name, file in zip(TAUGHT, spots, strict=True)}
    if dense:
        from simtest.estimators.learned_dense import LearnedDense

        made |= {named("learned_dense", name): LearnedDense(file) for name, file in zip(TAUGHT, dense, strict=True)}
    return {**made, **load_estimators(list(CLASSICAL))}


def detectors(files: Pair | None) -> Mapping[str, Detector]:
    """Return the networks that find highlights, and the classical detector beside them."""
    made: dict[str, Detector] = {}
    if files:
        from simtest.detection.learned_detector import LearnedDetector

        pairs = zip(TAUGHT, files, strict=True)
        made |= {named("learned_detector", name): LearnedDetector(file) for name, file in pairs}
    return {**made, COLOUR: ColourDetector(isolated=False)}
