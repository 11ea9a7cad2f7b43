"""What is drawn on frames, and what detection makes of it: boxes of tests/data/overlays.json, and exact masks.

`python -m studies.detection.overlays`: how many answered highlights stand on overlays, and how many of the tissue's are
masked with them, on the frames that were developed on, on the others, and on rendered ones whose overlays are known to
the pixel.
"""

import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.calibration import Calibration, Frame, Response
from simtest.detection.colour import ColourDetector
from simtest.geometry import Camera
from simtest.reconstruction.images import read_picture
from simtest.reconstruction.options import SMOOTHING_BY_COLOUR_PX
from simtest.rendering import Session
from simtest.runtime.arrays import Image, Mask
from simtest.simulation.frame import render_picture
from simtest.simulation.sensor import overlaid
from simtest.spec import load_scene
from studies.detection.real_frames import FRAMES, ROOT

BOXES = ROOT / "tests" / "data" / "overlays.json"
DEVELOPED_ON = 12
"""So many frames, the first by name, were developed on."""

VIEWPOINTS = (3, 11, 17, 26, 34, 41)

_LINES = ("Sex:   Age:", "D.O.B.:", "16/09/2014", "10:18:33", "00:57:10", "", "CVP:1  A5", "2/3")
DRAWN: dict[str, Any] = {
    # Text on tissue, a row of squares that hide a name, a cursor, a message, a black box with a frozen frame.
    "captions": [
        {"text": text, "x": 0.08, "y": 0.18 + 0.04 * row, "height_px": 10} for row, text in enumerate(_LINES) if text
    ],
    "boxes": [
        *({"x": 0.08 + 0.024 * i, "y": 0.52, "width": 0.019, "height": 0.025, "colour": [1, 1, 1]} for i in range(7)),
        {"x": 0.4, "y": 0.8, "width": 0.016, "height": 0.027, "colour": [1, 1, 1]},
        {"x": 0.3, "y": 0.6, "width": 0.4, "height": 0.08, "colour": [0.0, 0.0, 0.65]},
        {"x": 0.0, "y": 0.66, "width": 0.3, "height": 0.34},
    ],
    "insets": [{"x": 0.02, "y": 0.7, "width": 0.26, "height": 0.26}],
}
"""What scopes draw, as on real frames."""

RENDERED: dict[str, Any] = {
    "camera.view_mask": {"radius": 281.0, "half_height": 239.0, "corner": 80.0},
    "render.samples_per_pixel": 2,
    "sensor": {"preset": "colonoscope_hd", "vignetting": {"type": "cosine", "power": 2.0}, "overlay": DRAWN},
}

Peak = tuple[int, int]


@dataclass(frozen=True)
class OverlayCounts:
    """Highlights of some frames that are answered, and those of them on overlays.

    `kept` counts without the mask; `tissue` of these lie on no box, and `hidden` of those are not answered with it.
    """

    answered: int = 0
    on_overlays: int = 0
    kept: int = 0
    kept_on_overlays: int = 0
    hidden: int = 0

    def __add__(self, other: "OverlayCounts") -> "OverlayCounts":
        return OverlayCounts(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    @property
    def tissue(self) -> int:
        """Highlights of tissue that are answered without the mask."""
        return self.kept - self.kept_on_overlays


def overlay_counts(folder: Path = FRAMES / "kvasir") -> Iterator[tuple[str, bool, OverlayCounts]]:
    """Yield name, whether it was developed on, and counts of the frames with boxes that the folder holds."""
    frames = json.loads(BOXES.read_text(encoding="utf-8"))["frames"]
    for number, (name, boxes) in enumerate(frames.items()):
        if not (folder / name).exists():
            continue
        picture = read_picture(folder / name)
        yield name, number < DEVELOPED_ON, _counts(picture, _mask_of(boxes, picture))


def drawn_counts(viewpoints: Iterable[int], **keys: Any) -> Iterator[tuple[str, OverlayCounts]]:
    """Yield the counts of rendered frames of a colon with `DRAWN` on them, by the masks of what was drawn."""
    session = None
    for viewpoint in viewpoints:
        scene = load_scene("tissue_colon", RENDERED | keys | {"surface.viewpoint": viewpoint})
        session = session or Session(scene)
        picture = render_picture(session, scene)
        assert scene.sensor.overlay is not None
        yield f"rendered, viewpoint {viewpoint}", _counts(picture, overlaid(scene.sensor.overlay, picture.shape[:2]))


def _counts(picture: Image, drawn: Mask) -> OverlayCounts:
    """Count the highlights of a picture, on which overlays are drawn."""
    shown, kept = (_answered(picture, keep) for keep in (False, True))
    on, kept_on = (sum(bool(drawn[y, x]) for x, y in peaks) for peaks in (shown, kept))
    return OverlayCounts(len(shown), on, len(kept), kept_on, sum(not drawn[y, x] for x, y in kept - shown))


def _answered(picture: Image, keep_overlays: bool) -> set[Peak]:
    """Return the peaks of the highlights of a picture that may carry one normal."""
    camera = Camera.from_fov(60.0, picture.shape[1], picture.shape[0])
    calibration = Calibration(camera, response=Response("srgb"), saturation_level=1.0)
    found = ColourDetector(keep_overlays=keep_overlays).detect(
        Frame(picture, calibration, SMOOTHING_BY_COLOUR_PX), camera
    )
    return {highlight.region.peak for highlight in found.highlights if highlight.is_isolated}


def _mask_of(boxes: list[list[int]], picture: Image) -> Mask:
    """Return the pixels of boxes of column, row, width, height and kind."""
    mask = np.zeros(picture.shape[:2], dtype=bool)
    for x, y, width, height, _ in boxes:
        mask[y : y + height, x : x + width] = True
    return mask


def main() -> int:
    """Print the table."""
    print(f"{'frame':32} {'answered':>9} {'on overlays':>12} {'without the mask':>17} {'tissue hidden':>14}")
    totals = {True: OverlayCounts(), False: OverlayCounts()}
    for name, developed_on, made in overlay_counts():
        totals[developed_on] += made
        _print(name, made)
    drawn = OverlayCounts()
    for name, made in drawn_counts(VIEWPOINTS):
        drawn += made
        _print(name, made)
    _print("rendered", drawn)
    for developed_on, made in totals.items():
        _print("developed on" if developed_on else "others", made)
        if made.kept:
            print(
                f"  on overlays {made.on_overlays / made.answered:.1%} (without the mask "
                f"{made.kept_on_overlays / made.kept:.1%}), tissue hidden {made.hidden / made.tissue:.1%}"
            )
    return 0 if totals[True].kept else 1


def _print(name: str, made: OverlayCounts) -> None:
    """Print one line."""
    without = f"{made.kept_on_overlays} of {made.kept}"
    print(f"{name:32} {made.answered:9d} {made.on_overlays:12d} {without:>17} {made.hidden:14d}")


if __name__ == "__main__":
    sys.exit(main())
