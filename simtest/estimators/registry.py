"""Estimators by name: those of packages, through the entry-point group ``simtest.estimators``, and cores by command."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from simtest.calibration import Priors
from simtest.errors import Failure, InputError
from simtest.estimators.installed import ESTIMATORS
from simtest.estimators.process import is_core
from simtest.estimators.protocol import AnyEstimator, Estimate, Estimator, FrameEstimator
from simtest.geometry import Camera, Patch
from simtest.runtime.resources import shown


@dataclass(frozen=True)
class PlainCallable:
    """A function of patch and camera, the old form of an estimator, which this release still accepts."""

    function: Callable[[Patch, Camera], Estimate | Failure]

    def estimate(self, patch: Patch, camera: Camera, _priors: Priors, /) -> Estimate | Failure:
        """Call the function."""
        return self.function(patch, camera)


def as_estimator(name: str, given: object) -> AnyEstimator:
    """Return an object as an estimator; a plain callable is wrapped, with a DeprecationWarning.

    Raises
    ------
    InputError
        If it is neither an estimator nor callable, or a class where an instance is meant.
    """
    if isinstance(given, type):
        raise InputError(f"estimator {name!r}: {given.__qualname__} is a class; must be an instance of it")
    if isinstance(given, Estimator | FrameEstimator):
        return given
    if not callable(given):
        raise InputError(f"estimator {name!r}: {given!r} is not callable and has neither estimate nor estimate_frame")
    warnings.warn(
        f"estimator {name!r} is a plain callable, which 0.3.0 refuses: give it a method "
        "estimate(patch, camera, priors)", DeprecationWarning, stacklevel=3,
    )  # fmt: skip
    return PlainCallable(given)


def load_estimators(estimators: Sequence[str] | Mapping[str, object]) -> dict[str, AnyEstimator]:
    """Load estimators by name, or take those of a mapping, in the given order.

    A name is as registered, or "package:name" where two packages register it; or it is a core's
    (`simtest.estimators.process.command.parse_core`), which is started and stands under its short name.

    Raises
    ------
    InputError
        If a name is unknown, ambiguous or given twice, its package cannot be imported, an object is no estimator, or a
        core cannot be started or has the name of an installed estimator.
    """
    if isinstance(estimators, Mapping):
        return {name: as_estimator(name, given) for name, given in estimators.items()}
    loaded: dict[str, AnyEstimator] = {}
    for name in estimators:
        short = core_name(name) if is_core(name) else name
        if short in loaded:
            raise InputError(f"estimator {short!r}: given twice")
        loaded[short] = _core(name) if is_core(name) else as_estimator(name, ESTIMATORS.load(name))
    return loaded


def short_names(estimators: Iterable[str]) -> tuple[str, ...]:
    """Return the names under which estimators stand in results: those of cores shortened, all others as they are."""
    return tuple(core_name(name) if is_core(name) else name for name in estimators)


def core_name(name: str) -> str:
    """Return a core's short name.

    Raises
    ------
    InputError
        If the core's name is malformed, or it is that of an installed estimator, for which it would be taken.
    """
    from simtest.estimators.process.command import parse_core

    short = parse_core(name).name
    if short in ESTIMATORS.names():
        raise InputError(
            f"estimator {shown(name, 120)!r}: is called {short}, as an installed estimator is; name it otherwise in a "
            "TOML file (core.name)"
        )
    return short


def _core(name: str) -> AnyEstimator:
    from simtest.estimators.process.estimator import load_core

    return load_core(name)
