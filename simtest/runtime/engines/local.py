"""Worker processes of this machine: spawned, watched, replaced when they die, and renewed regularly."""

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from simtest.errors import SimtestError
from simtest.runtime.engines.engine import MAX_DEATHS, OnStep, Task
from simtest.runtime.machine_errors import disk_problem, machine_problem


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
                for pipe in wait(list(pipes), timeout=1.0):
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
    except (EOFError, OSError):
        # The pipe closed. Errors of a task, OSError included, are answers and do not arrive here.
        return


def _answer(pipe: Connection, task: Task, argument: Any) -> tuple[str, Any]:
    try:
        return "done", task(argument, lambda: pipe.send(("step", None)))
    except Exception as error:
        answer = error
        # Whoever knows the folder says which one it is.
        if not isinstance(error, SimtestError) and not (isinstance(error, OSError) and disk_problem(error)):
            answer = SimtestError(machine_problem(error) or f"a worker failed ({type(error).__name__}: {error})")
        # A traceback does not pass the pipe; its text does.
        answer.add_note(f"In a worker: {''.join(traceback.format_exception(error))}")
        return "error", answer


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
