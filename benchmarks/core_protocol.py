"""What a core of another process costs beside its own work: a request to one that answers at once, there and back.

Wall time of the median request, and the processor time of both processes over all requests.
"""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from benchmarks.measuring import Figure
from simtest.calibration import NO_PRIORS, Calibration, Frame
from simtest.estimators import Estimate
from simtest.estimators.process.core import Core, ProcessEstimator, ProcessFrameEstimator, load_core
from simtest.geometry import Camera, Patch

ROUNDS = 200
HIGHLIGHT_MS = 3.0
FRAME_MS = 10.0
SIDE = 100

CAMERA = Camera.from_fov(70.0, 640, 480)
CORE = Path(__file__).parent / "echo_core.py"


@dataclass(frozen=True)
class Cost:
    """Wall time of the median request, and processor time of one in both processes, ms."""

    wall_ms: float
    processor_ms: float

    def figure(self, name: str, limit: float) -> Figure:
        """Return the wall time beside its limit."""
        return Figure(name, self.wall_ms, limit, unit="ms", about=f"{self.processor_ms:.2f} ms of processor time")


def measured(core: Core, ask: Callable[[], object], pid: int) -> Cost:
    """Ask a core again and again."""
    for _ in range(10):
        assert isinstance(ask(), Estimate | list)
    child, walls = psutil.Process(pid), []
    before = time.process_time() + sum(child.cpu_times()[:2])
    for _ in range(ROUNDS):
        start = time.perf_counter()
        ask()
        walls.append(time.perf_counter() - start)
    used = time.process_time() + sum(child.cpu_times()[:2]) - before
    core.close()
    return Cost(1e3 * statistics.median(walls), 1e3 * used / ROUNDS)


def _loaded(kind: str) -> tuple[ProcessEstimator | ProcessFrameEstimator, int]:
    """Start a core of its own; return it as an estimator, with the number of its process."""
    mine = psutil.Process()
    before = {child.pid for child in mine.children()}
    estimator = load_core(f"command: {sys.executable} -S {CORE} {kind}")
    (pid,) = (c.pid for c in mine.children() if c.pid not in before and "echo_core" in " ".join(c.cmdline()))
    return estimator, pid


def figures() -> list[Figure]:
    """Return the cost of a highlight and of a frame."""
    y, x = np.mgrid[:480, :640] + 0.5
    light = np.exp(-((x - 320) ** 2 + (y - 240) ** 2) / 500).astype(np.float32)
    patch = Patch.cut(light, (320 - SIDE // 2, 240 - SIDE // 2, SIDE, SIDE), raw=light, noise=0.01, smoothing_px=2.0)
    frame = Frame(light, Calibration(CAMERA), 2.0)
    assert isinstance(patch, Patch)
    single, first = _loaded("patch")
    whole, second = _loaded("frame")
    assert isinstance(single, ProcessEstimator)
    assert isinstance(whole, ProcessFrameEstimator)
    of_patch = measured(single.core, lambda: single.estimate(patch, CAMERA, NO_PRIORS), first)
    of_frame = measured(whole.core, lambda: whole.estimate_frame(frame, CAMERA, NO_PRIORS), second)
    return [
        of_patch.figure(f"a highlight of {SIDE} x {SIDE} px asked of another process", HIGHLIGHT_MS),
        of_frame.figure("a frame of 640 x 480 asked of another process", FRAME_MS),
    ]
