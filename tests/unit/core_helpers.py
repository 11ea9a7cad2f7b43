"""Cores for tests: how they are started, what they are asked, and whether anything is left of them."""

import sys
import time
import uuid
from pathlib import Path

import numpy as np
import psutil

from simtest.estimators.process.core import CoreCommand
from simtest.geometry import Camera, Patch

CORES = Path(__file__).parent / "cores"
BAD_CORE = CORES / "bad_core.py"
OWN_CORE = CORES / "own_core.py"

CAMERA = Camera.from_fov(70.0, 640, 480)


def lobe_patch(side=60):
    """Cut a highlight at the image's centre."""
    y, x = np.mgrid[:480, :640] + 0.5
    lobe = np.exp(-((x - 320) ** 2 + (y - 240) ** 2) / 200).astype(np.float32)
    patch = Patch.cut(
        lobe, (320 - side // 2, 240 - side // 2, side, side), raw=lobe, noise=0.01, smoothing_px=2.0, others_px=()
    )
    assert isinstance(patch, Patch)
    return patch


PATCH = lobe_patch()


def bad_command(*arguments, limit_s=20.0, start_s=20.0):
    """Return the command of a core that breaks down, and a word that its processes alone have on their command line."""
    mark = f"--mark={uuid.uuid4().hex}"
    line = (sys.executable, "-S", str(BAD_CORE), *arguments, mark)
    return CoreCommand("bad core", "bad_core", line, (BAD_CORE,), limit_s, start_s), mark


def script_command(folder, text):
    """Return the command of a core of this text."""
    script = folder / "core.py"
    script.write_text(text)
    return CoreCommand("script core", "core", (sys.executable, "-S", str(script)), (script,))


def processes_with(mark):
    """Return the processes whose command line holds a word; this one and its own parents aside."""
    found = []
    for process in psutil.process_iter(["cmdline", "status"]):
        held = process.info["cmdline"] or []
        if any(mark in word for word in held) and process.info["status"] != psutil.STATUS_ZOMBIE:
            found.append(process)
    return found


def wait_until(condition, limit_s=20.0):
    """Return whether a condition comes true in time."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False
