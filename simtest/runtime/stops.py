"""A stop (Ctrl-C, SIGTERM): a run waits for the end of its step, or for a place where it may break in."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import local


class _Stop(local):
    """What this thread knows of a stop; signals come to the main thread alone."""

    is_wanted = False
    is_breakable = False


STOP = _Stop()


@contextmanager
def breakable() -> Iterator[None]:
    """Let a stop break in, or raise the one that came before: nothing in the body loses or is broken by it."""
    STOP.is_breakable = True
    try:
        if STOP.is_wanted:
            raise KeyboardInterrupt
        yield
    finally:
        STOP.is_breakable = False
