"""Task `spot_normals`: normal and axis ratio of base and fine surface at one highlight, each with its uncertainty."""

import itertools
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor, nn

from simtest.dataset.learn import likelihood
from simtest.dataset.learn.likelihood import number_loss, pair_loss
from simtest.dataset.learn.spots import Spots, read_spots
from simtest.dataset.learn.tasks import Batch
from simtest.dataset.learn.training import Training
from simtest.estimators.spot_inputs import EXTRAS, OUTPUTS, ROTATION_SCALE, SIDE, STEPS, SURFACES
from simtest.validation.runner import Progress

VECTORS = ((1, 2), (3, 4))
"""Columns of the extras that turn with the picture, and below those of a symmetric matrix."""

MATRIX = (6, 7, 8)

RATIO_WEIGHT = 0.3


class SpotNetwork(nn.Module):
    """Three convolutions over the crops, then three dense layers over their outputs and the extras.

    The outputs have the shape (N, 2, 7): for each of `SURFACES` the `OUTPUTS`.
    """

    def __init__(self, mean: Tensor, spread: Tensor, width: float = 1.0) -> None:
        super().__init__()
        widths = (len(STEPS), *(round(width * channels) for channels in (24, 32, 64)))
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU()]
        self.convolutions = nn.Sequential(*layers, nn.Flatten())
        cells, dense = widths[-1] * (SIDE // 2 ** (len(widths) - 1)) ** 2, round(width * 96)
        self.features = nn.Sequential(
            nn.Linear(cells + len(EXTRAS), dense), nn.ReLU(), nn.Linear(dense, dense // 2), nn.ReLU()
        )
        self.heads = nn.Linear(dense // 2, len(SURFACES) * len(OUTPUTS))
        self.register_buffer("mean", mean)
        self.register_buffer("spread", spread)

    def forward(self, crops: Tensor, extras: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs and features (N, width / 2) for crops, (N, 3, 32, 32), and extras, (N, 11)."""
        seen = self.convolutions(crops)
        features = self.features(torch.cat([seen, (extras - self.mean) / self.spread], dim=1))
        return self.heads(features).reshape(-1, len(SURFACES), len(OUTPUTS)), features


class SpotNormals:
    """The task (see `simtest.dataset.learn.tasks.Task`)."""

    name = "spot_normals"
    evaluated_at_once = 1024

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Batch:
        """Read the examples of a split."""
        return batch_of(read_spots(folder, split, progress=progress))

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return the batch mirrored and turned by right angles: what it shows is as likely."""
        flip_x, flip_y, transpose = (bool(v) for v in torch.randint(2, (3,), generator=generator))
        return moved(batch, flip_x, flip_y, transpose)

    def network(self, examples: Batch, training: Training) -> nn.Module:
        """Return a fresh network with the scales of the examples' extras."""
        extras = examples["extras"]
        mean, spread = extras.mean(dim=0), extras.std(dim=0) + 1e-3
        # Components along x and y are drawn alike, since the examples are turned.
        for columns in (*VECTORS, (6, 8)):
            mean[list(columns)] = 0.0 if columns in VECTORS else mean[list(columns)].mean()
            spread[list(columns)] = spread[list(columns)].max()
        mean[7] = 0.0
        return SpotNetwork(mean, spread, training.width)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return the mean negative log-likelihood of the rotations and axis ratios that are known."""
        outputs, _ = network(batch["crops"], batch["extras"])
        total = outputs.new_zeros(())
        for number, surface in enumerate(SURFACES):
            rotation, ratio = batch[surface], batch[f"{surface}_ratio"]
            known = torch.isfinite(rotation[:, 0])
            if not known.any():
                continue
            made = outputs[known, number].float()
            of_rotation = _rotation_loss(made, rotation[known])
            of_ratio = _ratio_loss(made, ratio[known])
            total = total + (of_rotation + RATIO_WEIGHT * of_ratio).sum() / len(rotation)
        return total

    def metrics(self, network: nn.Module, batch: Batch) -> dict[str, float]:
        """Return median errors of the normals, deg, and of the axis ratios."""
        outputs, _ = network(batch["crops"], batch["extras"])
        found: dict[str, float] = {}
        for number, surface in enumerate(SURFACES):
            truth, made = batch[surface].cpu().numpy(), outputs[:, number].float().cpu().numpy()
            known = np.isfinite(truth[:, 0])
            if not known.any():
                continue
            off = made[known, :2] * ROTATION_SCALE - truth[known]
            gone = np.abs(1 / (1 + np.exp(-made[known, 5])) - batch[f"{surface}_ratio"].cpu().numpy()[known])
            found[f"{surface}: median error of the normal, deg"] = float(
                np.degrees(np.median(np.linalg.norm(off, axis=1)))
            )
            found[f"{surface}: median error of the axis ratio"] = float(np.nanmedian(gone))
        return found

    def finish(self, network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> list[Path]:
        """Write model.onnx for `simtest.estimators.learned_spot`; covariances are scaled on the validation split."""
        from simtest.dataset.learn.spot_export import export_spots

        return [export_spots(network, taught, judged, out, about)]


def batch_of(spots: Spots) -> Batch:
    """Return highlights as tensors."""
    names = ("crops", "extras", *SURFACES, *(f"{surface}_ratio" for surface in SURFACES))
    return {name: torch.from_numpy(np.ascontiguousarray(getattr(spots, name), dtype=np.float32)) for name in names}


def moved(batch: Batch, flip_x: bool, flip_y: bool, transpose: bool) -> Batch:
    """Return a batch with its pictures mirrored, then transposed, and its vectors moved alike."""
    crops, extras = batch["crops"], batch["extras"].clone()
    turned = {name: batch[name].clone() for name in SURFACES}
    pairs = [extras[:, list(columns)] for columns in VECTORS] + [turned[name] for name in SURFACES]
    first, mixed, second = (extras[:, column].clone() for column in MATRIX)
    if flip_x:
        crops, mixed = crops.flip(-1), -mixed
        pairs = [pair * pair.new_tensor([-1.0, 1.0]) for pair in pairs]
    if flip_y:
        crops, mixed = crops.flip(-2), -mixed
        pairs = [pair * pair.new_tensor([1.0, -1.0]) for pair in pairs]
    if transpose:
        crops, first, second = crops.transpose(-1, -2), second, first
        pairs = [pair.flip(-1) for pair in pairs]
    for columns, pair in zip(VECTORS, pairs, strict=False):
        extras[:, list(columns)] = pair
    extras[:, list(MATRIX)] = torch.stack([first, mixed, second], dim=1)
    return {**batch, "crops": crops, "extras": extras, **dict(zip(SURFACES, pairs[len(VECTORS) :], strict=True))}


def _rotation_loss(made: Tensor, rotation: Tensor) -> Tensor:
    """Return the negative log-likelihood of rotations, rad, under a normal distribution, shape (N,)."""
    return pair_loss(made, rotation / ROTATION_SCALE)


def squared_distance(made: Tensor, rotation: Tensor) -> Tensor:
    """Return the squared Mahalanobis distance of rotations, rad, from outputs of one surface, shape (N,)."""
    return likelihood.squared_distance(made, rotation / ROTATION_SCALE)


def _ratio_loss(made: Tensor, ratio: Tensor) -> Tensor:
    """Return the negative log-likelihood of axis ratios, shape (N,); 0 where none is known."""
    return number_loss(torch.sigmoid(made[:, 5]), made[:, 6], ratio)
