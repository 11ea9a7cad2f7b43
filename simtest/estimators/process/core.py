"""Cores: how a user names one, its life with one request after the other, and the estimators that it is."""

import atexit
import errno
import itertools
import os
import re
import shlex
import shutil
import threading
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy.typing as npt
from pydantic import Field

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.process import PREFIX
from simtest.estimators.process.messages import (
    Hello,
    estimate_of,
    estimates_of,
    frame_request,
    hello_of,
    patch_request,
    shown_value,
)
from simtest.estimators.process.pipe import PROTOCOL, Child, CoreFault, Message, broken, encode, exchange_files
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch
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
    """How a core is started."""

    text: str  # as the user named it
    name: str  # of the estimator
    arguments: tuple[str, ...]  # program and arguments; those that name files are absolute
    # The program and the files that arguments name, and those of the TOML file and itself, if any.
    files: tuple[Path, ...]
    # time_limit_s, start_limit_s: for a request, and for the start.
    time_limit_s: float = TIME_LIMIT_S
    start_limit_s: float = START_LIMIT_S
    environment: tuple[str, ...] = ()  # names of environment variables that are passed on beside `PASSED`
    kind: Literal["patch", "frame"] | None = None  # what the core must be

    @property
    def short(self) -> str:
        """Name in results."""
        return self.name

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
    stated = table.model_dump(include={"name", "time_limit_s", "start_limit_s", "environment", "kind"})
    files = (*dict.fromkeys((*files, *further)), path.absolute())
    return CoreCommand(text, arguments=arguments, files=files, **stated)


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


def _program(what: str, word: str, folder: Path) -> Path:
    """Return the absolute path of a program; raise `InputError` where it is missing or cannot be run."""
    path, is_path = folder / word, "/" in word or word in (".", "..")
    # Links stay: a virtual environment's Python is one.
    if found := shutil.which(str(path) if is_path else word):
        return Path(os.path.abspath(found))
    interpreter = SCRIPTS.get(Path(word).suffix)
    called = interpreter and f'a script is called with what runs it: "{interpreter} {word!s:.80}"'
    if not is_path:
        # A directory of the name beside the user is no program, but a likely mistake.
        near = f" ({called or 'a program in this folder is named ./ and its name'})" if _exists(path) else ""
        raise InputError(f"{what}: no program {word!r:.80} on PATH{near}")
    if not _exists(path):
        raise InputError(f"{what}: {word!s:.200} does not exist; must be a program")
    if not path.is_file():
        raise InputError(f"{what}: {word!s:.200} is a {'folder' if path.is_dir() else 'device'}; must be a program")
    raise InputError(f"{what}: {word!s:.200} is not executable; must be a program ({called or 'chmod +x'})")


MAX_FAULTS = 5  # after so many faults in a row a core is not started again
KEPT_CORES = 8  # cores that are kept at once; the one that was named last stays longest


class Core:
    """A core of one command: started at need, asked one request after the other, and started again after a fault.

    After `MAX_FAULTS` faults without an answer between them it is not started any more.
    """

    def __init__(self, command: CoreCommand) -> None:
        self.command = command
        self.hello: Hello | None = None
        self._child: Child | None = None
        self._faults = 0
        self._last: CoreFault | None = None
        self.is_closed = False
        self._numbers = itertools.count(1)
        self._lock = threading.RLock()

    def start(self) -> Hello:
        """Start the core, if it does not run, and return its greeting.

        Raises `CoreFault` if it does not start, or greets otherwise than it must.
        """
        with self._lock:
            if self._child is not None and self._child.owner == os.getpid():
                assert self.hello is not None
                return self.hello
            try:
                self._child = Child.start(self.command.arguments, self.command.variables())
            except OSError as error:
                what = f"cannot be started ({error.strerror or error})"
                if error.errno == errno.ENOEXEC:
                    what += "; must be a compiled program, or a script with #! in its first line"
                raise CoreFault(Reason.CORE_DIED, what) from error
            greeting, kind = {"type": "hello", "protocol": PROTOCOL, "simtest": provenance.version()}, self.command.kind
            try:
                hello = hello_of(self._child.exchange(encode(greeting, {}), self.command.start_limit_s).header)
                if kind is not None and hello.kind != kind:
                    raise broken(f"hello: kind {hello.kind}; {self.command.text} says {kind}")
                if self.hello is not None and hello != self.hello:
                    raise broken("hello: differs from that of the first start")
            except BaseException:
                self._end()
                raise
            self.hello, self.is_closed = hello, False
            _started.add(self)
            return hello

    def ask(self, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> Message:
        """Send a request, which gets a number of its own, and return the answer to it.

        Raises `CoreFault` if the core breaks down or breaks the protocol. It has been ended then, and the next request
        starts it anew.
        """
        with self._lock:
            if self._faults >= MAX_FAULTS and self._last is not None:
                raise CoreFault(self._last.reason, f"not asked after {MAX_FAULTS} faults in a row: {self._last.detail}")
            try:
                answer = self._asked(header, arrays, next(self._numbers))
            except BaseException as error:
                if isinstance(error, CoreFault):
                    self._faults, self._last = self._faults + 1, error
                # Also at Ctrl-C in the middle of a message, of which the rest would be taken for the next answer.
                self._end()
                raise
            self._faults = 0
            return answer

    def forgive(self) -> None:
        """Count the faults from 0 again."""
        with self._lock:
            self._faults, self._last = 0, None

    def record(self) -> dict[str, object]:
        """Return what a run's record says of the core."""
        hello = self.start() if self.hello is None else self.hello
        command = self.command
        return {
            "command": command.text, "name": hello.name, "version": hello.version, "kind": hello.kind,
            "transport": hello.transport, "time_limit_s": command.time_limit_s, "files": command.hashes(),
        }  # fmt: skip

    def close(self) -> None:
        """End the core; the next request starts it again, whatever its faults were."""
        with self._lock:
            child, self._child = self._child, None
            self._faults, self._last, self.is_closed = 0, None, True
            if child is not None:
                child.close()

    def _asked(self, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], number: int) -> Message:
        hello = self.start()
        child = self._child
        assert child is not None
        child.check_silent()
        request = {"type": header["type"], "id": number, **header}
        if hello.transport == "files":
            answer = exchange_files(child, request, arrays, self.command.time_limit_s)
        else:
            answer = child.exchange(encode(request, arrays), self.command.time_limit_s)
        given, stated = answer.header.get("id"), answer.header.get("type")
        if given != number or isinstance(given, bool):
            raise broken(f"an answer with id {shown_value(given)} to request {number}")
        allowed = ("estimate" if hello.kind == "patch" else "estimates", "failure")
        if stated not in allowed:
            raise broken(f"an answer of type {shown_value(stated)}; must be {' or '.join(allowed)}")
        return answer

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.kill()


