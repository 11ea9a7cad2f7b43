"""The names of cores among those of estimators: in results, in records, and in other processes."""

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING

from simtest.errors import InputError
from simtest.estimators.installed import ESTIMATORS
from simtest.estimators.process import is_core
from simtest.runtime.resources import shown

if TYPE_CHECKING:
    from simtest.estimators.process.command import CoreCommand


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
    short = _parsed(name).name
    if short in ESTIMATORS.names():
        raise InputError(
            f"estimator {shown(name, 120)!r}: is called {short}, as an installed estimator is; name it otherwise in a "
            "TOML file (core.name)"
        )
    return short


def absolute_names(estimators: Iterable[str]) -> tuple[str, ...]:
    """Return names that mean the same estimators in a process with another current folder."""
    return tuple(_parsed(name).absolute if is_core(name) else name for name in estimators)


def core_records(estimators: Iterable[str]) -> dict[str, dict[str, object]]:
    """Return what a run's record says of the cores among estimators: command, greeting and files, by short name."""
    from simtest.estimators.process.core import kept_core

    return {core_name(name): kept_core(name).record() for name in estimators if is_core(name)}


def core_hashes(estimators: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the SHA-256 of the files of the cores among estimators, by name and path."""
    return {name: _parsed(name).hashes() for name in estimators if is_core(name)}


def close_cores() -> None:
    """End the processes of all cores that this process has started; those that are asked again start again."""
    # Where no core was named the module is not even loaded.
    if loaded := sys.modules.get("simtest.estimators.process.core"):
        loaded.close_cores()


def forgive_cores() -> None:
    """Count the faults of all cores from 0 again, so that no part of a run depends on those before it."""
    if loaded := sys.modules.get("simtest.estimators.process.core"):
        loaded.forgive_cores()


def _parsed(name: str) -> "CoreCommand":
    """Return the command of a core; what reads it is imported at need, since few runs name one."""
    from simtest.estimators.process.command import parse_core

    return parse_core(name)
