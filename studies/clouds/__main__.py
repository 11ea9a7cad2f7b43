"""Clouds on planes, cylinders and spheres against the base's normal: python -m studies.clouds [--most N].

A fresh relief each frame, of seeds on which nothing was tuned; `--most` takes so many frames of each surface. Answers
of at least `MANY` spots are judged against the base's highlight point that most of their spots belong to. One is false
where they belong to no point in view, and sure where no flag warns of that.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.calibration import Frame
from simtest.errors import Failure
from simtest.estimators.cloud import cloud
from simtest.estimators.cloud_shape import slope_of
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.rendering import HighlightPoint, Session
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Image
from simtest.simulation.frame import render_picture
from simtest.simulation.highlights import CloudRegions
from simtest.spec import scene_from_dict
from simtest.validation.scoring import mahalanobis2

SEED = 20000
PLANES = ((3.0, 1.5), (6.0, 1.5), (6.0, 3.0))
"""Slope, deg, and wavelength, mm, of theory.md's table of clouds from a picture."""

SLOPES_DEG, WAVES_MM = (4.0, 5.0, 3.0, 6.0), (1.5, 2.0)
"""Of cylinders and spheres, in turn."""

SMOOTHING_PX = 1.0
"""Of the frames; the estimator smooths the light on its own."""

MANY = 15
CLOSE = 0.15
"""A slope this near, as a share of the true one, counts as right."""

WARNINGS = {"base_unverified", "cut", "wide"}
REGION = chi_squared.quantile(0.95, 2)


@dataclass(frozen=True)
class Answer:
    """An answer that is not false: its error in deg and over s / sqrt(N), s the slope and N the number of spots.

    `inside`: whether its 95 % region holds the truth; `semi_deg`: longer semi-axis of its covariance; `slope_ratio`:
    its slope of the relief over the true one, the true gains of the base given.
    """

    error_deg: float
    units: float
    inside: bool
    semi_deg: float
    slope_ratio: float


