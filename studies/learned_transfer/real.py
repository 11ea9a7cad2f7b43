"""Networks on real frames: what is answered where nothing shines, and how far normals agree with the classical ones.

Nobody knows the true normals of these frames, nor their cameras. The picture is reduced to 480 px across, the size that
the networks were taught, and taken in two ways:

- as `simtest reconstruct FRAME --fov 80` does: a field of view of 80 deg across it, lights not told;
- with a rig told: the same, and two light guides 4 mm beside the camera (eight in the laparoscope), tissue 30 mm away,
  give or take 15. Guides and angle are assumed.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from simtest.calibration import Calibration, Normal
from simtest.errors import Failure
from simtest.estimators import AnyEstimator, Estimate
from simtest.geometry.vectors import basis_across, tangent_coordinates
from simtest.reconstruction import Specularity
from simtest.reconstruction.assumptions import calibration_of_view
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import run
from simtest.runtime.arrays import Array, Image
from simtest.spec.lights import Rig
from studies.detection.real_frames import (
    OutlinedFrame,
)
from studies.hard.table import CHI2_95
from studies.learned_transfer.answers import OK, why
from studies.learned_transfer.frames import DISTANCE_MM, DISTANCE_SD

FOV_DEG, ACROSS_PX = 80.0, 480

UNTOLD, TOLD = "as the command", "rig told"

LAPAROSCOPY = "laparoscopy_0.png"

FORBIDDEN = ("instrument", "text", "vessel", "border")

STEPS = np.linspace(0.01, 0.99, 99)
"""Weights of the two regions at which their overlap is tested."""


@dataclass(frozen=True)
class Agreement:
    """What a network's normal is to a classical one at the same highlight of a real frame.

    Parameters
    ----------
    frame, estimator, other : str
        Names.
    off_deg : float
        Angle between the two.
    overlaps : bool or None
        Whether their 95 % regions overlap; None where one states none.
    """

    frame: str
    estimator: str
    other: str
    off_deg: float
    overlaps: bool | None


def untold(picture: Image) -> Calibration:
    """Return the calibration of `simtest reconstruct --fov 80`: nothing told of lights and distance."""
    return calibration_of_view(FOV_DEG, picture.shape[1], picture.shape[0])


def told(picture: Image, name: str) -> Calibration:
    """Return the assumed calibration of a reduced picture."""
    guessed = untold(picture)
    rig = Rig(preset="laparoscope" if name == LAPAROSCOPY else "colonoscope_2")
    lights = tuple((float(x), float(y), float(z)) for x, y, z in rig.nominal_mm())
    priors = replace(guessed.priors, lights_mm=lights, distance_mm=Normal(DISTANCE_MM, DISTANCE_SD))
    return replace(guessed, priors=priors)


def reduced(picture: Image) -> Image:
    """Return a picture of `ACROSS_PX` px across, averaged."""
    height, width = picture.shape[:2]
    if width <= ACROSS_PX:
        return picture
    size = (ACROSS_PX, round(height * ACROSS_PX / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def ways(frame: OutlinedFrame) -> Iterator[tuple[str, Image, Calibration]]:
    """Yield the two ways in which a frame is measured: name, picture, calibration."""
    small = reduced(frame.picture)
    yield UNTOLD, small, untold(small)
    yield TOLD, small, told(small, frame.name)


NORMALS_HEADS = (
    "frame", "way", "estimator", "detections", "answered", "refused", "answers on instrument, text, vessel, border",
)  # fmt: skip


def specularities(
    picture: Image, calibration: Calibration, estimators: Mapping[str, AnyEstimator]
) -> Sequence[Specularity]:
    """Return the estimates at a picture's highlights; all state the base's normals."""
    return run(picture, calibration, Options(detector="colour", estimators=estimators, target="base"))


def refusals(found: Sequence[Specularity], name: str) -> Counter[str]:
    """Count an estimator's answers and its refusals by reason."""
    results = [each.estimates[name] for each in found if name in each.estimates]
    return Counter(why(result) if isinstance(result, Failure) else OK for result in results)


def misplaced(frame: OutlinedFrame, found: Sequence[Specularity], name: str, picture: Image) -> str:
    """Count the answers on each kind of what carries none, in the order of `FORBIDDEN`, on a reduced picture."""
    height, width = frame.specular.shape
    scale = np.array([width / picture.shape[1], height / picture.shape[0]])
    answered = [result for each in found if isinstance(result := each.estimates.get(name), Estimate)]
    columns, rows = np.array([result.look_px * scale for result in answered]).reshape(-1, 2).T.astype(int)
    nowhere = np.zeros((height, width), dtype=bool)
    return ", ".join(str(int(frame.forbidden.get(kind, nowhere)[rows, columns].sum())) for kind in FORBIDDEN)


def agreements(
    frame: str, found: Sequence[Specularity], names: Sequence[str], others: Sequence[str]
) -> Iterator[Agreement]:
    """Yield the agreement of networks with classical estimators where both answer.

    A cloud has no highlight of its own: it is compared with the nearest highlight that the network answers.
    """
    for name in names:
        answered = [result for each in found if isinstance(result := each.estimates.get(name), Estimate)]
        for other in others:
            for each in found:
                result = each.estimates.get(other)
                if not isinstance(result, Estimate) or not answered:
                    continue
                own = each.estimates.get(name)
                if result.cloud is not None:
                    own = _nearest(answered, result.look_px)
                if isinstance(own, Estimate):
                    yield compared(frame, (name, own), (other, result))


def _nearest(estimates: Sequence[Estimate], point: Array) -> Estimate:
    """Return the estimate that looks at the pixel nearest to a point."""
    return min(estimates, key=lambda estimate: float(np.hypot(*(estimate.look_px - point))))


def compared(frame: str, one: tuple[str, Estimate], other: tuple[str, Estimate]) -> Agreement:
    """Compare two estimates of one normal."""
    (name, first), (other_name, second) = one, other
    off = tangent_coordinates(first.normal, second.normal)
    overlaps = None
    if first.covariance is not None and second.covariance is not None:
        turned = basis_across(first.normal) @ basis_across(second.normal).T
        overlaps = regions_overlap(off, first.covariance, turned @ second.covariance @ turned.T)
    return Agreement(frame, name, other_name, math.degrees(float(np.hypot(*off))), overlaps)


def regions_overlap(off: Array, first: Array, second: Array) -> bool:
    """Return whether two 95 % ellipses overlap whose centres lie `off` apart.

    They do not if for some s in (0, 1) the point `off` lies outside the ellipse of first / (1 - s) + second / s
    [Gilitschenski and Hanebeck 2012].
    """
    return all(off @ np.linalg.solve(first / (1 - s) + second / s, off) <= CHI2_95 for s in STEPS)
