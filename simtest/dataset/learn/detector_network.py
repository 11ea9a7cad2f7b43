"""Network of the task `highlight_instances`: a small U-Net."""

import itertools

import torch
from torch import Tensor, nn

from simtest.detection.highlight_inputs import INPUTS

WIDTHS = (12, 20, 24, 24)
"""Channels at full, half, quarter and eighth resolution."""

MULTIPLE = 2 ** (len(WIDTHS) - 1)
"""Height and width of what goes in are multiples of this."""


class HighlightUNet(nn.Module):
    """A U-Net with two convolutions a level on the way down, and one on the way up.

    The outputs have the shape (N, 2, H, W): logits of a highlight's pixel, and of the bump around its middle.
    """

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        widths = [round(width * channels) for channels in WIDTHS]
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(before, after), _convolution(after, after))
            for before, after in itertools.pairwise([len(INPUTS), *widths])
        )
        self.up = nn.ModuleList(
            _convolution(after + before, before) for before, after in reversed(list(itertools.pairwise(widths)))
        )
        self.head = nn.Conv2d(widths[0], 2, 1)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs, and the means of the coarsest features, shape (N, F), for inputs, shape (N, 5, H, W)."""
        kept: list[Tensor] = []
        values = inputs
        for number, level in enumerate(self.down):
            values = level(nn.functional.max_pool2d(values, 2) if number else values)
            kept.append(values)
        features = values.mean(dim=(2, 3))
        for level, skip in zip(self.up, reversed(kept[:-1]), strict=True):
            values = level(torch.cat([nn.functional.interpolate(values, scale_factor=2.0, mode="nearest"), skip], 1))
        return self.head(values), features


def _convolution(before: int, after: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(before, after, 3, padding=1, bias=False), nn.BatchNorm2d(after), nn.ReLU())