_started: "weakref.WeakSet[Core]" = weakref.WeakSet()
"""All cores of this process that were ever started; one that was closed may be started again by who holds it."""

_kept: dict[str, tuple[tuple[object, ...], Core]] = {}
"""Cores whose greeting is known, by the name that a user gives them, with what changes when their files do."""


def kept_core(text: str) -> Core:
    """Return the core of a name, which was started once at least; the same one, as long as its files are the same.

    One that was closed, as the cores of a run are at its end, greets anew: a module that its script imports may have
    changed.
    """
    command = parse_core(text)
    signature = (os.getpid(), *command.signature())
    before, core = _kept.pop(text, ((), None))
    if core is None or before != signature or core.is_closed:
        if core is not None:
            core.close()
        core = Core(command)
        try:
            core.start()
        except CoreFault as fault:
            raise InputError(f"estimator {text!r:.120}: {fault.detail}") from fault
    # The last used one stands last.
    _kept[text] = signature, core
    while len(_kept) > KEPT_CORES:
        _kept.pop(next(iter(_kept)))[1].close()
    return core


@atexit.register
def close_cores() -> None:
    """End all cores of this process; those that are asked again are started again."""
    for core in list(_started):
        core.close()


def forgive_cores() -> None:
    """Count the faults of all cores of this process from 0 again."""
    for core in list(_started):
        core.forgive()


@dataclass(frozen=True)
class _Process:
    """What both kinds share."""

    core: Core = field(repr=False)  # started once at least, so that its greeting is known

    def _answer(self, request: tuple[Mapping[str, Any], Mapping[str, npt.NDArray[Any]]]) -> Message | Failure:
        try:
            return self.core.ask(*request)
        except CoreFault as fault:
            return Failure(fault.reason, fault.detail)

    @property
    def description(self) -> str:
        """What the core is, in one line for a reader who chooses an estimator."""
        hello = self._hello
        version = f" {hello.version}" if hello.version else ""
        return f"A core of its own process: {hello.name}{version}, {self.core.command.text}."

    @property
    def _hello(self) -> Hello:
        assert self.core.hello is not None
        return self.core.hello


@dataclass(frozen=True)
class ProcessEstimator(_Process):
    """A core that takes single highlights."""

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Ask the core (see `simtest.estimators.Estimator`); its breakdown is a Failure ``core_...``."""
        answer = self._answer(patch_request(patch, camera, priors, self._hello))
        return answer if isinstance(answer, Failure) else estimate_of(answer, camera, self._hello)


@dataclass(frozen=True)
class ProcessFrameEstimator(_Process):
    """A core that takes whole frames."""

    def estimate_frame(
        self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS
    ) -> list[Estimate | Failure] | Failure:
        """Ask the core (see `simtest.estimators.FrameEstimator`); its breakdown is a Failure ``core_...``."""
        answer = self._answer(frame_request(frame, camera, priors, self._hello))
        return answer if isinstance(answer, Failure) else estimates_of(answer, camera, self._hello)


def load_core(text: str) -> ProcessEstimator | ProcessFrameEstimator:
    """Start a core, if it does not run in this process already, and return it as an estimator."""
    core = kept_core(text)
    assert core.hello is not None
    return ProcessEstimator(core) if core.hello.kind == "patch" else ProcessFrameEstimator(core)
