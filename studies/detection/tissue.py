"""Detection on frames of the shipped tissue scenes, by the size of the visible highlights.

`python -m studies.detection.tissue [SPLIT COUNT FOLDER]`: so many frames of each tissue, 5 by default; FOLDER keeps
what was rendered. A cluster counts for as many highlights as it has peaks: what lies inside its outline without a peak
of its own is missed, and told apart as such. Each cell is F1 (found + missed, of these in clusters, false).
"""

import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import HIGHLIGHT_CONTRAST_SIGMA, PIXEL_CENTRE
from simtest.detection.detector import Highlight, Kind
from simtest.geometry.patch import encloses
from simtest.reconstruction import detect_in_picture
from studies.detection.tissue_frames import TISSUES, TissueFrame, tissue_frames

Floats = npt.NDArray[np.float64]

CLASSES = (1.0, 2.0, 4.0, 8.0)
"""Least radius of each class, px."""

LIMITS = (0.85, 0.92, 0.95, 0.95)
"""Least F1 of each."""

REACH_PX = 1.5
"""A detected peak within this distance of a visible highlight's pixels lies on it."""


@dataclass
class Counts:
    """Highlights found, marked where none is, and missed; and the missed ones inside a cluster's outline."""

    hits: int = 0
    false: int = 0
    missed: int = 0
    clustered: int = 0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; NaN where there are none."""
        total = 2 * self.hits + self.false + self.missed
        return 2 * self.hits / total if total else float("nan")


def detected_peaks(highlights: Sequence[Highlight]) -> tuple[Floats, Floats]:
    """Return the peaks of single highlights and of clusters, px, shape (N, 2), and the radius of each."""
    points, radii = [], []
    for highlight in highlights:
        peaks = getattr(highlight, "peaks", None)
        peaks = np.array([highlight.region.peak]) if peaks is None or not len(peaks) else np.asarray(peaks)
        points += list(peaks + PIXEL_CENTRE)
        radii += [float(np.sqrt(highlight.area_px / len(peaks) / np.pi))] * len(peaks)
    return np.array(points).reshape(-1, 2), np.array(radii)


def size_class(radius: float) -> int:
    """Return the number of a radius's class, -1 below the first."""
    return int(np.searchsorted(CLASSES, radius, side="right")) - 1


def needed_ones(frame: TissueFrame) -> npt.NDArray[np.bool_]:
    """Return which visible highlights need be found: those 10 noise deviations high, clear of the border."""
    return (frame.clearness >= HIGHLIGHT_CONTRAST_SIGMA) & frame.whole & (frame.radii >= CLASSES[0])


def matches(frame: TissueFrame, points: Floats) -> tuple[dict[int, int], npt.NDArray[np.int64]]:
    """Match detected peaks, px, shape (N, 2), with the visible highlights of a frame.

    Each peak matches the nearest highlight whose pixels it is on, each once. Returns the peak by highlight, and for
    each peak the highlight that it is on, or -1.
    """
    # candidates: pairs of a detected peak and a highlight whose pixels it is on
    outside = (frame.regions == 0).astype(np.uint8)
    away, nearest = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    number_of = np.zeros(int(nearest.max()) + 1, dtype=np.int64)
    number_of[nearest[outside == 0]] = frame.regions[outside == 0]
    pairs, on = [], np.full(len(points), -1)
    for i, (x, y) in enumerate(points):
        column, row = int(x), int(y)
        if away[row, column] <= REACH_PX:
            truth = int(number_of[nearest[row, column]]) - 1
            on[i] = truth
            pairs.append((float(np.hypot(*(points[i] - frame.peaks[truth]))), i, truth))
    matched: dict[int, int] = {}
    for _, i, truth in sorted(pairs):
        if truth not in matched:
            matched[truth] = i
    return matched, on


def false_ones(frame: TissueFrame, points: Floats) -> npt.NDArray[np.bool_]:
    """Return which detected peaks are false: on no highlight, or the further ones on one that need be found."""
    matched, on = matches(frame, points)
    needed, taken = needed_ones(frame), set(matched.values())
    return np.array([i not in taken and not (on[i] >= 0 and not needed[on[i]]) for i in range(len(points))], dtype=bool)


def score_frame(frame: TissueFrame, highlights: Sequence[Highlight], counts: dict[int, Counts]) -> None:
    """Add a frame's counts by class.

    A detection on a highlight that need not be found (`needed_ones`) counts neither as right nor as wrong.
    """
    points, radii = detected_peaks(highlights)
    matched, _ = matches(frame, points)
    for truth in np.flatnonzero(needed_ones(frame)):
        key = size_class(frame.radii[truth])
        if int(truth) in matched:
            counts[key].hits += 1
        else:
            counts[key].missed += 1
            counts[key].clustered += _in_cluster(frame.peaks[truth], highlights)
    for i in np.flatnonzero(false_ones(frame, points)):
        counts[max(size_class(radii[i]), 0)].false += 1


def _in_cluster(peak: Floats, highlights: Sequence[Highlight]) -> bool:
    """Return whether a cluster's outline encloses a peak, px."""
    return any(highlight.kind is Kind.CLUSTER and bool(encloses(highlight.outline, peak)) for highlight in highlights)


def main(split: str = "figures", count: str = "5", folder: str | None = None) -> int:
    """Print the table."""
    with tempfile.TemporaryDirectory() as temporary:
        kept = Path(folder or temporary)
        by_tissue: dict[str, dict[int, Counts]] = {name: defaultdict(Counts) for name in TISSUES}
        for frame in tissue_frames(split, int(count), kept):
            found = detect_in_picture(frame.picture.astype(np.float32) / 255).detection
            score_frame(frame, found.highlights, by_tissue[frame.name.split()[0]])
    print(f"{'tissue':12} " + " ".join(f"{f'from {low:g} px':>28}" for low in CLASSES))
    every: dict[int, Counts] = defaultdict(Counts)
    for name, counts in by_tissue.items():
        print(f"{name:12} " + _row(counts))
        for key, one in counts.items():
            total = every[key]
            for field in fields(Counts):
                setattr(total, field.name, getattr(total, field.name) + getattr(one, field.name))
    print(f"{'all':12} " + _row(every))
    print(f"{'limit':12} " + " ".join(f"{limit:28.2f}" for limit in LIMITS))
    return 0


def _row(counts: dict[int, Counts]) -> str:
    parts = [counts.get(key, Counts()) for key in range(len(CLASSES))]
    return " ".join(f"{f'{p.f1:.3f} ({p.hits} + {p.missed}, {p.clustered}, {p.false})':>28}" for p in parts)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
