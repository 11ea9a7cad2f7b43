"""The training loop of all tasks: seeded, and resumed with the weights that an undisturbed run has."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from simtest.dataset.learn.checkpoint import BEST, LAST, Epoch, State, load_checkpoint, save_checkpoint
from simtest.dataset.learn.tasks import Batch, Task
from simtest.dataset.learn.training import Training
from simtest.errors import InputError
from simtest.runtime.files import make_folder
from simtest.validation.runner import Progress


@dataclass(frozen=True)
class Trained:
    """A finished training: the network of the best epoch, in evaluation mode, and the history."""

    network: nn.Module
    state: State


def train(
    training: Training, task: Task, taught: Batch, judged: Batch, out: Path, progress: Progress | None = None
) -> Trained:
    """Train a network, or go on with a training that was stopped.

    Parameters
    ----------
    training : Training
        Task, seed and optimiser.
    task : Task
        What is learned.
    taught, judged : dict of Tensor
        Examples of the train and of the validation split.
    out : Path
        Folder of the checkpoints, which are written after each epoch: the last and the best.
    progress : callable, optional
        Called with steps done, steps in all, and what is being done, after each step; what it raises stops the
        training, which keeps the last checkpoint.
    """
    for name, examples in (("train", taught), ("validation", judged)):
        if _count(examples) == 0:
            raise InputError(f"split {name}: holds no example for the task {task.name}")
    make_folder(out)
    run = _Run(training, task, taught, judged, out)
    while not run.is_done:
        run.do_epoch(progress)
    best, _ = run.fresh()
    load_checkpoint(out / BEST, best, run.optimiser_of(best), run.made_of)
    return Trained(best.eval(), run.state)


class _Run:
    """A training between its first epoch, or the one after the last checkpoint, and its end."""

    def __init__(self, training: Training, task: Task, taught: Batch, judged: Batch, out: Path) -> None:
        self._training, self._task, self._out = training, task, out
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._taught, self._judged = _moved(taught, self._device), _moved(judged, self._device)
        self.made_of = {**training.model_dump(mode="json"), "data": _digest(taught, judged)}
        self._network, self._optimiser = self.fresh()
        self.state = State(self.made_of)
        if (out / LAST).exists():
            self.state = load_checkpoint(out / LAST, self._network, self._optimiser, self.made_of)
        self._steps = -(-_count(taught) // training.batch)

    def fresh(self) -> tuple[nn.Module, torch.optim.Optimizer]:
        """Return a network as before its first step, and its optimiser."""
        torch.manual_seed(self._training.seed)
        network = self._task.network(self._taught, self._training).to(self._device)
        return network, self.optimiser_of(network)

    def optimiser_of(self, network: nn.Module) -> torch.optim.Optimizer:
        """Return the optimiser of a network's weights."""
        rate, decay = self._training.learning_rate, self._training.weight_decay
        return torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=decay)

    @property
    def is_done(self) -> bool:
        """Whether all epochs are done, or the loss has not fallen for too long."""
        patience, done = self._training.patience, len(self.state.history)
        return done >= self._training.epochs or bool(patience and done and self.state.waited >= patience)

    def do_epoch(self, progress: Progress | None) -> None:
        """Do one pass over the train split, judge the network, and write the checkpoints."""
        number = len(self.state.history)
        # Each epoch has a stream of its own, so that a resumed run draws what an undisturbed one draws.
        generator = torch.Generator().manual_seed(_seed(self._training.seed, number))
        torch.manual_seed(_seed(self._training.seed, number, 1))
        self._network.train()
        losses, count = 0.0, _count(self._taught)
        for step, chosen in enumerate(torch.randperm(count, generator=generator).split(self._training.batch)):
            batch = {name: values[chosen.to(self._device)] for name, values in self._taught.items()}
            loss = self._step(self._task.augmented(batch, generator), number * self._steps + step)
            losses += loss * len(chosen)
            if progress:
                done, total = number * self._steps + step + 1, self._training.epochs * self._steps
                progress(done, total + 1, f"epoch {number + 1}, loss {loss:.3f}")
        self._finish(losses / count)

    def _step(self, batch: Batch, number: int) -> float:
        """Take one step of the optimiser; return the loss before it."""
        for group in self._optimiser.param_groups:
            group["lr"] = self._training.learning_rate * self._share_of_rate(number)
        mixed = self._training.mixed_precision and self._device.type == "cuda"
        # bfloat16 has the range of float32, so no loss needs scaling.
        with torch.autocast(self._device.type, dtype=torch.bfloat16, enabled=mixed):
            loss = self._task.loss(self._network, batch)
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self._network.parameters(), self._training.largest_gradient)
        self._optimiser.step()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise InputError(f"learning_rate = {self._training.learning_rate:g}: the loss is {value} at step {number}")
        return value

    def _share_of_rate(self, step: int) -> float:
        total = self._training.epochs * self._steps
        rising = self._training.warm_up * total
        if step < rising:
            return (step + 1) / (rising + 1)
        return 0.5 * (1 + math.cos(math.pi * (step - rising) / max(total - rising, 1)))

    def _finish(self, train_loss: float) -> None:
        """Judge the network after an epoch, and write the checkpoints."""
        self._network.eval()
        with torch.no_grad():
            loss = _mean(
                lambda batch: float(self._task.loss(self._network, batch)), self._judged, self._task.evaluated_at_once
            )
            metrics = self._task.metrics(self._network, self._judged)
        history = self.state.history
        is_best = not history or loss < history[self.state.best].validation_loss
        history.append(Epoch(train_loss, loss, metrics))
        if is_best:
            self.state.best = len(history) - 1
            save_checkpoint(self._out / BEST, self._network, self._optimiser, self.state)
        # Last: a kill between both leaves a best one that the repeated epoch writes again.
        save_checkpoint(self._out / LAST, self._network, self._optimiser, self.state)


def _mean(figure: Callable[[Batch], float], examples: Batch, at_once: int) -> float:
    """Return the mean of a figure over examples, so many at once."""
    count, total = _count(examples), 0.0
    for first in range(0, count, at_once):
        batch = {name: values[first : first + at_once] for name, values in examples.items()}
        total += figure(batch) * _count(batch)
    return total / count


def _count(examples: Batch) -> int:
    return len(next(iter(examples.values())))


def _moved(examples: Batch, device: torch.device) -> Batch:
    return {name: values.to(device) for name, values in examples.items()}


def _seed(*parts: int) -> int:
    return int(np.random.SeedSequence(parts).generate_state(1)[0])


def _digest(*splits: Batch) -> str:
    """Return the hash of examples."""
    found = hashlib.sha256()
    for examples in splits:
        for name in sorted(examples):
            values: Tensor = examples[name].cpu().contiguous()
            found.update(f"{name} {tuple(values.shape)} {values.dtype}".encode())
            found.update(values.numpy().tobytes())
    return found.hexdigest()


def history_table(state: State) -> list[dict[str, Any]]:
    """Return the epochs as rows: number, losses, metrics."""
    return [
        {"epoch": number + 1, "train_loss": epoch.train_loss, "validation_loss": epoch.validation_loss, **epoch.metrics}
        for number, epoch in enumerate(state.history)
    ]
