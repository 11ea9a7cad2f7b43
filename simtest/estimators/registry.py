"""Finds estimators by name, those of other packages too, through the entry-point group ``simtest.estimators``."""

from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points

from simtest.errors import InputError
from simtest.estimators.protocol import Estimator

GROUP = "simtest.estimators"


def _entry_points() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def available() -> list[str]:
    """List the names of all installed estimators, sorted."""
    return sorted(_entry_points())


def load_estimators(names: Sequence[str]) -> dict[str, Estimator]:
    """Load estimators.

    Parameters
    ----------
    names : sequence of str
        As registered.

    Returns
    -------
    dict
        Estimator by name, in the order asked for.

    Raises
    ------
    InputError
        If a name is unknown, given twice, or its package cannot be imported.
    """
    points = _entry_points()
    loaded: dict[str, Estimator] = {}
    for name in names:
        if name not in points:
            raise InputError(f"estimator {name!r}: not installed; allowed: {', '.join(sorted(points))}")
        if name in loaded:
            raise InputError(f"estimator {name!r}: given twice")
        try:
            estimator = points[name].load()
        except Exception as error:
            raise InputError(f"estimator {name!r}: {points[name].value} cannot be imported ({error})") from error
        if not callable(estimator):
            raise InputError(f"estimator {name!r}: {points[name].value} is not callable")
        loaded[name] = estimator
    return loaded


def distributions(names: Sequence[str]) -> dict[str, str]:
    """Give the package and version that each estimator comes from, by "estimator NAME"."""
    points = _entry_points()
    found = {name: points[name].dist for name in names if name in points}
    return {f"estimator {name}": f"{dist.name} {dist.version}" if dist else "" for name, dist in found.items()}
