"""Run time and memory: times taken in turns, and the memory of a process and all that it has started."""

import statistics
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path


def times_in_turns(
    functions: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Time functions in turns, so that what slows the machine down for a while slows all of them.

    Parameters
    ----------
    functions : mapping
        Function without arguments by name; each is called once beforehand.
    rounds : int
        How many times each is timed.
    clock : callable
        Gives the time, s; default wall time.

    Returns
    -------
    dict
        Times by name, s, one a round.
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
    """Give the median wall time of functions by name, s; see `times_in_turns`."""
    return {name: statistics.median(times) for name, times in times_in_turns(functions, rounds).items()}


def memory_of_tree_mib(pid: int) -> float | None:
    """Give the memory of a process and its descendants, shared pages once, MiB; None where the system does not tell.

    What a page is shared by n processes counts for 1/n in each (Linux's proportional set size).
    """
    found = [_proportional_mib(member) for member in _tree(pid)]
    known = [value for value in found if value is not None]
    return sum(known) if known else None


class PeakMemory:
    """Watches the memory of a process and its descendants while the body of a `with` runs.

    Parameters
    ----------
    pid : int
        The process.
    step_s : float
        Time between two looks.
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


def _tree(pid: int) -> list[int]:
    try:
        # A thread other than the first may have started a process too.
        listed = [path.read_text().split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    except OSError:
        return [pid]
    return [pid, *(descendant for children in listed for child in children for descendant in _tree(int(child)))]


def _proportional_mib(pid: int) -> float | None:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:")), None)
