"""Checkpoints of a training: weights, the optimiser's state and the history in one safetensors file, never a pickle."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from simtest.errors import InputError
from simtest.runtime.files import require_plain, write_atomically

LAST, BEST = "last.safetensors", "best.safetensors"

_NETWORK, _OPTIMISER, _STATE = "network.", "optimiser.", "state"


@dataclass
class Epoch:
    """One pass: mean loss over the train split while it learned, and loss and metrics on the validation split."""

    train_loss: float
    validation_loss: float
    metrics: dict[str, float]


@dataclass
class State:
    """State of a training between two epochs.

    Parameters
    ----------
    made_of : dict
        What the weights depend on: the training's file, the digest of the data.
    history : list of Epoch
        The epochs done.
    best : int
        Index of the epoch with the smallest loss on the validation split; -1 before the first.
    """

    made_of: dict[str, Any]
    history: list[Epoch] = field(default_factory=list)
    best: int = -1

    @property
    def waited(self) -> int:
        """Epochs since the best one."""
        return len(self.history) - 1 - self.best


def save_checkpoint(path: Path, network: nn.Module, optimiser: torch.optim.Optimizer, state: State) -> None:
    """Write a checkpoint, in one piece or not at all."""
    tensors = {f"{_NETWORK}{name}": tensor for name, tensor in network.state_dict().items()}
    for index, values in optimiser.state_dict()["state"].items():
        tensors |= {f"{_OPTIMISER}{index}.{name}": tensor for name, tensor in values.items()}
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    metadata = {_STATE: json.dumps(asdict(state))}
    content = save(plain, metadata=metadata)
    # Written here, not by safetensors, whose files nobody else may read.
    write_atomically(path, lambda part: part.write_bytes(content))


def load_checkpoint(path: Path, network: nn.Module, optimiser: torch.optim.Optimizer, made_of: dict[str, Any]) -> State:
    """Read a checkpoint into a network and an optimiser; return its state."""
    tensors, state = _read(path)
    for key in sorted({*made_of, *state.made_of}):
        there, here = state.made_of.get(key), made_of.get(key)
        if there != here:
            raise InputError(
                f"--out {path.parent}: holds another training ({key} = {there} there, "
                f"{here} here); must be another folder"
            )
    weights = {name.removeprefix(_NETWORK): t for name, t in tensors.items() if name.startswith(_NETWORK)}
    steps: dict[int, dict[str, Tensor]] = {}
    try:
        network.load_state_dict(weights)
        for name, tensor in tensors.items():
            if name.startswith(_OPTIMISER):
                index, _, key = name.removeprefix(_OPTIMISER).partition(".")
                steps.setdefault(int(index), {})[key] = tensor
        optimiser.load_state_dict({"state": steps, "param_groups": optimiser.state_dict()["param_groups"]})
    except (RuntimeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: fits no network of this training ({reason!s:.120})") from None
    return state


def read_state(path: Path) -> State:
    """Return the state of a checkpoint; raise `InputError` if the file is none."""
    return _read(path)[1]


def _read(path: Path) -> tuple[dict[str, Tensor], State]:
    """Read tensors and state of a checkpoint; raise `InputError` if it is none."""
    try:
        with safe_open(require_plain(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dict)
            content = json.loads((file.metadata() or {})[_STATE])
        epochs = [Epoch(**epoch) for epoch in content["history"]]
        state = State(dict(content["made_of"]), epochs, int(content["best"]))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is no checkpoint ({error!s:.120}); remove it to start anew") from None
    return tensors, state
