"""What an engine is, and the choice of one."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from simtest.errors import InputError

Tell = Callable[[], None]
"""Called by a task after each step; what it raises stops the task."""

Task = Callable[[Any, Tell], Any]
"""A function at the top level of a module: its argument, and whom to tell of each step."""

ENGINES = ("local", "ray")

MAX_WORKERS = 256

MAX_DEATHS = 8
"""A task under which so many processes died is given up: the fault is the task's."""


class Engine(Protocol):
    """Runs tasks."""

    def run(self, task: Task, arguments: Sequence[Any], tell: Tell) -> Iterator[tuple[int, Any]]:
        """Run a task for each argument.

        Parameters
        ----------
        task : callable
            See `Task`.
        arguments : sequence
            One for each run.
        tell : callable
            Told, in this process, of the steps.

        Yields
        ------
        tuple
            Place of the argument, and result, as they are finished.

        Raises
        ------
        SimtestError
            What a task raised; or if processes die again and again under the same task.
        """


def check_workers(workers: int) -> None:
    """Raise `InputError` where a number of workers is out of range."""
    if isinstance(workers, bool) or not isinstance(workers, int) or not 1 <= workers <= MAX_WORKERS:
        raise InputError(f"workers = {workers!r}: must be 1 to {MAX_WORKERS}")


def make_engine(
    name: str = "local",
    workers: int = 1,
    address: str | None = None,
    gpu: bool = False,
    renew_after: int | None = None,
) -> Engine:
    """Give an engine by name.

    Parameters
    ----------
    name : {"local", "ray"}
        Processes of this machine, or a Ray cluster (needs the extra ``ray``).
    workers : int
        How many tasks run at once, 1 to 256.
    address : str, optional
        Of the Ray cluster's head; default: one is started here.
    gpu : bool
        Whether each of a cluster's tasks needs a GPU.
    renew_after : int, optional
        Tasks after which a process is replaced, so that what libraries leak does not add up; default never.

    Returns
    -------
    Engine

    Raises
    ------
    InputError
        If there is no such engine, its packages are missing, or the number is out of range.
    """
    check_workers(workers)
    if name == "local":
        from simtest.runtime.engines.local import LocalEngine

        if address is not None:
            raise InputError(f"--address {address}: is for --engine ray")
        return LocalEngine(workers, renew_after)
    if name == "ray":
        from simtest.runtime.engines.cluster import RayEngine

        return RayEngine(workers, address, gpu, renew_after)
    raise InputError(f"engine = {name!r}: unknown; allowed: {', '.join(ENGINES)}")
