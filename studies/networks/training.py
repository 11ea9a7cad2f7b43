"""The training loop of both networks: seeded, on one processor thread, stopped where nothing is gained."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Generator, Tensor, nn

from simtest.errors import InputError
from simtest.runtime.files import JsonObject
from simtest.validation.runner import Progress
from studies.networks.examples import Examples

WARM_UP, LARGEST_GRADIENT = 0.1, 1.0
"""Share of the steps over which the rate rises, before it falls along a cosine; norm to which gradients are cut."""

Batch = dict[str, Tensor]
"""Inputs and targets of some examples."""


@dataclass(frozen=True)
class Recipe:
    """How a network is trained.

    `title`: for the card; `task`: name of what is learned; `seed`: of weights, order and augmentation; `epochs`,
    `batch`: passes over the examples at most, and examples of a step; `learning_rate`, `weight_decay`: of AdamW;
    `patience`: epochs without a smaller loss on the validation split after which training stops; 0: never; `width`:
    factor of the network's numbers of channels.
    """

    title: str
    task: str
    seed: int = 1
    epochs: int = 16
    batch: int = 128
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    patience: int = 6
    width: float = 1.0


class Task(Protocol):
    """What is learned, of a dataset."""

    recipe: Recipe
    evaluated_at_once: int
    bits: int
    """Of the shipped weights."""

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Examples:
        """Read the examples of a split, all at once."""

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return a batch moved at random in a way under which the task is invariant."""

    def network(self, taught: Batch, width: float) -> nn.Module:
        """Return a fresh network with the scales of the train split's inputs."""

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return the mean loss of a batch."""

    def metrics(self, network: nn.Module, batch: Batch) -> dict[str, float]:
        """Return figures of the network on a split, by name with unit."""

    def export(self, network: nn.Module, taught: Batch, judged: Batch, path: Path, about: JsonObject) -> Path:
        """Write the ONNX file that the estimator runs; `about` names data and versions."""


@dataclass(frozen=True)
class Trained:
    """The network of the best epoch, in evaluation mode, and of each epoch its losses and figures."""

    network: nn.Module
    history: list[dict[str, float]]
    best: int


def batch_of(examples: Examples) -> Batch:
    """Return examples as tensors of float32."""
    return {name: torch.from_numpy(np.ascontiguousarray(array, np.float32)) for name, array in examples.items()}


def train(task: Task, recipe: Recipe, taught: Batch, judged: Batch, progress: Progress | None = None) -> Trained:
    """Train a network on the examples of the train split, and judge each epoch on those of the validation split.

    `progress` is called with steps done, steps in all, and what is being done. Raises `InputError` where a loss is not
    finite.
    """
    torch.manual_seed(recipe.seed)
    network = task.network(taught, recipe.width)
    optimiser = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay)
    steps, history, best, kept = -(-_count(taught) // recipe.batch), list[dict[str, float]](), 0, {}
    for epoch in range(recipe.epochs):
        # Each epoch has a stream of its own.
        generator = Generator().manual_seed(_seed(recipe.seed, epoch))
        torch.manual_seed(_seed(recipe.seed, epoch, 1))
        network.train()
        losses = 0.0
        for step, chosen in enumerate(torch.randperm(_count(taught), generator=generator).split(recipe.batch)):
            done, total = epoch * steps + step, recipe.epochs * steps
            batch = task.augmented({name: values[chosen] for name, values in taught.items()}, generator)
            optimiser.param_groups[0]["lr"] = recipe.learning_rate * _share_of_rate(done, total)
            loss = _step(network, optimiser, task.loss(network, batch))
            if not math.isfinite(loss):
                raise InputError(f"learning_rate = {recipe.learning_rate:g}: the loss is {loss} at step {done}")
            losses += loss * len(chosen)
            if progress:
                progress(done + 1, total + 1, f"epoch {epoch + 1}, loss {loss:.3f}")
        network.eval()
        with torch.no_grad():
            own = _mean(lambda batch: float(task.loss(network, batch)), judged, task.evaluated_at_once)
            figures = {"train_loss": losses / _count(taught), "validation_loss": own, **task.metrics(network, judged)}
        history.append(figures)
        if epoch == 0 or own < history[best]["validation_loss"]:
            best, kept = epoch, copy.deepcopy(network.state_dict())
        if recipe.patience and epoch - best >= recipe.patience:
            break
    network.load_state_dict(kept)
    return Trained(network.eval(), history, best)


def _step(network: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor) -> float:
    """Take one step of the optimiser; return the loss before it."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
    optimiser.step()
    return float(loss.detach())


def _share_of_rate(step: int, total: int) -> float:
    rising = WARM_UP * total
    if step < rising:
        return (step + 1) / (rising + 1)
    return 0.5 * (1 + math.cos(math.pi * (step - rising) / max(total - rising, 1)))


def _mean(figure: Callable[[Batch], float], examples: Batch, at_once: int) -> float:
    """Return the mean of a figure over examples, so many at once."""
    count, total = _count(examples), 0.0
    for first in range(0, count, at_once):
        batch = {name: values[first : first + at_once] for name, values in examples.items()}
        total += figure(batch) * _count(batch)
    return total / count


def _count(examples: Batch) -> int:
    return len(next(iter(examples.values())))


def _seed(*parts: int) -> int:
    return int(np.random.SeedSequence(parts).generate_state(1)[0])
