"""Tasks for the tests of engines: workers import them by name."""

import os
import signal
from pathlib import Path

from simtest.errors import InputError


def square(number, tell):
    tell()
    return number * number


def dies_once(argument, tell):
    folder, number = argument
    mark = Path(folder) / str(number)
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def fails(number, tell):
    raise InputError(f"no such number: {number}")


def breaks(number, tell):
    raise TypeError(f"no such kind: {number}")


def meets_a_full_disk(number, tell):
    raise OSError(28, "No space left on device")


def blocked_signals(_, tell):
    """Return which signals the worker has blocked: as it was started, since nothing changes that."""
    return sorted(map(int, signal.pthread_sigmask(signal.SIG_BLOCK, [])))


def threads(_, tell):
    """Return what the worker's libraries read, or were told, of their threads."""
    import cv2

    return os.environ["SIMTEST_THREADS"], os.environ["OPENBLAS_NUM_THREADS"], cv2.getNumThreads()


def swallows_memory(path):
    """Need more memory than there is."""
    return len(bytearray(2**40))


def prints(path):
    """Read a file as a library that prints would."""
    print("a warning of the library")
    os.write(1, b"another\n")
    return Path(path).read_text()


def process(number, tell):
    """Return the process's number."""
    return os.getpid()
