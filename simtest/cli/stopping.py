"""SIGTERM, answered as Ctrl-C is: between two steps, with what is finished kept and no process left behind.

Before a command begins, and once it has ended, there is nothing to keep: then both end the process at once and say
nothing. Within an import they wait for its end: an exception there can be swallowed, or break a library for good.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

INTERRUPTED = 130
TERMINATED = 143

LATER_S = 0.01
"""After so long a stop that came within an import is tried again."""


class Termination:
    """Hands SIGTERM on to whatever answers Ctrl-C, and remembers that it came."""

    def __init__(self) -> None:
        self.came = False
        self._working = False
        self._before: dict[int, Any] = {}
        self._unraisable = sys.unraisablehook

    def __enter__(self) -> "Termination":
        """Answer SIGTERM and Ctrl-C from now on; in a thread, which gets no signals, nothing is done."""
        if threading.current_thread() is threading.main_thread():
            self._before = {
                number: signal.signal(number, answer)
                for number, answer in ((signal.SIGTERM, self._terminate), (signal.SIGALRM, self._again))
            }
            # Ignored by nohup, and in the background of a script: then it stays so.
            if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
                self._before[signal.SIGINT] = signal.signal(signal.SIGINT, self._interrupt)
            sys.unraisablehook = self._lost
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the signals to whoever answered them before."""
        for number, before in self._before.items():
            signal.signal(number, before)
        sys.unraisablehook = self._unraisable

    @contextmanager
    def working(self) -> Iterator[None]:
        """Have a stop raise KeyboardInterrupt meanwhile."""
        self._working = True
        try:
            yield
        finally:
            self._working = False

    def _terminate(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        if self._before and not self._working:
            os._exit(TERMINATED)
        if _importing(frame):
            signal.setitimer(signal.ITIMER_REAL, LATER_S)
            return
        # A progress bar waits for the end of its step; otherwise KeyboardInterrupt is raised here.
        interrupt = signal.getsignal(signal.SIGINT)
        if callable(interrupt):
            interrupt(number, frame)
        else:
            raise KeyboardInterrupt

    def _interrupt(self, _: int, frame: FrameType | None) -> None:
        if not self._working:
            os._exit(TERMINATED if self.came else INTERRUPTED)
        if _importing(frame):
            signal.setitimer(signal.ITIMER_REAL, LATER_S)
            return
        raise KeyboardInterrupt

    def _again(self, number: int, frame: FrameType | None) -> None:
        # Ctrl-C may by now be answered by someone else, such as a progress bar.
        answer = self._terminate if self.came else signal.getsignal(signal.SIGINT)
        if callable(answer):
            answer(number, frame)

    def _lost(self, what: Any) -> None:
        """Try again where an exception was raised in a place that cannot raise, such as the end of an object."""
        if issubclass(what.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, LATER_S)
        else:
            self._unraisable(what)


def _importing(frame: FrameType | None) -> bool:
    """Return whether a module is being imported."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False
