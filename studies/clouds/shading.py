"""What the constants of `cloud` were fitted to: python -m studies.clouds.shading [--frames FOLDER] [--most N].

The clouds of the tissue frames that the estimator was tuned on, before any is refused, against the base's true
highlight points: how far off the light's gradient is, how far off the spots' centre, and how many of the long ones
lie about no point or the wrong one.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtest.calibration import Frame
from simtest.estimators.cloud import ALBEDO_SLOPE, JACKKNIFE_CUBIC, LEAST_GAIN, MOST_EXTENT
from simtest.estimators.cloud_light import DiffuseLight, Shading, find_spots
from simtest.estimators.cloud_mixture import CLUMPING, fit_mixture, window_of
from simtest.geometry import Array
from simtest.geometry.vectors import basis_across
from studies.clouds.__main__ import tuned_tissue
from studies.clouds.frames import BaseFrame, load
from studies.clouds.scores import MANY, SMOOTHING_PX, true_slope_deg

FAR = 5.0
"""A cloud that is farther off its point than so many s / sqrt(N) does not lie about it."""


@dataclass(frozen=True)
class Row:
    """A cloud: its extent, rad, the way from its centre to the true point, rad, or None, and the fits to the light."""

    extent: float
    spots: int
    way: Array | None
    fits: tuple[Shading, Shading] | None


def rows_of(frame: BaseFrame) -> list[Row]:
    """Return the clouds of a frame of one light with enough spots."""
    calibration = frame.calibration
    camera, given = calibration.camera, Frame(frame.picture, calibration, SMOOTHING_PX)
    spots, light, rows = find_spots(given), DiffuseLight(given), []
    if len(spots.peaks) < MANY:
        return []
    mixture = fit_mixture(camera.unproject(spots.points_px), window_of(camera, given.seen))
    owner = np.where(mixture.belongs.sum(axis=1) > 0.5, mixture.belongs.argmax(axis=1), -1)
    for i, cloud in enumerate(mixture.clouds):
        own = spots.points_px[owner == i]
        if len(own) < MANY or cloud.seen < 0.95:
            continue
        way, matched = None, frame.matched(own, camera.project(cloud.sightline))
        if matched:
            point = -frame.normals[matched[0]]
            way = basis_across(cloud.centre) @ point / (cloud.centre @ point)
            if np.degrees(np.linalg.norm(way)) > FAR * true_slope_deg(frame) / np.sqrt(len(own)):
                way = None
        extent = float(np.sqrt(np.linalg.eigvalsh(cloud.covariance)[-1]))
        rows.append(Row(extent, len(own), way, light.around(cloud.centre, cloud.covariance) if light.shows else None))
    return rows


def print_rows(name: str, rows: Sequence[Row]) -> None:
    """Print what the clouds of one organ say of the constants."""
    long = [row for row in rows if row.extent > MOST_EXTENT]
    good = [row for row in rows if row.extent <= MOST_EXTENT and row.way is not None]
    shares = np.array([row.way / row.extent for row in good if row.way is not None])
    chance = CLUMPING * float(np.mean([1 / row.spots for row in good]))
    bends = np.sqrt(max(float((shares**2).mean()) - chance, 0.0))
    most, lost = np.degrees(MOST_EXTENT), sum(row.way is None for row in long)
    print(f"{name}: {len(rows)} clouds; of {len(long)} longer than {most:.0f} deg {lost} lie about no point")
    print(f"  of the others {len(rows) - len(long) - len(good)} lie about none; the centre of {len(good)} is off by")
    print(f"  {bends:.2f} of the longer extent along one direction, chance taken off")
    for which, title, factor in ((0, "quadric", 1.0), (1, "cubic", JACKKNIFE_CUBIC)):
        off, jackknife = _errors(good, which)
        if not len(off):
            continue
        share, typical = off / np.hypot(factor * jackknife, ALBEDO_SLOPE), np.median(np.abs(off)) / 0.6745
        print(
            f"  {title}: gradient off by {typical:.2f} per rad (median / 0.67), jackknife {np.median(jackknife):.2f}; "
            f"over its standard deviation {np.sqrt((share**2).mean()):.2f} RMS, "
            f"{100 * np.mean(np.abs(share) < 1.96):.0f} % within 1.96, {len(off)} directions"
        )


def _errors(rows: Sequence[Row], which: int) -> tuple[Array, Array]:
    """Return errors of the gradient along directions of a clear gain, and the jackknife's standard deviations."""
    off, jackknife = [], []
    for row in rows:
        if row.fits is None or row.way is None:
            continue
        fit = row.fits[which]
        gains, directions = np.linalg.eigh(fit.gains)
        for gain, direction in zip(gains, directions.T, strict=True):
            if gain >= LEAST_GAIN:
                off.append(float(direction @ fit.gradient - (2 + gain) * gain * direction @ row.way))
                jackknife.append(float(np.sqrt(direction @ fit.covariance @ direction)))
    return np.array(off), np.array(jackknife)


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.clouds.shading")
    parser.add_argument("--frames", type=Path, default=Path("reports/studies/clouds"))
    parser.add_argument("--most", type=int, default=None)
    given = parser.parse_args()
    for name, cases in tuned_tissue().items():
        rows: list[Row] = []
        session = None
        for case in cases[: given.most]:
            frame, session = load(case, given.frames, session)
            rows += rows_of(frame)
        print_rows(name, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
