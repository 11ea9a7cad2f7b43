"""The phantom's frame against its registered normals: python -m studies.clouds.phantom FOLDER.

FOLDER holds color.png, normals.png and config.ini of C3VD's sample. The frame is read as it is, at other JPEG
qualities, cropped to three quarters, and at half its size; the light is not given. No constant is fitted to it.
"""

import argparse
import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import simtest
from simtest.calibration import Calibration, Priors, Uniform
from simtest.estimators.budget import total
from simtest.estimators.prior_parts import relief_part
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction import Specularities
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array
from simtest.spec.calibration_file import load_calibration
from simtest.validation.references import load_map_reference

RADIUS = math.sqrt(chi_squared.quantile(0.95, 2) / 2)
"""Of a round 95 % region, over the rms."""

QUALITIES = (95, 80, 60)


def variants(folder: Path) -> Iterator[tuple[str, Array, Array, Calibration, Array, float]]:
    """Yield name, picture, normals, calibration, and the whole frame's pixel of a pixel: offset and scale."""
    bgr, told = cv2.imread(str(folder / "color.png")), cv2.imread(str(folder / "normals.png"))
    if bgr is None or told is None:
        raise SystemExit(f"{folder}: must hold color.png and normals.png")
    calibration = load_calibration(folder / "config.ini")
    with tempfile.TemporaryDirectory() as held:
        # The sample's normals are the data set's, but for 8 bits in place of 16.
        file = Path(held) / "0000_normals.tiff"
        cv2.imwrite(str(file), told.astype(np.uint16) * 257)
        normals = np.asarray(load_map_reference(file, "c3vd", calibration.camera).map)
    origin = np.zeros(2)
    yield "as it is", bgr, normals, calibration, origin, 1.0
    for quality in QUALITIES:
        _, coded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
        yield f"JPEG {quality}", np.asarray(cv2.imdecode(coded, 1)), normals, calibration, origin, 1.0
    camera, (height, width) = calibration.camera, bgr.shape[:2]
    x, y = width // 4, height // 4
    part = replace(camera, cx=camera.cx - x, cy=camera.cy - y, width=width - x, height=height - y)
    yield "three quarters", bgr[y:, x:], normals[y:, x:], replace(calibration, camera=part), np.array([x, y]), 1.0
    size, half = (width // 2, height // 2), {name: getattr(camera, name) / 2 for name in ("fx", "fy", "cx", "cy")}
    small = replace(camera, width=size[0], height=size[1], **half)
    shrunk = np.asarray(cv2.resize(bgr, size, interpolation=cv2.INTER_AREA))
    yield "half size", shrunk, normals[1::2, 1::2], replace(calibration, camera=small), origin, 2.0


def rows(name: str, spots: Specularities, normals: Array, origin: Array, scale: float) -> list[str]:
    """Return a row of the table for each cloud that has an answer, or one that says why none has."""
    made = []
    for spot in spots.clouds:
        estimate = spot.normals["cloud"]
        x, y = (int(v) for v in estimate.look_px)
        look, error = scale * estimate.look_px + origin, float(angle_deg(estimate.normal, normals[y, x]))
        radius = RADIUS * (estimate.deviation_deg or math.nan)
        made.append(
            f"| {name} | ({look[0]:.0f}, {look[1]:.0f}) | {error:.1f} | {radius:.1f} | {', '.join(estimate.flags)} |"
        )
    return made or [f"| {name} | {spots.of_organ} | | | |"]


def of_singles(spots: Specularities, normals: Array) -> str:
    """Return how far single highlights are off the organ's normal, and how many of their regions contain it.

    The last share is of regions that allow for slopes of 3 to 10 deg alone, as the recipes have them.
    """
    errors, radii, narrower = [], [], []
    gentle = np.trace(relief_part(Priors(relief_slope=Uniform(*np.radians([3.0, 10.0]).tolist()))))
    for spot in spots:
        best = spot.organ.get(spot.best) if spot.best else None
        if best is not None and best.cloud is None and best.deviation_deg is not None:
            x, y = (int(v) for v in best.look_px)
            errors.append(float(angle_deg(best.normal, normals[y, x])))
            radii.append(RADIUS * best.deviation_deg)
            rest = np.trace(total(best.budget) - best.budget["relief"])
            narrower.append(RADIUS * math.degrees(math.sqrt(rest + gentle)))
    off = np.array(errors)
    known, inside, within = np.isfinite(off), off <= np.array(radii), off <= np.array(narrower)
    return (
        f"{known.sum()} single highlights: median {np.median(off[known]):.1f} deg off the organ's normal, "
        f"{100 * inside[known].mean():.0f} % inside its 95 % region of {np.median(radii):.0f} deg, "
        f"{100 * within[known].mean():.0f} % inside one of {np.median(narrower):.0f} deg"
    )


def main() -> None:
    """Print the clouds' answers, and those of the single highlights of the frame as it is."""
    parser = argparse.ArgumentParser(prog="python -m studies.clouds.phantom", description=__doc__)
    parser.add_argument("folder", type=Path)
    table, singles = ["| frame | looks at, px | error, deg | radius | flags |", "|---|---|---|---|---|"], ""
    for name, picture, normals, calibration, origin, scale in variants(parser.parse_args().folder):
        spots = simtest.reconstruct(np.ascontiguousarray(picture[..., ::-1]), calibration)
        table += rows(name, spots, normals, origin, scale)
        singles = singles or of_singles(spots, normals)
    print("\n".join(table), singles, sep="\n\n")


if __name__ == "__main__":
    main()
