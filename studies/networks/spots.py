"""Recipe of `learned_spot`: normals and axis ratios at one highlight, each with its uncertainty."""

import itertools
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor, nn

from simtest.estimators.learned import LOG_RANGE, CovarianceScale, inflation
from simtest.estimators.learned_spot import (
    EXTRAS,
    FORMAT,
    OUTPUTS,
    RATIO,
    RATIO_DEVIATION,
    ROTATION_SCALE,
    SIDE,
    STEPS,
    SURFACES,
    log_deviation,
)
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.validation.runner import Progress
from studies.networks import fitted
from studies.networks.examples import Examples, read_spots
from studies.networks.fitted import USUAL, fitted_range, fitted_scale, number_loss, pair_loss
from studies.networks.onnx_file import export
from studies.networks.training import Batch, Recipe

VECTORS, MATRIX = ((1, 2), (3, 4)), (6, 7, 8)
"""Columns of the extras that turn with the picture, and those of a symmetric matrix."""

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
    """The task (see `studies.networks.training.Task`)."""

    recipe = Recipe("Normals from the crops of a highlight", "spot_normals")
    evaluated_at_once = 1024
    bits = 16

    def examples(self, folder: Path, split: str, progress: Progress | None = None) -> Examples:
        """Read the examples of a split."""
        return read_spots(folder, split, progress=progress)

    def augmented(self, batch: Batch, generator: Generator) -> Batch:
        """Return the batch mirrored and turned by right angles: what it shows is as likely."""
        return moved(batch, *(bool(v) for v in torch.randint(2, (3,), generator=generator)))

    def network(self, taught: Batch, width: float) -> nn.Module:
        """Return a fresh network with the scales of the examples' extras."""
        extras = taught["extras"]
        mean, spread = extras.mean(dim=0), extras.std(dim=0) + 1e-3
        # Components along x and y are drawn alike, since the examples are turned.
        for columns in (*VECTORS, (6, 8)):
            mean[list(columns)] = 0.0 if columns in VECTORS else mean[list(columns)].mean()
            spread[list(columns)] = spread[list(columns)].max()
        mean[7] = 0.0
        return SpotNetwork(mean, spread, width)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return the mean negative log-likelihood of the rotations and axis ratios that are known."""
        outputs, _ = network(batch["crops"], batch["extras"])
        total = outputs.new_zeros(())
        for number, surface in enumerate(SURFACES):
            rotation, ratio = batch[surface], batch[f"{surface}_ratio"]
            known = torch.isfinite(rotation[:, 0])
            if not known.any():
                continue
            made = outputs[known, number]
            of_rotation = pair_loss(made, rotation[known] / ROTATION_SCALE)
            of_ratio = number_loss(torch.sigmoid(made[:, RATIO]), made[:, RATIO_DEVIATION], ratio[known])
            total = total + (of_rotation + RATIO_WEIGHT * of_ratio).sum() / len(rotation)
        return total

    def metrics(self, network: nn.Module, batch: Batch) -> dict[str, float]:
        """Return median errors of the normals, deg, and of the axis ratios."""
        outputs, _ = network(batch["crops"], batch["extras"])
        found: dict[str, float] = {}
        for number, surface in enumerate(SURFACES):
            truth, made = batch[surface].numpy(), outputs[:, number].numpy()
            known = np.isfinite(truth[:, 0])
            if not known.any():
                continue
            off = made[known, :2] * ROTATION_SCALE - truth[known]
            gone = np.abs(1 / (1 + np.exp(-made[known, RATIO])) - batch[f"{surface}_ratio"].numpy()[known])
            found[f"{surface}: median error of the normal, deg"] = float(
                np.degrees(np.median(np.linalg.norm(off, axis=1)))
            )
            found[f"{surface}: median error of the axis ratio"] = float(np.nanmedian(gone))
        return found

    def export(self, network: nn.Module, taught: Batch, judged: Batch, path: Path, about: JsonObject) -> Path:
        """Write the file; covariances are scaled, and the range of the features taken, on the validation split."""
        content = {"format": FORMAT, **_calibration(network, taught, judged), "about": about}
        inputs = {name: taught[name][:2] for name in ("crops", "extras")}
        return export(network, inputs, ("outputs", "features"), content, path)


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


def squared_distance(made: Tensor, rotation: Tensor) -> Tensor:
    """Return the squared Mahalanobis distance of rotations, rad, from outputs of one surface, shape (N,)."""
    return fitted.squared_distance(made, rotation / ROTATION_SCALE)


def _calibration(network: nn.Module, taught: Batch, judged: Batch) -> JsonObject:
    """Return the covariances' scales, the ranges of the extras, and the distribution of the features."""
    with torch.no_grad():
        outputs, features = network(judged["crops"], judged["extras"])
        own = network(taught["crops"], taught["extras"])[1]
    taught_range = fitted_range(EXTRAS, taught["extras"].numpy(), own.numpy(), features.numpy())
    distances = taught_range.distances(features.numpy())
    usual = float(np.quantile(distances, USUAL))
    inflated = inflation(distances, usual)
    scales, ratio_scales = {}, {}
    for number, surface in enumerate(SURFACES):
        known = torch.isfinite(judged[surface][:, 0])
        made = outputs[known, number]
        gaps = squared_distance(made, judged[surface][known]).double().numpy() / inflated[known.numpy()]
        scales[surface] = fitted_scale(gaps, log_deviation(made.double().numpy())).written()
        ratio_scales[surface] = _ratio_scale(outputs[:, number], judged[f"{surface}_ratio"], inflated).written()
    return {"scales": scales, "ratio_scales": ratio_scales, "feature_usual": usual, **taught_range.written()}


def _ratio_scale(made: Tensor, ratio: Tensor, inflated: Array) -> CovarianceScale:
    """Return the factor of the axis ratio's variance, where the ratio is known."""
    known = torch.isfinite(ratio)
    sure = made[known, RATIO_DEVIATION].clamp(*LOG_RANGE)
    off = (ratio[known] - torch.sigmoid(made[known, RATIO])) * torch.exp(-sure)
    return fitted_scale((off * off).double().numpy() / inflated[known.numpy()], sure.double().numpy(), dimensions=1)
