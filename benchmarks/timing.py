"""Run time and memory: interleaved timings, and the memory of a process with all its descendants."""

import statistics
import threading
import time
from collections.abc import Callable, Mapping


def times_in_turns(
    functions: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Return the times of functions by name, s, one per round.

    The functions take turns, so that a slow spell of the machine slows all of them alike; each is called once
    beforehand. `clock` returns the time, s.
    """
    for function in functions.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            start = clock()
            function()
            times[name].append(clock() - start)
    return times


def in_turns(functions: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the median wall time of each function by name, s; see `times_in_turns`."""
    return {name: statistics.median(times) for name, times in times_in_turns(functions, rounds).items()}


def memory_of_tree_mib(pid: int) -> float | None:
    """Return the memory of a process and its descendants, MiB; None if the system does not report it.

    A page shared by n processes counts for 1/n in each of them (Linux's proportional set size).
    """
    import psutil  # 30 ms to import, and few commands measure memory

    def proportional_size(process: psutil.Process) -> int | None:
        try:
            return getattr(process.memory_full_info(), "pss", None)
        except psutil.Error:  # it ended meanwhile, or belongs to someone else
            return None

    try:
        process = psutil.Process(pid)
        sizes = [proportional_size(member) for member in (process, *process.children(recursive=True))]
    except psutil.Error:
        return None
    # A process that ended between the two calls counts for nothing.
    known = [size for size in sizes if size is not None]
    return sum(known) / 2**20 if known else None


class PeakMemory:
    """Context manager that watches the memory of a process and its descendants.

    `pid`: the process; `step_s`: time between two readings; `Attributes`; `----------`; `peak_mib`: the largest
    reading so far; None before the first.
    """

    def __init__(self, pid: int, step_s: float = 0.1) -> None:
        self._pid, self._step_s = pid, step_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self.peak_mib: float | None = None

    def __enter__(self) -> "PeakMemory":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            now = memory_of_tree_mib(self._pid)
            if now is not None:
                self.peak_mib = max(now, self.peak_mib or 0.0)
            if self._stop.wait(self._step_s):
                return
