"""The networks that are compared, each trained twice: on smooth surfaces and on tissue."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from simtest.estimators import AnyEstimator, load_estimators

SMOOTH, TISSUE = "smooth", "tissue"
TAUGHT = (SMOOTH, TISSUE)
"""What the two networks of a task were taught."""

CLASSICAL = ("bisector", "cloud")

Files = Sequence[Path]
"""Files of a task's network taught on smooth surfaces, and on tissue; one file is that of tissue."""


def named(task: str, taught: str) -> str:
    """Return a network's name in tables."""
    return f"{task}, {taught}"


def _taught(files: Files) -> Mapping[str, Path]:
    """Return the files by what their networks were taught."""
    return dict(zip(TAUGHT[-len(files) :], files, strict=True))


def estimators(spots: Files | None, dense: Files | None) -> Mapping[str, AnyEstimator]:
    """Return the networks that state normals, and the classical estimators beside them."""
    made: dict[str, AnyEstimator] = {}
    if spots:
        from simtest.estimators.learned_spot import LearnedSpot

        made |= {named("learned_spot", name): LearnedSpot(file) for name, file in _taught(spots).items()}
    if dense:
        from simtest.estimators.learned_dense import LearnedDense

        made |= {named("learned_dense", name): LearnedDense(file) for name, file in _taught(dense).items()}
    return {**made, **load_estimators(list(CLASSICAL))}
