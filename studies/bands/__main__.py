"""Fit bands to pictures and print their normals: python -m studies.bands PICTURE --camera FILE [--normals MAP].

MAP is a reference of the format c3vd, whose name ends in _normals.tiff: each band's error is then printed beside its
region.
"""

import argparse
import math
import time
from pathlib import Path

from simtest.calibration import Frame
from simtest.reconstruction.images import read_picture
from simtest.reconstruction.options import complete
from simtest.spec import load_calibration
from simtest.validation.references import FORMATS, read_normals
from studies.bands.cells import count_cells
from studies.bands.fit import fit_bands
from studies.bands.judge import judge, turned

SMOOTHING_PX = 1.0


def main() -> None:
    """Fit the bands of the command line's picture and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--camera", type=Path, required=True)
    parser.add_argument("--normals", type=Path)
    asked = parser.parse_args()
    calibration = complete(load_calibration(asked.camera), None)
    frame = Frame(read_picture(asked.picture), calibration, SMOOTHING_PX)
    started = time.process_time()
    cells = count_cells(frame)
    fit = fit_bands(cells)
    answers = judge(frame, cells, fit, calibration.priors)
    print(
        f"{len(answers)} bands in {time.process_time() - started:.1f} s of processor; dispersion {fit.dispersion:.1f}"
    )
    truth = None if asked.normals is None else read_normals(asked.normals, FORMATS["c3vd"])
    for answer in answers:
        x, y = frame.camera.project(answer.band.centre)
        told = f"({x:.0f}, {y:.0f}) px, amplitude {answer.band.amplitude:.2f}, +-{math.degrees(answer.radius):.1f} deg"
        if truth is not None and 0 <= x < truth.shape[1] and 0 <= y < truth.shape[0]:
            told += f", error {math.degrees(turned(answer.normal, truth[int(y), int(x)])):.1f} deg"
        print(told + (f"; refused: {answer.refused}" if answer.refused else ""))


if __name__ == "__main__":
    main()
