"""Detection on the real frames whose specular areas are outlined in tests/data/real_frames.json.

`python -m studies.detection.real_frames`: a line for each frame, and the medians.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.detection.detector import Highlight
from simtest.reconstruction import detect_in_picture
from simtest.reconstruction.images import read_picture
from simtest.reconstruction.pipeline import PictureDetection

Mask = npt.NDArray[np.bool_]
Polygon = Sequence[int]

FINER = 5
"""Outlines are filled on pixels of this share of a pixel's side; odd, so that one has the pixel's centre."""

ROOT = Path(__file__).resolve().parents[2]
OUTLINES = ROOT / "tests" / "data" / "real_frames.json"
FRAMES = ROOT.parent / "shared" / "data" / "frames"


@dataclass(frozen=True)
class OutlinedFrame:
    """A real frame as outlined by hand; masks have the frame's shape (H, W).

    `name`: the file's name; `split`: whether thresholds were tuned on it; `picture` (shape (H, W, 3)): RGB as
    encoded, in [0, 1]; `specular`, `unclear`: what shines, and what may; `forbidden`: masks of what must not be
    marked, by kind: instrument, text, vessel, border.
    """

    name: str
    split: str
    picture: npt.NDArray[np.float32]
    specular: Mask
    unclear: Mask
    forbidden: dict[str, Mask]


@dataclass(frozen=True)
class FrameScore:
    """What detection makes of an outlined frame.

    `covered`: share of the specular area inside the outlines of highlights of any kind; NaN where there is none;
    `answered`: the same inside the outlines of those that may carry one normal; `iou`: marked pixels with the
    outlined ones: intersection over union, away from what is unclear; `marks`: highlights of any kind whose peak
    lies in a forbidden area, by its kind; `count`, `clusters`, `empty`: highlights of any kind, clusters among
    them, and those without an outline.
    """

    covered: float
    answered: float
    iou: float
    marks: dict[str, int]
    count: int
    clusters: int
    empty: int


def outlined_frames(folder: Path = FRAMES) -> Iterator[OutlinedFrame]:
    """Yield the outlined frames that the folder holds."""
    for name, outlines in json.loads(OUTLINES.read_text(encoding="utf-8"))["frames"].items():
        if not (folder / name).exists():
            continue
        picture = read_picture(folder / name)
        shape = picture.shape[:2]
        # The picture's own sides are no border.
        inner = np.pad(_filled([outlines["view"]], shape), 32, mode="edge")
        depth = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5)[32:-32, 32:-32]
        forbidden = {kind: _filled(polygons, shape) for kind, polygons in outlines["forbidden"].items()}
        forbidden["border"] = depth <= outlines["border_px"]
        yield OutlinedFrame(
            name, outlines["split"], picture,
            _filled(outlines["specular"], shape), _filled(outlines["unclear"], shape), forbidden,
        )  # fmt: skip


def _filled(polygons: Sequence[Polygon], shape: tuple[int, ...]) -> Mask:
    """Return the pixels of polygons of pixel indices."""
    mask = np.zeros(shape, dtype=np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [np.array(polygon, dtype=np.int32).reshape(-1, 2)], 1)
    return mask > 0


def inside_outlines(highlights: Sequence[Highlight], shape: tuple[int, ...]) -> Mask:
    """Return the pixels whose centres lie inside the outlines of highlights, in px."""
    mask = np.zeros(shape, dtype=bool)
    for highlight in highlights:
        if len(highlight.outline) < 3:
            continue
        left, top = np.maximum(np.floor(highlight.outline.min(axis=0)).astype(int), 0)
        right, bottom = np.ceil(highlight.outline.max(axis=0)).astype(int)
        # Finer, since OpenCV also fills what the line touches.
        fine = np.zeros((FINER * (bottom - top), FINER * (right - left)), dtype=np.uint8)
        corners = np.rint((highlight.outline - [left, top]) * FINER - 0.5).astype(np.int32)
        cv2.fillPoly(fine, [corners], 1)
        inside = fine[FINER // 2 :: FINER, FINER // 2 :: FINER] > 0
        part = mask[top:bottom, left:right]
        part |= inside[: part.shape[0], : part.shape[1]]
    return mask


def score_frame(frame: OutlinedFrame, found: PictureDetection) -> FrameScore:
    """Score a detection by colour on an outlined frame."""
    return score_highlights(frame, found.detection.highlights, found.detection.mask)


def score_highlights(frame: OutlinedFrame, highlights: Sequence[Highlight], mask: Mask) -> FrameScore:
    """Score highlights of any detector, and the pixels that it marks, shape (H, W), on an outlined frame."""
    clear = ~frame.unclear
    specular = frame.specular & clear
    area = int(np.count_nonzero(specular))
    outlined = inside_outlines(highlights, specular.shape)
    answered = inside_outlines([highlight for highlight in highlights if highlight.is_isolated], specular.shape)
    marked = mask & clear
    union = int(np.count_nonzero(marked | specular))
    peaks = [highlight.region.peak for highlight in highlights]
    marks = {kind: sum(bool(part[y, x]) for x, y in peaks) for kind, part in frame.forbidden.items()}
    return FrameScore(
        covered=np.count_nonzero(outlined & specular) / area if area else float("nan"),
        answered=np.count_nonzero(answered & specular) / area if area else float("nan"),
        iou=np.count_nonzero(marked & specular) / union if union else float("nan"),
        marks=marks,
        count=len(highlights),
        clusters=sum(str(highlight.kind) == "cluster" for highlight in highlights),
        empty=sum(len(highlight.outline) < 3 for highlight in highlights),
    )


def main() -> int:
    """Print the table."""
    scores: dict[str, list[FrameScore]] = {"tuning": [], "figures": []}
    heads = ("covered", "answered", "IoU", "marks", "clusters", "empty")
    print(f"{'frame':28} {'split':8} " + " ".join(f"{head:>8}" for head in heads) + "  forbidden")
    for frame in outlined_frames():
        made = score_frame(frame, detect_in_picture(frame.picture))
        scores[frame.split].append(made)
        where = ", ".join(f"{kind} {number}" for kind, number in made.marks.items() if number) or "none"
        print(
            f"{frame.name:28} {frame.split:8} {made.covered:8.3f} {made.answered:8.3f} {made.iou:8.3f} "
            f"{made.count:8d} {made.clusters:8d} {made.empty:8d}  {where}"
        )
    every = scores["tuning"] + scores["figures"]
    for name, part in (*scores.items(), ("all", every)):
        if part:
            medians = [np.nanmedian([getattr(s, key) for s in part]) for key in ("covered", "answered", "iou")]
            print(f"median, {name:20} {'':8} {medians[0]:8.3f} {medians[1]:8.3f} {medians[2]:8.3f}")
    return 0 if every else 1


if __name__ == "__main__":
    sys.exit(main())
