"""Detection on frames of the shipped tissue scenes, by the size of the visible highlights.

`python -m studies.detection.tissue [COUNT]`: so many frames of each tissue, 5 by default, on which nothing was tuned. A
cluster counts for as many highlights as it has peaks: what lies inside its outline without a peak is missed, and told
apart as such.
"""

import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.measuring import print_markdown
from simtest.conventions import HIGHLIGHT_CONTRAST_SIGMA, PIXEL_CENTRE
from simtest.detection.detector import Highlight, Kind
from simtest.geometry.patch import encloses
from simtest.reconstruction import detect_in_picture
from simtest.rendering import Session
from simtest.simulation.frame import RenderedView, render_view
from simtest.simulation.highlights import find_spots
from simtest.simulation.sensor import collect, displayed
from simtest.spec import load_scene

Floats = npt.NDArray[np.float64]

CLASSES = (1.0, 2.0, 4.0, 8.0)
"""Least radius of each class, px."""

TISSUES = ("colon", "stomach", "liver", "gallbladder")

SEED = 920
"""Where the seeds of relief, viewpoint and noise begin."""

REACH_PX = 1.5
"""A detected peak within this distance of a visible highlight's pixels lies on it."""


@dataclass(frozen=True)
class TissueFrame:
    """A tissue frame with its visible highlights (theory.md 7.1b).

    `name`: tissue and seed; `picture` (shape (H, W, 3)): RGB as encoded; `peaks` (shape (N, 2)): peaks of the
    visible highlights, px; `radii` (shape (N,)): their radii at half height, px; `clearness` (shape (N,)): peak
    over noise; `whole` (shape (N,)): whether they are clear of the frame's border; `regions` (shape (H, W)): number
    of the visible highlight from 1, 0 elsewhere.
    """

    name: str
    picture: npt.NDArray[np.uint8]
    peaks: Floats
    radii: Floats
    clearness: Floats
    whole: npt.NDArray[np.bool_]
    regions: npt.NDArray[np.int32]


def tissue_frames(count: int) -> Iterator[TissueFrame]:
    """Render so many frames of each shipped tissue with other viewpoints, reliefs and noise."""
    for tissue in TISSUES:
        session: Session | None = None
        for seed in range(SEED, SEED + count):
            viewpoint = {} if tissue == "gallbladder" else {"surface.viewpoint": seed}
            scene = load_scene(f"tissue_{tissue}", {**viewpoint, "surface.relief.seed": seed, "sensor.seed": seed})
            session = session or Session(scene)
            yield _frame(f"{tissue} {seed}", render_view(session, scene), seed)


def _frame(name: str, view: RenderedView, seed: int) -> TissueFrame:
    picture = np.rint(255 * displayed(view.frame(seed), view.scene.sensor)).astype(np.uint8)
    light = view.light if view.light.ndim == 2 else view.light.mean(axis=2)
    specular = collect(view.radiance.specular, view.scene.sensor, view.calibration.camera)
    regions = find_spots(light, specular if specular.ndim == 2 else specular.mean(axis=2), view.calibration.camera.seen)
    spots = view.visible_highlights
    return TissueFrame(
        name, picture,
        np.array([s.peak_px for s in spots]).reshape(-1, 2),
        np.array([s.radius_px for s in spots]),
        np.array([s.peak_snr for s in spots]),
        np.array([s.whole for s in spots], dtype=bool),
        regions.regions.astype(np.int32),
    )  # fmt: skip


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


def main(count: str = "5") -> int:
    """Print the table."""
    counts: dict[int, Counts] = defaultdict(Counts)
    for frame in tissue_frames(int(count)):
        found = detect_in_picture(frame.picture.astype(np.float32) / 255).detection
        score_frame(frame, found.highlights, counts)
    parts = [counts[key] for key in range(len(CLASSES))]
    print_markdown([
        ["radius, px", *(f"from {low:g}" for low in CLASSES)],
        ["F1", *(f"{p.f1:.3f}" for p in parts)],
        ["found + missed (of the missed inside a cluster's outline), false",
         *(f"{p.hits} + {p.missed} ({p.clustered}), {p.false}" for p in parts)],
    ])  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
