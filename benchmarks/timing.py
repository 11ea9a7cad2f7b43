"""Interleaved timings."""

import statistics
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
