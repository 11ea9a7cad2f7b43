"""What each estimator does, in one line for a reader who chooses one."""

import inspect
import sys
from collections.abc import Sequence

from simtest.runtime.resources import OWN

DESCRIPTIONS: dict[str, str] = {
    "cone_axis": "The axis of the cone from the camera through the highlight's isophotes, averaged over several.",
    "circle_pose": "The published method: takes one isophote for a circle and solves for its pose; two candidates.",
    "brightest_point": "The line of sight through the brightest pixel.",
    "bisector": "The cone's axis, corrected for a light beside the camera whose position is known.",
    "curved": "The centre of the isophotes carries the normal, their shape the surface's curvature.",
    "photometric": "A fit of the reflectance model to all pixels of the highlight.",
    "inverse_rendering": "A curved patch, rendered and adjusted until it looks like the highlight.",
    "cloud": "The normal of the base surface, from the cloud of glints that its relief makes of one highlight.",
    "learned_dense": "The normal of the base surface at each highlight, by a network of the whole frame; lights told.",
    "learned_spot": "The normal of the base surface at each highlight, by a small network; needs the lights told.",
}
"""Of this package's estimators, by name: in pages, `simtest list`, completion and the reference."""


def is_own(name: str) -> bool:
    """Whether an estimator of that name, maybe with its package's, is one of this package."""
    return name.removeprefix(f"{OWN}:") in DESCRIPTIONS


def describe_estimators(names: Sequence[str]) -> dict[str, str]:
    """Describe estimators by name: this package's own, and others by the first line of their docstring.

    A foreign estimator is imported, as a run has done anyway; one without a docstring has an empty description. A core
    stands under its short name.
    """
    from simtest.estimators.registry import load_estimators

    described = {}
    for name in names:
        if own := DESCRIPTIONS.get(name.removeprefix(f"{OWN}:")):
            described[name] = own
        else:
            described |= {short: _described(given) for short, given in load_estimators([name]).items()}
    return described


def _described(estimator: object) -> str:
    """Return what an estimator says of itself: its description, where it has one, else its docstring's first line."""
    stated = getattr(estimator, "description", None)
    return stated if isinstance(stated, str) else _first_line(estimator)


def _first_line(estimator: object) -> str:
    """Return the first line of an estimator's own docstring, of a wrapped function that function's, or the module's."""
    given = getattr(estimator, "function", estimator)
    # An instance without a docstring of its own has its class's; `inspect.getdoc` would go on to object's.
    own = given.__doc__ if inspect.isroutine(given) else type(given).__doc__
    # Without either, the module's, as `simtest list` prints it.
    own = own or getattr(sys.modules.get(getattr(given, "__module__", "")), "__doc__", None)
    return (inspect.cleandoc(own).splitlines() or [""])[0] if own else ""
