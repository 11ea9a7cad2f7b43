"""Progress on the error stream: a bar with time left at a terminal, else plain lines; and a stop between two steps."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Protocol

from simtest.cli.manners import MANNERS
from simtest.cli.remaining import Remaining
from simtest.pages import WRITTEN

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

LINE_EVERY_S = 10.0
"""Of a log; work that takes less leaves no line."""


@contextmanager
def stop_between_steps() -> Iterator[Callable[[], None]]:
    """Yield a callable that raises KeyboardInterrupt if Ctrl-C was pressed meanwhile; a second press stops at once.

    Raised anywhere else, KeyboardInterrupt can be lost in a callback, or break the renderer while it is imported.
    """
    presses = 0

    def press(*_: object) -> None:
        nonlocal presses
        presses += 1
        if presses > 1:
            raise KeyboardInterrupt

    def check() -> None:
        if presses:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, press)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


class Display(Protocol):
    """What shows the steps of some work."""

    def show(self, done: int, total: int, what: str) -> None:
        """Show how many steps are done, and the present one."""

    def close(self) -> None:
        """End the display."""


@contextmanager
def progress_bar(afterwards: str = "writing the report") -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar, or lines, while the body runs, and yield the callable that moves it: (done, total, what).

    `afterwards` is what the body does once all steps are done, unless the last step is that of a page (`WRITTEN`):
    nothing follows it. A single step shows no bar. What comes after all steps of a bar, such as the steps of a page,
    has a bar of its own below.
    """
    display: Display | None = None
    with stop_between_steps() as check:

        def move(done: int, total: int, what: str) -> None:
            nonlocal display
            check()
            if display is None:
                if done == total:
                    return
                # Not before the first step: bad input is reported in one line, and nothing to do takes no time.
                display = _display()
            display.show(done, total, afterwards if done == total and what != WRITTEN else what)

        try:
            yield move
        finally:
            if display is not None:
                display.close()


def at_terminal() -> bool:
    """Return whether a person sees the error stream."""
    return sys.stderr is not None and sys.stderr.isatty()


def _display() -> Display:
    if MANNERS.quiet:
        return _Nothing()
    return _Lines() if MANNERS.verbose or not at_terminal() else _Bar()


class _Nothing:
    def show(self, done: int, total: int, what: str) -> None:
        """Show nothing."""

    def close(self) -> None:
        """Do nothing."""


class _Lines:
    """Plain lines for a log: one in `LINE_EVERY_S`, or with --verbose one a step."""

    def __init__(self) -> None:
        self.began = self.told = time.monotonic()
        self.remaining = Remaining()

    def show(self, done: int, total: int, what: str) -> None:
        """Print a line where the last one is old enough."""
        now = time.monotonic()
        left = self.remaining.seconds(done, total, now)
        if not MANNERS.verbose and now - self.told < LINE_EVERY_S:
            return
        self.told, passed = now, now - self.began
        about = f", about {left:.0f} s left" if left and done < total else ""
        print(f"simtest: {done}/{total} {what} ({passed:.0f} s{about})", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Do nothing: the command says what came of it."""


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

    def close(self) -> None:
        """Leave the bar as it stands."""
        self.bar.stop()


def _rich_bar() -> "Progress":
    """Return a bar on the error stream."""
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.SpinnerColumn(finished_text=" "), rich.BarColumn(), rich.MofNCompleteColumn(), rich.TimeElapsedColumn(),
        rich.TextColumn("{task.fields[left]}"), rich.TextColumn("{task.description}"),
    )  # fmt: skip
    return rich.Progress(*columns, console=Console(stderr=True))
