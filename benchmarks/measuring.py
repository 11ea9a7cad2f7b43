"""What the benchmarks share: a measured figure with its limit, and times taken in turns."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A measured figure beside what the project promises.

    Parameters
    ----------
    name : str
        What was measured.
    value : float
        The figure.
    limit : float or None
        What it must keep to; None where it is shown alone.
    at_least : bool
        Whether the limit is a lower one.
    unit : str
        "x" for a ratio.
    about : str
        The times behind it.
    """

    name: str
    value: float
    limit: float | None = None
    at_least: bool = False
    unit: str = "x"
    about: str = ""

    @property
    def met(self) -> bool:
        """Whether the figure keeps to its limit."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def in_turns(functions: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Time functions in turns, so that what slows the machine down for a while slows all of them.

    Parameters
    ----------
    functions : mapping
        Function without arguments by name; each is called once beforehand.
    rounds : int
        How many times each is timed.

    Returns
    -------
    dict
        Median wall time by name, s.
    """
    for function in functions.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}
