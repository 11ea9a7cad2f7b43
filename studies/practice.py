"""Errors of single highlights on tissue by what the user gives: python -m studies.practice [FRAMES] [SEED].

Frames are those of `studies.one_light` whose light stands beside the camera, as in an endoscope. Each is read twice:
with nothing but its field of view across the width, and with its camera, light and working range. The best estimate of
each highlight is compared with the normal of the facet that shines. The printed rows stand in
simtest/report/practice.toml. Nothing was tuned on the seed.
"""

import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.advice.twin.scoring import ScoredSpot, score
from simtest.reconstruction.assumptions import calibration_of_view
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import run
from simtest.runtime import chi_squared
from studies.one_light import OneLight, in_8_bits, rendered, told

FRAMES, SEED = 30, 9671
REGION = math.sqrt(chi_squared.quantile(0.95, 2) / 2)
"""Radius of a round 95 % region over its root mean square error."""


def line(given: str, frames: Sequence[Sequence[ScoredSpot]]) -> list[str]:
    """Return a row of the table."""
    spots = [spot for frame in frames for spot in frame if spot.kind != "false" and spot.held is not None]
    errors = np.array([spot.error_deg for spot in spots])
    reported = np.array([spot.spot.estimate.deviation_deg or math.nan for spot in spots])
    ((most, count),) = Counter(spot.spot.estimator for spot in spots).most_common(1)
    return [
        given, f"{most} ({100 * count / len(spots):.0f} %)", str(len(frames)), str(len(spots)),
        f"{np.median(errors):.1f}", f"{np.quantile(errors, 0.95):.1f}",
        f"{REGION * np.nanmedian(reported):.0f}", f"{100 * np.mean([spot.held for spot in spots]):.0f} %",
    ]  # fmt: skip


def main(arguments: Sequence[str]) -> None:
    """Render, read and print."""
    frames, seed = (int(arguments[i]) if len(arguments) > i else default for i, default in enumerate((FRAMES, SEED)))
    plan = OneLight(seed, 2 * frames)
    by_view, by_calibration = list[list[ScoredSpot]](), list[list[ScoredSpot]]()
    # Those of odd numbers have their light at the camera.
    for number in range(0, 2 * frames, 2):
        made = rendered(plan, number)
        if made is None:
            continue
        session, view, family = made
        picture, camera = in_8_bits(view), view.calibration.camera
        of_view = calibration_of_view(
            2 * math.degrees(math.atan(camera.width / (2 * camera.fx))), camera.width, camera.height, "width"
        )
        by_view.append(score(session, view, run(picture, of_view, Options())))
        calibrated = told(view, family)
        # as of a picture: with floors
        calibrated = replace(calibrated, priors=replace(calibrated.priors, floors=None))
        by_calibration.append(score(session, view, run(picture, calibrated, Options())))
        print(f"frame {number}: {len(by_view[-1])} highlights", file=sys.stderr, flush=True)
    print_markdown([
        ["given", "best", "frames", "highlights", "median, deg", "95th percentile", "region, median", "inside"],
        line("field of view", by_view),
        line("camera, light and working range", by_calibration),
    ])  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
