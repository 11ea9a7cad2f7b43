"""A core's process: started apart from everything else, spoken to with deadlines, and ended with all its children.

Messages between simtest and a core: one JSON object on a line, followed by the raw bytes of the arrays it lists.

Requests and answers as files, for cores that read no binary streams: JSON, NPY and PNG in a folder a request.
"""

import contextlib
import fcntl
import io
import json
import math
import os
import re
import select
import shutil
import signal
import stat
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from simtest.errors import Reason, SimtestError
from simtest.runtime.stops import breakable

PROTOCOL = 1
"""Version of the protocol."""

DTYPES = ("<f8", "<f4", "<u2", "|u1", "<i4", "|b1")
"""Element types of arrays, as NumPy writes them."""

MAX_HEADER_BYTES = 1 << 20
MAX_ARRAY_BYTES = 64 << 20
"""Of all arrays of one answer together."""

MAX_ARRAYS = 64
MAX_DIMENSIONS = 4


class CoreFault(Exception):
    """A core broke the protocol, died or took too long: a reason ``core_...`` and one line of detail."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.reason, self.detail = reason, detail


def broken(detail: str) -> CoreFault:
    """Return the fault of a core that does not keep to the protocol."""
    return CoreFault(Reason.CORE_PROTOCOL, detail)


@dataclass(frozen=True)
class Message:
    """A message."""

    header: dict[str, Any]  # the JSON object, without ``arrays``
    arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict)  # by name


def encode(header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> list[memoryview]:
    """Return the bytes of a message: its line, then each array in C order.

    Values that JSON does not have, NaN and infinity, are sent as null. An array of another type is sent as ``<f8``.
    """
    sent = {name: _sendable(array) for name, array in arrays.items()}
    listed = [{"name": name, "dtype": a.dtype.str, "shape": list(a.shape)} for name, a in sent.items()]
    line = to_line({**header, "arrays": listed} if sent else header)
    return [memoryview(line), *(a.data.cast("B") for a in sent.values() if a.size)]


def to_line(header: Mapping[str, Any]) -> bytes:
    """Return a header as one line of JSON."""
    return json.dumps(finite(header), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def finite(value: Any) -> Any:
    """Return a JSON value with None in place of numbers that are not finite, and lists in place of arrays."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    return [finite(each) for each in value] if isinstance(value, list | tuple) else value


