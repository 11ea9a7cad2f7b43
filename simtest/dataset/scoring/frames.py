"""The exported frames of a run or a dataset by name, with their truth."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from simtest.dataset.scoring.record import Record, Source, check_frame, open_source, read_record
from simtest.errors import InputError
from simtest.rendering import Session
from simtest.runtime.arrays import Image
from simtest.simulation.frame import RenderedView
from simtest.validation.columns import Value


@dataclass(frozen=True)
class ScoredFrame:
    """An exported frame and what it shows.

    Parameters
    ----------
    name : str
        As in frames.csv.
    view : RenderedView
        The rendered scene: truth, true highlights, calibration.
    session : Session
        At the scene, until the next frame is taken.
    setting : str
        Of the experiment; of a dataset the split.
    swept : mapping
        Swept, pooled and drawn values by key path.
    image : ndarray of float32, shape (H, W) or (H, W, 3)
        The frame as encoded, as it was exported.
    seed : int
        Of its noise.
    case, realisation : int
        Index of the experiment's case and number of the realisation; of a dataset 0 and the sample's index.
    anatomy : str
        Name of the dataset's anatomy that it shows; empty in a run.
    """

    name: str
    view: RenderedView
    session: Session
    setting: str
    swept: Mapping[str, Value]
    image: Image
    seed: int
    case: int
    realisation: int
    anatomy: str = ""


def scored_frames(folder: Path | str) -> Iterator[ScoredFrame]:
    """Render the exported frames of a run or dataset again, in the order of its cases, or of its shards.

    A frame that stands for several realisations comes once for each.
    """
    folder = Path(folder)
    record = read_record(folder)
    # Not a generator itself, so that a folder that cannot be used raises at the call.
    return _frames(record, open_source(folder, record))


def _frames(record: Record, source: Source) -> Iterator[ScoredFrame]:
    names = record.names()
    for views in source.views:
        for each in views:
            name = names.get((each.case, each.number))
            if name is None:
                raise InputError(f"{source.folder}: {each.setting} was not exported as a whole; export again")
            check_frame(source.folder, name, record.frames[name].sha256, each.image)
            yield ScoredFrame(
                name,
                each.view,
                each.session,
                each.setting,
                each.swept,
                each.image,
                each.seed,
                each.case,
                each.number,
                each.anatomy,
            )
