"""Bands on rendered organs, whose base is known: python -m studies.bands.rendered [FIRST_SEED] [FRAMES] [FOLDER].

FRAMES of each organ and slope, rendered once into the folder; each is read with the lights told and without.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simtest.calibration import Frame
from studies.bands.cells import count_cells
from studies.bands.fit import fit_bands
from studies.bands.frames import ORGANS, SLOPES_DEG, BaseFrame, frames
from studies.bands.judge import REGION, judge, turned
from studies.kept import of_this_code

SMOOTHING_PX = 1.0
SURE, SURE_DEG = 3.0, 5.0
"""Wrong and sure: so many times the stated error, and by so much."""


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
    cells = count_cells(given)
    answers = [answer for answer in judge(given, cells, fit_bands(cells), priors) if not answer.refused]
    truths = [frame.normal_at(given.camera.project(answer.band.centre)) for answer in answers]
    return [
        (math.degrees(turned(answer.normal, truth)), math.degrees(answer.radius))
        for answer, truth in zip(answers, truths, strict=True)
        if truth is not None
    ]


def line(name: str, held: Sequence[Read]) -> str:
    """Return a row of the table."""
    answered = sum(bool(each.answers) for each in held)
    start = f"| {name} | {len(held)} | {answered} |"
    if not answered:
        return f"{start} 0 | | | | | |"
    error, radius = np.array([answer for each in held for answer in each.answers]).T
    sure = np.count_nonzero((error > SURE * radius / math.sqrt(REGION)) & (error > SURE_DEG))
    return (
        f"{start} {len(error)} | {np.median(error):.1f} | {np.quantile(error, 0.95):.1f} | {np.mean(radius):.1f} | "
        f"{100 * np.mean(error <= radius):.0f} % | {sure} |"
    )


def main() -> None:
    """Print a table for told and untold lights, by slope, by organ and over all."""
    given = sys.argv[1:]
    first, many = (int(given[i]) if len(given) > i else value for i, value in enumerate((60000, 20)))
    folder = Path(given[2]) if len(given) > 2 else of_this_code(Path("reports/studies/bands"))
    done = [
        Read(organ, slope, told, read(frame, told))
        for organ, slope, _, frame in frames(first, many, folder)
        for told in (True, False)
    ]
    print("| frames | n | answered | bands | median, deg | 95th percentile | mean radius | inside | wrong and sure |")
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
