"""A core's process: started apart from everything else, spoken to with deadlines, and ended with all its children."""

import contextlib
import fcntl
import os
import re
import select
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO

from simtest.errors import Reason
from simtest.estimators.process.wire import CoreFault, Message, MessageReader, broken, excerpt

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
    """A running core.

    Parameters
    ----------
    folder : str
        Its own temporary folder, in which it runs.
    process : Popen
        The core, leader of its process group.
    guard : file
        Input of the shell that watches over it.
    owner : int
        Process that started it; a fork of that one must not use its pipes.
    """

    folder: str
    process: "subprocess.Popen[bytes]"
    guard: IO[bytes]
    owner: int = field(default_factory=os.getpid)
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

        Raises
        ------
        CoreFault
            If the answer is malformed or late, or the process ends. The process must then be ended: its pipes may hold
            a part of a message.
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
