"""Run cases in forked children of a process that has loaded the commands; judge and repeat what looks wrong."""

import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import psutil

from studies.bad_inputs.files import Content

LIMIT_S = 10.0
"""Of processor time. A case that takes none and does not end is a hang after `HANG_S`."""

HANG_S = 60.0
LIMIT_MIB = 1500.0
KILL_MIB = 4000.0
LONGEST_LINE = 1000
BAR = re.compile("[\u2501\u2800-\u28ff]")
"""What a progress bar is drawn with."""

_LOOK_S = 0.05
_KEPT = frozenset({"PATH", "HOME", "LANG", "PYTHONPATH", "XDG_CACHE_HOME", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"})


class Wanted(StrEnum):
    """What a command should make of a case."""

    REFUSED = "refused"
    """One line on stderr, exit code 2 (or 1 where a command's verdict is 1), nothing written."""

    DONE = "done"
    """Exit code 0: a good input, without which a refusal of its spoilt copies would say nothing."""

    ORDERLY = "orderly"
    """Either refused so, or done: some damaged bytes are still a good file."""


@dataclass(frozen=True)
class Case:
    """A command that is run in a folder of its own.

    `name`: "kind: what", unique; `command`: arguments of `simtest`; `files`: what stands in the folder, by name;
    `wanted`: what should come of it; `says`: what the line must hold, such as the key's name.
    """

    name: str
    command: tuple[str, ...]
    files: Mapping[str, Content] = field(default_factory=dict)
    wanted: Wanted = Wanted.REFUSED
    says: str = ""

    def make_files(self, folder: Path) -> None:
        """Make the case's files."""
        for name, content in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if callable(content):
                content(path)
            else:
                path.write_bytes(content.encode() if isinstance(content, str) else content)


@dataclass(frozen=True)
class Outcome:
    """What a case did: exit code (negative: its signal), output, processor time, peak memory, faults found."""

    case: Case
    code: int
    stderr: str
    processor_s: float
    peak_mib: float
    faults: tuple[str, ...]


@dataclass
class _Running:
    case: Case
    pid: int
    folder: Path
    logs: Path
    before: frozenset[str]
    started: float
    peak: float = 0.0
    killed: str = ""


Start = Callable[[Case, Path, Path], int]
"""Starts a case in a folder, its output in another, as a child of this process; returns the child's id."""


def preload() -> None:
    """Import what the commands need and what a fork bears: neither polars nor the renderer."""
    import cv2
    import scipy.io
    import trimesh

    import simtest.cli.main
    import simtest.reconstruction.pipeline
    import simtest.spec.calibration_spec
    import simtest.spec.recipes
    import simtest.surfaces.recipe  # noqa: F401

    # Its threads do not survive a fork.
    cv2.setNumThreads(0)
    assert "polars" not in sys.modules
    del scipy, trimesh


def forked(case: Case, folder: Path, logs: Path) -> int:
    """Start a case in a fork of this process."""
    return _child(folder, logs, lambda: _main(case))


def executed(case: Case, folder: Path, logs: Path) -> int:
    """Start a case as a command of its own."""
    environment = {name: value for name, value in os.environ.items() if name in _KEPT}
    command = [sys.executable, "-c", "from simtest.cli.main import main; main()", *case.command]
    return _child(folder, logs, lambda: os.execve(sys.executable, command, environment))


def _child(folder: Path, logs: Path, do: Callable[[], int]) -> int:
    """Fork; the child works in a folder, with its output in files, in a session of its own."""
    if pid := os.fork():
        return pid
    code = 99
    try:
        os.setsid()
        os.chdir(folder)
        null, out, err = os.open(os.devnull, os.O_RDONLY), _log(logs / "stdout"), _log(logs / "stderr")
        for number, descriptor in enumerate((null, out, err)):
            os.dup2(descriptor, number)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = do()
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _main(case: Case) -> int:
    from simtest.cli.main import main

    sys.argv = ["simtest", *case.command]
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1
    return 0


def _log(path: Path) -> int:
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)


def run_all(cases: Sequence[Case], workers: int, start: Start = forked) -> Iterator[Outcome]:
    """Run cases, so many at once; yield the outcomes in the order in which they end."""
    waiting, running = list(reversed(cases)), dict[int, _Running]()
    with tempfile.TemporaryDirectory() as scratch:
        while waiting or running:
            while waiting and len(running) < workers:
                own = _start(waiting.pop(), Path(scratch), start)
                running[own.pid] = own
            time.sleep(_LOOK_S / 5)
            for own in list(running.values()):
                _watch(own)
                # Of the child and of the children that it waited for.
                pid, status, usage = os.wait4(own.pid, os.WNOHANG)
                if pid:
                    del running[own.pid]
                    yield _outcome(own, os.waitstatus_to_exitcode(status), usage)


def _start(case: Case, scratch: Path, start: Start) -> _Running:
    root = Path(tempfile.mkdtemp(dir=scratch))
    folder, logs = root / "case", root / "logs"
    folder.mkdir()
    logs.mkdir()
    case.make_files(folder)
    return _Running(case, start(case, folder, logs), folder, logs, _names(folder), time.monotonic())


def _names(folder: Path) -> frozenset[str]:
    return frozenset(str(path.relative_to(folder)) for path in folder.rglob("*"))


def _watch(own: _Running) -> None:
    """Kill a case that hangs or eats the machine's memory."""
    try:
        process = psutil.Process(own.pid)
        memory, times = process.memory_info().rss / 2**20, process.cpu_times()
    except psutil.Error:
        return
    own.peak = max(own.peak, memory)
    used = times.user + times.system
    if not own.killed:
        if used > 2 * LIMIT_S or time.monotonic() - own.started > HANG_S:
            own.killed = "hang"
        elif memory > KILL_MIB:
            own.killed = "memory"
        if own.killed:
            os.killpg(own.pid, signal.SIGKILL)


def _outcome(own: _Running, code: int, usage: resource.struct_rusage) -> Outcome:
    stderr = (own.logs / "stderr").read_text(errors="replace")
    stdout = (own.logs / "stdout").read_text(errors="replace")
    used = usage.ru_utime + usage.ru_stime
    peak = max(own.peak, usage.ru_maxrss / 2**10)
    left = sorted(name for name in _names(own.folder) - own.before if not name.endswith(".lock"))
    faults = tuple(_faults(own, code, stderr, stdout, used, peak, left))
    shutil.rmtree(own.folder.parent, ignore_errors=True)
    return Outcome(own.case, code, stderr, used, peak, faults)


def _faults(
    own: _Running, code: int, stderr: str, stdout: str, used: float, peak: float, left: list[str]
) -> Iterator[str]:
    """Yield what is wrong with a case's end; of a killed one only why it was killed."""
    if own.killed:
        yield own.killed
        return
    wrong = {
        "slow": used > LIMIT_S,
        "memory": peak > LIMIT_MIB,
        "crash": code < 0,
        "internal error": "internal error" in stderr or "a worker failed" in stderr,
        "traceback": "Traceback" in stderr + stdout,
        "accepted": code == 0 and own.case.wanted is Wanted.REFUSED,
        "refused": code != 0 and own.case.wanted is Wanted.DONE,
        f"left {', '.join(left[:3])}": bool(left) and code != 0 and own.case.wanted is Wanted.REFUSED,
    }
    yield from (what for what, so in wrong.items() if so)
    if code:
        yield from _unclear(own.case, code, stderr, stdout)


def _unclear(case: Case, code: int, stderr: str, stdout: str) -> Iterator[str]:
    """Yield what is wrong with a refusal's text."""
    lines = [
        line
        for line in stderr.splitlines()
        if line and not line.startswith("simtest: warning:") and not BAR.search(line)
    ]
    # A verdict stands in the output.
    verdict = code == 1 and stdout.strip() and case.name.startswith(("mesh check", "dataset verify", "doctor"))
    if len(lines) != 1 and not (verdict and not lines):
        yield f"{len(lines)} lines"
    elif any(len(line) > LONGEST_LINE or not line.isprintable() for line in lines):
        yield "line too long or not printable"
    if case.says not in stderr + stdout:
        yield f"does not say {case.says!r}"
