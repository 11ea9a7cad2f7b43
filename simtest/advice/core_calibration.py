"""Calibrates a core: renders frames of a scope, runs the core on them, and finds how large its errors are by stratum.

The frames are those of `simtest advise`: walls of an organ at drawn forms, poses and reliefs. Detection, answers and
their matching with the truth are those of a run; what matches no true highlight is judged at the answer's own pixel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from simtest.advice.plan import DISTANCES, Question, main_experiment
from simtest.dataset.scoring.frames import CaseFrames, RenderedFrame
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.names import forgive_cores
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.regions import MOST_DEG, features, statistics_of
from simtest.runtime.seeds import Stage, integer
from simtest.validation.cases import expand
from simtest.validation.realisation import answer, score
from simtest.geometry.vectors import angle_deg

Answered = dict[str, Any]


def batch_of(question: Question, batch: int) -> Question:
    seed = integer(question.seed, "calibrate core", "batch", batch, Stage.SWEEP)
    return replace(question, frames=DISTANCES, seed=seed)


def frames_of(question: Question, variant: str | None = None):
    experiment = main_experiment(question)
    for number, case in enumerate(expand(experiment)):
        yield from CaseFrames(experiment, case, number, variant)


def answers_of(frame: RenderedFrame, estimators: Mapping[str, AnyEstimator], like: str) -> list[Answered]:
    if like == "reconstruct":
        picture = np.round(255 * frame.image).astype(np.uint8)
        spots, isolated = reconstruct(picture, frame.calibration, estimators), True
    else:
        isolated = False
        spots = answer(frame.view, frame.image, estimators, isolated)
    rows = score(frame.session, frame.view, spots, estimators, {}, isolated).rows
    made = []
    for row in rows:
        if row["status"] != "ok":
            continue
        spot, name = spots[row["specularity"]], row["estimator"]
        stated = spot.estimates[name]
        for estimate in dict.fromkeys(e.target for e in (stated, spot.organ[name])):
            pass
        for estimate in ([stated] if stated.target == "base" else [stated, spot.organ[name]]):
            made.append((row, spot, estimate))
    if not made:
        return []
    looks = np.stack([e.look_px for _, _, e in made])
    at = frame.session.exact_points(looks)
    answered = []
    size = frame.image.shape[1], frame.image.shape[0]
    for n, (row, spot, estimate) in enumerate(made):
        target = estimate.target
        error = row.get(f"error_{target}_deg")
        normal = (at.normal if target == "fine" else at.normal_base)[n]
        look = float(angle_deg(estimate.normal, normal)) if at.valid[n] else MOST_DEG
        if error is None:
            error = look
        answered.append({
            "estimator": row["estimator"], "target": target, "error_deg": error, "look_deg": look, "false": row["true_id"] is None,
            "visible": row.get("visible_id") is not None,
            **features(spot, estimate, size),
            # study
            "s": row["specularity"], "flag_text": ",".join(estimate.flags), "axis_ratio": estimate.axis_ratio,
            "contrast": spot.region.contrast, "peak": spot.peak_px.tolist() if spot.peak_px is not None else None,
            "n_spots": len(spots), "margin": estimate.choice_margin, "n_cand": len(estimate.candidates),
            "saturated": row.get("saturated_share"),
            "area1": None if estimate.cloud is None else len(estimate.cloud.points_px),
            "cov": None if estimate.covariance is None else estimate.covariance.tolist(),
            "m2": row.get("mahalanobis2") if target == stated_target(spot, row) else None,
            "hl": None if spot.highlight is None else [spot.highlight.area_px, spot.highlight.axis_ratio, spot.highlight.residual, spot.highlight.wander, spot.highlight.tint, spot.highlight.clutter, spot.highlight.clipped],
        })
    return answered

def stated_target(spot, row):
    return spot.estimates[row["estimator"]].target
