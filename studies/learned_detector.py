"""Highlights found by a trained network and by colour, on unseen anatomies: F1 by radius, on tissue and on real frames.

`python -m studies.learned_detector DATA [NETWORK ...] [--split test] [--tissue COUNT] [--kept FOLDER] [--real]
[--picture FILE]`

DATA is a dataset with the field `visible`; NETWORK a file model.onnx, or `shipped`. `--picture` draws the frame of the
split with the most highlights. `--tissue` adds so many frames of each tissue of `studies.detection.tissue`, with seeds
of their own, kept in a folder; `--real` adds the real frames of `studies.detection.real_frames`. Each cell is F1
(found + missed, false); frames that a network refuses count as missed. Differences are paired: F1 of a network less F1
by colour, with an interval of 95 % from 2,000 draws of anatomies.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Frame, Response
from simtest.dataset.learn.detector_frames import needs_be_found
from simtest.dataset.learn.spots import sample_frame
from simtest.dataset.reader import read_samples
from simtest.dataset.sample import Sample
from simtest.detection.blobs import Highlight
from simtest.detection.colour import ColourDetector, detect_colour
from simtest.detection.judging import ColourDetection
from simtest.detection.learned_detector import LearnedDetector
from simtest.detection.view_mask import find_view
from simtest.errors import Failure
from simtest.geometry import Camera
from simtest.reconstruction.picture_detection import PictureDetection
from studies.detection import tissue_frames
from studies.detection.real_frames import outlined_frames
from studies.detection.real_frames import score_frame as score_real
from studies.detection.tissue import (
    CLASSES,
    Counts,
    detected_peaks,
    false_ones,
    matches,
    needed_ones,
    score_frame,
)
from studies.detection.tissue_frames import TISSUES, TissueFrame
from studies.resampling import drawn_groups

DRAWS, LEVEL = 2000, 0.95

SEEDS_OF_TISSUE = 983
"""Where the seeds of `--tissue` begin: no split of `studies.detection.tissue_frames` has them."""

Finder = Callable[[Frame], Sequence[Highlight] | Failure]
Table = npt.NDArray[np.int64]
"""Hits, false and missed by class, shape (4, 3)."""


def finder_of(detector: ColourDetector | LearnedDetector) -> Finder:
    """Return what finds highlights of every kind."""

    def find(frame: Frame) -> Sequence[Highlight] | Failure:
        found = detector.detect(frame, frame.camera)
        return found.highlights if found.refusal is None else found.refusal

    return find


def networks_of(names: Sequence[str]) -> dict[str, LearnedDetector]:
    """Return detectors by the names of their networks."""
    return {name: LearnedDetector(None if name == "shipped" else Path(name), isolated=False) for name in names}


def labelled(sample: Sample) -> TissueFrame:
    """Return a dataset's sample in the form that the study of tissue scores."""
    visible = sample.meta["visible_highlights"]
    return TissueFrame(
        f"{sample.meta['anatomy']['family']} {sample.meta['anatomy']['number']}",
        sample.images["image"],
        np.array([spot["peak_px"] for spot in visible], dtype=float).reshape(-1, 2),
        np.sqrt(np.array([spot["area_px"] for spot in visible], dtype=float) / np.pi),
        np.array([np.inf if spot["peak_snr"] is None else spot["peak_snr"] for spot in visible], dtype=float),
        needs_be_found(visible),
        np.zeros(len(visible)),
        sample.images["visible"].astype(np.int32),
    )


def dataset_frames(folder: Path, split: str) -> Iterator[tuple[str, TissueFrame, Frame]]:
    """Yield organ, labels and frame of each sample of a split."""
    for sample in read_samples(folder, split, ("image", "visible")):
        yield str(sample.meta["scene"]["surface"]["type"]), labelled(sample), sample_frame(sample)


