"""A small network that proposes normal and axis ratio for a highlight's crop, and its training."""

import itertools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from simtest.dataset.learn.crops import EXTRAS, SIDE, Crops
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import Array

ROTATION_SCALE = 0.1
"""Rotation, rad, for an output of 1."""

OnEpoch = Callable[[int, int, str], None]
"""Called with epochs done, epochs in all, and the loss."""


class HighlightNetwork(nn.Module):
    """Three convolutions over the crop, then two dense layers over their outputs and the extras; 0.1 million weights.

    The outputs, (N, 3), are the rotation in units of `ROTATION_SCALE`, and the axis ratio as a logit.
    """

    def __init__(self, mean: Tensor, spread: Tensor) -> None:
        super().__init__()
        widths = (1, 16, 32, 48)
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU()]
        self.convolutions = nn.Sequential(*layers, nn.Flatten())
        cells = widths[-1] * (SIDE // 2 ** (len(widths) - 1)) ** 2
        self.dense = nn.Sequential(nn.Linear(cells + len(EXTRAS), 96), nn.ReLU(), nn.Linear(96, 3))
        self.register_buffer("mean", mean)
        self.register_buffer("spread", spread)

    def forward(self, images: Tensor, extras: Tensor) -> Tensor:
        """Return the outputs for crops, shape (N, 32, 32), and extras, shape (N, 6)."""
        seen = self.convolutions(images[:, None])
        return self.dense(torch.cat([seen, (extras - self.mean) / self.spread], dim=1))


def train(crops: Crops, epochs: int = 60, seed: int = 0, on_epoch: OnEpoch | None = None) -> HighlightNetwork:
    """Train a network on the crops of the train split; return it in evaluation mode.

    `epochs` are passes over the crops; `seed` is that of weights and order.
    """
    torch.manual_seed(seed)
    images, extras = torch.from_numpy(crops.images), torch.from_numpy(crops.extras)
    network = HighlightNetwork(extras.mean(dim=0), extras.std(dim=0) + 1e-6)
    rotation = torch.from_numpy(crops.rotation) / ROTATION_SCALE
    ratio = torch.from_numpy(crops.axis_ratio)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
    steps = epochs * -(-len(crops) // 64)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=max(steps, 1))
    for epoch in range(epochs):
        total = 0.0
        for batch in torch.randperm(len(crops)).split(64):
            made = network(images[batch], extras[batch])
            # Robust: a few highlights on folds have large rotations, which must not dominate.
            loss = nn.functional.smooth_l1_loss(made[:, :2], rotation[batch])
            loss = loss + nn.functional.mse_loss(torch.sigmoid(made[:, 2]), ratio[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += float(loss.detach()) * len(batch)
        if on_epoch:
            on_epoch(epoch + 1, epochs, f"loss {total / len(crops):.4f}")
    return network.eval()


def propose(network: HighlightNetwork, crops: Crops) -> tuple[Array, Array]:
    """Return a network's unit normals, shape (N, 3), camera frame, and axis ratios, shape (N,)."""
    with torch.no_grad():
        made = network(torch.from_numpy(crops.images), torch.from_numpy(crops.extras)).numpy()
    rotation = made[:, :2].astype(float) * ROTATION_SCALE
    first, second = tangent_basis(crops.towards)
    along = rotation[:, :1] * first + rotation[:, 1:] * second
    angle = np.linalg.norm(along, axis=1, keepdims=True)
    # The exponential map, from the direction to the camera.
    normal = np.cos(angle) * crops.towards + np.sinc(angle / np.pi) * along
    return normal, 1 / (1 + np.exp(-made[:, 2].astype(float)))
