"""Work in other processes: engines, and readers that may crash.

Engines run tasks in processes of this machine (`LocalEngine`) or on a Ray cluster (`RayEngine`, extra ``ray``). A task
is a module-level function of one picklable argument; its result must not depend on where, when or beside what it runs.
A process may die during a task, which is then repeated: so a task must tolerate running twice.

Files whose reader may crash or take all memory are read in a process of their own under a memory limit (`call_apart`).
"""

import contextlib
import ctypes
import importlib
import multiprocessing
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol, TypeVar

from simtest.errors import InputError, SimtestError
from simtest.runtime.boundary import explain, plain
from simtest.runtime.files import check_count
from simtest.runtime.stops import breakable

T = TypeVar("T")

OnStep = Callable[[], None]
"""Called by a task after each step; an exception from it stops the task."""

Task = Callable[[Any, OnStep], Any]
"""A function at the top level of a module, of its argument and the callback for each step."""

ENGINES = ("local", "ray")

MOST_WORKERS = 256

MOST_BYTES = 600 * 2**20
"""A worker that holds more gives back after each task what it has freed: scenes leave it in pieces that glibc keeps."""

MAX_DEATHS = 8
"""After this many processes died during the same task the run fails: the fault is the task's."""


class Engine(Protocol):
    """Runs tasks."""

    def run(self, task: Task, arguments: Sequence[Any], on_step: OnStep) -> Iterator[tuple[int, Any]]:
        """Run a task for each argument; yield index and result in the order in which tasks finish.

        `on_step` is called in this process for each step. Raises `SimtestError` if a task did, or if processes keep
        dying during the same task.
        """


def check_workers(workers: int) -> None:
    """Raise `InputError` if a number of workers is out of range."""
    check_count(workers, "workers", MOST_WORKERS)


def make_engine(
    name: str = "local",
    workers: int = 1,
    address: str | None = None,
    gpu: bool = False,
    renew_after: int | None = None,
) -> Engine:
    """Return an engine by name: "local" (processes of this machine) or "ray" (a cluster; needs the extra ``ray``).

    So many `workers` tasks run at once. `address` is that of the cluster's head, by default one is started here; with
    `gpu` each of its tasks needs one. A process is replaced after `renew_after` tasks, so that leaks do not add up.
    """
    check_workers(workers)
    if name == "local":
        if address is not None:
            raise InputError(f"--address {address}: is for --engine ray")
        return LocalEngine(workers, renew_after)
    if name == "ray":
        return RayEngine(workers, address, gpu, renew_after)
    raise InputError(f"engine = {name!r}: unknown; allowed: {', '.join(ENGINES)}")


@dataclass
class _Worker:
    """A process, our end of its pipe, the index of its task, and how many tasks it has finished."""

    process: Any
    pipe: Connection
    task: int | None = None
    finished: int = 0


class LocalEngine:
    """Runs tasks in this process if one worker is asked for, else in spawned ones; parameters as in `make_engine`."""

    def __init__(self, workers: int, renew_after: int | None = None) -> None:
        self._workers, self._renew_after = workers, renew_after

    def run(self, task: Task, arguments: Sequence[Any], on_step: OnStep) -> Iterator[tuple[int, Any]]:
        """Run a task for each argument (see `Engine.run`)."""
        if self._workers == 1:
            yield from ((i, task(argument, on_step)) for i, argument in enumerate(arguments))
            return
        yield from _Pool(min(self._workers, len(arguments)), task, arguments, self._renew_after).run(on_step)


