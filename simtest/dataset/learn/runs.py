"""A training from its dataset to its files: what `simtest train` runs."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from simtest.dataset.learn.training import Training
from simtest.errors import InputError

try:
    import torch

    from simtest.dataset.learn.checkpoint import LAST, State, read_state
    from simtest.dataset.learn.engine import train
    from simtest.dataset.learn.model_card import origin_of, validation_of, write_card
    from simtest.dataset.learn.page import write_page
    from simtest.dataset.learn.tasks import load_task
except ImportError as error:
    raise InputError(f"training needs the package {error.name}: install the extra learn") from error
from simtest.runtime.locks import exclusive_folder
from simtest.validation.runner import Progress


@dataclass(frozen=True)
class TrainingRun:
    """A finished training: its state, and its files, the page first."""

    state: State
    files: list[Path]


def run_training(training: Training, data: Path, out: Path, progress: Progress | None = None) -> TrainingRun:
    """Train, or go on where a training was stopped; write checkpoints, curves, and the network for use elsewhere.

    Parameters
    ----------
    training : Training
        What to train.
    data : Path
        Folder of a finished dataset.
    out : Path
        Gets last.safetensors, best.safetensors, training.json, index.html, figures, and the task's own files:
        model.onnx and its card, model.md.
    progress : callable, optional
        As in `simtest.dataset.learn.engine.train`. Whatever stops the training, the page shows the epochs done.
    """
    task = load_task(training.task)
    about = origin_of(training, data)
    with exclusive_folder(out), _one_thread():
        taught, judged = (task.examples(data, split, progress) for split in ("train", "validation"))
        try:
            trained = train(training, task, taught, judged, out, progress)
        finally:
            if (out / LAST).exists():
                page = write_page(training, read_state(out / LAST), out, str(data))
        files = task.finish(trained.network, taught, judged, out, about | validation_of(trained.state))
        cards = [write_card(file) for file in files if file.suffix == ".onnx"]
    return TrainingRun(trained.state, [page, *files, *cards])


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread, unless OMP_NUM_THREADS names a number.

    Several threads wait for each other at small networks, and the order of their sums changes the weights' last digits.
    """
    before = torch.get_num_threads()
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
