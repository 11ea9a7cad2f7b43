"""What a network can be trained for: a task is a view of a dataset, a network, a loss and metrics."""

import importlib
from pathlib import Path
from typing import Protocol

from torch import Generator, Tensor, nn

from simtest.dataset.learn.training import Training
from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.validation.runner import Progress

Batch = dict[str, Tensor]
"""Inputs and targets of some examples by name; the first axis numbers the examples."""


class Task(Protocol):
    """A task; the engine (`simtest.dataset.learn.engine`) knows nothing else of it."""

    @property
    def name(self) -> str:
        """Name, as in a training's file."""

    @property
    def evaluated_at_once(self) -> int:
        """Examples of a batch without gradients."""

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Batch:
        """Read the examples of a dataset's split, all at once."""

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return a batch moved at random in a way under which the task is invariant."""

    def network(self, examples: Batch, training: Training) -> nn.Module:
        """Return a fresh network; `examples` are those of the train split, for the scales of the inputs."""

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return the mean loss of a batch."""

    def metrics(self, network: nn.Module, batch: Batch) -> dict[str, float]:
        """Return figures of the network on a split, by name with unit."""

    def finish(self, network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> list[Path]:
        """Write what runs the network elsewhere into the training's folder; `about` names data and versions."""


TASKS = {
    "dense_normals": "simtest.dataset.learn.dense_task:DenseNormals",
    "highlight_instances": "simtest.dataset.learn.detector_task:HighlightInstances",
    "spot_normals": "simtest.dataset.learn.spot_task:SpotNormals",
}
"""Class of each task by name."""


def load_task(name: str) -> Task:
    """Return a task by name; raise `InputError` if there is none."""
    if name not in TASKS:
        raise InputError(f"task = {name}: unknown; allowed: {', '.join(TASKS)}{suggestion(name, TASKS)}")
    module, _, attribute = TASKS[name].partition(":")
    task: Task = getattr(importlib.import_module(module), attribute)()
    return task
