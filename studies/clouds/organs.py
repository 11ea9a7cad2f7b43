"""Clouds on rendered organs, whose base is known: python -m studies.clouds.organs [FIRST_SEED] [FRAMES] [--fit].

FRAMES of each organ and slope, rendered once into the folder; each is read with the lights told and without, and the
error is that against the base's normal where an answer looks. With `--fit` the constants of `cloud` are fitted to the
clouds of these frames, before any is refused.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from simtest.calibration import Calibration, Frame
from simtest.errors import Failure, SimtestError
from simtest.estimators.budget import total
from simtest.estimators.cloud import LEAST_VERIFIABLE, SLOPES, TYPICAL_SLOPE, Groups, cloud
from simtest.estimators.cloud_light import DiffuseLight, find_spots
from simtest.estimators.cloud_mixture import CLUMPING, sampling_covariance
from simtest.geometry.vectors import basis_across
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Image
from simtest.simulation.frame import render_picture
from simtest.spec import Scene, load_scene, scene_from_dict
from simtest.validation.statistics import is_wrong_and_sure
from studies.kept import of_this_code, write_arrays

ORGANS = ("colon", "liver", "gallbladder")
SLOPES_DEG = (3.0, 6.0, 10.0, 17.0)
HEIGHTS_MM = {"colon": 0.226, "liver": 0.226, "gallbladder": 0.138}
"""Of the shipped relief."""

HIGHEST_MM = 0.27
"""Steeper relief is drawn finer, so that it stays below this."""

STRIDE = 4
"""Of the pixels whose base normal is kept, px."""

SMOOTHING_PX = 1.0
REGION = 3.0
"""Squared radius of the 95 % region over the mean square of the error."""


@dataclass(frozen=True)
class BaseFrame:
    """A rendered picture with its base's normals at every `STRIDE`-th pixel, zero or NaN off the surface."""

    organ: str
    slope_deg: float
    picture: Image
    normals: Array
    calibration: Calibration

    def normal_at(self, pixel: Array) -> Array | None:
        """Return the base's normal at a pixel, none off the surface."""
        column, row = (int(v // STRIDE) for v in pixel)
        if not (0 <= row < self.normals.shape[0] and 0 <= column < self.normals.shape[1]):
            return None
        normal = self.normals[row, column]
        return np.asarray(normal, dtype=float) if np.abs(normal).sum() > 0.5 else None


def organ_scene(organ: str, slope_deg: float, seed: int) -> Scene:
    """Return a shipped tissue scene at a viewpoint drawn for it, its relief scaled to a slope along one direction."""
    place: dict[str, object] = {"surface.viewpoint": seed}
    if organ == "gallbladder":
        rng = np.random.default_rng([seed, 3])
        place = {"surface.tilt_deg": float(rng.uniform(0, 25)), "surface.spin_deg": float(rng.uniform(0, 180))}
    drawn = {"surface.relief.seed": seed, "sensor.seed": seed, "render.samples_per_pixel": 4, **place}
    data = load_scene(f"tissue_{organ}", drawn).model_dump(mode="json")
    bands = data["surface"]["relief"]["bands"]
    scale = slope_deg / float(np.sqrt(sum(band["slope_deg"] ** 2 for band in bands)))
    finer = min(1.0, HIGHEST_MM / (HEIGHTS_MM[organ] * scale))
    for band in bands:
        band["slope_deg"] *= scale
        band["wavelength_mm"] *= finer
    return scene_from_dict(data)


def frames(first: int, many: int, folder: Path) -> Iterator[BaseFrame]:
    """Yield `many` frames of each organ and slope, seeds from `first` on, from a folder or rendered into it.

    What cannot be rendered is said.
    """
    for o, organ in enumerate(ORGANS):
        session = None
        for n in range(many * len(SLOPES_DEG)):
            seed, slope = first + 1000 * o + n, SLOPES_DEG[n % len(SLOPES_DEG)]
            scene, file = organ_scene(organ, slope, seed), folder / f"{organ}_{slope:g}_{seed}.npz"
            try:
                if not file.exists():
                    session = session or Session(scene)
                    write_arrays(file, _rendered(session, scene))
            except SimtestError as error:
                print(f"{organ}, {slope:g} deg, seed {seed}: {error}")
                continue
            with np.load(file) as kept:
                picture, normals, nearest = (kept[name] for name in ("picture", "normals", "nearest_mm"))
            yield BaseFrame(
                organ, slope, picture, normals, scene.calibration(float(nearest[0]) if len(nearest) else None)
            )


def _rendered(session: Session, scene: Scene) -> dict[str, Array]:
    """Return picture, base normals, and the distance of the base's nearest lit highlight point, if there is one."""
    session.update(scene)
    radiance = session.radiance()
    distances = [point.distance for point in session.base_highlights(radiance) if point.lit]
    normals = np.asarray(session.truth(STRIDE).normal_base)
    return {
        "picture": np.asarray(render_picture(session, scene, radiance), dtype=np.float32),
        "normals": normals.astype(np.float32),
        "nearest_mm": np.array(sorted(distances)[:1]),
    }


@dataclass(frozen=True)
class Read:
    """A frame that was read: whether the lights were told, and of each answer its error and its radius, deg."""

    organ: str
    slope_deg: float
    told: bool
    answers: Sequence[tuple[float, float]]


def read(frame: BaseFrame, told: bool) -> list[tuple[float, float]]:
    """Return the error against the base's normal where an answer looks, and its 95 % radius, deg, of each answer."""
    calibration = frame.calibration
    priors = calibration.priors if told else replace(calibration.priors, lights_mm=())
    given = Frame(frame.picture, calibration, SMOOTHING_PX)
    made = cloud.estimate_frame(given, given.camera, priors)
    answers = []
    for each in [] if isinstance(made, Failure) else made:
        if (truth := frame.normal_at(each.look_px)) is not None:
            error = float(np.arccos(np.clip(each.normal @ truth, -1.0, 1.0)))
            answers.append((math.degrees(error), math.degrees(math.sqrt(REGION * np.trace(total(each.budget))))))
    return answers


def line(name: str, held: Sequence[Read]) -> str:
    """Return a row of the table."""
    answered = sum(bool(each.answers) for each in held)
    start = f"| {name} | {len(held)} | {answered} |"
    if not answered:
        return f"{start} 0 | | | | | |"
    error, radius = np.array([answer for each in held for answer in each.answers]).T
    sure = np.count_nonzero(is_wrong_and_sure(error, radius / math.sqrt(REGION)))
    return (
        f"{start} {len(error)} | {np.median(error):.1f} | {np.quantile(error, 0.95):.1f} | {np.mean(radius):.1f} | "
        f"{100 * np.mean(error <= radius):.0f} % | {sure} |"
    )


@dataclass(frozen=True)
class Found:
    """A cloud before it is judged, of a frame whose lights are told; angles in rad.

    `truth`, `light`, (2,): turn of the base from the reversed centre, and what the diffuse light says of it;
    `jackknife`, (2, 2): its covariance by the jackknife; `chance`, `dimness`: variances of the turn by the number of
    spots and by a density below the frame's densest, each for constants of 1.
    """

    truth: Array
    light: Array
    jackknife: Array
    chance: float
    dimness: float


def found_in(frame: BaseFrame) -> list[Found]:
    """Return the clouds of a frame around which enough diffuse light is seen."""
    calibration = frame.calibration
    given, camera = Frame(frame.picture, calibration, SMOOTHING_PX), calibration.camera
    spots, light, rows = find_spots(given), DiffuseLight(given), []
    if len(spots.peaks) < cloud.least_spots or not light.shows:
        return []
    groups = Groups.of(given, spots, camera, calibration.priors)
    for each, own in zip(groups.clouds, groups.spots, strict=True):
        count, truth = len(own.peaks), frame.normal_at(camera.project(each.sightline))
        shading = light.around(each.sightline, each.covariance)
        is_judged = count >= cloud.least_spots and each.seen >= LEAST_VERIFIABLE
        if not is_judged or truth is None or shading is None:
            continue
        half = basis_across(each.centre)
        across = half @ basis_across(each.sightline).T
        gains = across @ shading.gains @ across.T
        back = np.linalg.inv(2 * np.eye(2) + gains) @ across
        slope = math.sqrt(float(np.trace(each.covariance)) / 2)
        square = TYPICAL_SLOPE * float(np.clip(slope, *SLOPES))
        sampling = sampling_covariance(each, groups.window, max(count / CLUMPING, 2.5))
        rows.append(
            Found(
                half @ (truth + each.centre),
                each.turns.mean(axis=0) - back @ shading.gradient,
                back @ shading.covariance @ back.T,
                square * float(np.trace(np.linalg.solve(each.covariance, sampling))) / 2,
                square * groups.dimness(each),
            )
        )
    return rows


def fitted(rows: Sequence[Found]) -> dict[str, float]:
    """Return the constants of `cloud` under which the errors of its averages are most likely, gaussian each."""
    truth, light = np.array([row.truth for row in rows]), np.array([row.light for row in rows])
    jackknife = np.array([np.trace(row.jackknife) / 2 for row in rows])
    chance, dimness = (np.array([getattr(row, name) for row in rows]) for name in ("chance", "dimness"))

    def cost(logs: Array) -> float:
        aside, number, dimmer, own, factor, share = np.exp(logs)
        spots = aside**2 + number**2 * chance + dimmer**2 * dimness
        other = own**2 + factor**2 * jackknife + share**2 * (light**2).sum(axis=1)
        variance = spots * other / (spots + other)
        gap = truth - (spots / (spots + other))[:, None] * light
        return float(np.mean(np.log(variance) + (gap**2).sum(axis=1) / (2 * variance)))

    start = np.log([math.radians(5.0), 1.0, 1.0, math.radians(2.0), 1.0, 0.5])
    aside, number, dimmer, own, factor, share = np.exp(
        minimize(cost, start, method="Nelder-Mead", options={"maxiter": 9999}).x
    )
    degrees = {"aside": math.degrees(aside), "light": math.degrees(own)}
    return {**degrees, "chance": number, "dimmer": dimmer, "jackknife": factor, "own_share": share}


def main() -> None:
    """Print a table for told and untold lights, by slope, by organ and over all; or the constants."""
    parser = argparse.ArgumentParser(prog="python -m studies.clouds.organs", description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=80000, metavar="FIRST_SEED")
    parser.add_argument("many", type=int, nargs="?", default=12, metavar="FRAMES")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--frames", type=Path, default=None, metavar="FOLDER")
    asked = parser.parse_args()
    drawn = frames(asked.first, asked.many, asked.frames or of_this_code(Path("reports/studies/organs")))
    if asked.fit:
        rows = [row for frame in drawn for row in found_in(frame)]
        print(f"{len(rows)} clouds:", ", ".join(f"{name} {value:.2f}" for name, value in fitted(rows).items()))
        return
    done = [Read(frame.organ, frame.slope_deg, told, read(frame, told)) for frame in drawn for told in (True, False)]
    print("| frames | n | answered | answers | median, deg | 95th percentile | mean radius | inside | wrong and sure |")
    print("|---|---|---|---|---|---|---|---|---|")
    for told, light in ((True, "light given"), (False, "not given")):
        own = [each for each in done if each.told == told]
        for slope in SLOPES_DEG:
            print(line(f"{light}, {slope:g} deg", [each for each in own if each.slope_deg == slope]))
        for organ in ORGANS:
            print(line(f"{light}, {organ}", [each for each in own if each.organ == organ]))
        print(line(f"{light}, all", own))


if __name__ == "__main__":
    main()
