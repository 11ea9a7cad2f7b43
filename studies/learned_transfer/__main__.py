"""Compare networks taught on smooth surfaces with those taught on tissue: on other rendered frames, and on real ones.

    python -m studies.learned_transfer --kept FOLDER [--scenes 12] [--spots SMOOTH TISSUE] [--dense SMOOTH TISSUE]
        [--hard] [--real] [--overlays FOLDER] [--sheet FILE]

SMOOTH and TISSUE are the files model.onnx of one task, trained on `highlights_smooth` and on `highlights`
(`python -m studies.networks`). The folder of `--kept` holds the frames of the corpus `hard`, rendered at the first run,
and the answers on them: a run that was ended goes on where it stopped. Without `--hard` and `--real`
both parts are run. Tasks without files are left out. `--overlays` writes a PNG of each real frame and method, `--sheet`
one contact sheet of all.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2

from simtest.estimators import AnyEstimator
from simtest.runtime.files import make_folder
from studies.detection.real_frames import outlined_frames
from studies.kept import of_this_code
from studies.learned_transfer import real, sheet, tables
from studies.learned_transfer.answers import OK, Answer
from studies.learned_transfer.frames import FIRST, GUIDES, ONE_LIGHT, ROWS, hard_frames
from studies.learned_transfer.kept import Kept
from studies.learned_transfer.networks import CLASSICAL, SMOOTH, TAUGHT, TISSUE, estimators, named

TASKS = ("learned_spot", "learned_dense")

GROUPS = {
    **{row.name: (row.name,) for row in ROWS},
    "all with two guides": tuple(row.name for row in GUIDES),
    "all with one light": tuple(row.name for row in ONE_LIGHT),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.learned_transfer", description="Smooth against tissue.")
    parser.add_argument("--kept", type=Path, required=True, help="folder of the rendered frames")
    parser.add_argument("--scenes", type=int, default=12)
    for task in ("spots", "dense"):
        parser.add_argument(f"--{task}", type=Path, nargs="+", metavar="FILE")
    parser.add_argument("--hard", action="store_true", help="the corpus hard alone")
    parser.add_argument("--real", action="store_true", help="the real frames alone")
    parser.add_argument("--overlays", type=Path)
    parser.add_argument("--sheet", type=Path)
    given = parser.parse_args(arguments)
    if any(len(files or ()) > len(TAUGHT) for files in (given.spots, given.dense)):
        parser.error("a task has two networks at most: SMOOTH TISSUE, or TISSUE alone")
    normals = estimators(given.spots, given.dense)
    both = given.hard == given.real
    if given.hard or both:
        for line in _hard(range(FIRST, FIRST + given.scenes), of_this_code(given.kept), normals):
            print(line, flush=True)
    if given.real or both:
        for line in _real(normals, given.overlays, given.sheet):
            print(line, flush=True)
    return 0


def _hard(scenes: Sequence[int], kept: Path, normals: Mapping[str, AnyEstimator]) -> Iterator[str]:
    """Yield the tables of the corpus `hard`."""
    made: list[Answer] = []
    answered = Kept(kept)
    for frame in hard_frames(scenes, ROWS, kept):
        made += answered.normals(frame, normals)
        print(f"scene {frame.scene}, {frame.row.name}", file=sys.stderr, flush=True)
    yield from ("", "## Corpus hard: normals", "")
    yield from tables.summary(made, GROUPS, list(normals))
    compared = [(named(task, TISSUE), named(task, SMOOTH)) for task in TASKS if named(task, SMOOTH) in normals]
    # A cloud is of no single highlight, so it pairs with none.
    compared += [(named(task, TISSUE), CLASSICAL[0]) for task in TASKS if named(task, TISSUE) in normals]
    yield from ("", "## Corpus hard: paired differences", "")
    yield from tables.pairs(made, GROUPS, compared)


def _real(normals: Mapping[str, AnyEstimator], overlays: Path | None, file: Path | None) -> Iterator[str]:
    """Yield the tables of the real frames, and write their pictures."""
    frames = list(outlined_frames())
    learned = [name for name in normals if name not in CLASSICAL]
    pictures: dict[str, dict[str, sheet.Picture]] = {frame.name: {} for frame in frames}
    yield from ("", "## Real frames: normals", "")
    yield from tables.head(real.NORMALS_HEADS)
    agreed: list[real.Agreement] = []
    for frame in frames:
        for way, picture, calibration in real.ways(frame):
            # Without lights the classical ones have nothing to say either.
            asked = {name: each for name, each in normals.items() if way == real.TOLD or name in learned}
            at = real.specularities(picture, calibration, asked)
            for name in asked:
                count = real.refusals(at, name)
                why = "; ".join(f"{n} {reason}" for reason, n in count.most_common() if reason != OK) or "0"
                on = real.misplaced(frame, at, name, picture)
                yield f"| {frame.name} | {way} | {name} | {count.total()} | {count[OK]} | {why} | {on} |"
            if way == real.TOLD:
                agreed += real.agreements(frame.name, at, learned, CLASSICAL)
                for name in learned:
                    pictures[frame.name][name] = sheet.needles(picture, at, name, 2)
    yield from ("", "## Real frames: agreement with the classical estimators, rig told", "")
    yield from tables.agreement(agreed, [frame.name for frame in frames])
    if overlays:
        make_folder(overlays)
        for frame_name, drawn in pictures.items():
            for name, canvas in drawn.items():
                cv2.imwrite(str(overlays / f"{Path(frame_name).stem}_{name.replace(', ', '_')}.png"), canvas)
    if file:
        titles = list(next(iter(pictures.values())))
        sheet.write_sheet([[drawn[title] for title in titles] for drawn in pictures.values()], titles, file)


if __name__ == "__main__":
    sys.exit(main())
