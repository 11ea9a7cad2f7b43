"""Renders the frames of a run or a dataset again, case by case or shard by shard, in any process."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from simtest.dataset.sample_calibration import picture_sensor, stored_picture
from simtest.dataset.shard_writer import maker_of
from simtest.errors import InputError
from simtest.reconstruction.records import Specularity
from simtest.rendering import Session
from simtest.runtime.arrays import Image
from simtest.simulation.frame import RenderedView
from simtest.spec import Experiment
from simtest.spec.recipes import Dataset
from simtest.spec.sensor import Sensor
from simtest.validation.case_work import realiser_of
from simtest.validation.cases import Case
from simtest.validation.columns import Value
from simtest.validation.realisation import answer


@dataclass(frozen=True)
class Shown:
    """One frame, with the view that it is of.

    Parameters
    ----------
    case, number : int
        Index of the case and number of the realisation; of a dataset 0 and the sample's index.
    seed : int
        Of the frame's noise.
    view : RenderedView
        The rendered scene with its truth.
    session : Session
        At the scene, until the next frame is taken.
    setting : str
        Of the experiment; of a dataset the split.
    swept : mapping
        Swept, pooled and drawn values by key path.
    isolated : bool
        Whether isolated highlights alone are detected and counted.
    anatomy : str
        Name of the dataset's anatomy that it shows; empty in a run.
    stored : bool
        Whether the frame is the picture that a dataset stores, not the sensor's frame itself.
    """

    case: int
    number: int
    seed: int
    view: RenderedView
    session: Session
    setting: str
    swept: Mapping[str, Value]
    isolated: bool = True
    anatomy: str = ""
    stored: bool = False

    @property
    def sensor(self) -> Sensor:
        """The sensor as whose values the frame is encoded."""
        sensor = self.view.scene.sensor
        return picture_sensor(sensor) if self.stored else sensor

    @cached_property
    def image(self) -> Image:
        """The frame as the estimators see it: float32, shape (H, W) or (H, W, 3)."""
        frame = self.view.frame(self.seed)
        if not self.stored:
            return frame
        return np.asarray(stored_picture(frame, self.view.scene.sensor) / np.float32(255), dtype=np.float32)

    def detections(self) -> Sequence[Specularity]:
        """Detect the frame's highlights as a run does, without any estimator; none where no light reaches it."""
        return answer(self.view, self.image, {}, self.isolated)


class Views(Protocol):
    """Some frames of a run or a dataset; can be sent to another process."""

    @property
    def key(self) -> int:
        """Index of the case, or number of the shard."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Shown]: ...


@dataclass(frozen=True)
class CaseViews:
    """The frames of one case of an experiment; `variant` is Mitsuba's."""

    experiment: Experiment
    case: Case
    key: int
    variant: str

    def __len__(self) -> int:
        return len(self.case.numbers())

    def __iter__(self) -> Iterator[Shown]:
        experiment, case, realiser = self.experiment, self.case, realiser_of(self.variant)
        for number in case.numbers():
            view, drawn = realiser.view(experiment, case, number)
            seed = case.noise_seed(experiment, number)
            swept = {**case.swept, **drawn}
            yield Shown(self.key, number, seed, view, realiser.session, case.setting, swept, case.isolated)


@dataclass(frozen=True)
class ShardViews:
    """The frames of one shard of a dataset, of which there are `count`; `variant` is Mitsuba's.

    The dataset's own estimators are not needed, and may not even be installed.
    """

    dataset: Dataset
    key: int
    count: int
    variant: str

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Shown]:
        maker = maker_of(self.dataset.model_dump_json(), self.variant)
        for index in maker.plan.shards[self.key].indices:
            drawn, view, session = maker.view(index)
            values: dict[str, Value] = {
                key: value if isinstance(value, bool | int | float | str) else str(value)
                for key, value in drawn.values.items()
            }
            split, of = maker.plan.split(index), maker.plan.anatomy(index)
            anatomy = f"{of.family}.{of.number}"
            yield Shown(0, index, drawn.scene.sensor.seed, view, session, split, values, anatomy=anatomy, stored=True)


def views_of_cases(experiment: Experiment, cases: Sequence[Case], variant: str) -> list[Views]:
    """Return the rendered cases of an experiment; those of the published protocol render nothing and are left out.

    Raises `InputError` where nothing else is there.
    """
    views: list[Views] = [
        CaseViews(experiment, case, index, variant) for index, case in enumerate(cases) if not case.is_paper
    ]
    if not views:
        what = "follows the published protocol, which renders no frames"
        raise InputError(f"experiment {experiment.name}: {what}; choose an experiment on scenes")
    return views
