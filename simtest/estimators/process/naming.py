"""Names of estimators with files of the user's own, cores and networks: in results, in records, in other processes."""

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING

from simtest.errors import InputError
from simtest.estimators.installed import ESTIMATORS
from simtest.estimators.process import is_core
from simtest.runtime.resources import parse_model

if TYPE_CHECKING:
    from simtest.estimators.process.command import CoreCommand


def short_names(estimators: Iterable[str]) -> tuple[str, ...]:
    """Return the names under which estimators stand in results: those with files shortened, all others as they are."""
    return tuple(short_name(name) if has_files(name) else name for name in estimators)


def has_files(name: str) -> bool:
    """Return whether an estimator's name is that of a core, or names a network's file."""
    return is_core(name) or parse_model(name) is not None


def short_name(name: str) -> str:
    """Return the short name of a core, or of an estimator with a network's file."""
    model = parse_model(name)
    short = _parsed(name).name if model is None else model.short
    if short in ESTIMATORS.names():
        how = "in a TOML file (core.name)" if model is None else "by its file"
        raise InputError(
            f"estimator {name!r}: is called {short}, as an installed estimator is; name it otherwise {how}"
        )
    return short


def absolute_names(estimators: Iterable[str]) -> tuple[str, ...]:
    """Return names that mean the same estimators in a process with another current folder."""
    return tuple(_absolute(name) for name in estimators)


def _absolute(name: str) -> str:
    if model := parse_model(name):
        return model.absolute
    return _parsed(name).absolute if is_core(name) else name


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
    return {name: (parse_model(name) or _parsed(name)).hashes() for name in estimators if has_files(name)}


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
