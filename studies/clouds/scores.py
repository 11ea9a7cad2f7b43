"""How the estimates of clouds stand against the base: errors, coverage, and the relief's slope."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtest.calibration import Frame
from simtest.errors import Failure
from simtest.estimators.cloud import cloud
from simtest.estimators.cloud_shape import slope_of
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.runtime import chi_squared
from simtest.validation.scoring import mahalanobis2
from studies.clouds.frames import BaseFrame

SMOOTHING_PX = 1.0
"""Of the frames; the estimator smooths the light on its own."""

MANY = 15
"""Answers of clouds with so many spots are what is promised."""

CLOSE = 0.15
"""A slope this near, as a share of the true one, counts as right."""

WARNINGS = {"base_unverified", "cut", "wide"}
"""Flags with which a false answer is no sure one."""

REGION = chi_squared.quantile(0.95, 2)
RADIUS = math.sqrt(REGION / 2)
"""Of a round 95 % region, over the rms."""


@dataclass(frozen=True)
class Answer:
    """An estimate against the base's highlight point that most of its spots belong to; of several lights their mean.

    Parameters
    ----------
    spots : int
        Of its cloud.
    error_deg : float or None
        Against the base's normal there; None where its spots belong to no point in view: a false answer.
    unit_deg : float
        s / sqrt(spots), s the relief's slope.
    mahalanobis2 : float or None
        Of the base's normal.
    semi_deg : float
        Longer semi-axis of the covariance.
    slope_ratio : float or None
        Slope with the true gains told over the true slope.
    prior_holds : bool or None
        Whether the interval of the slope without told gains holds the true slope.
    flags : tuple of str
        Of the estimate.
    """

    spots: int
    error_deg: float | None
    unit_deg: float
    mahalanobis2: float | None
    semi_deg: float
    slope_ratio: float | None
    prior_holds: bool | None
    flags: tuple[str, ...]


def true_slope_deg(frame: BaseFrame) -> float:
    """Return the slope along one direction of a frame's relief: of all bands together."""
    relief = frame.case.scene.surface.relief
    assert relief is not None
    return float(np.sqrt(sum(band.slope_deg**2 for band in relief.bands)))


def answers(frame: BaseFrame) -> list[Answer] | Failure:
    """Return the answers of estimator `cloud` on a frame, or why there is none."""
    calibration = frame.calibration
    given = Frame(frame.picture, calibration, SMOOTHING_PX)
    found = cloud.estimate_frame(given, calibration.camera, calibration.priors)
    return found if isinstance(found, Failure) else [_answer(frame, estimate) for estimate in found]


def _answer(frame: BaseFrame, estimate: Estimate) -> Answer:
    shape, slope_deg = estimate.cloud, true_slope_deg(frame)
    assert shape is not None
    assert estimate.covariance is not None
    count = len(shape.points_px)
    semi_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(estimate.covariance)[-1])))
    unit_deg = slope_deg / float(np.sqrt(count))
    matched = frame.matched(shape.points_px, estimate.look_px)
    if not matched:
        return Answer(count, None, unit_deg, None, semi_deg, None, None, estimate.flags)
    # Lights that are not told apart make one cloud, around the mean of their points.
    truth = frame.normals[matched].mean(axis=0)
    truth /= np.linalg.norm(truth)
    first, second = frame.gains[matched[0]].tolist()
    told = slope_of(shape.covariance, shape.independent, shape.lobe, (first, second))
    return Answer(
        spots=count,
        error_deg=float(angle_deg(estimate.normal, truth)),
        unit_deg=unit_deg,
        mahalanobis2=mahalanobis2(estimate, truth),
        semi_deg=semi_deg,
        slope_ratio=float(np.degrees(told.value)) / slope_deg,
        prior_holds=shape.slope.low <= np.radians(slope_deg) <= shape.slope.high,
        flags=estimate.flags,
    )


def header() -> str:
    """Return the heading of the table."""
    return (
        f"{'group':26s} frames  answers  false, sure  spots   error, deg          in s/sqrt(spots)  hold the truth    "
        "semi-axis   slope, gains told         prior's interval\n"
        f"{'':26s}                                median  mean     RMS         mean             of the regions    "
        "over RMS    median  within 15 %       holds it"
    )


def line(name: str, judged: Sequence[list[Answer] | Failure], least: int = MANY) -> str:
    """Return a line of the table: of answers with so many spots at least."""
    given = [answer for made in judged if not isinstance(made, Failure) for answer in made if answer.spots >= least]
    true = [answer for answer in given if answer.error_deg is not None]
    sure = sum(answer.error_deg is None and not WARNINGS & set(answer.flags) for answer in given)
    start = f"{name:26s} {len(judged):5d} {len(given):8d} {len(given) - len(true):6d} {sure:5d}"
    if not true:
        return start
    error = np.array([answer.error_deg for answer in true])
    units = error / np.array([answer.unit_deg for answer in true])
    held = [answer.mahalanobis2 is not None and answer.mahalanobis2 <= REGION for answer in true]
    rms = float(np.sqrt(np.mean(error**2)))
    # The RMS angle is that of two components.
    semi = float(np.median([answer.semi_deg for answer in true])) * np.sqrt(2) / rms
    ratio = np.array([answer.slope_ratio for answer in true])
    spread = units.std(ddof=1) / np.sqrt(len(units)) if len(units) > 1 else np.nan
    return (
        f"{start} {np.median([answer.spots for answer in true]):6.0f} {error.mean():7.2f} {rms:7.2f}"
        f"       {units.mean():5.2f} +- {spread:4.2f}     {sum(held):3d} of {len(held):3d}"
        f" ({100 * np.mean(held):3.0f} %)"
        f"    {semi:5.2f}      {np.median(ratio):5.2f}   {100 * np.mean(np.abs(ratio - 1) <= CLOSE):3.0f} %"
        f"            {100 * np.mean([bool(answer.prior_holds) for answer in true]):3.0f} %"
    )
