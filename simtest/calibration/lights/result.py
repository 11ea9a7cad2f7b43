"""What highlights on mirrors say of the lights: positions with 95 % intervals, residuals, and what is doubtful."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from simtest.calibration.lights.bundle import REACH_MM, Bundle, Highlights, solve
from simtest.calibration.lights.mirrors import Mirrors
from simtest.calibration.lights.search import Found
from simtest.geometry.camera import Camera
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, Index
from simtest.runtime.statistics import NORMAL_QUANTILE

UNLIKELY = 0.01
"""Residuals that are so unlikely to be as large by chance are told."""

MOST_INFLATION = 2.25
"""Residuals of more than 1.5 times the stated errors: several lights merge in one highlight, the lights did not stay
where they were, or the camera, response or ball is another one. No calibration is written. Of nine rigs of
`studies.light_calibration` beyond it, five were wrong by more than their intervals."""

WIDE_MM = 1.0
"""An interval that reaches farther than this on each side is told."""

FOREIGN_SURE = 3.0
"""A light lies beyond the reach if its distance is known to a third of it, or better."""


@dataclass(frozen=True)
class MeasuredLight:
    """A light."""

    position_mm: Array  # (3,): camera frame
    covariance_mm2: Array  # (3, 3): of the position, residuals and the errors of radius and camera included
    pictures: int  # how many pictures show its highlight
    is_foreign: bool  # whether it lies farther from the camera than any light of an endoscope: a lamp or a window

    @property
    def half_widths_mm(self) -> Array:
        """Half of the 95 % interval of each coordinate, shape (3,), mm."""
        return NORMAL_QUANTILE * np.sqrt(np.diag(self.covariance_mm2))


@dataclass(frozen=True)
class LightCalibration:
    """The lights, and how well they explain the highlights."""

    lights: tuple[MeasuredLight, ...]  # by their distance from the camera
    source: Index  # (N,): which light made each highlight; -1: none
    residuals_px: Array  # (N, 2): measured less predicted centre; NaN where no light made it
    predicted_px: Array  # (V, S, 2): where each picture should show each light
    chi2: float  # of the fit
    freedom: int  # of the fit
    inflation: float  # factor, at least 1, by which the residuals have widened all covariances
    notes: tuple[str, ...]  # what is to be known about the result
    problems: tuple[str, ...]  # why it must not be used; empty: it may be

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals along an axis, px."""
        return float(np.sqrt(np.nanmean(self.residuals_px**2)))

    @property
    def own(self) -> tuple[MeasuredLight, ...]:
        """The lights that travel with the camera."""
        return tuple(light for light in self.lights if not light.is_foreign)


def judge(
    camera: Camera, mirrors: Mirrors, highlights: Highlights, found: Found, radius_sd_share: float, further: Array
) -> LightCalibration:
    """Return what was found, with its intervals and what is doubtful about it.

    `radius_sd_share` is the standard deviation of the ball's radius as a share of it: a scene and its scaled copy give
    the same pictures, so each position is wrong by the same share, which no residual shows. `further` is from
    `covariance_of_variations`.
    """
    bundle = found.bundle
    inflation = max(1.0, bundle.chi2 / bundle.freedom) if bundle.freedom > 0 else 1.0
    scale = bundle.lights.ravel() * radius_sd_share
    covariance = inflation * bundle.covariance + further + np.outer(scale, scale)
    counts = np.bincount(found.source[found.source >= 0], minlength=len(bundle.lights))
    order = np.argsort(np.linalg.norm(bundle.lights, axis=1), kind="stable")
    lights = []
    for i in order:
        block = covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        lights.append(MeasuredLight(bundle.lights[i], block, int(counts[i]), _is_foreign(bundle.lights[i], block)))
    rank = np.empty(len(order) + 1, dtype=np.intp)
    rank[order], rank[-1] = np.arange(len(order)), -1
    source = rank[found.source]
    residuals, predicted = _residuals(camera, mirrors, highlights, bundle, found)
    notes, problems = _doubts(lights, bundle, inflation, len(mirrors), found)
    return LightCalibration(
        tuple(lights), source, residuals, predicted[:, order], bundle.chi2, bundle.freedom, inflation,
        tuple(notes), tuple(problems),
    )  # fmt: skip