def surfaces() -> dict[str, list[tuple[dict[str, Any], float, float, int]]]:
    """Return the base, the relief's slope, deg, and wavelength, mm, and the seed of each frame, by kind of surface."""
    cases = {
        f"plane, slope {slope:g} deg at {wave:g} mm": [
            (_plane(seed), slope, wave, seed) for seed in range(SEED, SEED + 24)
        ]
        for slope, wave in PLANES
    }
    for kind, first, count, every, curvatures in (
        ("cylinder", 100, 32, 4, (0.5, 1.0, -0.3, -0.5)),
        ("sphere", 300, 24, 3, (0.3, 0.7, -0.3)),
    ):
        cases[kind] = [
            (_curved(kind, curvatures[i % every], seed), SLOPES_DEG[i // every % 4], WAVES_MM[i // 2 % 2], seed)
            for i, seed in enumerate(range(SEED + first, SEED + first + count))
        ]
    return cases


def _plane(seed: int) -> dict[str, Any]:
    azimuth = float(np.random.default_rng([seed, 1]).uniform(0, 360))
    return {"type": "plane", "distance_mm": 25.0, "tilt_deg": 25.0, "azimuth_deg": azimuth}


def _curved(kind: str, kd: float, seed: int) -> dict[str, Any]:
    """Return a cylinder or sphere with a distance times curvature of about `kd`."""
    rng = np.random.default_rng([seed, 2])
    distance, azimuth = float(rng.uniform(18, 30)), float(rng.uniform(0, 360))
    return {"type": kind, "distance_mm": distance, "tilt_deg": 12.0, "azimuth_deg": azimuth,
            "radius_mm": abs(distance / kd), "side": "outside" if kd > 0 else "inside"}  # fmt: skip


def rendered(
    surface: dict[str, Any], slope_deg: float, wave_mm: float, seed: int, session: Session | None
) -> tuple[Session, Image, list[HighlightPoint]]:
    """Return session and picture of a surface with its relief, and the lit highlight points of its base."""
    relief = {"bands": [{"slope_deg": slope_deg, "wavelength_mm": wave_mm}], "seed": seed}
    scene = scene_from_dict(
        {
            "surface": {**surface, "relief": relief},
            "reflectance": {"type": "phong", "exponent": 400.0},
            # 81 deg: the point that a plane tilted by 25 deg has its cloud around is 140 px off the centre.
            "camera": {"width": 512, "height": 512, "fx": 300.0, "fy": 300.0},
            "sensor": {"noise_sigma": 0.01, "point_spread_px": 0.7, "exposure": {"percentile": 99.9}, "seed": seed},
            "render": {"samples_per_pixel": 4},
        }
    )
    session = session or Session(scene)
    session.update(scene)
    radiance = session.radiance()
    picture = render_picture(session, scene, radiance)
    return session, picture, [point for point in session.base_highlights(radiance) if point.lit]


def judged(
    session: Session, picture: Image, points: Sequence[HighlightPoint], slope_deg: float
) -> Iterator[Answer | tuple[str, ...]]:
    """Yield the answers on a picture with enough spots; of a false one its flags."""
    calibration = session.scene.calibration(min((point.distance for point in points), default=None))
    given = Frame(picture, calibration, SMOOTHING_PX)
    found, regions = cloud.estimate_frame(given, calibration.camera, calibration.priors), None
    for estimate in [] if isinstance(found, Failure) else found:
        shape = estimate.cloud
        assert shape is not None
        if len(shape.points_px) < MANY:
            continue
        regions = regions or CloudRegions.of(session, points)
        point = _point_of(estimate, points, regions)
        if point is None:
            yield estimate.flags
            continue
        assert estimate.covariance is not None
        error, squared = float(angle_deg(estimate.normal, point.normal_base)), mahalanobis2(estimate, point.normal_base)
        gains = (1 + point.kd_min_base, 1 + point.kd_max_base)
        given_gains = slope_of(shape.covariance, shape.independent, shape.lobe, gains)
        yield Answer(
            error,
            error * np.sqrt(len(shape.points_px)) / slope_deg,
            squared is not None and squared <= REGION,
            float(np.degrees(np.sqrt(np.linalg.eigvalsh(estimate.covariance)[-1]))),
            float(np.degrees(given_gains.value)) / slope_deg,
        )


def _point_of(estimate: Estimate, points: Sequence[HighlightPoint], regions: CloudRegions) -> HighlightPoint | None:
    """Return the highlight point that most spots of a cloud belong to; of several the nearest to where it looks."""
    assert estimate.cloud is not None
    spots = estimate.cloud.points_px
    owners = [n for n in regions.assign(np.zeros(len(spots), dtype=np.int64), spots) if n is not None]
    votes = np.bincount(owners, minlength=len(points))
    gaps = {n: np.linalg.norm(points[n].bp_px - estimate.look_px) for n in np.flatnonzero(votes == max(votes.max(), 1))}
    return points[min(gaps, key=lambda n: gaps[n])] if gaps else None


def row(name: str, frames: int, answers: Sequence[Answer | tuple[str, ...]]) -> list[str]:
    """Return a row of the table."""
    true = [each for each in answers if isinstance(each, Answer)]
    false = [each for each in answers if not isinstance(each, Answer)]
    sure = sum(not WARNINGS & set(flags) for flags in false)
    start = [name, str(frames), str(len(answers)), f"{len(false)} ({sure})" if false else "0"]
    if not true:
        return [*start, *[""] * 5]
    error, units, inside, semi, ratio = np.array([list(vars(each).values()) for each in true], dtype=float).T
    # The RMS angle is that of two components.
    of_rms = np.median(semi) * np.sqrt(2) / np.sqrt(np.mean(error**2))
    right = 100 * np.mean(np.abs(ratio - 1) <= CLOSE)
    held = f"{inside.sum():.0f} of {len(inside)}"
    return [*start, f"{error.mean():.2f}", f"{units.mean():.2f}", held, f"{of_rms:.2f}", f"{right:.0f} %"]


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.clouds")
    parser.add_argument("--most", type=int, help="frames of each surface")
    most = parser.parse_args().most
    table = [["surface", "frames", "answers", "false (sure)", "error, mean, deg", "over s / sqrt(N)",
              "regions that contain the truth", "semi-axis over RMS", "slope within 15 %, gains given"]]  # fmt: skip
    for name, cases in surfaces().items():
        session, answers = None, []
        for surface, slope_deg, wave_mm, seed in cases[:most]:
            session, picture, points = rendered(surface, slope_deg, wave_mm, seed, session)
            answers += judged(session, picture, points, slope_deg)
        table.append(row(name, len(cases[:most]), answers))
    print_markdown(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
