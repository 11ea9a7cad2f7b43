"""The frames of a run or a dataset with their truth, rendered again from their seeds."""

from collections.abc import Iterator
from pathlib import Path

from simtest.dataset.scoring.dense.frame_truth import FrameTruth, truth_of_view
from simtest.dataset.scoring.frames import scored_frames


def frames_of(folder: Path) -> Iterator[FrameTruth]:
    """Yield each exported frame of a run or dataset once; raise `InputError` as `scored_frames` does."""
    told: set[str] = set()
    for each in scored_frames(folder):
        # One frame may stand for several realisations; it has one map.
        if each.name not in told:
            told.add(each.name)
            yield truth_of_view(each.name, each.view, each.session, each.setting, each.swept, each.image)
