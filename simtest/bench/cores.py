"""What a certificate tells of a core: its name, its version, and hashes of its files."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from simtest.bench.suite import digest_of
from simtest.errors import InputError
from simtest.estimators import AnyEstimator, load_estimators
from simtest.estimators.installed import ESTIMATORS
from simtest.estimators.process.command import INTERPRETERS, parse_core
from simtest.estimators.process.naming import core_hashes, core_records, has_files, short_name
from simtest.runtime.files import Json, JsonObject
from simtest.runtime.resources import parse_model


def load_core(text: str) -> tuple[str, AnyEstimator]:
    """Load a core by its name or command; return it with the name that its results bear."""
    found = load_estimators([text])
    return next(iter(found.items()))


def core_record(text: str) -> JsonObject:
    """Return what a certificate tells of a core, without paths.

    `sha256` is of the core's own files and of the words of its command. An interpreter or another program of the
    machine, such as docker, is no part of it, since it differs from machine to machine: it stands under `program`.
    Modules that a script loads are seen only where the command or the TOML file (`core.files`) names them.
    """
    name, _ = load_core(text)
    if not has_files(text):
        ((_, package),) = ESTIMATORS.distributions([text]).items()
        return {"name": name, "kind": "installed", "version": package, "sha256": None}
    if parse_model(text):
        ((_, package),) = ESTIMATORS.distributions([text]).items()
        (digest,) = core_hashes([text])[text].values()
        return {"name": name, "kind": "network", "version": package, "sha256": digest}
    (record,) = core_records([text]).values()
    ((_, hashes),) = core_hashes([text]).items()
    (program, digest), *files = hashes.items()
    own = files if _is_shared(Path(program)) else [(program, digest), *files]
    # Files by name, without folders: the same core lies elsewhere on another machine.
    named: Json = sorted([Path(file).name, of_file] for file, of_file in own)
    version = record.get("version")
    return {
        "name": short_name(text), "kind": "command", "version": None if version is None else str(version),
        "sha256": digest_of({"files": named, "words": _words(parse_core(text).arguments[1:])}),
        "program": {"name": Path(program).name, "sha256": digest},
    }  # fmt: skip


def _words(arguments: Sequence[str]) -> list[str]:
    """Return the words of a command as they are on every machine: paths without their folders."""
    words = []
    for word in arguments:
        option, equals, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
        words.append(f"{option}{equals}{Path(value).name if value.startswith('/') else value}")
    return words


def _is_shared(program: Path) -> bool:
    """Return whether a program belongs to the machine, not to the core: an interpreter, or one that is on PATH."""
    found = shutil.which(program.name)
    return bool(INTERPRETERS.match(program.name)) or (found is not None and os.path.abspath(found) == str(program))


def check_core(text: str) -> None:
    """Raise `InputError` for an empty core, before anything is read."""
    if not text.strip():
        raise InputError('--core: is empty; must be an installed estimator, or a command as in "command: ./core"')