def more_tissue(count: int, folder: Path) -> Iterator[tuple[str, TissueFrame, Frame]]:
    """Yield tissue, labels and frame of fresh tissue frames, whose view is found in the picture."""
    tissue_frames.SEEDS["learned"] = SEEDS_OF_TISSUE
    for made in tissue_frames.tissue_frames("learned", count, folder, TISSUES):
        height, width = made.picture.shape[:2]
        calibration = Calibration(Camera.from_fov(60.0, width, height), response=Response("srgb"), saturation_level=1.0)
        frame = Frame(made.picture.astype(np.float32) / np.float32(255), calibration, 1.0)
        yield made.name.split()[0], made, frame


def counted(frame: TissueFrame, found: Sequence[Highlight] | Failure) -> Table:
    """Return a frame's counts by class."""
    counts: dict[int, Counts] = defaultdict(Counts)
    score_frame(frame, () if isinstance(found, Failure) else found, counts)
    parts = [counts[key] for key in range(len(CLASSES))]
    return np.array([[part.hits, part.false, part.missed] for part in parts], dtype=np.int64)


def f1(table: Table) -> npt.NDArray[np.float64]:
    """Return F1 by class of counts, shape (..., 4, 3)."""
    hits, wrong = 2.0 * table[..., 0], table[..., 1] + table[..., 2]
    return np.asarray(np.divide(hits, hits + wrong, out=np.full(hits.shape, np.nan), where=hits + wrong > 0))


