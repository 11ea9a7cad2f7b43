"""A core as a user names it: a command, or a TOML file that describes one."""

import os
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from simtest.errors import InputError
from simtest.estimators.process import PREFIX
from simtest.runtime import provenance
from simtest.spec.spec_model import Spec, validate
from simtest.spec.toml_files import read_toml

TIME_LIMIT_S = 10.0
START_LIMIT_S = 60.0

PASSED = ("PATH", "HOME", "LANG", "LD_LIBRARY_PATH")
"""Environment variables that every core sees, beside the locale (LC_*), TMPDIR and the numbers of threads."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")

INTERPRETERS = re.compile(r"(python|pypy|octave|matlab|julia|java|node|ruby|perl|Rscript|bash|sh|env)([-0-9.]|$)")
"""Names of programs that run a file, by how they begin."""

SCRIPTS = {".py": "python", ".m": "octave-cli", ".jl": "julia", ".js": "node", ".R": "Rscript", ".sh": "bash"}
"""What runs a script, by the end of its name."""

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}$"


class CoreTable(Spec):
    """The table ``core`` of a core's TOML file."""

    name: str = Field(pattern=_NAME, description="name in results, in tables and on pages")
    command: str = Field(min_length=1, max_length=4096, description="program and arguments, as in a shell")
    time_limit_s: float = Field(TIME_LIMIT_S, ge=0.01, le=3600, description="for each request, s")
    start_limit_s: float = Field(START_LIMIT_S, ge=0.01, le=3600, description="from the start to the greeting, s")
    environment: tuple[str, ...] = Field((), description="names of further environment variables that it sees")
    kind: Literal["patch", "frame"] | None = Field(None, description="what its greeting must say that it takes")
    files: tuple[str, ...] = Field((), max_length=1000, description="further files it reads: modules, weights")


class CoreFile(Spec):
    """A core's TOML file."""

    core: CoreTable


@dataclass(frozen=True)
class CoreCommand:
    """How a core is started.

    Parameters
    ----------
    text : str
        As the user named it.
    name : str
        Of the estimator.
    arguments : tuple of str
        Program and arguments; those that name files are absolute.
    files : tuple of Path
        The program and the files that arguments name, and those of the TOML file and itself, if any.
    time_limit_s, start_limit_s : float
        For a request, and for the start.
    environment : tuple of str
        Names of environment variables that are passed on beside `PASSED`.
    kind : {"patch", "frame"}, optional
        What the core must be.
    """

    text: str
    name: str
    arguments: tuple[str, ...]
    files: tuple[Path, ...]
    time_limit_s: float = TIME_LIMIT_S
    start_limit_s: float = START_LIMIT_S
    environment: tuple[str, ...] = ()
    kind: Literal["patch", "frame"] | None = None

    @property
    def absolute(self) -> str:
        """The same core under a name that means the same in every folder."""
        if not self.text.startswith(PREFIX):
            return str(self.files[-1])
        # A program that is found on PATH stays one, since the core's name depends on it.
        program = shlex.split(self.text.removeprefix(PREFIX))[0]
        return f"{PREFIX} {shlex.join((program if '/' not in program else self.arguments[0], *self.arguments[1:]))}"

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of each of the files, by path."""
        return {str(file): provenance.file_hash(file) for file in self.files}

    def signature(self) -> tuple[object, ...]:
        """Return what changes when one of the files does, found without reading them."""
        found = (file.stat() for file in self.files)
        return (self, *((each.st_ino, each.st_size, each.st_mtime_ns) for each in found))

    def variables(self) -> dict[str, str]:
        """Return the core's environment, without TMPDIR."""
        names = (*PASSED, *THREADS, *self.environment, *(name for name in os.environ if name.startswith("LC_")))
        passed = {name: os.environ[name] for name in names if name in os.environ}
        # A worker's share of the cores.
        share = os.environ.get("SIMTEST_THREADS")
        return {name: share for name in THREADS if share} | passed


