"""From rendered balls to normals: what measured lights are worth on frames of the same scope.

    python -m studies.light_calibration.closed_loop [RIGS] [FIRST_SEED]

Each rig of one to three lights takes pictures of a ball (`rendered`) and is calibrated on them. The same lights then
render a smooth cylinder and rough tissue. Both pictures are reconstructed three times, with calibration files that
differ in the lights alone: not told, as calibrated, and exact. The distance is told with a standard deviation of 15 %.
"""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measuring import print_markdown
from simtest.advice.twin.scoring import ScoredSpot, score
from simtest.calibration import Calibration, Normal, Priors, Response
from simtest.errors import InputError
from simtest.estimators.budget import deviations
from simtest.reconstruction.images import read_picture
from simtest.reconstruction.light_calibration.page import write_calibration
from simtest.reconstruction.light_calibration.run import Ball, calibrate_lights, picture_readers
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import run
from simtest.rendering import Session
from simtest.simulation.frame import RenderedView, render_view
from simtest.spec import Scene, load_scene
from simtest.spec.calibration_file import load_calibration, save_calibration
from studies.light_calibration.plantings import plant
from studies.light_calibration.rendered import CAMERA, GAMMA, Floats, Rendering, camera, places, rig_table

RADIUS_MM, BALLS = 5.0, 8
FIRST = 7000
"""Seed of the first rig; nothing was tuned on them."""

DISTANCE_SD = 0.15
"""Of the told distance, as a share of it."""

TOLD = ("not told", "calibrated", "exact")
FRAMES = ("cylinder", "tissue")


@dataclass(frozen=True)
class Rated:
    """A highlight's error and what is stated of it, deg; `held`: whether the 95 % region holds the true normal."""

    told: str
    frame: str
    error: float
    stated: float
    light: float
    held: bool


def plain_calibration() -> Calibration:
    """Return what is known of the camera before its lights are measured."""
    return Calibration(camera(), response=Response("gamma", GAMMA))


def calibrated_file(lights: Floats, seed: int, folder: Path) -> Path:
    """Render balls, measure the lights on the pictures, and return the calibration file; `InputError` if doubtful."""
    files = Rendering(lights, places(BALLS, RADIUS_MM, seed), RADIUS_MM, seed=seed).write(folder)
    made = calibrate_lights(picture_readers(files), plain_calibration(), Ball(RADIUS_MM))
    if made.result.problems:
        raise InputError("; ".join(made.result.problems))
    return write_calibration(made, folder)[0]


def scenes(lights: Floats, seed: int) -> dict[str, Scene]:
    """Return a smooth cylinder and rough tissue in the light of a rig."""
    sensor = {
        "sensor.response": {"type": "gamma", "gamma": GAMMA}, "sensor.bits": 8, "sensor.full_well": 20000.0,
        "sensor.seed": seed,
    }  # fmt: skip
    shared = {"rig": rig_table(lights), "camera": CAMERA, **sensor}
    cylinder = {
        "surface.distance_mm": 20.0, "surface.radius_mm": 20.0, "surface.azimuth_deg": float(37 * seed % 360),
        "surface.spin_deg": float(53 * seed % 180), "sensor.noise_sigma": 0.005, "reflectance.exponent": 600.0,
        "reflectance.diffuse": 0.2,
    }  # fmt: skip
    return {
        "cylinder": load_scene("cylinder", {**shared, **cylinder}),
        "tissue": load_scene("tissue_stomach", {**shared, "surface.viewpoint": 1 + seed % 5}),
    }


def rated(
    session: Session, view: RenderedView, picture: Path, calibration: Calibration, names: tuple[str, str]
) -> list[Rated]:
    """Return the highlights of a picture that have a stated region."""
    made = run(read_picture(picture), calibration, Options())
    return [
        _rated(each, *names) for each in score(session, view, made) if each.held is not None and each.kind != "false"
    ]


def _rated(each: ScoredSpot, told: str, frame: str) -> Rated:
    estimate = each.spot.estimate
    light = deviations(estimate.budget or {}).get("light_offset", 0.0)
    return Rated(told, frame, each.error_deg, estimate.deviation_deg or 0.0, float(np.degrees(light)), bool(each.held))


def rows_of_rig(
    lights: Floats, seed: int, folder: Path, others: Mapping[str, Priors] | None = None, frames: Sequence[str] = FRAMES
) -> list[Rated]:
    """Return the highlights of the frames of a rig, for each of what is told of its lights, `others` besides."""
    by_balls = load_calibration(calibrated_file(lights, seed, folder)).priors
    exact = tuple((float(x), float(y), float(z)) for x, y, z in lights)
    told = {"not told": Priors(), "calibrated": by_balls, "exact": Priors(lights_mm=exact), **(others or {})}
    rows = []
    for name in frames:
        scene = scenes(lights, seed)[name]
        session = Session(scene)
        view = render_view(session, scene)
        picture = folder / f"{name}.png"
        values = np.rint(255 * np.clip(view.frame(scene.sensor.seed), 0, 1)).astype(np.uint8)
        cv2.imwrite(str(picture), values[..., ::-1] if values.ndim == 3 else values)
        distance = distance_told(view, seed)
        for label, priors in told.items():
            file = folder / f"{label}.toml"
            save_calibration(replace(plain_calibration(), priors=replace(priors, distance_mm=distance)), file)
            rows += rated(session, view, picture, load_calibration(file), (label, name))
    return rows


def distance_told(view: RenderedView, seed: int) -> Normal:
    """Return the distance of the middle highlight as a user would know it."""
    true = float(np.median([point.distance for point in view.highlights if point.lit]))
    off = 1 + DISTANCE_SD * np.random.default_rng([2412, seed]).standard_normal()
    return Normal(true * off, DISTANCE_SD * true * off)


def table(rows: Sequence[Rated]) -> list[list[str]]:
    """Return the table of errors and stated deviations."""
    lines = [["frame", "lights", "highlights", "RMS error, deg", "stated, deg", "part of the light, deg", "held"]]
    for frame in FRAMES:
        for told in TOLD:
            own = [row for row in rows if (row.frame, row.told) == (frame, told)]
            if own:
                numbers = np.array([(row.error, row.stated, row.light) for row in own])
                rms = [f"{value:.2f}" for value in np.sqrt(np.mean(numbers**2, axis=0))]
                held = np.mean([row.held for row in own])
                lines.append([frame, told, str(len(own)), *rms, f"{held:.0%}".replace("%", " %")])
    return lines


def main(arguments: Sequence[str]) -> None:
    """Run the rigs, and print the table."""
    count, first = (int(arguments[i]) if len(arguments) > i else default for i, default in ((0, 4), (1, FIRST)))
    rows = []
    for seed in range(first, first + count):
        lights = plant(seed, 1 + seed % 3).lights
        with tempfile.TemporaryDirectory() as folder:
            try:
                rows += rows_of_rig(lights, seed, Path(folder))
            except InputError as error:
                print(f"rig {seed}: {error}", file=sys.stderr)
                continue
        print(f"rig {seed}, {len(lights)} lights: {len(rows)} rows", file=sys.stderr, flush=True)
    print_markdown(table(rows))


if __name__ == "__main__":
    main(sys.argv[1:])
