"""Task `dense_normals`: the base's normal and the distance all over a frame, each with its uncertainty."""

from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor, nn

from simtest.dataset.learn.dense_frames import DenseFrames, read_dense_frames
from simtest.dataset.learn.dense_network import DenseNetwork
from simtest.dataset.learn.likelihood import number_loss, pair_loss
from simtest.dataset.learn.tasks import Batch
from simtest.dataset.learn.training import Training
from simtest.estimators.dense_inputs import DISTANCE_MM, DISTANCE_SCALE, ROTATION_SCALE, VIEWED
from simtest.validation.runner import Progress

SEEN, AXIS, LIGHT = VIEWED.index("share seen"), (5, 6), (7, 8)
"""Planes: the share seen, the sightline's x and y, the mean light across the sightline."""

GAMMA, FALLOFF, COLOUR, NOISE = 0.15, 0.4, 0.3, 0.05
"""Largest change of the logarithms' scale, of the light towards the corners and of the colours; deviation of noise."""

CUT_CHANCE, CUT_CELLS = 0.25, 14
"""How often cells along a border are taken out of view, and how many at most."""

DISTANCE_WEIGHT = 0.5

RELIEF_WEIGHT = 2.0
"""Of the distances' mean error without a factor for each frame: the likelihood is about that factor alone, which a
single frame hardly tells, and would leave the shape of the distances to chance."""


class DenseNormals:
    """The task (see `simtest.dataset.learn.tasks.Task`)."""

    name = "dense_normals"

    evaluated_at_once = 16
    """Frames of a batch without gradients."""

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Batch:
        """Read the examples of a split."""
        return batch_of(read_dense_frames(folder, split, progress))

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return the batch mirrored, with other response, falloff, colours, noise and view: the shape stays."""
        flip_x, flip_y = (bool(v) for v in torch.randint(2, (2,), generator=generator))
        return disturbed(moved(batch, flip_x, flip_y), generator)

    def network(self, examples: Batch, training: Training) -> nn.Module:
        """Return a fresh network with the scales of the examples' planes."""
        planes = examples["planes"]
        mean, spread = planes.mean(dim=(0, 2, 3)), planes.std(dim=(0, 2, 3)) + 0.05
        # Mirrored frames are as likely.
        mean[[*AXIS, *LIGHT]] = 0.0
        for pair in (AXIS, LIGHT):
            spread[list(pair)] = spread[list(pair)].max()
        return DenseNetwork(mean, spread, training.width)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return the mean negative log-likelihood of the normals and distances that are known."""
        outputs, _ = network(batch["planes"])
        made, rotation, distance = known_cells(outputs, batch)
        of_distance = number_loss(made[:, 5], made[:, 6], distance)
        off = without_factor(made[:, 5] - distance, cells_of(batch)).abs()
        return (pair_loss(made, rotation) + DISTANCE_WEIGHT * of_distance + RELIEF_WEIGHT * off).mean()

    def metrics(self, network: nn.Module, batch: Batch) -> dict[str, float]:
        """Return median errors of the normal, deg, and of the distance, before and after a factor for each frame."""
        normal, raw, scaled = [], [], []
        for first in range(0, len(batch["planes"]), self.evaluated_at_once):
            part = {name: values[first : first + self.evaluated_at_once] for name, values in batch.items()}
            outputs, _ = network(part["planes"])
            made, rotation, distance = known_cells(outputs, part)
            normal.append(torch.linalg.norm(made[:, :2] - rotation, dim=1) * ROTATION_SCALE)
            off = (made[:, 5] - distance) * DISTANCE_SCALE
            raw.append(off.abs())
            scaled.append(without_factor(off, cells_of(part)).abs())
        return {
            "median error of the normal, deg": float(np.degrees(torch.cat(normal).median().item())),
            "median error of the distance, %": 100 * float(torch.cat(raw).median()),
            "median error of the distance after a factor, %": 100 * float(torch.cat(scaled).median()),
        }

    def finish(self, network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> list[Path]:
        """Write model.onnx for `simtest.estimators.learned_dense`; what it states is scaled on the validation split."""
        from simtest.dataset.learn.dense_export import export_dense

        return [export_dense(network, taught, judged, out, about)]


def batch_of(frames: DenseFrames) -> Batch:
    """Return frames as tensors."""
    names = ("planes", "rotation", "distance", "camera")
    return {name: torch.from_numpy(np.ascontiguousarray(getattr(frames, name), dtype=np.float32)) for name in names}


def known_cells(outputs: Tensor, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Return outputs, (N, 7), rotations over their scale, (N, 2), and distances as outputs, (N,), where all are known.

    The cells of the first frame come first.
    """
    known = _known(batch)
    made = outputs.float().movedim(1, -1)[known]
    rotation = batch["rotation"].movedim(1, -1)[known] / ROTATION_SCALE
    return made, rotation, torch.log(batch["distance"][known] / DISTANCE_MM) / DISTANCE_SCALE


