"""One highlight of 100 x 100 px: each estimator's processor time over that of a fixed piece of work."""

import statistics
import time

import cv2

from benchmarks.measuring import Figure
from simtest.nightly.cost import SIDE, estimator_pieces, reference_kernel
from simtest.runtime.measuring import times_in_turns

ROUNDS = 25
LIMITS = {"circle_pose": 6.0, "cone_axis": 3.0, "curved": 4.0, "photometric": 8.0}
"""Largest ratios to the blur of a frame, which takes its turns with them: whatever the machine, it slows both alike."""


def figures() -> list[Figure]:
    """Return the figures, measured in turns on one core by processor time."""
    cv2.setNumThreads(1)
    pieces = {name: piece for name, piece in estimator_pieces().items() if name in LIMITS}
    times = times_in_turns({"reference": reference_kernel(), **pieces}, ROUNDS, time.process_time)
    shown = []
    for name, limit in LIMITS.items():
        ratio = statistics.median(own / blur for own, blur in zip(times[name], times["reference"], strict=True))
        about = (
            f"{1e3 * statistics.median(times[name]):.2f} ms over {1e3 * statistics.median(times['reference']):.2f} ms"
        )
        shown.append(Figure(f"{name}, one highlight of {SIDE} x {SIDE} px, over a blur of 406 x 406 px", ratio, limit,
                            about=about))  # fmt: skip
    return shown
