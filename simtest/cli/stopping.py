"""SIGTERM, answered as Ctrl-C is: between two steps, with what is finished kept and no process left behind."""

import signal
import threading
from types import FrameType
from typing import Any


class Termination:
    """Hands SIGTERM on to whatever answers Ctrl-C, and remembers that it came."""

    def __init__(self) -> None:
        self.came = False
        self._before: Any = None

    def __enter__(self) -> "Termination":
        """Answer SIGTERM from now on; in a thread, which gets no signals, nothing is done."""
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGTERM, self._answer)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave SIGTERM to whoever answered it before."""
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _answer(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        # A progress bar waits for the end of its step; otherwise KeyboardInterrupt is raised here.
        interrupt = signal.getsignal(signal.SIGINT)
        if callable(interrupt):
            interrupt(number, frame)
        else:
            # Started with SIGINT ignored, as by nohup or in the background of a script.
            raise KeyboardInterrupt