def parse_core(text: str) -> CoreCommand:
    """Read a core's name: ``command: PROGRAM ARGUMENT...``, or the path of a TOML file with a table ``core``.

    Arguments that name existing files become absolute. Relative ones are looked for in the current folder; those of a
    TOML file in that file's folder.
    """
    if text.startswith(PREFIX):
        arguments, files, name = _resolved(text, text.removeprefix(PREFIX), Path.cwd())
        return CoreCommand(text, name, arguments, files)
    path = Path(text)
    table = validate(CoreFile, read_toml(path), str(path)).core
    folder = path.absolute().parent
    arguments, files, _ = _resolved(f"{text}: core.command", table.command, folder)
    further = tuple(_further(text, folder, name) for name in table.files)
    return CoreCommand(
        text, table.name, arguments, (*dict.fromkeys((*files, *further)), path.absolute()), table.time_limit_s,
        table.start_limit_s, table.environment, table.kind,
    )  # fmt: skip


def _further(text: str, folder: Path, name: str) -> Path:
    """Return the absolute path of a file that a TOML file lists; raise `InputError` where it is none."""
    file = Path(os.path.normpath(folder / name))
    if not _exists(file) or not file.is_file():
        raise InputError(f"{text}: core.files: {name} is no file in {folder}; must be a file")
    return file


def _resolved(text: str, command: str, folder: Path) -> tuple[tuple[str, ...], tuple[Path, ...], str]:
    """Return a command's absolute arguments, the files among them, and the name that they give it."""
    what = f"estimator {text!r:.120}"
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"{what}: cannot be split into words ({error})") from None
    if not words or not words[0]:
        raise InputError(f"{what}: names no program; must be {PREFIX!r}, a program and its arguments")
    if "\0" in command:
        raise InputError(f"{what}: holds a zero byte; must be text")
    program = _program(what, words[0], folder)
    arguments, files = [str(program)], [program]
    for word in words[1:]:
        option, equals, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
        found = folder / value if value and _exists(folder / value) else None
        arguments.append(word if found is None else f"{option}{equals}{os.path.normpath(found)}")
        if found is not None and found.is_file():
            files.append(Path(os.path.normpath(found)))
    named = [file for file in files[1:] if str(file) in arguments]
    # A program of the user's own has a name; what runs a script has that of the script.
    source = named[0] if named and ("/" not in words[0] or INTERPRETERS.match(program.name)) else program
    name = re.sub("[^A-Za-z0-9_.-]+", "_", source.stem).lstrip("_.-")[:40]
    return tuple(arguments), tuple(dict.fromkeys(files)), name or "core"


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        # Longer than a name may be, for one: then it names no file.
        return False


def _called(word: str) -> str:
    """Return how a script is called; nothing if its name does not tell what runs it."""
    interpreter = SCRIPTS.get(Path(word).suffix)
    return f'a script is called with what runs it: "{interpreter} {word!s:.80}"' if interpreter else ""


def _program(what: str, word: str, folder: Path) -> Path:
    """Return the absolute path of a program; raise `InputError` where it is missing or cannot be run."""
    if word in (".", ".."):
        raise InputError(f"{what}: {word} is a folder; must be a program")
    if "/" not in word:
        found = shutil.which(word)
        # A directory of the name beside the user is no program, but a likely mistake.
        if found is None:
            near = (
                ""
                if not _exists(folder / word)
                else _called(word) or "a program in this folder is named ./ and its name"
            )
            raise InputError(f"{what}: no program {word!r:.80} on PATH{f' ({near})' if near else ''}")
        return Path(os.path.abspath(found))
    path = folder / word
    if not _exists(path):
        raise InputError(f"{what}: {word!s:.200} does not exist; must be a program")
    if not path.is_file():
        raise InputError(f"{what}: {word!s:.200} is a {'folder' if path.is_dir() else 'device'}; must be a program")
    if not os.access(path, os.X_OK):
        raise InputError(f"{what}: {word!s:.200} is not executable; must be a program ({_called(word) or 'chmod +x'})")
    # Links stay: a virtual environment's Python is one.
    return Path(os.path.normpath(path))
