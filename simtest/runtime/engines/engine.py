"""Engine protocol and the choice of an engine by name."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from simtest.errors import InputError
from simtest.runtime.limits import check_count

OnStep = Callable[[], None]
"""Called by a task after each step; an exception from it stops the task."""

Task = Callable[[Any, OnStep], Any]
"""A function at the top level of a module, of its argument and the callback for each step."""

ENGINES = ("local", "ray")

MOST_WORKERS = 256

MAX_DEATHS = 8
"""After this many processes died during the same task the run fails: the fault is the task's."""


class Engine(Protocol):
    """Runs tasks."""

    def run(self, task: Task, arguments: Sequence[Any], on_step: OnStep) -> Iterator[tuple[int, Any]]:
        """Run a task for each argument.

        Parameters
        ----------
        task : callable
            See `Task`.
        arguments : sequence
            One for each run.
        on_step : callable
            Called in this process for each step.

        Yields
        ------
        tuple
            Index of the argument, and result, in the order in which tasks finish.

        Raises
        ------
        SimtestError
            What a task raised, or if processes keep dying during the same task.
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
    """Return an engine by name.

    Parameters
    ----------
    name : {"local", "ray"}
        Processes of this machine, or a Ray cluster (needs the extra ``ray``).
    workers : int
        How many tasks run at once, 1 to 256.
    address : str, optional
        Of the Ray cluster's head; default: a cluster is started here.
    gpu : bool
        Whether each of a cluster's tasks needs a GPU.
    renew_after : int, optional
        Tasks after which a process is replaced, so that leaks of libraries do not add up; default never.

    Raises
    ------
    InputError
        If there is no such engine, its packages are missing, or the number is out of range.
    """
    check_workers(workers)
    # Each engine is imported on demand: Ray is an extra, and both load slowly.
    if name == "local":
        from simtest.runtime.engines.local import LocalEngine

        if address is not None:
            raise InputError(f"--address {address}: is for --engine ray")
        return LocalEngine(workers, renew_after)
    if name == "ray":
        from simtest.runtime.engines.cluster import RayEngine

        return RayEngine(workers, address, gpu, renew_after)
    raise InputError(f"engine = {name!r}: unknown; allowed: {', '.join(ENGINES)}")