def difference(one: Table, other: Table, anatomies: Sequence[str]) -> list[tuple[float, float, float]]:
    """Return F1 of one less that of the other by class, with its interval; counts have the shape (N, 4, 3)."""
    names = sorted(set(anatomies))
    by_anatomy = [np.array([name == each for each in anatomies]) for name in names]
    parts = np.array([[table[which].sum(axis=0) for which in by_anatomy] for table in (one, other)])
    draws = drawn_groups(len(names), DRAWS, seed=0)
    gaps = f1(parts[0][draws].sum(axis=1)) - f1(parts[1][draws].sum(axis=1))
    middle = f1(one.sum(axis=0)) - f1(other.sum(axis=0))
    low, high = np.nanquantile(gaps, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return list(zip(middle.tolist(), low.tolist(), high.tolist(), strict=True))


def compare(title: str, frames: Iterator[tuple[str, TissueFrame, Frame]], finders: dict[str, Finder]) -> None:
    """Print F1 by organ and class of each detector, and the differences from the first one."""
    organs: list[str] = []
    anatomies: list[str] = []
    made: dict[str, list[Table]] = {name: [] for name in finders}
    refused: dict[str, int] = dict.fromkeys(finders, 0)
    for organ, labels, frame in frames:
        organs.append(organ)
        anatomies.append(labels.name)
        for name, find in finders.items():
            found = find(frame)
            refused[name] += isinstance(found, Failure)
            made[name].append(counted(labels, found))
        print(f"\r{title}: frame {len(organs)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(f"\n{title}: {len(organs)} frames of {len(set(anatomies))} anatomies")
    print(f"{'':46} " + " ".join(f"{f'from {low:g} px':>24}" for low in CLASSES))
    tables = {name: np.array(rows).reshape(-1, len(CLASSES), 3) for name, rows in made.items()}
    for name, table in tables.items():
        for organ in [*(sorted(set(organs)) if len(set(organs)) > 1 else ()), "all"]:
            which = np.array([organ in (each, "all") for each in organs], dtype=bool)
            label = f"{name[-34:]}, {organ}" + f" ({refused[name]} refused)" * (organ == "all")
            print(f"{label:46} " + " ".join(_cell(row) for row in table[which].sum(axis=0)))
    first = next(iter(tables))
    for name in list(tables)[1:]:
        gaps = difference(tables[name], tables[first], anatomies)
        text = " ".join(f"{f'{gap:+.3f} ({low:+.3f} to {high:+.3f})':>24}" for gap, low, high in gaps)
        print(f"{f'{name[-34:]} less {first}':46} {text}")


def _cell(row: Table) -> str:
    hits, false, missed = (int(v) for v in row)
    return f"{f'{float(f1(row[None])[0]):.3f} ({hits} + {missed}, {false})':>24}"


def real(networks: dict[str, LearnedDetector]) -> None:
    """Print what each detector makes of the real frames."""
    print(f"\n{'real frame':28} {'detector':24} {'covered':>8} {'answered':>8} {'IoU':>6} {'marks':>6}  forbidden")
    for outlined in outlined_frames():
        height, width = outlined.picture.shape[:2]
        calibration = Calibration(Camera.from_fov(60.0, width, height), response=Response("srgb"), saturation_level=1.0)
        frame, view = Frame(outlined.picture, calibration, 1.0), find_view(outlined.picture)
        made: dict[str, ColourDetection | Failure] = {"colour": detect_colour(frame.channels, frame.clipped, view.seen)}
        made |= {name: each.find(frame.channels, frame.clipped, view.seen) for name, each in networks.items()}
        for name, found in made.items():
            head = f"{outlined.name:28} {name[-24:]:24}"
            if isinstance(found, Failure):
                print(f"{head} refused: {found.detail}")
                continue
            score = score_real(outlined, PictureDetection(view, found))
            where = ", ".join(f"{kind} {number}" for kind, number in score.marks.items() if number) or "none"
            print(f"{head} {score.covered:8.3f} {score.answered:8.3f} {score.iou:6.3f} {score.count:6d}  {where}")


FOUND, MISSED, FALSE = (60, 220, 60), (40, 40, 255), (0, 230, 255)
"""Colours of the picture, blue first."""

SHOWN_PX, TIMES = 200, 2
"""Side of the part of a frame that is drawn, around the middle of its highlights, and its magnification."""


def draw(frames: Iterator[tuple[str, TissueFrame, Frame]], finders: dict[str, Finder], path: Path) -> None:
    """Draw the frame with the most highlights: found ones, missed ones and false ones of each detector."""
    _, labels, frame = max(frames, key=lambda each: np.count_nonzero(needed_ones(each[1])))
    needed = needed_ones(labels)
    height, width = labels.picture.shape[:2]
    x, y = (np.median(labels.peaks[needed], axis=0) - SHOWN_PX / 2).astype(int)
    x, y = int(np.clip(x, 0, width - SHOWN_PX)), int(np.clip(y, 0, height - SHOWN_PX))
    part = np.ascontiguousarray(labels.picture[y : y + SHOWN_PX, x : x + SHOWN_PX, ::-1])
    plain = cv2.resize(part, None, fx=TIMES, fy=TIMES, interpolation=cv2.INTER_NEAREST)
    panels = [plain]
    for name, find in finders.items():
        found = find(frame)
        points, _ = detected_peaks(() if isinstance(found, Failure) else found)
        matched, _ = matches(labels, points)
        hit = np.array([number in matched for number in range(len(needed))], dtype=bool)
        panel = plain.copy()
        for which, colour in ((needed & hit, FOUND), (needed & ~hit, MISSED)):
            _circles(panel, labels.peaks[which] - [x, y], colour)
        _circles(panel, points[false_ones(labels, points)] - [x, y], FALSE)
        print(f"{path.name}, {labels.name}: panel {len(panels) + 1} is {name}")
        panels.append(panel)
    cv2.imwrite(str(path), np.hstack(panels), [cv2.IMWRITE_JPEG_QUALITY, 85])


def _circles(panel: npt.NDArray[np.uint8], points: npt.NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    for x, y in np.rint(points * TIMES).astype(int):
        cv2.circle(panel, (int(x), int(y)), 4 * TIMES, colour, 1, cv2.LINE_AA)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("networks", nargs="*")
    parser.add_argument("--split", default="test")
    parser.add_argument("--tissue", type=int, default=0)
    parser.add_argument("--kept", type=Path, default=Path("tissue_frames"))
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    networks = networks_of(given.networks)
    finders = {"colour": finder_of(ColourDetector(isolated=False))}
    finders |= {name: finder_of(each) for name, each in networks.items()}
    compare(f"{given.data.name}, {given.split}", dataset_frames(given.data, given.split), finders)
    if given.picture:
        draw(dataset_frames(given.data, given.split), finders, given.picture)
    if given.tissue:
        compare("tissue scenes", more_tissue(given.tissue, given.kept), finders)
    if given.real:
        real(networks)


if __name__ == "__main__":
    main()
