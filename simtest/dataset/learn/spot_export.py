"""Writes a network of the task `spot_normals` as ONNX, with its calibration and the range that it was taught."""

import json
import warnings
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import nn

from simtest.dataset.learn.spot_task import squared_distance
from simtest.dataset.learn.tasks import Batch
from simtest.estimators.learned_spot import FORMAT, METADATA, CovarianceScale, log_deviation
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

LEAST_FOR_SCALE = 60
"""Examples from which one factor of the covariances is fitted; with fewer in all they stay as they are."""

MOST_FACTORS = 5

DIGITS = 7
"""Of the numbers of the metadata: those of the weights have no more."""


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
        made = outputs[known, number]
        distances = squared_distance(made, judged[surface][known]).double().numpy()
        scale = fitted_scale(distances, log_deviation(made.double().numpy()))
        scales[surface] = {key: _rounded(values) for key, values in asdict(scale).items()}
    mean, covariance = own.mean(axis=0), np.cov(own.T)
    average = np.trace(covariance) / len(covariance)
    precision = np.linalg.inv((1 - SHRUNK) * covariance + SHRUNK * average * np.eye(len(covariance)))
    distances = _distances(features.double().numpy(), mean, precision)
    extras = taught["extras"].numpy()
    return {
        "scales": scales,
        "low": dict(zip(EXTRAS, extras.min(axis=0).tolist(), strict=True)),
        "high": dict(zip(EXTRAS, extras.max(axis=0).tolist(), strict=True)),
        "feature_mean": _rounded(mean),
        "feature_precision": _rounded(precision[np.triu_indices(len(precision))]),
        "feature_limit": float(np.quantile(distances, 1 - REFUSED)),
    }


def fitted_scale(distances: Array, deviations: Array) -> CovarianceScale:
    """Return the covariances' factors that put a share `COVERAGE` of examples inside their ellipses.

    The examples are sorted by the deviation that the network states and divided into groups, each with a factor of its
    own: a network may be too sure where it states to be sure, and right elsewhere. No group's factor is below that of
    all examples together, so that no group gains at another's cost.

    Parameters
    ----------
    distances : ndarray, shape (N,)
        Squared Mahalanobis distances of the truths.
    deviations : ndarray, shape (N,)
        Stated deviations (`simtest.estimators.learned_spot.log_deviation`).
    """
    groups = min(len(distances) // LEAST_FOR_SCALE, MOST_FACTORS)
    if groups == 0:
        return CovarianceScale((0.0,), (1.0,))
    parts = np.array_split(np.argsort(deviations, kind="stable"), groups)
    centres = [float(np.median(deviations[part])) for part in parts]
    least = _factor(distances)
    if (np.diff(centres) <= 0).any():
        return CovarianceScale((centres[0],), (least,))
    return CovarianceScale(tuple(centres), tuple(max(_factor(distances[part]), least) for part in parts))


def _factor(distances: Array) -> float:
    """Return the factor for N examples: the ceil((N + 1) 0.95)-th smallest distance, which covers one more at 95 %."""
    rank = min(int(np.ceil((len(distances) + 1) * COVERAGE)), len(distances))
    return float(np.sort(distances)[rank - 1] / _CHI2)


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in values]


def _distances(features: Array, mean: Array, precision: Array) -> Array:
    """Return the squared Mahalanobis distances of features from those of the train split."""
    off = features - mean
    return np.asarray(np.einsum("ni,ij,nj->n", off, precision, off))
