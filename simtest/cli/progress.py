"""Progress on the error stream: a bar with time left at a terminal, else plain lines; and a stop between two steps."""

import signal
import sys
import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from operator import itemgetter
from typing import TYPE_CHECKING

from simtest.cli.main import MANNERS
from simtest.pages import WRITTEN
from simtest.runtime.stops import STOP

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

LEAST_STEPS, JUDGED_STEPS = 2, 4
"""Measured steps before which there is no estimate, with the first one three, and none that must be stable."""

LEAST_S = 2.0
"""Measured time before which there is none; at a terminal, work that has no steps shows a bar after it."""

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
        """Return the time of a step, s: over all of a few, else over the later half; None while it is not stable."""
        if not self._ends:
            return None
        (start, began), (end, ended) = self._ends[0], self._ends[-1]
        if end - start < LEAST_STEPS or ended - began < LEAST_S:
            return None
        # A search through all of them at every step took a fifth of a long run.
        middle, passed = self._ends[bisect_right(self._ends, (start + end) / 2, key=itemgetter(0)) - 1]
        overall, recent = (ended - began) / (end - start), (ended - passed) / (end - middle)
        if end - start < JUDGED_STEPS:
            return overall
        return recent if overall <= AGREEMENT * recent and recent <= AGREEMENT * overall else None


LINE_EVERY_S = 10.0
"""Of a log, after a line once the time left is known; work that takes less leaves none."""


PATIENCE_S = 5.0
"""So long a stop waits for the end of a step: who stops a container kills it 10 s later."""


@contextmanager
def stop_between_steps() -> Iterator[Callable[[], None]]:
    """Yield a callable that raises KeyboardInterrupt if Ctrl-C was pressed meanwhile.

    A second press stops at once, and so does the end of `PATIENCE_S`: what is lost is the step. Raised anywhere else,
    KeyboardInterrupt can be lost in a callback, or break the renderer while it is imported. A wait for another process
    (`breakable`) is stopped by the first press.
    """

    def press(*_: object) -> None:
        if STOP.is_wanted or STOP.is_breakable:
            raise KeyboardInterrupt
        STOP.is_wanted = True
        # Where a command runs, its answer to this signal is a press (`simtest.cli.main.Termination`).
        if callable(signal.getsignal(signal.SIGALRM)):
            signal.setitimer(signal.ITIMER_REAL, PATIENCE_S, PATIENCE_S)

    def check() -> None:
        if STOP.is_wanted:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, press)
    try:
        yield check
    finally:
        if STOP.is_wanted:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, before)
        STOP.is_wanted = False


@contextmanager
def progress_bar(
    afterwards: str = "writing the report", stopped: str = ""
) -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar, or lines, while the body runs, and yield the callable that moves it: (done, total, what).

    `afterwards` is what the body does once all steps are done, unless the last step is that of a page (`WRITTEN`):
    nothing follows it. A single step shows no bar, unless it is long. What comes after all steps of a bar, such as the
    steps of a page, has a bar of its own below. `stopped` is what a stop leaves; default what `main` says.
    """
    display: _Lines | _Bar | None = None
    began, lock = time.monotonic(), threading.Lock()

    def wait() -> None:
        nonlocal display
        with lock:
            if display is None and not waiting.finished.is_set():
                display = _Bar()

    waiting = threading.Timer(LEAST_S, wait)
    waiting.daemon = True
    with stop_between_steps() as check:
        if at_terminal() and not MANNERS.quiet and not MANNERS.verbose:
            waiting.start()

        def move(done: int, total: int, what: str) -> None:
            nonlocal display
            check()
            if MANNERS.quiet:
                return
            with lock:
                if display is None:
                    if done == total:
                        return
                    # Not before the first step: bad input is reported in one line, and nothing to do takes no time.
                    display = _Lines(began) if MANNERS.verbose or not at_terminal() else _Bar()
            display.show(done, total, afterwards if done == total and what != WRITTEN else what)

        try:
            yield move
        except KeyboardInterrupt as stop:
            if stopped and not str(stop):
                raise KeyboardInterrupt(stopped) from None
            raise
        finally:
            with lock:
                waiting.cancel()
            if isinstance(display, _Bar):
                display.bar.stop()


def at_terminal() -> bool:
    """Return whether a person sees the error stream."""
    return sys.stderr is not None and sys.stderr.isatty()


class _Lines:
    """Plain lines for a log: one in `LINE_EVERY_S` and once the time left is known; with --verbose one a step."""

    def __init__(self, began: float) -> None:
        self.began = self.told = began
        self.remaining = Remaining()
        self.is_known = False

    def show(self, done: int, total: int, what: str) -> None:
        """Print a line where the last one is old enough."""
        now = time.monotonic()
        left = self.remaining.seconds(done, total, now)
        first, self.is_known = bool(left) and not self.is_known, self.is_known or bool(left)
        if not (MANNERS.verbose or first) and now - self.told < LINE_EVERY_S:
            return
        self.told, passed = now, now - self.began
        about = f", about {left:.0f} s left" if left and done < total else ""
        print(f"simtest: {done}/{total} {what} ({passed:.0f} s{about})", file=sys.stderr, flush=True)


class _Bar:
    """A bar for each stretch of the work."""

    def __init__(self) -> None:
        self.bar = _rich_bar()
        self.remaining = Remaining()
        self.task: TaskID = self.bar.add_task("starting", total=None, left="")
        self.bar.start()

    def show(self, done: int, total: int, what: str) -> None:
        """Move the bar, or begin the next."""
        if done < total and self.bar.tasks[-1].finished:
            self.bar.update(self.task, description="done")
            self.task = self.bar.add_task(what, total=total, left="")
        seconds = self.remaining.seconds(done, total, time.monotonic())
        left = f"about {timedelta(seconds=round(seconds))} left" if seconds and done < total else ""
        self.bar.update(self.task, completed=done, total=total, description=what, left=left)


def _rich_bar() -> "Progress":
    """Return a bar on the error stream."""
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.SpinnerColumn(finished_text=" "), rich.BarColumn(), rich.MofNCompleteColumn(), rich.TimeElapsedColumn(),
        rich.TextColumn("{task.fields[left]}"), rich.TextColumn("{task.description}"),
    )  # fmt: skip
    return rich.Progress(*columns, console=Console(stderr=True))
