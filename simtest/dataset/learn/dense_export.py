"""Writes a network of the task `dense_normals` as ONNX, with its calibration and the range that it was taught."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from simtest.dataset.learn.calibration import COVERAGE, USUAL, fitted_range, fitted_scale
from simtest.dataset.learn.dense_task import DenseNormals, cells_of, known_cells
from simtest.dataset.learn.likelihood import squared_distance
from simtest.dataset.learn.onnx_export import MODEL, export
from simtest.dataset.learn.tasks import Batch
from simtest.estimators.covariance_scale import CovarianceScale
from simtest.estimators.dense_inputs import CAMERA
from simtest.estimators.learned_dense import FORMAT, stated_deviation
from simtest.estimators.spot_inputs import LOG_RANGE
from simtest.runtime.arrays import Array
from simtest.runtime.training_range import inflation


def export_dense(network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> Path:
    """Write model.onnx into a folder and return its path; `about` goes into the file's metadata."""
    network = network.cpu().eval()
    taught, judged = ({name: values.cpu() for name, values in split.items()} for split in (taught, judged))
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
    axes = {name: {0: "n"} for name in ("planes", "outputs", "features")}
    inputs = {"planes": taught["planes"][:2]}
    return export(network, inputs, ["outputs", "features"], axes, metadata, out / MODEL)


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
    base = fitted_scale(_double(squared_distance(made, rotation)) / factors, stated_deviation(stated), coverage)
    logarithm = made[:, 6].clamp(*LOG_RANGE)
    off = _double(((distance - made[:, 5]) * torch.exp(-logarithm)) ** 2)
    return base, fitted_scale(off / factors, _double(logarithm), coverage, dimensions=1)


def _double(values: Tensor) -> Array:
    return np.asarray(values.double().numpy())
