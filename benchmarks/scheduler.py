"""Simulation of a dataset's run on a cluster: workers take shards from one process, which books each one in turn.

What a run on many nodes costs beyond its work: the last shards, when most workers are idle, and the process that hands
them out, which does one thing at a time. Both are simulated, event by event, with measured times. What is not: a folder
that is too slow, nodes that fail, and workers of unequal speed.
"""

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simtest.runtime.arrays import Array


@dataclass(frozen=True)
class Simulated:
    """One run on `workers` workers.

    Parameters
    ----------
    workers : int
        Tasks that run at once.
    makespan_s : float
        From the start to the last booking, s.
    work_s : float
        All tasks together, s.
    """

    workers: int
    makespan_s: float
    work_s: float

    @property
    def efficiency(self) -> float:
        """Share of the workers' time that is work; 1 is linear."""
        return self.work_s / self.workers / self.makespan_s


def simulate(tasks_s: Array, workers: int, booking_s: Callable[[int], float], start_s: float = 0.0) -> Simulated:
    """Simulate a run.

    Parameters
    ----------
    tasks_s : ndarray, shape (N,)
        Length of each task, s, in the order in which they are handed out.
    workers : int
        At most so many run at once.
    booking_s : callable
        How long the one process takes to book a finished task and to hand out the next, s, by the number of those
        booked before.
    start_s : float
        What a worker takes before its first task, s.

    Returns
    -------
    Simulated
    """
    running = [start_s + task for task in tasks_s[:workers].tolist()]
    waiting = iter(tasks_s[workers:].tolist())
    heapq.heapify(running)
    free, booked = 0.0, 0
    while running:
        # The process books in the order in which tasks end, and only when it is done with the one before.
        free = max(free, heapq.heappop(running)) + booking_s(booked)
        booked += 1
        following = next(waiting, None)
        if following is not None:
            heapq.heappush(running, free + following)
    return Simulated(workers, free, float(tasks_s.sum()))


def shard_times(
    samples_s: Array, anatomies_s: Array, shards: int, samples_a_shard: int, samples_an_anatomy: int, seed: int = 0
) -> Array:
    """Draw the lengths of shards, s, from measured times of samples and of anatomies, with replacement.

    A shard makes each of its anatomies anew, the one that it shares with the shard before too.
    """
    rng = np.random.default_rng(seed)
    anatomies = 1 + -(-samples_a_shard // samples_an_anatomy)
    made = np.empty(shards)
    # In parts: millions of numbers at once take memory for nothing.
    for first in range(0, shards, 1000):
        count = min(1000, shards - first)
        of_samples = rng.choice(samples_s, (count, samples_a_shard)).sum(axis=1)
        made[first : first + count] = of_samples + rng.choice(anatomies_s, (count, anatomies)).sum(axis=1)
    return made
