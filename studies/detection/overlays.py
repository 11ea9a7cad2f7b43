"""What is drawn on real frames, and what detection makes of it, by the boxes of tests/data/overlays.json.

`python -m studies.detection.overlays`: how many answered highlights stand on overlays, and how many of the tissue's are
masked with them, on the frames that were developed on and on the others.
"""

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from simtest.calibration import Calibration, Frame, Response
from simtest.detection.colour import ColourDetector
from simtest.geometry import Camera
from simtest.reconstruction.images import read_picture
from simtest.reconstruction.options import SMOOTHING_BY_COLOUR_PX
from studies.detection.real_frames import FRAMES, ROOT

BOXES = ROOT / "tests" / "data" / "overlays.json"
DEVELOPED_ON = 12
"""So many frames, the first by name, were developed on."""

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
        shown, kept = (_answered(folder / name, keep) for keep in (False, True))
        on, kept_on = (sum(_on_box(peak, boxes) for peak in peaks) for peaks in (shown, kept))
        hidden = sum(not _on_box(peak, boxes) for peak in kept - shown)
        yield name, number < DEVELOPED_ON, OverlayCounts(len(shown), on, len(kept), kept_on, hidden)


def _answered(path: Path, keep_overlays: bool) -> set[Peak]:
    """Return the peaks of the highlights of a picture that may carry one normal."""
    picture = read_picture(path)
    camera = Camera.from_fov(60.0, picture.shape[1], picture.shape[0])
    calibration = Calibration(camera, response=Response("srgb"), saturation_level=1.0)
    found = ColourDetector(keep_overlays=keep_overlays).detect(
        Frame(picture, calibration, SMOOTHING_BY_COLOUR_PX), camera
    )
    return {highlight.region.peak for highlight in found.highlights if highlight.is_isolated}


def _on_box(peak: Peak, boxes: list[list[int]]) -> bool:
    """Return whether a peak lies on a box of column, row, width, height and kind."""
    return any(x <= peak[0] < x + width and y <= peak[1] < y + height for x, y, width, height, _ in boxes)


def main() -> int:
    """Print the table."""
    print(f"{'frame':32} {'answered':>9} {'on overlays':>12} {'without the mask':>17} {'tissue hidden':>14}")
    totals = {True: OverlayCounts(), False: OverlayCounts()}
    for name, developed_on, made in overlay_counts():
        totals[developed_on] += made
        _print(name, made)
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