class _Pool:
    """The processes of one run."""

    def __init__(self, workers: int, task: Task, arguments: Sequence[Any], renew_after: int | None) -> None:
        self._count, self._task, self._arguments = workers, task, arguments
        self._renew_after = renew_after
        self._waiting = deque(range(len(arguments)))
        self._deaths = [0] * len(arguments)
        self._left = len(arguments)
        self._workers: list[_Worker] = []

    def run(self, on_step: OnStep) -> Iterator[tuple[int, Any]]:
        try:
            while self._left:
                self._assign_tasks()
                pipes = {worker.pipe: worker for worker in self._workers}
                with breakable():
                    ready = wait(list(pipes), timeout=1.0)
                for pipe in ready:
                    assert isinstance(pipe, Connection)
                    yield from self._receive(pipes[pipe], on_step)
                # Without workers no message arrives, and Ctrl-C is answered in the callback.
                if not pipes:
                    on_step()
        finally:
            self._kill_workers()

    def _assign_tasks(self) -> None:
        """Send every idle process a task, and start processes as long as tasks wait."""
        for worker in self._workers:
            if worker.task is None and self._waiting:
                self._send_task(worker)
        while self._waiting and len(self._workers) < self._count:
            self._send_task(self._start_worker())

    def _start_worker(self) -> _Worker:
        # Spawned, not forked: polars hangs in a forked process.
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        threads = max(1, (os.cpu_count() or 1) // self._count)
        process = context.Process(target=_work, args=(there, self._task, threads), daemon=True)
        # Masks are inherited: a Ctrl-C must not break into the child's imports. Here it comes once that is started.
        stops = {signal.SIGINT, signal.SIGTERM}
        # Where it is not running yet, the start of a process starts it, and that lifts the mask before the process.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, stops)
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        there.close()
        worker = _Worker(process, here)
        self._workers.append(worker)
        return worker

    def _send_task(self, worker: _Worker) -> None:
        worker.task = self._waiting.popleft()
        try:
            worker.pipe.send(self._arguments[worker.task])
        except OSError:
            self._reap_worker(worker)

    def _receive(self, worker: _Worker, on_step: OnStep) -> Iterator[tuple[int, Any]]:
        try:
            kind, content = worker.pipe.recv()
        except (EOFError, OSError):
            self._reap_worker(worker)
            return
        if kind == "step":
            on_step()
        elif kind == "error":
            raise content
        else:
            number = worker.task
            assert number is not None
            worker.task, worker.finished = None, worker.finished + 1
            self._left -= 1
            # Closing the pipe of an idle worker ends it; the next task starts another one.
            if self._renew_after is not None and worker.finished >= self._renew_after:
                self._join_worker(worker)
            yield number, content

    def _reap_worker(self, worker: _Worker) -> None:
        """Remove a dead process and put its task back into the queue."""
        self._join_worker(worker)
        number = worker.task
        if number is None:
            return
        self._deaths[number] += 1
        if self._deaths[number] >= MAX_DEATHS:
            raise SimtestError(
                f"{MAX_DEATHS} processes died under the same task (the last with exit code "
                f"{worker.process.exitcode}); is there enough memory? What is finished is kept"
            )
        self._waiting.appendleft(number)

    def _join_worker(self, worker: _Worker) -> None:
        # A worker ends by itself once its pipe is closed.
        worker.pipe.close()
        worker.process.join(timeout=10)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        self._workers.remove(worker)

    def _kill_workers(self) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()


def _work(pipe: Connection, task: Task, threads: int) -> None:
    """Run tasks until the pipe closes."""
    # Ctrl-C reaches all processes of a terminal, SIGTERM those of a job; the parent answers them.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    # Read by NumPy and the renderer when they load.
    os.environ["OPENBLAS_NUM_THREADS"] = str(threads)
    os.environ["SIMTEST_THREADS"] = str(threads)
    import cv2

    cv2.setNumThreads(threads)
    try:
        while True:
            pipe.send(_answer(pipe, task, pipe.recv()))
            give_back()
    except (EOFError, OSError):
        # The pipe closed. Errors of a task, OSError included, are answers and do not arrive here.
        return


def give_back() -> None:
    """Return the memory that this process has freed to the system, where it holds more than `MOST_BYTES`."""
    # Linux tells what it holds; of C libraries glibc alone keeps so much.
    with contextlib.suppress(OSError, AttributeError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        if pages * os.sysconf("SC_PAGE_SIZE") > MOST_BYTES:
            ctypes.CDLL(None).malloc_trim(0)


def _answer(pipe: Connection, task: Task, argument: Any) -> tuple[str, Any]:
    try:
        return "done", task(argument, lambda: pipe.send(("step", None)))
    except Exception as error:
        # Whoever knows the folder says what stays of the work.
        told = error if isinstance(error, OSError) and explain(error) else plain(error)
        if not isinstance(told, SimtestError | OSError):
            told = SimtestError(f"a worker failed ({type(error).__name__}: {error})")
        # A traceback does not pass the pipe; its text does.
        told.add_note(f"In a worker: {''.join(traceback.format_exception(error))}")
        return "error", told


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


POLL_S = 1.0
"""Length of one wait; Ctrl-C is answered between two of them."""

ANSWER_S = 5.0
"""How long a cluster's head may take to answer."""


class RayEngine:
    """Runs tasks on a Ray cluster whose nodes share the folder of the files.

    The parameters are those of `make_engine`. Without an address a cluster of this machine is started, and ended with
    the run. Raises `InputError` if Ray is not installed.
    """

    def __init__(
        self, workers: int, address: str | None = None, gpu: bool = False, renew_after: int | None = None
    ) -> None:
        try:
            import ray
        except ImportError:
            raise InputError("engine = 'ray': needs Ray; install simtest[ray]") from None
        self._ray: Any = ray
        self._workers, self._address, self._gpu = workers, address, gpu
        self._renew_after = renew_after

    def run(self, task: Task, arguments: Sequence[Any], on_step: OnStep) -> Iterator[tuple[int, Any]]:
        """Run a task for each argument (see `Engine.run`); the steps of a task count when it is finished."""
        ray = self._ray
        own = not ray.is_initialized()
        if own:
            self._join()
        try:
            yield from self._run(task, arguments, on_step)
        finally:
            if own:
                ray.shutdown()

    def _join(self) -> None:
        ray = self._ray
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        if self._address is not None:
            _check_address(self._address)
        try:
            if self._address is None:
                ray.init(include_dashboard=False, log_to_driver=False, logging_level="ERROR")
            else:
                ray.init(address=self._address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, RuntimeError, ValueError) as error:
            said = str(error).splitlines()[0][:160]
            tried = (
                "--engine ray: no cluster can be started"
                if self._address is None
                else (f"--address {self._address}: no Ray cluster can be joined")
            )
            raise InputError(f"{tried} ({said})") from error

    def _run(self, task: Task, arguments: Sequence[Any], on_step: OnStep) -> Iterator[tuple[int, Any]]:
        ray = self._ray
        cores = cores_per_task([node["Resources"] for node in ray.nodes() if node["Alive"]], self._workers)
        remote = ray.remote(
            # Ray itself repeats a task whose process or node dies, and renews processes.
            num_cpus=cores,
            num_gpus=int(self._gpu),
            max_retries=MAX_DEATHS,
            max_calls=self._renew_after or 0,
        )(_work_on_node)
        waiting = list(enumerate(arguments))
        running: dict[Any, int] = {}
        while waiting or running:
            # No more than `workers` tasks at once, however large the cluster.
            while waiting and len(running) < self._workers:
                number, argument = waiting.pop(0)
                running[remote.remote(task, argument, cores)] = number
            done, _ = ray.wait(list(running), timeout=POLL_S)
            for reference in done:
                number = running.pop(reference)
                result, steps = self._get(reference)
                for _ in range(steps):
                    on_step()
                yield number, result

    def _get(self, reference: Any) -> Any:
        ray = self._ray
        try:
            return ray.get(reference)
        # what the task itself raised
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, SimtestError):
                raise error.cause from None
            raise SimtestError(f"a worker failed ({type(error.cause).__name__}: {error.cause})") from error
        # what Ray could not cure by repeating it
        except ray.exceptions.RayError as error:
            said = str(error).splitlines()[0][:160]
            raise SimtestError(f"the cluster lost a task ({said}); what is finished is kept") from error


def cores_per_task(nodes: Sequence[Mapping[str, float]], workers: int) -> int:
    """Return a task's cores, at least 1: its share of all, but no more than one node has, or it would wait forever.

    `nodes` are the resources of each live node; one that offers no cores names none. `workers` tasks run at once.
    """
    cores = [node.get("CPU", 0.0) for node in nodes]
    return max(1, int(min(sum(cores) // workers, max(cores, default=0.0))))


def _check_address(address: str) -> None:
    """Raise `InputError` if nobody listens; Ray itself would try for minutes, then end the process."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--address {address}: must be HOST:PORT, that of the cluster's head")
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER_S).close()
    except OSError as error:
        raise InputError(f"--address {address}: no Ray cluster answers ({error.strerror or error})") from None


def _work_on_node(task: Task, argument: Any, threads: int) -> tuple[Any, int]:
    """Run a task; return its result and the number of its steps."""
    os.environ["SIMTEST_THREADS"] = str(threads)
    steps = 0

    def count() -> None:
        nonlocal steps
        steps += 1

    return task(argument, count), steps


TIMEOUT_S = 300
"""How long a reader may take over one file."""

_CALL = "import sys; from simtest.runtime.processes import _answer_apart; _answer_apart(*sys.argv[1:])"


def call_apart(read: Callable[[str], T], path: Path, memory_bytes: float, kind: str, breakdown: str) -> T:
    """Return what a function makes of a file, called in a process of its own: its library may crash over it.

    The function stands at the top level of a module, and raises `InputError` where the content is not what it must be,
    without the file's name. The process may take `memory_bytes` beside its libraries. For messages: `kind` is what the
    file must be, such as "VTK mesh", and `breakdown` is said of a file over which the library breaks down. Raises
    `InputError` then, where the file is refused or takes more than `TIMEOUT_S`, and `SimtestError` where memory lacks.
    """
    # -P: no file of the current folder may stand in for a package.
    command = [sys.executable, "-P", "-c", _CALL, read.__module__, read.__name__, str(path.absolute())]
    try:
        child = subprocess.run([*command, str(memory_bytes), kind], capture_output=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise InputError(f"{path}: not read within {TIMEOUT_S} s; must be a smaller file") from None
    # What the machine did is no damage of the file.
    if child.returncode == -signal.SIGKILL:
        raise SimtestError(f"{path}: the reader of a {kind} was killed, mostly for want of memory")
    try:
        error, made = pickle.loads(child.stdout)
    except (pickle.UnpicklingError, EOFError):
        raise InputError(f"{path}: {breakdown}") from None
    if error is not None:
        raise error(f"{path}: {made}")
    return made


def _answer_apart(module: str, name: str, path: str, memory_bytes: str, kind: str) -> None:
    """Call a function on a file; write what it makes of it, or the error's type and text, to the standard output."""
    # Where libraries print nothing.
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    read = getattr(importlib.import_module(module), name)
    limit_memory(float(memory_bytes))
    answer: tuple[type[SimtestError] | None, Any]
    try:
        answer = None, read(path)
    except InputError as error:
        answer = InputError, str(error)
    except MemoryError as error:
        answer = SimtestError, explain(error)
    except Exception as error:
        # The reader raises whatever it runs into; the file is at fault.
        text = " ".join(str(error).split())[:160] or type(error).__name__
        answer = InputError, f"not a readable {kind} ({text})"
    with output:
        pickle.dump(answer, output)


def limit_memory(most: float) -> None:
    """Let this process allocate at most so many bytes beside what it holds now; beyond, allocations fail.

    Systems without such limits (Windows) are left as they are.
    """
    try:
        import resource
    except ImportError:
        return
    try:
        held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except (OSError, ValueError, IndexError):
        held = 0
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = held + int(most)
    try:
        resource.setrlimit(
            resource.RLIMIT_DATA, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard)
        )
    except (OSError, ValueError):
        return
