"""Costs of the code: run time of fixed pieces of work over a reference kernel timed beside them, and memory."""

import time
from collections.abc import Callable

import cv2
import numpy as np
import polars as pl

from simtest.calibration import Priors, exactly
from simtest.errors import Failure
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.photometric import photometric
from simtest.geometry import Camera, Patch, smooth
from simtest.nightly.canaries.canary import canary
from simtest.nightly.records import Cell, Figure, figure_table
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.measuring import times_in_turns
from simtest.spec import load_scene

SIDE, WIDTH_PX, SIGMA, SMOOTHING_PX = 100, 28.0, 0.05, 2.0
FRAME_PX = 406

HIGHLIGHT, FRAME = f"a highlight of {SIDE} x {SIDE} px", f"a frame of {FRAME_PX} x {FRAME_PX} px"

ROUNDS = 15

Piece = Callable[[], object]


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


def _frame_pieces(variant: str | None) -> dict[str, Piece]:
    """Return the work on a whole frame: its radiance, and detection with the default estimators."""
    scene = load_scene("cylinder")
    session = Session(scene, variant)
    light = session.radiance().total
    noise = np.random.default_rng(2).standard_normal(light.shape, dtype=np.float32)
    frame = light / light.max() + np.float32(SIGMA) * noise
    return {"radiance": session.radiance, "reconstruct": lambda: reconstruct(frame, session.camera)}


def run_times(variant: str | None = None, rounds: int = ROUNDS) -> pl.DataFrame:
    """Time the pieces, each in so many rounds.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, kind "cost", `estimator` the piece's name, quantity "run_time": the median of the rounds'
        ratios to the reference kernel's time; `low`, `high` are their quartiles. A piece without a result has no value,
        for it stops early and would look fast; a row of kind "canary" counts these.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        of_highlight = estimator_pieces()
        pieces = {**of_highlight, **_frame_pieces(variant)}
        idle = {name: why for name, piece in pieces.items() if (why := _no_result(piece()))}
        # The processor's time, of all threads: other work on the machine changes it less than the clock's.
        times = times_in_turns({"reference": reference_kernel(), **pieces}, rounds, time.process_time)
    finally:
        cv2.setNumThreads(threads)
    # Ratios to the reference kernel, round by round
    reference = np.array(times["reference"])
    made = []
    for name in pieces:
        cell = _cell(name, HIGHLIGHT if name in of_highlight else FRAME)
        if name in idle:
            # It would look fast.
            made.append(Figure("cost", cell, "run_time", "x", None, n=0, about=f"no answer: {idle[name]}"))
            continue
        low, middle, high = (float(value) for value in np.percentile(times[name] / reference, (25, 50, 75)))
        about = f"{1e3 * np.median(times[name]):.3g} ms over {1e3 * np.median(reference):.3g} ms of processor time"
        made.append(Figure("cost", cell, "run_time", "x", middle, low, high, rounds, about=about))
    about = "; ".join(f"{name}: {why}" for name, why in idle.items()) or "each piece that is timed has an answer"
    made.append(canary("costs", "unanswered", "", len(idle), 0.0, n=len(pieces), about=about))
    return figure_table(made)


def _no_result(result: object) -> str:
    """Return the reason where a piece of work has no result; nothing where it has one."""
    if isinstance(result, Failure):
        return str(result)
    if isinstance(result, list):
        # Of a frame: one specularity that all estimators answer is enough, as noise may add others.
        whole = [spot for spot in result if not any(isinstance(own, Failure) for own in spot.estimates.values())]
        return "" if whole else f"none of {len(result)} specularities"
    return ""


def memory(peak_mib: float | None, workers: int) -> pl.DataFrame:
    """Return the figure of the run's peak memory; no row where the system does not tell it."""
    cell = _cell("night", f"{workers} worker{'s' * (workers > 1)}")
    about = "all processes together, shared pages once"
    return figure_table(
        [] if peak_mib is None else [Figure("cost", cell, "peak_memory", "MiB", peak_mib, n=1, about=about)]
    )


def _cell(piece: str, setting: str) -> Cell:
    return Cell("cost", setting=setting, estimator=piece)
