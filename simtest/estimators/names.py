"""Estimators by name: installed ones, cores, and networks of the user's own; in results, records, other processes.

Names, packages and descriptions of installed estimators (entry-point group ``simtest.estimators``) are asked for
without loading any.
"""

import inspect
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from simtest.errors import InputError
from simtest.estimators.process import is_core
from simtest.runtime.resources import OWN, SUFFIX, EntryPointGroup, ModelName, parse_model

if TYPE_CHECKING:
    from simtest.estimators.process.core import CoreCommand
    from simtest.estimators.protocol import AnyEstimator


def short_names(estimators: Iterable[str]) -> tuple[str, ...]:
    """Return the names under which estimators stand in results: those with files shortened, all others as they are."""
    return tuple(short_name(name) if has_files(name) else name for name in estimators)


def has_files(name: str) -> bool:
    """Return whether an estimator's name is that of a core, or names a network's file."""
    return is_core(name) or parse_model(name) is not None


def _with_files(name: str) -> "ModelName | CoreCommand | None":
    """Return the network or core of a name, None of all others; what reads a core's is imported at need."""
    if (model := parse_model(name)) or not is_core(name):
        return model
    from simtest.estimators.process.core import parse_core

    return parse_core(name)


def short_name(name: str) -> str:
    """Return the short name of a core, or of an estimator with a network's file."""
    own = _with_files(name)
    short = name if own is None else own.short
    if short in ESTIMATORS.names():
        how = "in a TOML file (core.name)" if is_core(name) else "by its file"
        raise InputError(
            f"estimator {name!r}: is called {short}, as an installed estimator is; name it otherwise {how}"
        )
    return short


def absolute_names(estimators: Iterable[str]) -> tuple[str, ...]:
    """Return names that mean the same estimators in a process with another current folder."""
    return tuple(name if (own := _with_files(name)) is None else own.absolute for name in estimators)


def core_records(estimators: Iterable[str]) -> dict[str, dict[str, object]]:
    """Return what a run's record says of cores and networks among estimators, by short name.

    Of a core it is command, greeting and files, of a network its name and file.
    """
    from simtest.estimators.process.core import kept_core

    made: dict[str, dict[str, object]] = {}
    for name in estimators:
        if model := parse_model(name):
            made[short_name(name)] = {"name": model.short, "kind": "network", "files": model.hashes()}
        elif is_core(name):
            made[short_name(name)] = kept_core(name).record()
    return made


def core_hashes(estimators: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the SHA-256 of the files of cores and networks among estimators, by name and path."""
    return {name: own.hashes() for name in estimators if (own := _with_files(name)) is not None}


def close_cores() -> None:
    """End the processes of all cores that this process has started; those that are asked again start again."""
    # Where no core was named the module is not even loaded.
    if loaded := sys.modules.get("simtest.estimators.process.core"):
        loaded.close_cores()


def forgive_cores() -> None:
    """Count the faults of all cores from 0 again, so that no part of a run depends on those before it."""
    if loaded := sys.modules.get("simtest.estimators.process.core"):
        loaded.forgive_cores()


ESTIMATORS = EntryPointGroup("simtest.estimators", "estimator")

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
    described = {}
    for name in names:
        if own := DESCRIPTIONS.get(name.removeprefix(f"{OWN}:")):
            described[name] = own
        else:
            described |= {short: _described(given) for short, given in load_estimators([name]).items()}
    return described


def _described(estimator: object) -> str:
    """Return what an estimator says of itself: its description, or the first line of the docstring that it has.

    Of a wrapped function that is the function's; of all without one the module's.
    """
    if isinstance(stated := getattr(estimator, "description", None), str):
        return stated
    given = getattr(estimator, "function", estimator)
    # An instance without a docstring of its own has its class's; `inspect.getdoc` would go on to object's.
    own = given.__doc__ if inspect.isroutine(given) else type(given).__doc__
    # Without either, the module's, as `simtest list` prints it.
    own = own or getattr(sys.modules.get(getattr(given, "__module__", "")), "__doc__", None)
    return (inspect.cleandoc(own).splitlines() or [""])[0] if own else ""


def as_estimator(name: str, given: object) -> "AnyEstimator":
    """Return an object as an estimator; raise `InputError` if it is none, or a class where an instance is meant."""
    from simtest.estimators.protocol import Estimator, FrameEstimator, RegionEstimator

    if isinstance(given, type):
        raise InputError(f"estimator {name!r}: {given.__qualname__} is a class; must be an instance of it")
    if isinstance(given, Estimator | FrameEstimator | RegionEstimator):
        return given
    raise InputError(
        f"estimator {name!r}: {given!r:.80} has neither estimate(patch, camera, priors) nor "
        "estimate_frame(frame, camera, priors)"
    )


def load_estimators(estimators: Sequence[str] | Mapping[str, object]) -> "dict[str, AnyEstimator]":
    """Load estimators by name, or take those of a mapping, in the given order.

    A name is as registered, or "package:name" where two packages register it; or it is a core's
    (`simtest.estimators.process.core.parse_core`), which is started, or that of a network of the user's own
    ("learned_spot:FILE.onnx", `simtest.runtime.resources`), which is read. Both stand under their short names.

    Raises
    ------
    InputError
        If a name is unknown, ambiguous or given twice, its package cannot be imported, an object is no estimator, a
        core cannot be started, a network cannot be used, or either has the name of an installed estimator.
    """
    if isinstance(estimators, Mapping):
        return {name: as_estimator(name, given) for name, given in estimators.items()}
    loaded: dict[str, AnyEstimator] = {}
    given: object
    for name in estimators:
        if is_core(name):
            # Imported at need, since few runs name one.
            from simtest.estimators.process.core import load_core

            short, given = short_name(name), load_core(name)
        elif parse_model(name):
            # Loaded first: an unknown estimator is told before the name that its results would bear.
            given, short = ESTIMATORS.load(name), short_name(name)
        else:
            short, given = name, _installed(name)
        if short in loaded:
            raise InputError(f"estimator {short!r}: given twice")
        loaded[short] = as_estimator(name, given)
    return loaded


def _installed(name: str) -> object:
    """Return an estimator by its registered name; errors say what else the name may have meant."""
    if "," in name:
        each = " ".join(f"--estimator {part.strip()}" for part in name.split(","))
        raise InputError(f"estimator {name!r}: one name each; several are given as {each}")
    if name.endswith(SUFFIX):
        raise InputError(
            f"estimator {name!r}: is no estimator's name; a network stands behind what runs it, as in "
            f"learned_spot:{Path(name)}"
        )
    if " " in name.strip() or "/" in name:
        raise InputError(f"estimator {name!r}: is no estimator's name; a program of yours needs 'command: ' before it")
    try:
        return ESTIMATORS.load(name)
    except InputError as error:
        if name in ESTIMATORS.names() or not Path(name).is_file():
            raise
        how = f"python {name}" if name.endswith(".py") else f"./{name}"
        raise InputError(f"{error}; the file {name} is run by 'command: {how}'") from error
