"""Writes a network of the task `spot_normals` as ONNX, with its calibration and the range that it was taught."""

import json
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import nn

from simtest.dataset.learn.spot_task import squared_distance
from simtest.dataset.learn.tasks import Batch
from simtest.estimators.learned_spot import FORMAT, METADATA
from simtest.estimators.spot_inputs import EXTRAS, SURFACES
from simtest.runtime.arrays import Array
from simtest.runtime.files import write_atomically

MODEL = "model.onnx"

COVERAGE = 0.95
_CHI2 = -2 * np.log(1 - COVERAGE)
"""Squared Mahalanobis distance, of two dimensions, that a share `COVERAGE` stays below."""

REFUSED = 0.005
"""Share of the validation split's examples whose features the network would refuse."""

SHRUNK = 0.1
"""Weight of the mean variance in the features' covariance, which has more dimensions than the examples fill."""

OPSET = 17

LEAST_FOR_SCALE = 30
"""Examples from which a scale is fitted; with fewer the covariances stay as they are."""


def export(network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> Path:
    """Write model.onnx into a folder and return its path; `about` goes into the file's metadata."""
    network = network.cpu().eval()
    taught, judged = ({name: values.cpu() for name, values in split.items()} for split in (taught, judged))
    content = {"format": FORMAT, **_calibration(network, taught, judged), "about": about}
    buffer = BytesIO()
    names = {name: {0: "n"} for name in ("crops", "extras", "outputs", "features")}
    with warnings.catch_warnings():
        # The exporter that needs no further package is called old by its successor.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, (taught["crops"][:2], taught["extras"][:2]), buffer, input_names=["crops", "extras"],
            output_names=["outputs", "features"], dynamic_axes=names, opset_version=OPSET, dynamo=False,
        )  # fmt: skip
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {METADATA: json.dumps(content, allow_nan=False)})
    onnx.checker.check_model(model)
    data = model.SerializeToString()
    write_atomically(out / MODEL, lambda part: part.write_bytes(data))
    return out / MODEL


def _calibration(network: nn.Module, taught: Batch, judged: Batch) -> dict[str, Any]:
    """Return the covariances' scales, the ranges of the extras, and the distribution of the features."""
    with torch.no_grad():
        outputs, features = network(judged["crops"], judged["extras"])
        own = network(taught["crops"], taught["extras"])[1].double().numpy()
    scales = {}
    for number, surface in enumerate(SURFACES):
        known = torch.isfinite(judged[surface][:, 0])
        distances = squared_distance(outputs[known, number], judged[surface][known]).numpy()
        enough = len(distances) >= LEAST_FOR_SCALE
        scales[surface] = float(np.quantile(distances, COVERAGE) / _CHI2) if enough else 1.0
    mean, covariance = own.mean(axis=0), np.cov(own.T)
    average = np.trace(covariance) / len(covariance)
    precision = np.linalg.inv((1 - SHRUNK) * covariance + SHRUNK * average * np.eye(len(covariance)))
    distances = _distances(features.double().numpy(), mean, precision)
    extras = taught["extras"].numpy()
    return {
        "scales": scales,
        "low": dict(zip(EXTRAS, extras.min(axis=0).tolist(), strict=True)),
        "high": dict(zip(EXTRAS, extras.max(axis=0).tolist(), strict=True)),
        "feature_mean": mean.tolist(),
        "feature_precision": precision.tolist(),
        "feature_limit": float(np.quantile(distances, 1 - REFUSED)),
    }


def _distances(features: Array, mean: Array, precision: Array) -> Array:
    """Return the squared Mahalanobis distances of features from those of the train split."""
    off = features - mean
    return np.asarray(np.einsum("ni,ij,nj->n", off, precision, off))
