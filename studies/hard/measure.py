"""Renders the frames of the corpus, finds their highlights, and judges what estimators state of them."""

import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from simtest.detection.colour import ColourDetector
from simtest.detection.peaks import PeakDetector
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry.vectors import angle_deg, deviation_deg
from simtest.reconstruction.options import SMOOTHING_BY_COLOUR_PX
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.rendering import Radiance, Session
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import key as hashed
from simtest.simulation.frame import RenderedView, render_view
from simtest.simulation.highlights import TrueHighlight
from simtest.validation.scoring import mahalanobis2, match, peak_px
from studies.hard.cases import Case, calibration_of, scene_of
from studies.hard.rows import Row

SMOOTHING_PX = 2.0
COLOUR = "llvm_ad_rgb"
LOWEST_ISOVALUE = 0.3

Record = dict[str, Any]


class Frames:
    """Makes the frames of one scene; rows that differ in the sensor alone share the radiance."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.session: Session | None = None
        self._radiance: dict[str, Radiance] = {}

    def view(self, row: Row) -> RenderedView:
        """Render a row of the scene."""
        tables, scene = scene_of(self.number, row)
        if self.session is None:
            self.session = Session(scene, COLOUR)
        same = json.dumps(tables, sort_keys=True)
        seen = render_view(self.session, scene, self._radiance.get(same))
        self._radiance[same] = seen.radiance
        return seen

    def cases(self, row: Row) -> Iterator[Case]:
        """Find the highlights of a row's frame, as reconstruction does, and match them with the truth."""
        view = self.view(row)
        frame = view.frame(hashed(f"{row.name} {self.number}") >> 1)
        lit = [highlight.distance for highlight in view.highlights if highlight.lit]
        span = (min(lit, default=1.0), max(lit, default=2.0))
        calibration = calibration_of(self.number, row, span)
        # Tissue is seen as the command sees a coloured picture, smooth surfaces as `simtest.reconstruct` does.
        detector, smoothing = (ColourDetector(), SMOOTHING_BY_COLOUR_PX) if view.is_rough else (None, SMOOTHING_PX)
        found = reconstruct(frame, calibration, {}, smoothing_px=smoothing, detector=detector or PeakDetector(True))
        for specularity, truth, holds, radius in _judged(found, view):
            if not isinstance(specularity.patch, Failure):
                own = (None, None) if truth is None else (truth.normal, truth.normal_base)
                yield Case(row.name, specularity.patch, *own, holds, radius, span)


def _judged(
    found: Sequence[Specularity], view: RenderedView
) -> Iterator[tuple[Specularity, TrueHighlight | None, int, float]]:
    """Match detections with isolated highlights, or on a relief with the spots that are seen and their glints."""
    if not view.is_rough:
        isolated = [highlight for highlight in view.highlights if highlight.isolated]
        own = match(found, [highlight.bp_px for highlight in isolated])
        for i, specularity in enumerate(found):
            truth = isolated[own[i]] if i in own else None
            yield specularity, truth, int(i in own), math.nan if truth is None else truth.radius_px
        return
    visible = view.visible_highlights
    spots = match(found, [spot.peak_px for spot in visible])
    for i, specularity in enumerate(found):
        if i not in spots:
            yield specularity, None, 0, math.nan
            continue
        spot, peak = visible[spots[i]], peak_px(specularity)
        glints = [view.highlights[number] for number in spot.glints]
        # What is stated of a spot of several glints must hold for the one that it looks at.
        near = min(glints, key=lambda glint: float(np.hypot(*(glint.bp_px - peak))), default=None)
        yield specularity, near, len(glints), spot.radius_px


def semi_axis_deg(covariance: Array) -> float:
    """Return the mean semi-axis of a normal's covariance, deg: its deviation along one axis."""
    return deviation_deg(covariance) / math.sqrt(2)


def record(number: int, kind: str, case: Case, name: str, result: Estimate | Failure) -> Record:
    """Return one answer as a row of the study's table."""
    made: Record = {
        "row": case.row, "scene": number, "kind": kind, "estimator": name, "matched": case.normal is not None,
        "holds": case.holds, "radius_px": case.radius_px, "status": "ok", "flags": "", "target": "fine",
        "error_deg": math.nan, "semi_deg": math.nan, "mahalanobis2": math.nan, "states": False,
    }  # fmt: skip
    if isinstance(result, Failure):
        return made | {"status": str(result.reason)}
    flags = list(result.flags)
    if case.patch.saturated is not None and case.patch.saturated_share(LOWEST_ISOVALUE):
        flags.append("saturated")
    made |= {"flags": ",".join(flags), "target": result.target}
    if result.covariance is not None:
        made["semi_deg"] = semi_axis_deg(result.covariance)
        for part, covariance in (result.budget or {}).items():
            made[f"budget_{part}_deg"] = semi_axis_deg(covariance)
    truth = case.normal if result.target == "fine" else case.normal_base
    if truth is None:
        return made
    made["error_deg"] = float(angle_deg(result.normal, truth))
    distance = mahalanobis2(result, truth)
    return made if distance is None else made | {"mahalanobis2": distance, "states": True}
