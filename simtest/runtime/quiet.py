"""Silence for native libraries, which print to the error stream what our own line says better."""

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

_LOCK = threading.RLock()


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Send nowhere what is written to the process's error stream meanwhile; for single calls of a library.

    libpng, libtiff and FFmpeg write to the descriptor itself, which no setting of OpenCV prevents.
    """
    with _LOCK:
        try:
            sys.stderr.flush()
            kept = os.dup(2)
        except (OSError, ValueError, AttributeError):
            # There is no error stream.
            yield
            return
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
