"""Ray cluster (extra ``ray``): a task runs on some node, and is repeated on another if that node or process dies."""

import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from simtest.errors import InputError, SimtestError
from simtest.runtime.engines.engine import MAX_DEATHS, OnStep, Task

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
        )(_work)
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


def _work(task: Task, argument: Any, threads: int) -> tuple[Any, int]:
    """Run a task; return its result and the number of its steps."""
    os.environ["SIMTEST_THREADS"] = str(threads)
    steps = 0

    def count() -> None:
        nonlocal steps
        steps += 1

    return task(argument, count), steps
