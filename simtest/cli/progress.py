"""A progress bar with time left, on the error stream, and a stop between two steps."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


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


@contextmanager
def progress_bar(afterwards: str = "writing the report") -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar while the body runs, and yield the callable that moves it: (done, total, what).

    `afterwards` is what the body does once all steps are done, unless the last step says itself how it ended: with a
    text that ends in "written". A single step shows no bar. What comes after all steps of a bar, such as the steps of
    a page, has a bar of its own below.
    """
    bar: Progress | None = None
    task: TaskID | None = None
    with stop_between_steps() as check:

        def move(done: int, total: int, what: str) -> None:
            nonlocal bar, task
            check()
            if bar is None:
                if done == total:
                    return
                # Not before the first step: bad input is reported in one line, and nothing to do takes no time.
                bar = _bar()
                task = bar.add_task("starting", total=None)
                bar.start()
            assert task is not None
            if done < total and bar.tasks[-1].finished:
                bar.update(task, description="done")
                task = bar.add_task(what, total=total)
            described = afterwards if done == total and not what.endswith("written") else what
            bar.update(task, completed=done, total=total, description=described)

        try:
            yield move
        finally:
            if bar is not None:
                bar.stop()


def _bar() -> "Progress":
    """Return a bar on the error stream."""
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.SpinnerColumn(finished_text=" "), rich.BarColumn(), rich.MofNCompleteColumn(), rich.TimeElapsedColumn(),
        rich.TextColumn("left"), rich.TimeRemainingColumn(), rich.TextColumn("{task.description}"),
    )  # fmt: skip
    return rich.Progress(*columns, console=Console(stderr=True))