def cells_of(batch: Batch) -> Tensor:
    """Return how many cells of each frame are known, shape (N,)."""
    return _known(batch).flatten(1).sum(dim=1)


def without_factor(logarithms: Tensor, cells: Tensor) -> Tensor:
    """Return logarithms less the mean of each frame's; the first frame has the first `cells[0]` of them, and so on."""
    frames = torch.repeat_interleave(torch.arange(len(cells), device=cells.device), cells)
    sums = torch.zeros(len(cells), device=cells.device).index_add(0, frames, logarithms)
    return logarithms - (sums / cells.clamp(min=1))[frames]


def _known(batch: Batch) -> Tensor:
    return torch.isfinite(batch["distance"]) & torch.isfinite(batch["rotation"]).all(dim=1)


def moved(batch: Batch, flip_x: bool, flip_y: bool) -> Batch:
    """Return a batch mirrored, with its sightlines, lights and normals."""
    batch = {**batch, "planes": batch["planes"].clone(), "rotation": batch["rotation"].clone()}
    for wanted, axis, component in ((flip_x, -1, 0), (flip_y, -2, 1)):
        if not wanted:
            continue
        for name in ("planes", "rotation", "distance"):
            batch[name] = batch[name].flip(axis)
        batch["planes"][:, [AXIS[component], LIGHT[component]]] *= -1
        batch["rotation"][:, component] *= -1
    return batch


def disturbed(batch: Batch, generator: Generator) -> Batch:
    """Return a batch with each frame's response, falloff, colours and noise changed at random, and some views cut."""
    planes = batch["planes"].clone()
    count, device = len(planes), planes.device

    def drawn(*shape: int) -> Tensor:
        return (2 * torch.rand((count, *shape), generator=generator) - 1).to(device)

    known = planes[:, SEEN] > 0
    light = planes[:, 0] * (1 + GAMMA * drawn(1, 1))
    off_axis = (planes[:, list(AXIS)] ** 2).sum(dim=1)
    light = light + FALLOFF * drawn(1, 1) * off_axis
    noise = torch.randn((count, len(VIEWED) - 1, *light.shape[1:]), generator=generator).to(device)
    planes[:, 0] = light + NOISE * noise[:, 0]
    planes[:, 2:4] = planes[:, 2:4] * (1 + COLOUR * drawn(2, 1, 1)) + NOISE * noise[:, 2:4]
    planes[:, : len(VIEWED)] *= (known & _kept(count, light.shape[1:], generator).to(device))[:, None]
    return {**batch, "planes": planes}


def _kept(count: int, shape: torch.Size, generator: Generator) -> Tensor:
    """Return the cells that stay in view, shape (N, rows, columns): some frames lose a part along each border."""
    kept = torch.ones((count, *shape), dtype=torch.bool)
    cut = torch.rand(count, generator=generator) < CUT_CHANCE
    width = torch.randint(CUT_CELLS + 1, (count, 4), generator=generator) * cut[:, None]
    for frame, (top, bottom, left, right) in zip(kept, width.tolist(), strict=True):
        frame[:top] = frame[:, :left] = False
        frame[shape[0] - bottom :] = frame[:, shape[1] - right :] = False
    return kept