def _is_foreign(position: Array, covariance: Array) -> bool:
    distance = float(np.linalg.norm(position))
    along = position / max(distance, 1e-9)
    return distance > REACH_MM and distance > FOREIGN_SURE * math.sqrt(float(along @ covariance @ along))


def _residuals(
    camera: Camera, mirrors: Mirrors, highlights: Highlights, bundle: Bundle, found: Found
) -> tuple[Array, Array]:
    """Return the residuals of the highlights, and every light's pixel in every picture, the mirrors as fitted."""
    views, lights = np.arange(len(mirrors))[:, None], bundle.lights[None]
    predicted = mirrors.predict(
        camera, np.broadcast_to(views, (len(mirrors), lights.shape[1])),
        np.broadcast_to(lights, (len(mirrors), *lights.shape[1:])),
        np.broadcast_to(bundle.z[:, None], (len(mirrors), *lights.shape[1:])),
    )  # fmt: skip
    residuals = highlights.pixels - predicted[highlights.view, found.source]
    return np.where(found.source[:, None] >= 0, residuals, np.nan), predicted


def _doubts(
    lights: list[MeasuredLight], bundle: Bundle, inflation: float, pictures: int, found: Found
) -> tuple[list[str], list[str]]:
    """Return notes and problems of a result."""
    notes, problems = list[str](), list[str]()
    if len(found.others):
        place = ", ".join(f"{value:.1f}" for value in found.others[0])
        problems.append(
            f"ambiguous: other lights, one at ({place}) mm, would explain the highlights as well; add pictures with "
            "the ball or plate at other places and distances"
        )
    for position in found.further:
        if float(np.linalg.norm(position)) <= REACH_MM:
            place = ", ".join(f"{value:.1f}" for value in position)
            problems.append(
                f"a further light may be at ({place}) mm, but too few pictures show it; add pictures with the ball "
                "nearer to the camera, where its highlights lie farther apart"
            )
    for number, light in enumerate(lights, 1):
        if light.pictures < pictures:
            notes.append(f"light {number}: {light.pictures} of {pictures} pictures show its highlight")
        if light.is_foreign:
            distance = float(np.linalg.norm(light.position_mm))
            notes.append(
                f"light {number}: about {distance:.0f} mm from the camera, beyond the tip: a lamp or a window; left out"
            )
        elif (wide := _widest(light)) is not None:
            half, axis = wide
            notes.append(
                f"light {number}: known to ± {half:.2g} mm along ({', '.join(f'{v:.2f}' for v in axis)}); "
                "pictures with the ball or plate at other places, nearer to the camera and across the view, narrow it"
            )
    unlikely = bundle.freedom > 0 and chi_squared.survival(bundle.chi2, bundle.freedom) < UNLIKELY
    if unlikely:
        text = (
            f"residuals are {math.sqrt(inflation):.1f} times what the measured centres and outlines explain: lights "
            "that merge in one highlight, a light that moved between pictures, another camera or response, a ball that "
            "is not round; intervals are as much wider"
        )
        (problems if inflation > MOST_INFLATION else notes).append(text)
    if bundle.freedom <= 0:
        notes.append("no highlight is left over that could check the positions; add pictures")
    return notes, problems


def _widest(light: MeasuredLight) -> tuple[float, Array] | None:
    """Return half of the widest 95 % interval, mm, and its axis, where it is wide."""
    values, vectors = np.linalg.eigh(light.covariance_mm2)
    half = NORMAL_QUANTILE * math.sqrt(float(values[-1]))
    axis = vectors[:, -1] * (1.0 if vectors[:, -1][np.abs(vectors[:, -1]).argmax()] > 0 else -1.0)
    return (half, axis) if half > WIDE_MM else None


def covariance_of_variations(
    variations: Iterable[tuple[Camera, Mirrors]], highlights: Highlights, found: Found
) -> Array:
    """Return the covariance of the lights by errors that are common to all pictures, shape (3 S, 3 S), mm^2.

    Each variation is camera and mirrors as they are if one of several independent errors is one standard deviation.
    """
    size = found.bundle.lights.size
    total = np.zeros((size, size))
    for camera, mirrors in variations:
        moved = solve(camera, mirrors, highlights, found.source, found.bundle.lights)
        if moved is not None:
            step = (moved.lights - found.bundle.lights).ravel()
            total += np.outer(step, step)
    return total
