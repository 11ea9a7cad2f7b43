"""Keeps a few frames of a run with all that is needed to draw them: truth, isophotes, ellipses, normals."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.files import write_atomically
from simtest.rendering import Session
from simtest.validation.cases import Case
from simtest.validation.metrics import angle_deg
from simtest.validation.realise import Realisation, View

MAP_SIDE = 80
"""Truth maps are thinned to about this many samples along the longer side."""

CONTOUR_POINTS = 200
"""Contours are thinned to about this many points."""


def save(path: Path, session: Session, case: Case, seen: View, made: Realisation, command: str) -> None:
    """Write one gallery item.

    Parameters
    ----------
    path : Path
        The .npz file.
    session : Session
        At the view's scene.
    case : Case
        Its setting.
    seen : View
        The rendered scene.
    made : Realisation
        The frame and the estimates.
    command : str
        Makes this item again.
    """
    camera = session.camera
    truth = session.truth(stride=max(1, max(camera.width, camera.height) // MAP_SIDE))
    meta = {
        "surface": seen.scene.surface.label,
        "setting": case.setting if not case.part else f"{case.setting} (part {case.part})",
        "label": case.label,
        "sigma": seen.scene.sensor.noise_sigma,
        "command": command,
        "camera": {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "skew")},
        "truth": [_truth(j, judged) for j, judged in enumerate(made.truths)],
        "estimates": [entry for i in range(len(made.specularities)) for entry in _estimates(i, made)],
    }

    # Pictures are encoded once more where they are drawn.
    linear = seen.scene.sensor.response.model().decode(made.frame)

    def write(part: Path) -> None:
        np.savez_compressed(
            part,
            frame=linear.astype(np.float16).astype(np.float32),
            position=truth.position.astype(np.float32),
            normal=truth.normal.astype(np.float32),
            meta=np.array(json.dumps(meta, allow_nan=False)),
        )

    write_atomically(path, write)


def _truth(j: int, judged: Any) -> dict[str, Any]:
    highlight = judged.highlight
    return {
        "id": j,
        "bp_px": highlight.bp_px.tolist(),
        "normal": highlight.normal.tolist(),
        "position": highlight.position.tolist(),
        "kd_min": highlight.kd_min,
        "kd_max": highlight.kd_max,
        "isolated": judged.isolated,
    }


def _estimates(i: int, made: Realisation) -> list[dict[str, Any]]:
    specularity = made.specularities[i]
    true_id = made.matched.get(i)
    peak = [v + PIXEL_CENTRE for v in specularity.region.peak]
    if not isinstance(specularity.patch, Failure):
        peak = specularity.patch.peak_px.tolist()
    entries = []
    for name, result in specularity.estimates.items():
        entry: dict[str, Any] = {
            "specularity": i, "true_id": true_id, "estimator": name, "bp_px": peak, "error_deg": None, "normal": None,
            "candidates": [], "look_px": None, "isophotes": [], "ellipses": [],
        }  # fmt: skip
        if isinstance(result, Failure):
            entries.append(entry | {"status": str(result.reason)})
            continue
        entries.append(entry | {"status": "ok"} | _drawn(result))
        if true_id is not None:
            entries[-1]["error_deg"] = float(angle_deg(result.normal, made.truths[true_id].highlight.normal))
    return entries


def _drawn(estimate: Estimate) -> dict[str, Any]:
    isophotes = []
    for isophote in estimate.isophotes:
        step = max(1, len(isophote.points) // CONTOUR_POINTS)
        isophotes.append({"t": isophote.isovalue, "points": np.round(isophote.points[::step], 2).tolist()})
    return {
        "normal": estimate.normal.tolist(),
        "candidates": estimate.candidates.tolist(),
        "look_px": estimate.look_px.tolist() if np.isfinite(estimate.look_px).all() else None,
        "isophotes": isophotes,
        "ellipses": [isophote.conic.image.tolist() for isophote in estimate.isophotes],
    }
