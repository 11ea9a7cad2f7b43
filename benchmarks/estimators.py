"""One highlight of 100 x 100 px: each estimator's time, and that over a fixed piece of work for comparison."""

import cv2

from benchmarks.measuring import Figure
from simtest.nightly.cost import SIDE, estimator_pieces, reference_kernel
from simtest.runtime.measuring import in_turns

ROUNDS = 25
LIMITS_MS = {"cone_axis": 1.5, "curved": 2.5, "photometric": 25.0}


def figures() -> list[Figure]:
    """Return the figures, measured in turns on one core."""
    cv2.setNumThreads(1)
    pieces = {name: piece for name, piece in estimator_pieces().items() if name in LIMITS_MS}
    times = in_turns({"reference": reference_kernel(), **pieces}, ROUNDS)
    shown = []
    for name, limit in LIMITS_MS.items():
        label, about = f"{name}, one highlight of {SIDE} x {SIDE} px", f"{1e3 * times[name]:.2f} ms"
        shown.append(Figure(label, 1e3 * times[name], limit, unit="ms"))
        shown.append(Figure(f"{label}, over a blur of 406 x 406 px", times[name] / times["reference"], about=about))
    return shown