def _sendable(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    little = array.dtype.newbyteorder("<")
    return np.ascontiguousarray(array, dtype=little if little.str in DTYPES else "<f8")


def parse_header(line: bytes) -> dict[str, Any]:
    """Return the JSON object of a line; raise `CoreFault` where it is none. NaN and Infinity are read as such."""
    try:
        header = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise broken(f"a line that is no JSON: {excerpt(line)} ({excerpt(str(error).encode(), 60)})") from None
    if not isinstance(header, dict):
        raise broken(f"a line that is no JSON object: {excerpt(line)}")
    return header


def excerpt(content: bytes, most: int = 80) -> str:
    """Return the beginning of what a core wrote, printable and on one line."""
    text = content[: 4 * most].decode("utf-8", "replace")
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= most else text[: most - 3] + "..."


class MessageReader:
    """Puts messages together from the bytes of a pipe, and holds no more of them than the limits allow."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._header: dict[str, Any] | None = None
        self._listed: list[tuple[str, np.dtype[Any], tuple[int, ...]]] = []
        self._needed = 0

    @property
    def waiting(self) -> int:
        """Bytes that have come of a message that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Message | None:
        """Take more bytes; return the message where they complete it.

        Raises `CoreFault` if a line is too long or no JSON object, lists malformed or too large arrays, or is followed
        by bytes that belong to no message.
        """
        self._buffer += data
        if self._header is None:
            end = self._buffer.find(b"\n", 0, MAX_HEADER_BYTES + 1)
            if end < 0:
                if len(self._buffer) > MAX_HEADER_BYTES:
                    raise broken(f"a line longer than {MAX_HEADER_BYTES} bytes: {excerpt(bytes(self._buffer[:400]))}")
                return None
            self._header = parse_header(bytes(self._buffer[:end]))
            # A greeting is followed by no arrays: it lists the names of those that the core wants.
            is_hello = self._header.get("type") == "hello"
            self._listed = [] if is_hello else list(_listed(self._header.pop("arrays", [])))
            self._needed = sum(dtype.itemsize * math.prod(shape) for _, dtype, shape in self._listed)
            if self._needed > MAX_ARRAY_BYTES:
                raise broken(f"arrays of {self._needed} bytes; at most {MAX_ARRAY_BYTES}")
            del self._buffer[: end + 1]
        if len(self._buffer) < self._needed:
            return None
        if len(self._buffer) > self._needed:
            extra = bytes(self._buffer[self._needed : self._needed + 400])
            raise broken(f"more than one answer to a request: {excerpt(extra) or 'an empty line'}")
        message = Message(self._header, dict(self._cut()))
        self._buffer, self._header = bytearray(), None
        return message

    def _cut(self) -> Iterator[tuple[str, npt.NDArray[Any]]]:
        start = 0
        for name, dtype, shape in self._listed:
            count = math.prod(shape)
            yield (
                name,
                np.frombuffer(self._buffer, dtype, count, start).reshape(shape) if count else np.empty(shape, dtype),
            )
            start += count * dtype.itemsize


def _listed(given: object) -> Iterator[tuple[str, np.dtype[Any], tuple[int, ...]]]:
    """Return name, type and shape of each array that a header lists; raise `CoreFault` where they are malformed."""
    if not isinstance(given, list) or len(given) > MAX_ARRAYS:
        raise broken(f"arrays: must be a list of at most {MAX_ARRAYS}")
    names = set()
    for entry in given:
        if not isinstance(entry, dict) or not isinstance(name := entry.get("name"), str) or name in names:
            raise broken("arrays: each must be an object with a name of its own")
        names.add(name)
        dtype, shape = entry.get("dtype"), entry.get("shape")
        what = f"array {excerpt(name.encode('utf-8', 'replace'), 40)!r}"
        if dtype not in DTYPES:
            raise broken(f"{what}: dtype {excerpt(str(dtype).encode(), 40)!r}; must be one of {', '.join(DTYPES)}")
        lengths: list[Any] = shape if isinstance(shape, list) else [None]
        is_sound = all(isinstance(n, int) and not isinstance(n, bool) and 0 <= n <= MAX_ARRAY_BYTES for n in lengths)
        if not is_sound or len(lengths) > MAX_DIMENSIONS:
            told = excerpt(json.dumps(shape).encode(), 40)
            raise broken(f"{what}: shape {told}; must be at most {MAX_DIMENSIONS} lengths from 0 to {MAX_ARRAY_BYTES}")
        yield name, np.dtype(dtype), tuple(lengths)


END_S = 2.0
"""How long a core may take to end after its standard input has closed."""

LOOK_S = 0.05
"""Time between two looks whether the process still lives, where another one holds its pipes open."""

CHUNK_BYTES = 1 << 18
PIPE_BYTES = 1 << 20
"""Size asked for pipes: a frame passes in a few pieces."""

KEPT_STDERR_BYTES = 4096
SHOWN_STDERR = 300

_GUARD = """exec 3<&0
(read -r group && read -r _ || { [ "$group" ] && kill -s KILL -- "-$group"; rm -rf -- "$1"; }) <&3 3<&- &"""
"""A shell that outlives this process if it is killed: when its input ends without a second line, it kills the core's
process group and removes its folder. It runs in the background of another one that ends at once, so that it is no child
of this process: a cluster kills those of its workers with them."""


@dataclass
class _Outgoing:
    """What is left to be written."""

    parts: Sequence[memoryview]
    index: int = 0
    start: int = 0

    @property
    def is_done(self) -> bool:
        return self.index >= len(self.parts)

    def write(self, pipe: int) -> None:
        """Write as much as the pipe takes."""
        while not self.is_done:
            part = self.parts[self.index]
            try:
                self.start += os.write(pipe, part[self.start :])
            except BlockingIOError:
                return
            if self.start >= len(part):
                self.index, self.start = self.index + 1, 0


@dataclass
class Child:
    """A running core."""

    folder: str  # its own temporary folder, in which it runs
    process: "subprocess.Popen[bytes]"  # the core, leader of its process group
    guard: IO[bytes]  # input of the shell that watches over it
    owner: int = field(default_factory=os.getpid)  # process that started it; a fork of that one must not use its pipes
    _stderr: bytes = b""
    _stderr_open: bool = True

    @classmethod
    def start(cls, arguments: Sequence[str], environment: Mapping[str, str]) -> "Child":
        """Start a core in an empty folder of its own, with this environment and no open files but its three pipes."""
        folder = tempfile.mkdtemp(prefix="simtest-core-")
        guard = None
        try:
            guard = _start_guard(folder)
            process = subprocess.Popen(
                list(arguments), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=folder,
                env={**environment, "TMPDIR": folder}, start_new_session=True, bufsize=0,
            )  # fmt: skip
        except BaseException:
            if guard is not None:
                _release(guard)
            shutil.rmtree(folder, ignore_errors=True)
            raise
        child = cls(folder, process, guard)
        with contextlib.suppress(OSError):
            guard.write(b"%d\n" % process.pid)
        for pipe in child._pipes:
            os.set_blocking(pipe, False)
            with contextlib.suppress(OSError):
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        return child

    @property
    def _pipes(self) -> tuple[int, int, int]:
        """Our ends of the core's standard input, output and error."""
        process = self.process
        pipes = (process.stdin, process.stdout, process.stderr)
        stdin, stdout, stderr = (pipe.fileno() for pipe in pipes if pipe is not None)
        return stdin, stdout, stderr

    def check_silent(self) -> None:
        """Raise `CoreFault` where the core has written without being asked, or has ended."""
        _, stdout, _ = self._pipes
        with contextlib.suppress(BlockingIOError):
            data = os.read(stdout, CHUNK_BYTES)
            told = excerpt(data) or "an empty line"
            raise broken(f"an answer that nobody asked for: {told}") if data else self._ended()

    def exchange(self, parts: Sequence[memoryview], limit_s: float) -> Message:
        """Write a request and read its answer, the two at once, so that neither side can block the other.

        Raises `CoreFault` if the answer is malformed or late, or the process ends. The process must then be ended: its
        pipes may hold a part of a message.
        """
        stdin, stdout, stderr = self._pipes
        outgoing, reader, answer = _Outgoing(parts), MessageReader(), None
        poll = select.poll()
        poll.register(stdout, select.POLLIN)
        poll.register(stdin, select.POLLOUT)
        if self._stderr_open:
            poll.register(stderr, select.POLLIN)
        deadline, looked = time.monotonic() + limit_s, time.monotonic()
        while answer is None or not outgoing.is_done:
            now = time.monotonic()
            if now >= deadline:
                raise CoreFault(Reason.CORE_TIMEOUT, self._late(limit_s, outgoing, reader))
            # A core that hangs must not hold up a stop.
            with breakable():
                ready = dict(poll.poll(1000 * min(deadline - now, LOOK_S)))
            if stderr in ready and not self._drain():
                poll.unregister(stderr)
            if stdin in ready and not outgoing.is_done:
                self._write(outgoing, stdin)
                # From now on it is watched for its other end alone.
                poll.modify(stdin, 0 if outgoing.is_done else select.POLLOUT)
            elif stdin in ready and stdout not in ready:
                raise self._ended("closed its standard input")
            if stdout in ready:
                data = self._read(stdout)
                if answer is not None:
                    raise broken(f"more than one answer to a request: {excerpt(data) or 'an empty line'}")
                answer = reader.feed(data)
            elif now - looked > LOOK_S:
                # Its own children may hold the pipes open, so the end of the process may not show there.
                looked = now
                # ... and it may have answered just before its end.
                if self.has_ended() and not _is_readable(stdout):
                    raise self._ended()
        return answer

    def _write(self, outgoing: _Outgoing, stdin: int) -> None:
        try:
            outgoing.write(stdin)
        except OSError:
            raise self._ended("closed its standard input") from None

    def _read(self, stdout: int) -> bytes:
        data = os.read(stdout, CHUNK_BYTES)
        if not data:
            raise self._ended("closed its standard output")
        return data

    def has_ended(self) -> bool:
        """Return whether the process has ended; it stays as a zombie, so that its group's number is not used again."""
        if self.process.returncode is not None:
            return True
        try:
            return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        except ChildProcessError:
            # Where the user's program ignores SIGCHLD nothing is left of a process that has ended.
            return True

    def close(self, wait_s: float = END_S) -> None:
        """Close the core's standard input, wait for its end, then kill what is left of its process group."""
        if self.owner != os.getpid():
            return
        assert self.process.stdin is not None
        outputs = self._pipes[1:]
        self.process.stdin.close()
        end = time.monotonic() + wait_s
        while not self.has_ended() and (left := end - time.monotonic()) > 0:
            _discard(outputs, min(left, 0.01))
        self.kill()

    def kill(self) -> None:
        """Kill the core with its process group, and remove its folder."""
        if self.owner != os.getpid():
            return
        if self.process.returncode is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        shutil.rmtree(self.folder, ignore_errors=True)
        _release(self.guard)

    def _drain(self) -> bool:
        """Read what there is of standard error; return whether it is still open."""
        try:
            data = os.read(self._pipes[2], CHUNK_BYTES)
        except BlockingIOError:
            return True
        self._stderr = (self._stderr + data)[-KEPT_STDERR_BYTES:]
        self._stderr_open = bool(data)
        return self._stderr_open

    def _ended(self, what: str = "") -> CoreFault:
        """Return the fault of a core that has closed a pipe; the process itself ends a moment later, or not at all."""
        end = time.monotonic() + 0.5
        while not self.has_ended() and time.monotonic() < end:
            time.sleep(0.002)
        if not self.has_ended():
            return broken(f"the core {what or 'closed its standard output'} but did not end{self.said()}")
        # Killed here already, so that its exit code can be read while its group's number is still its own.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        return CoreFault(Reason.CORE_DIED, f"{_exit(self.process.wait())}{self.said()}")

    def _late(self, limit_s: float, outgoing: _Outgoing, reader: MessageReader) -> str:
        if not outgoing.is_done:
            what = "the request was not read"
        else:
            what = f"an answer was begun ({reader.waiting} bytes) but not ended" if reader.waiting else "no answer"
        # The likeliest cause of silence.
        hint = " (nothing was written: is standard output flushed?)" if what == "no answer" else ""
        return f"{what} within {limit_s:g} s{hint}{self.said()}"

    def said(self) -> str:
        """Return the last of what the core wrote to standard error, as the end of a sentence."""
        for _ in range(16):
            if not self._stderr_open or not _is_readable(self._pipes[2]):
                break
            self._drain()
        text = self._stderr.replace(self.folder.encode(), b".")
        if len(text) > SHOWN_STDERR:
            # Three bytes less, and from the next word on: what is cut off shows.
            kept = text[-SHOWN_STDERR + 3 :]
            text = b"..." + (re.sub(rb"^\S*\s+", b"", kept) or kept)
        return f"; its last words: {excerpt(text, SHOWN_STDERR)}" if text.strip() else ""


def _is_readable(pipe: int) -> bool:
    """Return whether a pipe holds something or has closed; unlike `select`, poll takes descriptors above 1023."""
    poll = select.poll()
    poll.register(pipe, select.POLLIN)
    return bool(poll.poll(0))


def _discard(pipes: Sequence[int], wait_s: float) -> None:
    """Read what an ending core still writes, so that it is not held up."""
    poll = select.poll()
    for pipe in pipes:
        poll.register(pipe, select.POLLIN)
    for pipe, event in poll.poll(1000 * wait_s):
        if event & select.POLLIN:
            os.read(pipe, CHUNK_BYTES)
        else:
            time.sleep(min(wait_s, 0.001))


def _start_guard(folder: str) -> IO[bytes]:
    """Start the shell that watches over a core with this folder; return its input."""
    guard = subprocess.Popen(
        ["/bin/sh", "-c", _GUARD, "sh", folder], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, cwd="/", env={"PATH": os.defpath}, start_new_session=True, bufsize=0,
    )  # fmt: skip
    # Its background part goes on.
    guard.wait()
    assert guard.stdin is not None
    return guard.stdin


def _release(guard: IO[bytes]) -> None:
    """Let the guard end without doing anything."""
    # Where no group has been told yet, this is it, and the next line is the one that lets it go.
    with contextlib.suppress(OSError):
        guard.write(b"\n\n")
    with contextlib.suppress(OSError):
        guard.close()


def _exit(code: int) -> str:
    if code >= 0:
        return f"the core ended with exit code {code}"
    with contextlib.suppress(ValueError):
        return f"the core was ended by {signal.Signals(-code).name}"
    return f"the core was ended by signal {-code}"


PICTURE = "encoded"
"""The array that is written as a picture too."""


def exchange_files(
    child: Child, request: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], limit_s: float
) -> Message:
    """Write a request's files, send a line that names their folder, and read the answer's files.

    Raises `CoreFault` if the core breaks down, or its answer is malformed or missing.
    """
    number = request["id"]
    folder = Path(child.folder) / f"request-{number}"
    try:
        _write(folder, request, arrays)
    except (FileExistsError, FileNotFoundError, NotADirectoryError, PermissionError) as error:
        raise broken(f"changed the folder that it runs in: no folder for a request ({error.strerror})") from None
    except OSError as error:
        raise SimtestError(f"{folder}: cannot be written ({error.strerror or error})") from error
    try:
        line = {"type": request["type"], "id": number, "folder": str(folder)}
        said = child.exchange(encode(line, {}), limit_s)
        # An answer that fits on the line needs no file.
        if said.header.get("type") != "done":
            return said
        if said.header.get("id") != number:
            raise broken(
                f"a line of type done with id {excerpt(repr(said.header.get('id')).encode(), 60)} to request {number}"
            )
        told = _read(folder)
        return Message({"id": said.header.get("id"), **told.header}, told.arrays)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(folder: Path, request: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    folder.mkdir()
    listed = []
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", np.ascontiguousarray(array), allow_pickle=False)
        listed.append({"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "file": f"{name}.npy"})
    if PICTURE in arrays:
        _write_picture(folder / f"{PICTURE}.png", arrays[PICTURE])
    (folder / "request.json").write_bytes(to_line({**request, "arrays": listed}))


def _write_picture(path: Path, values: npt.NDArray[Any]) -> None:
    """Write values in [0, 1] as PNG of 16 bits."""
    import cv2

    steps = np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16)
    if not cv2.imwrite(str(path), steps[..., ::-1] if steps.ndim == 3 else steps):
        raise OSError(f"{path}: cannot be written")


def _read(folder: Path) -> Message:
    """Read answer.json, and the arrays that it lists."""
    header = parse_header(_content(folder, "answer.json", MAX_HEADER_BYTES))
    listed, left, arrays = header.pop("arrays", []), MAX_ARRAY_BYTES, {}
    if not isinstance(listed, list) or len(listed) > MAX_ARRAYS:
        raise broken(f"arrays: must be a list of at most {MAX_ARRAYS}")
    for entry in listed:
        name = entry.get("name") if isinstance(entry, dict) else entry
        if not isinstance(name, str) or not name.replace("_", "").replace(".", "").isalnum() or name in arrays:
            raise broken("arrays: each must have a name of its own, of letters, digits, points and underscores")
        content = _content(folder, f"{name}.npy", left)
        left -= len(content)
        try:
            array = np.load(io.BytesIO(content), allow_pickle=False)
        # A header may claim any size and type.
        except Exception as error:
            raise broken(f"{name}.npy cannot be read ({excerpt(str(error).encode())})") from None
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
            raise broken(f"{name}.npy: must be an array of numbers")
        arrays[name] = array
    return Message(header, arrays)


def _content(folder: Path, name: str, most: int) -> bytes:
    """Read a plain file of the folder; links are not followed, and pipes not waited for."""
    try:
        opened = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise broken(f"{name} cannot be read ({error.strerror})") from None
    try:
        found = os.fstat(opened)
        if not stat.S_ISREG(found.st_mode) or found.st_size > most:
            raise broken(f"{name}: must be a plain file of at most {most} bytes")
        with open(opened, "rb", closefd=False) as file:
            return file.read(most)
    finally:
        os.close(opened)
