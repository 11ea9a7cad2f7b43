"""Single highlights against the organ's normal: python -m studies.clouds.singles [FIRST_SEED] [FRAMES].

FRAMES of each organ, whose relief has a slope drawn from the prior of a relief that nobody states, are reconstructed as
pictures are, with the lights told and without; each highlight's statement of the organ's normal is compared with the
base's normal where it looks.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

import simtest
from simtest.calibration.priors import UNTOLD_SLOPE_RAD
from simtest.geometry.vectors import angle_deg
from studies.clouds.organ_frames import ORGANS, BaseFrame, loaded
from studies.clouds.scores import RADIUS
from studies.kept import of_this_code

SLOPES_DEG = ((3.0, 6.0), (6.0, 10.0), (10.0, 15.0), (15.0, 20.0))


def drawn(organ: str, seed: int) -> float:
    """Return the slope of a frame's relief, deg."""
    share = np.random.default_rng([seed, ORGANS.index(organ)]).uniform()
    return math.degrees(float(UNTOLD_SLOPE_RAD.quantile(np.array([share]))[0]))


def judged(frame: BaseFrame, told: bool) -> list[tuple[float, float, bool]]:
    """Return of each highlight the organ's error and rms, deg, and whether its 95 % region holds the organ's normal."""
    calibration = frame.calibration
    if not told:
        calibration = replace(calibration, priors=replace(calibration.priors, lights_mm=()))
    picture, rows = np.round(255 * np.clip(frame.picture, 0, 1)).astype(np.uint8), []
    for spot in simtest.reconstruct(picture, calibration):
        stated = spot.organ.get(spot.best) if spot.best is not None else None
        truth = None if stated is None else frame.normal_at(stated.look_px)
        if stated is None or truth is None or stated.covariance is None or stated.cloud is not None:
            continue
        error = float(angle_deg(stated.normal, truth))
        rms = math.degrees(math.sqrt(float(np.trace(stated.covariance))))
        rows.append((error, rms, error <= RADIUS * rms))
    return rows


def main() -> None:
    """Print a table by slope, and over all."""
    parser = argparse.ArgumentParser(prog="python -m studies.clouds.singles", description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=200000, metavar="FIRST_SEED")
    parser.add_argument("many", type=int, nargs="?", default=20, metavar="FRAMES")
    parser.add_argument("--frames", type=Path, default=None, metavar="FOLDER")
    asked = parser.parse_args()
    folder = asked.frames or of_this_code(Path("reports/studies/singles"))
    found: list[tuple[str, float, bool, list[tuple[float, float, bool]]]] = []
    seeds = range(asked.first, asked.first + asked.many)
    cases = ((organ, drawn(organ, seed), seed) for organ in ORGANS for seed in seeds)
    for organ, slope, _, frame in loaded(cases, folder):
        found += [(organ, slope, told, judged(frame, told)) for told in (True, False)]
    print("| light | frames | n | highlights | error, median | 95th percentile | rms stated, median | inside |")
    print("|---|---|---|---|---|---|---|---|")
    for told in (True, False):
        own = [each for each in found if each[2] == told]
        groups = {f"{low:g} to {high:g} deg": [e for e in own if low <= e[1] < high] for low, high in SLOPES_DEG}
        groups |= {organ: [e for e in own if e[0] == organ] for organ in ORGANS} | {"all": own}
        for name, group in groups.items():
            rows = np.array([row for *_, rows in group for row in rows], dtype=float).reshape(-1, 3)
            if len(rows):
                off, rms, held = rows.T
                print(
                    f"| {'' if told else 'not '}given | {name} | {len(group)} | {len(rows)} | {np.median(off):.1f} | "
                    f"{np.quantile(off, 0.95):.1f} | {np.median(rms):.1f} | {100 * held.mean():.1f} % |"
                )


if __name__ == "__main__":
    main()
