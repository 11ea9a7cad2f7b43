"""One highlight of 100 x 100 px: each estimator's time, and that over a fixed piece of work for comparison."""

import cv2
import numpy as np

from benchmarks.measuring import Figure, in_turns
from simtest.calibration import Known
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.photometric import photometric
from simtest.geometry import Camera, Patch, smooth

SIDE, WIDTH_PX, SIGMA, SMOOTHING_PX = 100, 28.0, 0.05, 2.0
ROUNDS = 25
LIMITS_MS = {"cone_axis": 1.5, "curved": 2.5, "photometric": 25.0}


def figures() -> list[Figure]:
    """Give the figures, measured in turns on one core."""
    cv2.setNumThreads(1)
    patch, camera = _highlight()
    known = Known(lobe_curvature=200.0)
    frame = np.random.default_rng(1).standard_normal((406, 406), dtype=np.float32)
    times = in_turns(
        {
            "reference": lambda: cv2.GaussianBlur(frame, (0, 0), 8.0),
            "cone_axis": lambda: cone_axis(_anew(patch), camera),
            "curved": lambda: curved(_anew(patch), camera, known),
            "photometric": lambda: photometric(_anew(patch), camera),
        },
        ROUNDS,
    )
    shown = []
    for name, limit in LIMITS_MS.items():
        label, about = f"{name}, one highlight of {SIDE} x {SIDE} px", f"{1e3 * times[name]:.2f} ms"
        shown.append(Figure(label, 1e3 * times[name], limit, unit="ms"))
        shown.append(Figure(f"{label}, over a blur of 406 x 406 px", times[name] / times["reference"], about=about))
    return shown


def _highlight() -> tuple[Patch, Camera]:
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    lobe = np.exp(-((x - 50.3) ** 2 + 1.3 * (y - 49.6) ** 2) / WIDTH_PX**2)
    frame = (lobe + SIGMA * np.random.default_rng(0).standard_normal(lobe.shape)).astype(np.float32)
    patch = Patch.cut(
        smooth(frame, SMOOTHING_PX), (0, 0, SIDE, SIDE), raw=frame, noise=SIGMA, smoothing_px=SMOOTHING_PX
    )
    assert isinstance(patch, Patch)
    return patch, Camera(SIDE, SIDE, 406.0, 406.0, SIDE / 2, SIDE / 2)


def _anew(patch: Patch) -> Patch:
    """Give the same patch without the isophotes that it has traced."""
    return Patch(
        patch.values, patch.origin_px, patch.peak_px, patch.peak_value, patch.peak_pixel, raw=patch.raw,
        noise=patch.noise, smoothing_px=patch.smoothing_px,
    )  # fmt: skip
