"""What a training is: its task, data order and optimiser, as a TOML file under scenes/learning."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from simtest.runtime.resources import find
from simtest.spec.spec_model import Name, Share, Spec, load


class Training(Spec):
    """A training.

    Parameters
    ----------
    name : str
        By default that of the file.
    title : str
        For the page.
    task : str
        Name of the task (`simtest.dataset.learn.tasks.TASKS`).
    seed : int
        Of weights, order and augmentation.
    epochs, batch : int
        Passes over the examples at most, and examples of a step.
    learning_rate, weight_decay : float
        Of AdamW. The rate rises to this value over the first `warm_up` of the steps and falls to 0 along a cosine.
    warm_up : float
        Share of the steps.
    largest_gradient : float
        Norm to which longer gradients are shortened.
    patience : int
        Epochs without a smaller loss on the validation split after which training stops; 0: never.
    mixed_precision : bool
        Compute in bfloat16 where that pays, on a GPU alone.
    width : float
        Factor of the network's numbers of channels.
    """

    name: Name
    title: str = ""
    task: str
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    epochs: Annotated[int, Field(ge=1, le=100_000)] = 40
    batch: Annotated[int, Field(ge=1, le=65536)] = 128
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 2e-3
    weight_decay: Annotated[float, Field(ge=0, le=1)] = 1e-3
    warm_up: Share = 0.1
    largest_gradient: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    patience: Annotated[int, Field(ge=0, le=100_000)] = 10
    mixed_precision: bool = True
    width: Annotated[float, Field(ge=0.25, le=16)] = 1.0


def load_training(name: str | Path, settings: Mapping[str, Any] | None = None) -> Training:
    """Read a training's file, by path or as a shipped one by name; `settings` replace values by key path."""
    return load(Training, find(name, "scenes", "learning"), dict(settings or {}))
