"""What networks and classical methods answer on the frames of the corpus `hard`, each answer with its error."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.detection.colour import ColourDetector
from simtest.errors import Failure
from simtest.estimators import AnyEstimator, Estimate
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.runtime.arrays import Array
from simtest.validation.scoring import mahalanobis2
from studies.hard.table import CHI2_95
from studies.learned_transfer.frames import SMOOTHING_PX, HardFrame

NEAR_PX = 1.5
"""A detection is the visible highlight whose peak is at most so far from its own."""

OK = "ok"


@dataclass(frozen=True)
class Answer:
    """What one estimator says of one detection.

    Parameters
    ----------
    row, kind : str
        Of the corpus; what is seen.
    scene, spot : int
        Numbers of the scene and of the detection in its frame.
    estimator : str
        Its name.
    status : str
        "ok", or why it refused.
    base_deg, fine_deg : float
        Error against the base's normal at the detection's pixel, and against the fine surface's at the only glint of
        its visible highlight, deg; NaN without an answer or truth.
    inside : float
        1 where the truth of the surface that it states lies inside its 95 % region, else 0; NaN where unknown.
    stated_deg : float
        Reported deviation (`Estimate.deviation_deg`), deg; NaN where none is reported.
    """

    row: str
    kind: str
    scene: int
    spot: int
    estimator: str
    status: str
    base_deg: float = math.nan
    fine_deg: float = math.nan
    inside: float = math.nan
    stated_deg: float = math.nan


def why(failure: Failure) -> str:
    """Return the reason of a refusal without its numbers, so that equal reasons can be counted."""
    detail = failure.detail or ""
    told = detail.split(" is ")[0].split(" at ")[0]
    return told if told.startswith(("outside", "unlike")) else failure.reason.value


def answers(frame: HardFrame, estimators: Mapping[str, AnyEstimator]) -> Iterator[Answer]:
    """Yield the answers at the highlights that the detector by colour finds in a frame."""
    found = reconstruct(
        frame.encoded, frame.calibration, estimators, smoothing_px=SMOOTHING_PX, detector=ColourDetector()
    )
    for number, each in enumerate(found):
        base, fine = base_at(frame, _pixel(each)), fine_at(frame, _pixel(each))
        if base is None:
            continue
        for name, result in each.estimates.items():
            yield _scored(frame, number, name, result, base, fine)


def _pixel(specularity: Specularity) -> Array:
    """Return where a specularity's normal is judged: a cloud's centre, or a highlight's peak."""
    for result in specularity.estimates.values():
        if isinstance(result, Estimate) and isinstance(specularity.patch, Failure):
            return result.look_px
    column, row = specularity.region.peak
    return np.array([column, row]) + PIXEL_CENTRE


def base_at(frame: HardFrame, point: Array) -> Array | None:
    """Return the base's true unit normal at a pixel; None off the surface."""
    height, width = frame.depth.shape
    column, row = int(point[0]), int(point[1])
    if not (0 <= column < width and 0 <= row < height):
        return None
    normal = frame.normal_base[row, column].astype(float)
    return normal / np.linalg.norm(normal) if np.isfinite(normal).all() else None


def fine_at(frame: HardFrame, point: Array) -> Array | None:
    """Return the fine surface's true normal at the only glint of the visible highlight at a pixel; None without."""
    if not len(frame.peaks):
        return None
    gaps = np.hypot(*(frame.peaks - point).T)
    nearest = int(gaps.argmin())
    normal = frame.fine[nearest]
    return normal if gaps[nearest] <= NEAR_PX and np.isfinite(normal).all() else None


def _scored(
    frame: HardFrame, number: int, name: str, result: Estimate | Failure, base: Array, fine: Array | None
) -> Answer:
    common = (frame.row.name, frame.kind, frame.scene, number, name)
    if isinstance(result, Failure):
        return Answer(*common, why(result))
    truth = base if result.target == "base" else fine
    distance = None if truth is None else mahalanobis2(result, truth)
    return Answer(
        *common, OK, float(angle_deg(result.normal, base)),
        math.nan if fine is None else float(angle_deg(result.normal, fine)),
        math.nan if distance is None else float(distance <= CHI2_95),
        math.nan if result.deviation_deg is None else result.deviation_deg,
    )  # fmt: skip
