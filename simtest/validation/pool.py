"""A pool of worker processes whose results come in order; with one worker, this process."""

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from simtest.errors import InputError

MAX_WORKERS = 256


def check_workers(workers: int) -> None:
    """Raise `InputError` where a number of workers is out of range."""
    if isinstance(workers, bool) or not isinstance(workers, int) or not 1 <= workers <= MAX_WORKERS:
        raise InputError(f"workers = {workers!r}: must be 1 to {MAX_WORKERS}")


class Pool:
    """Runs a function over tasks.

    Parameters
    ----------
    workers : int
        Number of processes, 1 to 256. They are spawned, since polars does not survive a fork, and only when needed.

    Raises
    ------
    InputError
        If the number is out of range.
    """

    def __init__(self, workers: int) -> None:
        check_workers(workers)
        self._workers = workers
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *_: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)

    def map(self, function: Callable[..., Any], tasks: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Give the function's results over argument tuples, in the order of the tasks."""
        if self._workers == 1:
            yield from (function(*task) for task in tasks)
            return
        if self._executor is None:
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(self._workers, context, initializer=_start)
        for future in [self._executor.submit(function, *task) for task in tasks]:
            yield future.result()


def _start() -> None:
    """Prepare a worker: Ctrl-C, which reaches all processes of a terminal, is the parent's to answer.

    One thread a worker: more would only get in each other's way.
    """
    import os
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Read when NumPy loads, which OpenCV's import does.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import cv2

    cv2.setNumThreads(1)
