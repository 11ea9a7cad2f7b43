"""Task `highlight_instances`: the pixels of highlights in a frame, and a bump around the middle of each."""

from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor, nn

from simtest.dataset.learn.detector_frames import FULL, HIGHLIGHT, OUTSIDE, UNJUDGED, DetectorFrames, read_frames
from simtest.dataset.learn.detector_moves import moved_crops, plain_inputs
from simtest.dataset.learn.detector_network import MULTIPLE, HighlightUNet
from simtest.dataset.learn.tasks import Batch
from simtest.dataset.learn.training import Training
from simtest.validation.runner import Progress

BUMP_WEIGHT, TOP_WEIGHT = 2.0, 9.0
"""Weight of the bumps' loss beside that of the pixels, and of a bump's top beside a pixel of tissue."""

JUDGED_PX = 192
"""Side of the middle part of each frame that is judged after an epoch."""


class HighlightInstances:
    """The task (see `simtest.dataset.learn.tasks.Task`)."""

    name = "highlight_instances"
    evaluated_at_once = 4

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Batch:
        """Read the frames of a split."""
        return batch_of(read_frames(folder, split, progress))

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return crops of the frames with other light, colour, sharpness, noise and size."""
        return moved_crops(batch, generator)

    def network(self, examples: Batch, training: Training) -> nn.Module:
        """Return a fresh network."""
        return HighlightUNet(training.width).to(memory_format=torch.channels_last)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return the mean cross entropy of pixels and bumps where they are judged."""
        return _losses(*_outputs(network, batch))

    def metrics(self, network: nn.Module, batch: Batch) -> dict[str, float]:
        """Return the overlap of found and true pixels."""
        both = either = 0
        for first in range(0, len(batch["state"]), self.evaluated_at_once):
            part = {name: values[first : first + self.evaluated_at_once] for name, values in batch.items()}
            outputs, state, _ = _outputs(network, part)
            found, true = outputs[:, 0] > 0, state == HIGHLIGHT
            judged = (state != UNJUDGED) & (state != OUTSIDE)
            both += int((found & true & judged).sum())
            either += int(((found | true) & judged).sum())
        return {"pixels: intersection over union": both / either if either else 1.0}

    def finish(self, network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> list[Path]:
        """Write model.onnx for `simtest.detection.learned_detector`; its threshold is fitted on the judged frames."""
        from simtest.dataset.learn.detector_export import export_detector

        return [export_detector(network, taught, judged, out, about)]


def batch_of(frames: DetectorFrames) -> Batch:
    """Return frames as tensors; bytes, since a network sees each frame anew."""
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in vars(frames).items()}


def _outputs(network: nn.Module, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Return outputs, states and bumps of crops as they are, or of the middle of whole frames."""
    if "inputs" not in batch:
        batch = _middle(plain_inputs(batch))
    outputs, _ = network(batch["inputs"].contiguous(memory_format=torch.channels_last))
    return outputs.float(), batch["state"], batch["bump"].float() / FULL


def _middle(batch: Batch) -> Batch:
    height, width = batch["state"].shape[-2:]
    rows, columns = (min(JUDGED_PX, size) // MULTIPLE * MULTIPLE for size in (height, width))
    top, left = (height - rows) // 2, (width - columns) // 2
    return {name: values[..., top : top + rows, left : left + columns] for name, values in batch.items()}


def _losses(outputs: Tensor, state: Tensor, bump: Tensor) -> Tensor:
    judged = ((state != UNJUDGED) & (state != OUTSIDE)).float()
    weight = judged * (1 + TOP_WEIGHT * bump)
    entropy = nn.functional.binary_cross_entropy_with_logits
    of_pixels = entropy(outputs[:, 0], (state == HIGHLIGHT).float(), weight, reduction="sum")
    of_bumps = entropy(outputs[:, 1], bump, weight, reduction="sum")
    return (of_pixels + BUMP_WEIGHT * of_bumps) / judged.sum().clamp(min=1)
