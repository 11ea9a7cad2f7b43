"""A core: its greeting, its requests, and what becomes of it when it breaks down."""

import atexit
import errno
import itertools
import os
import threading
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy.typing as npt

from simtest.errors import InputError, Reason
from simtest.estimators.process import files
from simtest.estimators.process.child import Child
from simtest.estimators.process.command import CoreCommand, parse_core
from simtest.estimators.process.wire import PROTOCOL, CoreFault, Message, broken, encode, excerpt
from simtest.runtime import provenance

PATCH_ARRAYS = ("values", "raw", "noise", "saturated", "seen", "rays")
FRAME_ARRAYS = ("encoded", "channels", "intensity", "smoothed", "noise", "clipped", "seen", "rays")
OUTLINES = ("isophote_", "isophote_rays_")
"""Names of the arrays of an isovalue, without it."""

MAX_ISOPHOTES = 16
MAX_FAULTS = 5
"""After so many faults in a row a core is not started again."""

KEPT_CORES = 8
"""Cores that are kept at once; the one that was named last stays longest."""


@dataclass(frozen=True)
class Hello:
    """A core's greeting: what it is and what it wants.

    Parameters
    ----------
    name, version : str
        What the core calls itself.
    kind : {"patch", "frame"}
        Whether it takes single highlights or whole frames.
    transport : {"stream", "files"}
        How arrays are handed over.
    arrays : tuple of str
        Names of the arrays that it wants.
    isophotes : tuple of float
        Isovalues of the isophotes that it wants.
    target : {"fine", "base"}
        Which surface's normals it states where an estimate does not say so.
    """

    name: str
    version: str
    kind: Literal["patch", "frame"]
    transport: Literal["stream", "files"] = "stream"
    arrays: tuple[str, ...] = ()
    isophotes: tuple[float, ...] = ()
    target: Literal["fine", "base"] = "fine"


def outline_names(level: float) -> tuple[str, str]:
    """Return the names of the arrays of an isovalue: the isophote's points, px, and their sightlines."""
    return f"{OUTLINES[0]}{level:g}", f"{OUTLINES[1]}{level:g}"


def hello_of(header: Mapping[str, Any]) -> Hello:
    """Read a core's greeting; raise `CoreFault` where it is malformed."""
    if header.get("type") != "hello":
        raise broken(f"the first line is of type {_told(header.get('type'))}; must be hello")
    if header.get("protocol") != PROTOCOL or isinstance(header.get("protocol"), bool):
        raise broken(f"hello: protocol {_told(header.get('protocol'))}; simtest speaks {PROTOCOL}")
    name, version = header.get("name"), header.get("version", "")
    if not isinstance(name, str) or not 0 < len(name) <= 80 or not name.isprintable():
        raise broken(f"hello: name {_told(name)}; must be text of 1 to 80 characters")
    if not isinstance(version, str | int | float) or len(str(version)) > 80 or not str(version).isprintable():
        raise broken(f"hello: version {_told(version)}; must be text of at most 80 characters")
    kind = header.get("kind")
    if kind not in ("patch", "frame"):
        raise broken(f"hello: kind {_told(kind)}; must be patch or frame")
    transport = header.get("transport", "stream")
    if transport not in ("stream", "files"):
        raise broken(f"hello: transport {_told(transport)}; must be stream or files")
    target = header.get("target", "fine")
    if target not in ("fine", "base"):
        raise broken(f"hello: target {_told(target)}; must be fine or base")
    levels = _levels(header.get("isophotes", []), kind)
    return Hello(name, str(version), kind, transport, _wanted(header.get("arrays"), kind, levels), levels, target)


def _levels(given: object, kind: str) -> tuple[float, ...]:
    """Return the isovalues of a greeting."""
    listed: list[Any] = given if isinstance(given, list) else [None]
    good = all(isinstance(t, int | float) and not isinstance(t, bool) and 0 < t < 1 for t in listed)
    if not good or len(listed) > MAX_ISOPHOTES or (listed and kind == "frame"):
        allowed = "none, since a frame has no peak" if kind == "frame" else f"at most {MAX_ISOPHOTES} numbers in (0, 1)"
        raise broken(f"hello: isophotes {_told(given)}; must be {allowed}")
    if len({outline_names(level) for level in listed}) < len(set(listed)):
        raise broken(
            f"hello: isophotes {_told(given)}; must differ in their first six digits, by which arrays are named"
        )
    return tuple(float(t) for t in listed)


