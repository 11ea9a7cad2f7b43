"""The network of the task `dense_normals`: a U-Net on a coarse grid."""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from simtest.estimators.dense_inputs import OUTPUTS, PLANES

CHANNELS = (16, 24, 24, 32)
"""Of each level; the first has half the cells of the planes along each axis, and each next one half of those."""


class DenseNetwork(nn.Module):
    """A U-Net of four levels; what the deepest one sees of the whole frame goes into all its cells.

    Its features are the means, over the frame, of the first level and of the deepest: the one sees noise and texture,
    the other shape.
    """

    def __init__(self, mean: Tensor, spread: Tensor, width: float = 1.0) -> None:
        super().__init__()
        channels = [max(4, round(width * count)) for count in CHANNELS]
        self.register_buffer("mean", mean.reshape(1, -1, 1, 1))
        self.register_buffer("spread", spread.reshape(1, -1, 1, 1))
        pairs = list(itertools.pairwise([len(PLANES), *channels]))
        self.down = nn.ModuleList(nn.Sequential(_convolution(a, b, 2), _convolution(b, b)) for a, b in pairs)
        self.whole = nn.Linear(channels[-1], channels[-1])
        self.up = nn.ModuleList(_convolution(b + a, a) for a, b in itertools.pairwise(channels))
        self.heads = nn.Conv2d(channels[0], len(OUTPUTS), 1)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs, (N, 7, 48, 64), and features of the frame, (N, 48 width), for planes, (N, 10, 96, 128)."""
        made, skipped = (planes - self.mean) / self.spread, []
        for level in self.down:
            made = level(made)
            skipped.append(made)
        first, deepest = (each.mean(dim=(2, 3)) for each in (skipped[0], made))
        made = functional.relu(made + self.whole(deepest)[:, :, None, None])
        for level, beside in zip(reversed(self.up), reversed(skipped[:-1]), strict=True):
            made = functional.interpolate(made, scale_factor=2.0, mode="bilinear", align_corners=False)
            made = level(torch.cat([made, beside], dim=1))
        return self.heads(made), torch.cat([first, deepest], dim=1)


def _convolution(before: int, after: int, stride: int = 1) -> nn.Sequential:
    """Return a convolution with the normalisation of its outputs."""
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False), nn.BatchNorm2d(after), nn.ReLU()
    )
