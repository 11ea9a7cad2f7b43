"""Draw the README's picture: a rendered colon with the true and the estimated normals at its highlights.

    python -m studies.readme_picture [OUT.jpg]

The scene is studies/readme_picture.toml. It is reconstructed as `simtest reconstruct` reconstructs a file: the
estimators see the picture and its calibration. Each normal is drawn as a disc that lies on the surface, with a pin
along the normal. The frame stands on the left, its highlights enlarged on the right.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.linalg import norm
from PIL import Image, ImageDraw

import simtest
from simtest.errors import Failure
from simtest.geometry.vectors import angle_deg, tangent_basis
from simtest.pages.pixels import GAMMA, Canvas, Pixels, font, legend
from simtest.pages.style import TRUTH, colours
from simtest.runtime.arrays import Array
from simtest.runtime.files import write_atomically
from simtest.validation.scoring import match, peak_px

SCENE = Path(__file__).with_suffix(".toml")
OUT = Path("docs/images/readme_normals.jpg")
TRUE = "true normal"
ESTIMATORS = ("cone_axis", "circle_pose")
HEIGHT, CROP_PX, COLUMNS = 660, 90, 2
RADIUS_PX, PIN = 17.0, 1.6
"""Radius of a disc that faces the camera, px of the frame, and length of its pin over that radius."""

QUALITY = 88


@dataclass(frozen=True)
class Spot:
    """A highlight: its pixel, its surface point (mm, camera frame) and its normals by name, the true one last."""

    bp_px: Array
    point: Array
    normals: Mapping[str, Array]

    def error_deg(self, name: str) -> float:
        """Return the angle of an estimator's normal to the true one, deg."""
        return float(angle_deg(self.normals[name], self.normals[TRUE]))


def find_spots(frame: simtest.LabelledFrame) -> list[Spot]:
    """Reconstruct the frame as a picture; return the highlights that both estimators answer, from left to right."""
    picture = np.rint(255 * np.clip(frame.image, 0, 1)).astype(np.uint8)
    found = simtest.reconstruct(picture, frame.calibration, estimators=ESTIMATORS)
    true = [highlight for highlight in frame.highlights if highlight.isolated]
    spots = []
    for i, j in match(found, [highlight.bp_px for highlight in true]).items():
        estimates = found[i].estimates
        answers = {n: e.normal for n in ESTIMATORS if not isinstance(e := estimates[n], Failure)}
        if len(answers) == len(ESTIMATORS):
            spots.append(Spot(peak_px(found[i]), true[j].position, {**answers, TRUE: true[j].normal}))
    print(f"{len(true)} true isolated highlights, {len(spots)} answered by all of {', '.join(ESTIMATORS)}")
    return sorted(spots, key=lambda spot: float(spot.bp_px[0]))


def draw_spot(canvas: Canvas, spot: Spot, camera: simtest.Camera, width: int) -> None:
    """Draw a highlight's normals as discs with pins, the true one on top."""
    radius = RADIUS_PX * norm(spot.point) / camera.K[0, 0]
    turns = np.linspace(0, 2 * np.pi, 73)[:, None]
    palette = {**colours(ESTIMATORS), TRUE: TRUTH}
    for name in (*reversed(ESTIMATORS), TRUE):
        normal = spot.normals[name]
        across, along = (axis[0] for axis in tangent_basis(normal[None]))
        # The truth is drawn smaller, or it would hide an estimate that equals it.
        size = radius * (0.82 if name == TRUE else 1.0)
        rim = camera.project(spot.point + size * (np.cos(turns) * across + np.sin(turns) * along))
        pin = camera.project(np.array([spot.point, spot.point + PIN * size * normal]))
        for colour, wide in (("#101010", width + 2), (palette[name], width)):
            canvas.line(rim, colour, wide)
            canvas.line(pin, colour, wide)


def draw(frame: simtest.LabelledFrame, spots: list[Spot]) -> Pixels:
    """Draw the frame, and beside it each highlight enlarged with the errors of its normals."""
    linear = np.asarray(frame.image, np.float32) ** np.float32(GAMMA)
    whole = Canvas(linear, None, HEIGHT)
    for spot in spots:
        draw_spot(whole, spot, frame.camera, 2)
    numbers = []
    rows = -(-len(spots) // COLUMNS)
    side = HEIGHT // rows
    crops = []
    for number, spot in enumerate(spots, start=1):
        x, y = spot.bp_px
        half = CROP_PX / 2
        numbers.append(((x * whole.scale + 42, y * whole.scale + 12), str(number), 22))
        crop = Canvas(linear, (x - half, x + half, y - half, y + half), side)
        draw_spot(crop, spot, frame.camera, 3)
        errors = [f"{name}: off by {spot.error_deg(name):.2f} deg" for name in ESTIMATORS]
        lines = [((10, side - 44 + 20 * line), text, 16) for line, text in enumerate(errors)]
        crops.append(_labelled(crop.pixels, [((10, 8), str(number), 22), *lines]))
    crops += [np.full_like(crops[0], 255)] * (rows * COLUMNS - len(crops))
    right = np.vstack([np.hstack(crops[COLUMNS * i : COLUMNS * (i + 1)]) for i in range(rows)])
    picture = np.hstack([_labelled(whole.pixels, numbers), np.full((HEIGHT, 6, 3), 255, np.uint8), right])
    palette = colours(ESTIMATORS)
    entries = [(TRUTH, TRUE), *((palette[name], name) for name in ESTIMATORS)]
    return np.vstack([picture, legend(picture.shape[1], entries)])


def _labelled(picture: Pixels, labels: Sequence[tuple[tuple[float, float], str, int]]) -> Pixels:
    """Write texts of a size in white with a dark edge, each from its upper left corner."""
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    for corner, text, size in labels:
        pen.text(corner, text, fill="#ffffff", font=font(size), stroke_width=1, stroke_fill="#101010")
    return np.asarray(image)


def main() -> None:
    """Write the picture and print the errors in it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=OUT)
    out = parser.parse_args().out
    frame = simtest.render(SCENE, variant="llvm_ad_rgb")
    spots = find_spots(frame)
    for number, spot in enumerate(spots, start=1):
        print(number, ", ".join(f"{name} {spot.error_deg(name):.3f} deg" for name in ESTIMATORS))
    ordered = cv2.cvtColor(draw(frame, spots), cv2.COLOR_RGB2BGR)
    how = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    write_atomically(out, lambda part: cv2.imwrite(str(part), ordered, how))
    print(out)


if __name__ == "__main__":
    main()
