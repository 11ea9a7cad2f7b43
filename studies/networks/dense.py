"""Recipe of `learned_dense`: the base's normal and the distance all over a frame, each with its uncertainty."""

import itertools
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from simtest.estimators.learned import LOG_RANGE, CovarianceScale, inflation
from simtest.estimators.learned_dense import (
    CAMERA,
    DISTANCE_MM,
    DISTANCE_SCALE,
    FORMAT,
    OUTPUTS,
    PLANES,
    ROTATION_SCALE,
    VIEWED,
    log_deviation,
)
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.validation.runner import Progress
from studies.networks.examples import Examples, read_dense_frames
from studies.networks.fitted import (
    COVERAGE,
    USUAL,
    fitted_range,
    fitted_scale,
    number_loss,
    pair_loss,
    squared_distance,
)
from studies.networks.onnx_file import export
from studies.networks.training import Batch, Recipe

CHANNELS = (16, 24, 24, 32)
"""Of each level; the first has half the cells of the planes along each axis, and each next one half of those."""

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


class DenseNormals:
    """The task (see `studies.networks.training.Task`)."""

    recipe = Recipe(
        "Normals and distances all over a frame", "dense_normals", epochs=45, batch=8, learning_rate=3e-3, patience=15
    )
    evaluated_at_once = 16
    bits = 8

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Examples:
        """Read the examples of a split."""
        return read_dense_frames(folder, split, progress)

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return the batch mirrored, with other response, falloff, colours, noise and view: the shape stays."""
        flip_x, flip_y = (bool(v) for v in torch.randint(2, (2,), generator=generator))
        return disturbed(moved(batch, flip_x, flip_y), generator)

    def network(self, taught: Batch, width: float) -> nn.Module:
        """Return a fresh network with the scales of the examples' planes."""
        planes = taught["planes"]
        mean, spread = planes.mean(dim=(0, 2, 3)), planes.std(dim=(0, 2, 3)) + 0.05
        # Mirrored frames are as likely.
        mean[[*AXIS, *LIGHT]] = 0.0
        for pair in (AXIS, LIGHT):
            spread[list(pair)] = spread[list(pair)].max()
        return DenseNetwork(mean, spread, width)

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

    def export(self, network: nn.Module, taught: Batch, judged: Batch, path: Path, about: JsonObject) -> Path:
        """Write the file; what it states is scaled, and the range of the features taken, on the validation split."""
        (outputs, features), (_, own) = (evaluated(network, split["planes"]) for split in (judged, taught))
        found = fitted_range(CAMERA, taught["camera"].numpy(), own.numpy(), features.numpy())
        distances = found.distances(features.numpy())
        usual = float(np.quantile(distances, USUAL))
        base, distance = dense_scales(outputs, judged, inflation(distances, usual))
        metadata = {
            "format": FORMAT,
            "scales": {"base": base.written(), "distance": distance.written()},
            "feature_usual": usual,
            **found.written(),
            "about": about,
        }
        return export(network, {"planes": taught["planes"][:2]}, ("outputs", "features"), metadata, path)


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


def evaluated(network: nn.Module, planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return outputs and features of frames, some at once."""
    with torch.no_grad():
        made = [network(part) for part in planes.split(DenseNormals.evaluated_at_once)]
    outputs, features = (torch.cat(parts) for parts in zip(*made, strict=True))
    return outputs, features


def dense_scales(outputs: Tensor, judged: Batch, inflated: Array) -> tuple[CovarianceScale, CovarianceScale]:
    """Return the factors of the normals' covariances and of the distances' variances, fitted on frames.

    `inflated`, shape (K,), are the factors by which each frame's covariances are larger already (`inflation`).
    Cells of one frame are not independent. A frame more, besides K frames, has its cells inside at `COVERAGE` on
    average if a share of `COVERAGE` (K + 1) / K of those K frames' cells is: a frame of the same anatomies. The few
    anatomies of a validation split promise less for another one.
    """
    made, rotation, distance = known_cells(outputs, judged)
    coverage = min(1.0, COVERAGE * (len(outputs) + 1) / len(outputs))
    stated = made.double().numpy()
    factors = np.repeat(inflated, cells_of(judged).numpy())
    base = fitted_scale(_double(squared_distance(made, rotation)) / factors, log_deviation(stated), coverage)
    logarithm = made[:, 6].clamp(*LOG_RANGE)
    off = _double(((distance - made[:, 5]) * torch.exp(-logarithm)) ** 2)
    return base, fitted_scale(off / factors, _double(logarithm), coverage, dimensions=1)


def _double(values: Tensor) -> Array:
    return np.asarray(values.double().numpy())
