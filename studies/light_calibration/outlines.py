"""How far the outlines of all pictures of a rig are off alike, over what is stated of them.

    python -m studies.light_calibration.outlines chrome 9000 45

takes so many rigs from the first seed on, with wet or chrome balls. A rig's shared error is the mean over its pictures
of the outline's centre along x and y, and of its radius, measured less planted, px. `UNSURE` of the calibration
is read off the last line, which leaves out rigs that no calibration comes of.
"""

import argparse

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.errors import InputError
from simtest.reconstruction.light_calibration.run import COMMON_PX, COMMON_RADIUS_PX, SHADED_PX
from studies.light_calibration.__main__ import measured
from studies.light_calibration.pictures import Floats
from studies.light_calibration.plantings import KINDS, Planting, plant


def main() -> None:
    """Print a row for each rig, and the root mean square of shared over own errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("first", type=int, help="seed of the first rig")
    parser.add_argument("count", type=int)
    given = parser.parse_args()
    rows, seed = [["rig", "x, px", "y, px", "radius, px", "own, px", "calibration"]], given.first
    ratios = list[Floats]()
    while len(rows) <= given.count:
        planting, seed = plant(seed), seed + 1
        if planting.kind != given.kind:
            continue
        try:
            shared, own, is_answered = errors(planting)
        except InputError as error:
            rows.append([str(planting.seed), "", "", "", "", str(error)[:40]])
            continue
        rows.append([str(planting.seed), *(f"{v:.3f}" for v in (*shared, own[0])), "yes" if is_answered else "no"])
        if is_answered:
            beside = SHADED_PX * planting.lights[:, :2].mean(axis=0)
            known = np.hypot([COMMON_PX, COMMON_PX, COMMON_RADIUS_PX], [*beside, 0.0])
            # What is left of the shared error beside its known parts.
            ratios.append(np.sqrt(np.maximum(shared**2 - known**2, 0.0)) / own)
    print_markdown(rows)
    rms, largest = (
        np.round(each, 2).tolist() for each in (np.sqrt(np.mean(np.square(ratios), axis=0)), np.max(ratios, axis=0))
    )
    print(f"\nshared over own along x, y and of the radius, {len(ratios)} rigs: RMS {rms}, largest {largest}")


def errors(planting: Planting) -> tuple[Floats, Floats, bool]:
    """Return the shared and the own errors along x, y and of the radius, px, and whether a calibration comes of it."""
    made, camera = measured(planting), planting.camera
    apart, own = [], []
    for view in made.views.views:
        outline, centre = view.seen_outline, planting.centres[int(view.name[:2])]
        distance, pixel = float(np.linalg.norm(centre)), outline.pixel_rad(camera)
        radius = (outline.half_angle - np.arcsin(planting.radius_mm / distance)) / pixel
        apart.append([*(camera.project(outline.direction) - camera.project(centre / distance)), radius])
        own.append(np.sqrt(np.diag(outline.covariance)) / pixel)
    return np.mean(apart, axis=0), np.mean(own, axis=0), not made.result.problems


if __name__ == "__main__":
    main()
