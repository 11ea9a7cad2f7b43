"""Keeps a few frames of a run with all that is needed to draw them: truth, isophotes, ellipses, normals."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.estimators.protocol import drawable
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import angle_deg
from simtest.rendering import Session
from simtest.runtime.files import write_atomically
from simtest.simulation.rendered_view import View
from simtest.spec import camera_table
from simtest.validation.cases import Case
from simtest.validation.realisation import Realisation

MAP_SIDE = 80
"""Truth maps are thinned to about this many samples along the longer side."""

CONTOUR_POINTS = 200
"""Contours are thinned to about this many points."""


def save(
    path: Path, session: Session, case: Case, seen: View, made: Realisation, command: str, why: str | None = None
) -> None:
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
    why : str, optional
        Why it is kept.
    """
    camera = session.camera
    truth = session.truth(stride=max(1, max(camera.width, camera.height) // MAP_SIDE))
    meta = {
        "surface": seen.scene.surface.label,
        "setting": case.setting if not case.part else f"{case.setting} (part {case.part})",
        "label": case.label,
        "sigma": seen.scene.sensor.noise_sigma,
        "command": command,
        "camera": camera_table(camera),
        "lights": np.asarray(seen.scene.rig.true_mm()).tolist(),
        "truth": [_truth(j, judged) for j, judged in enumerate(made.truths)],
        "estimates": [entry for i in range(len(made.specularities)) for entry in _estimates(i, made, camera)],
    }
    if why:
        meta["why"] = why

    # Pictures are encoded once more where they are drawn.
    linear = seen.scene.sensor.response.model().decode(made.frame)
    write_item(path, meta, linear, truth.position, truth.normal, curvature=truth.larger_curvature)


def write_item(path: Path, meta: dict[str, Any], frame: Any, position: Any, normal: Any, **more: Any) -> None:
    """Write the file of one gallery item.

    Parameters
    ----------
    path : Path
        The .npz file.
    meta : dict
        All that is no picture.
    frame : ndarray, shape (H, W) or (H, W, 3)
        Share of full scale.
    position, normal : ndarray, shape (h, w, 3)
        Thinned truth, camera frame; NaN where there is no surface.
    **more : ndarray
        Further pictures.
    """
    # Half precision is enough to look at; stored wider, since it is read back as it is.
    content = {"frame": np.asarray(frame).astype(np.float16).astype(np.float32)}
    content |= {"position": np.asarray(position, np.float32), "normal": np.asarray(normal, np.float32)}
    content |= {name: np.asarray(picture).astype(np.float16) for name, picture in more.items()}
    text = np.array(json.dumps(meta, allow_nan=False))
    write_atomically(path, lambda part: np.savez_compressed(part, **content, meta=text))  # type: ignore[arg-type]


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


def _estimates(i: int, made: Realisation, camera: Camera) -> list[dict[str, Any]]:
    specularity = made.specularities[i]
    true_id = made.matched.get(i)
    peak = [v + PIXEL_CENTRE for v in specularity.region.peak]
    if not isinstance(specularity.patch, Failure):
        peak = specularity.patch.peak_px.tolist()
    normal = None if true_id is None else made.truths[true_id].highlight.normal
    place = {"specularity": i, "true_id": true_id, "bp_px": peak}
    return [
        place | {"estimator": name} | drawn(result, specularity.patch, camera, normal)
        for name, result in specularity.estimates.items()
    ]


def drawn(result: Estimate | Failure, patch: Patch | Failure, camera: Camera, truth: Any) -> dict[str, Any]:
    """Give what a gallery item keeps of an estimator's answer.

    Parameters
    ----------
    result : Estimate or Failure
        The answer.
    patch : Patch or Failure
        What it looked at.
    camera : Camera
        Of the frame.
    truth : ndarray, shape (3,), or None
        The true normal, where there is one.
    """
    entry: dict[str, Any] = {
        "error_deg": None, "error_oracle_deg": None, "normal": None, "candidates": [], "look_px": None,
        "isophotes": [], "curves": [],
    }  # fmt: skip
    if isinstance(result, Failure):
        return entry | {"status": str(result.reason)}
    entry |= {"status": "ok"} | _drawn(result, patch, camera)
    if truth is not None:
        entry["error_deg"] = float(angle_deg(result.normal, truth))
        entry["error_oracle_deg"] = float(angle_deg(result.candidates, truth).min())
    return entry


def _drawn(estimate: Estimate, patch: Patch | Failure, camera: Camera) -> dict[str, Any]:
    isophotes = []
    for t, points in estimate.contours(patch):
        step = max(1, len(points) // CONTOUR_POINTS)
        isophotes.append({"t": t, "points": np.round(points[::step], 2).tolist()})
    return {
        "normal": estimate.normal.tolist(),
        "candidates": estimate.candidates.tolist(),
        "look_px": estimate.look_px.tolist() if np.isfinite(estimate.look_px).all() else None,
        "isophotes": isophotes,
        "curves": [drawable(isophote.ellipse_px(camera)) for isophote in estimate.isophotes],
    }
