"""The frames of a run or a dataset with their truth, rendered again from their seeds."""

from collections.abc import Iterator
from pathlib import Path

from simtest.dataset.scoring.dense.frame_truth import FrameTruth, Progress, truth_of_view
from simtest.dataset.scoring.frames import scored_frames
from simtest.dataset.scoring.record import read_record


def frame_names(folder: Path) -> list[str]:
    """Return the names of the frames that were exported of a run or dataset; raise `InputError` where none was."""
    return list(read_record(folder).frames)


def frames_of(folder: Path, progress: Progress | None = None, total: int = 0) -> Iterator[FrameTruth]:
    """Yield each exported frame of a run or dataset once.

    `progress` is called when a frame has been used, with their number, the `total` and its name. Raises `InputError` as
    `scored_frames` does.
    """
    told: set[str] = set()
    for each in scored_frames(folder):
        # One frame may stand for several realisations; it has one map.
        if each.name not in told:
            told.add(each.name)
            yield truth_of_view(each.name, each.view, each.session, each.setting, each.swept, each.image, each.anatomy)
            if progress:
                progress(len(told), total, each.name)