def _wanted(given: object, kind: str, levels: tuple[float, ...]) -> tuple[str, ...]:
    """Return the names of the wanted arrays; an isovalue of which none is named gets both of its own."""
    offered = PATCH_ARRAYS if kind == "patch" else FRAME_ARRAYS
    outlines = [outline_names(level) for level in levels]
    allowed = (*offered, *itertools.chain.from_iterable(outlines))
    if given is None:
        given = ["values" if kind == "patch" else "intensity"]
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        raise broken(f"hello: arrays {_told(given)}; must be a list of names")
    if unknown := next((name for name in given if name not in allowed), None):
        raise broken(f"hello: array {_told(unknown)}; must be one of {', '.join(allowed)}")
    unnamed = [name for pair in outlines if not set(pair) & set(given) for name in pair]
    return tuple(dict.fromkeys([*given, *unnamed]))


def _told(value: object) -> str:
    return excerpt(repr(value).encode("utf-8", "replace"), 60)


class Core:
    """A core of one command: started at need, asked one request after the other, and started again after a fault.

    After `MAX_FAULTS` faults without an answer between them it is not started any more.

    Parameters
    ----------
    command : CoreCommand
        How it is started.
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

        Raises
        ------
        CoreFault
            If it does not start, or greets otherwise than it must.
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
            greeting = {"type": "hello", "protocol": PROTOCOL, "simtest": provenance.version()}
            try:
                hello = hello_of(self._child.exchange(encode(greeting, {}), self.command.start_limit_s).header)
                self._check(hello)
            except BaseException:
                self._end()
                raise
            self.hello, self.is_closed = hello, False
            _started.add(self)
            return hello

    def ask(self, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> Message:
        """Send a request, which gets a number of its own, and return the answer to it.

        Raises
        ------
        CoreFault
            If the core breaks down or breaks the protocol. It has been ended then, and the next request starts it anew.
        """
        with self._lock:
            if self._faults >= MAX_FAULTS and self._last is not None:
                raise CoreFault(self._last.reason, f"not asked after {MAX_FAULTS} faults in a row: {self._last.detail}")
            try:
                answer = self._asked(header, arrays, next(self._numbers))
            except CoreFault as fault:
                self._faults, self._last = self._faults + 1, fault
                self._end()
                raise
            except BaseException:
                # Ctrl-C in the middle of a message, of which the rest would be taken for the next answer.
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
        kind, rest = header["type"], {key: value for key, value in header.items() if key != "type"}
        request = {"type": kind, "id": number, **rest}
        if hello.transport == "files":
            answer = files.exchange(child, request, arrays, self.command.time_limit_s)
        else:
            answer = child.exchange(encode(request, arrays), self.command.time_limit_s)
        _check_answer(answer.header, number, hello.kind)
        return answer

    def _check(self, hello: Hello) -> None:
        """Raise `CoreFault` where a greeting is not that of this core."""
        if self.command.kind is not None and hello.kind != self.command.kind:
            raise broken(f"hello: kind {hello.kind}; {self.command.text} says {self.command.kind}")
        if self.hello is not None and hello != self.hello:
            raise broken("hello: differs from that of the first start")

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.kill()


def _check_answer(header: Mapping[str, Any], number: int, kind: str) -> None:
    """Raise `CoreFault` where an answer is not that to the request of this number, or of a type that is none."""
    given, stated = header.get("id"), header.get("type")
    if given != number or isinstance(given, bool):
        raise broken(f"an answer with id {_told(given)} to request {number}")
    allowed = ("estimate" if kind == "patch" else "estimates", "failure")
    if stated not in allowed:
        raise broken(f"an answer of type {_told(stated)}; must be {' or '.join(allowed)}")


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
