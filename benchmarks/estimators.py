"""Fixed pieces of work: processor time of each over that of a reference kernel, whatever the machine.

Estimators on one highlight of 100 x 100 px, the radiance of a frame, and its reconstruction.
"""

import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np

from benchmarks.measuring import Figure
from benchmarks.timing import times_in_turns
from simtest.calibration import Priors, exactly
from simtest.errors import Failure
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.photometric import photometric
from simtest.geometry import Camera, Patch, smooth
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.spec import load_scene

SIDE, WIDTH_PX, SIGMA, SMOOTHING_PX = 100, 28.0, 0.05, 2.0
FRAME_PX = 406

ROUNDS = 25
LIMITS = {
    "circle_pose": 6.0, "cone_axis": 3.0, "curved": 4.0, "photometric": 8.0, "radiance": 10.0, "reconstruct": 30.0,
}  # fmt: skip
"""Largest ratios to the blur of a frame, which takes its turns with them: whatever the machine, it slows both alike."""

Piece = Callable[[], object]


def figures() -> list[Figure]:
    """Return the figures, measured in turns on one core by processor time."""
    cv2.setNumThreads(1)
    pieces = {**estimator_pieces(), **frame_pieces()}
    # What gives no answer stops early, and would look fast.
    if idle := {name: why for name, piece in pieces.items() if (why := no_result(piece()))}:
        raise RuntimeError("; ".join(f"{name}: no answer: {why}" for name, why in idle.items()))
    times = times_in_turns({"reference": reference_kernel(), **pieces}, ROUNDS, time.process_time)
    shown = []
    for name, limit in LIMITS.items():
        ratio = statistics.median(own / blur for own, blur in zip(times[name], times["reference"], strict=True))
        about = (
            f"{1e3 * statistics.median(times[name]):.2f} ms over {1e3 * statistics.median(times['reference']):.2f} ms"
        )
        size = FRAME_PX if name in ("radiance", "reconstruct") else SIDE
        what = "a frame" if size == FRAME_PX else "one highlight"
        shown.append(Figure(f"{name}, {what} of {size} x {size} px, over a blur of 406 x 406 px", ratio, limit,
                            about=about))  # fmt: skip
    return shown


def highlight() -> tuple[Patch, Camera]:
    """Return a noisy highlight of 100 x 100 px, always the same, and its camera."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    lobe = np.exp(-((x - 50.3) ** 2 + 1.3 * (y - 49.6) ** 2) / WIDTH_PX**2)
    frame = (lobe + SIGMA * np.random.default_rng(0).standard_normal(lobe.shape)).astype(np.float32)
    patch = Patch.cut(
        smooth(frame, SMOOTHING_PX), (0, 0, SIDE, SIDE), raw=frame, noise=SIGMA, smoothing_px=SMOOTHING_PX
    )
    assert isinstance(patch, Patch)
    return patch, Camera(SIDE, SIDE, 406.0, 406.0, SIDE / 2, SIDE / 2)


def untraced(patch: Patch) -> Patch:
    """Return the same patch without the isophotes that it has traced."""
    return Patch(
        patch.values, patch.origin_px, patch.peak_px, patch.peak_value, patch.peak_pixel, raw=patch.raw,
        noise=patch.noise, smoothing_px=patch.smoothing_px,
    )  # fmt: skip


def reference_kernel() -> Piece:
    """Return the work that run times are ratios to: a wide blur of a frame, on one core."""
    frame = np.random.default_rng(1).standard_normal((FRAME_PX, FRAME_PX), dtype=np.float32)
    return lambda: cv2.GaussianBlur(frame, (0, 0), 8.0)


def estimator_pieces() -> dict[str, Piece]:
    """Return estimators at work on one highlight."""
    patch, camera = highlight()
    priors = Priors(lobe_curvature=exactly(200.0))
    return {
        "circle_pose": lambda: circle_pose.estimate(untraced(patch), camera),
        "cone_axis": lambda: cone_axis.estimate(untraced(patch), camera),
        "curved": lambda: curved.estimate(untraced(patch), camera, priors),
        "photometric": lambda: photometric.estimate(untraced(patch), camera),
    }


def frame_pieces() -> dict[str, Piece]:
    """Return the work on a whole frame: its radiance, and detection with the default estimators."""
    session = Session(load_scene("cylinder"))
    light = session.radiance().total
    noise = np.random.default_rng(2).standard_normal(light.shape, dtype=np.float32)
    frame = light / light.max() + np.float32(SIGMA) * noise
    return {"radiance": session.radiance, "reconstruct": lambda: reconstruct(frame, session.camera)}


def no_result(result: object) -> str:
    """Return the reason where a piece of work has no result; nothing where it has one."""
    if isinstance(result, Failure):
        return str(result)
    if isinstance(result, list):
        # Of a frame: one specularity that all estimators answer is enough, as noise may add others.
        whole = [spot for spot in result if not any(isinstance(own, Failure) for own in spot.estimates.values())]
        return "" if whole else f"none of {len(result)} specularities"
    return ""
