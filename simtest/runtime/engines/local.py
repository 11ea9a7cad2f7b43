"""Processes of this machine: spawned, watched, replaced when they die, and renewed now and then."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from simtest.errors import SimtestError
from simtest.runtime.engines.engine import MAX_DEATHS, Task, Tell


@dataclass
class _Worker:
    process: Any
    pipe: Connection
    doing: int | None = None
    done: int = 0


class LocalEngine:
    """Runs tasks in this process where one is asked for, else in spawned ones.

    Parameters
    ----------
    workers : int
        Number of processes.
    renew_after : int, optional
        Tasks after which a process is replaced, so that what libraries leak does not add up; default never.
    """

    def __init__(self, workers: int, renew_after: int | None = None) -> None:
        self._workers, self._renew_after = workers, renew_after

    def run(self, task: Task, arguments: Sequence[Any], tell: Tell) -> Iterator[tuple[int, Any]]:
        """See `Engine.run`."""
        if self._workers == 1:
            yield from ((i, task(argument, tell)) for i, argument in enumerate(arguments))
            return
        yield from _Pool(min(self._workers, len(arguments)), task, arguments, self._renew_after).run(tell)


class _Pool:
    """The processes of one run."""

    def __init__(self, workers: int, task: Task, arguments: Sequence[Any], renew_after: int | None) -> None:
        self._count, self._task, self._arguments = workers, task, arguments
        self._renew_after = renew_after
        self._waiting = deque(range(len(arguments)))
        self._deaths = [0] * len(arguments)
        self._left = len(arguments)
        self._workers: list[_Worker] = []

    def run(self, tell: Tell) -> Iterator[tuple[int, Any]]:
        try:
            while self._left:
                self._staff()
                pipes = {worker.pipe: worker for worker in self._workers}
                for pipe in wait(list(pipes), timeout=1.0):
                    assert isinstance(pipe, Connection)
                    yield from self._hear(pipes[pipe], tell)
                # Ctrl-C is answered between two messages too.
                if not pipes:
                    tell()
        finally:
            self._dismiss()

    def _staff(self) -> None:
        """Give every free process a task; start as many as there is work for."""
        for worker in self._workers:
            if worker.doing is None and self._waiting:
                self._hand(worker)
        while self._waiting and len(self._workers) < self._count:
            self._hand(self._hire())

    def _hire(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        threads = max(1, (os.cpu_count() or 1) // self._count)
        process = context.Process(target=_work, args=(there, self._task, threads), daemon=True)
        process.start()
        there.close()
        worker = _Worker(process, here)
        self._workers.append(worker)
        return worker

    def _hand(self, worker: _Worker) -> None:
        worker.doing = self._waiting.popleft()
        try:
            worker.pipe.send(self._arguments[worker.doing])
        except OSError:
            self._bury(worker)

    def _hear(self, worker: _Worker, tell: Tell) -> Iterator[tuple[int, Any]]:
        try:
            kind, content = worker.pipe.recv()
        except (EOFError, OSError):
            self._bury(worker)
            return
        if kind == "step":
            tell()
        elif kind == "error":
            raise content
        else:
            number = worker.doing
            assert number is not None
            worker.doing, worker.done = None, worker.done + 1
            self._left -= 1
            if self._renew_after is not None and worker.done >= self._renew_after:
                self._release(worker)
            yield number, content

    def _bury(self, worker: _Worker) -> None:
        """Take a dead process's task back."""
        self._release(worker)
        number = worker.doing
        if number is None:
            return
        self._deaths[number] += 1
        if self._deaths[number] >= MAX_DEATHS:
            raise SimtestError(
                f"{MAX_DEATHS} processes died under the same task (the last with exit code "
                f"{worker.process.exitcode}); is there enough memory? What is finished is kept"
            )
        self._waiting.appendleft(number)

    def _release(self, worker: _Worker) -> None:
        worker.pipe.close()
        worker.process.join(timeout=10)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        self._workers.remove(worker)

    def _dismiss(self) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()


def _work(pipe: Connection, task: Task, threads: int) -> None:
    """Do tasks until the pipe closes."""
    # Ctrl-C reaches all processes of a terminal; it is the parent's to answer.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
        # The pipe closed; what goes wrong in a task, which may be an OSError too, is an answer.
        return


def _answer(pipe: Connection, task: Task, argument: Any) -> tuple[str, Any]:
    try:
        return "done", task(argument, lambda: pipe.send(("step", None)))
    except SimtestError as error:
        return "error", error
    except Exception as error:
        return "error", SimtestError(f"a worker failed ({type(error).__name__}: {error})")


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
