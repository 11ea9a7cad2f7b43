"""How long some work still takes: an estimate that waits until it is worth showing."""

from dataclasses import dataclass, field

LEAST_STEPS = 4
"""Measured steps before which there is no estimate."""

LEAST_S = 2.0
"""Measured time before which there is none."""

AGREEMENT = 1.5
"""An estimate is stable where the paces of all measured steps and of their later half differ by at most this factor."""


@dataclass
class Remaining:
    """An estimate of the time that is left of a stretch of work, from the times at which its steps ended.

    The first step is not measured: it compiles the renderer's kernels, and takes as long as dozens of others.
    """

    _first: int | None = None  # steps that were done at the first call
    _ends: list[tuple[int, float]] = field(default_factory=list)  # steps done, and when, from the end of the first on

    def seconds(self, done: int, total: int, now: float) -> float | None:
        """Take note that `done` of `total` steps are done at a time, s, and return the time left, s.

        It is None while it is not known.
        """
        if self._first is None or done < self._first or (self._ends and done < self._ends[-1][0]):
            # A new stretch of work.
            self._first, self._ends = done, []
            return None
        if done > self._first and (not self._ends or done > self._ends[-1][0]):
            self._ends.append((done, now))
        pace = self._pace()
        return None if pace is None else pace * (total - done)

    def _pace(self) -> float | None:
        """Return the time of a step, s, as measured over the later half of the steps; None while it is not stable."""
        if not self._ends:
            return None
        (start, began), (end, ended) = self._ends[0], self._ends[-1]
        if end - start < LEAST_STEPS or ended - began < LEAST_S:
            return None
        middle, passed = next(entry for entry in reversed(self._ends) if 2 * entry[0] <= start + end)
        overall, recent = (ended - began) / (end - start), (ended - passed) / (end - middle)
        return recent if overall <= AGREEMENT * recent and recent <= AGREEMENT * overall else None
