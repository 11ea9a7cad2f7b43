"""Writes a network of the task `spot_normals` as ONNX, with its calibration and the range that it was taught."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from simtest.dataset.learn.calibration import USUAL, fitted_range, fitted_scale
from simtest.dataset.learn.onnx_export import MODEL, export
from simtest.dataset.learn.spot_task import squared_distance
from simtest.dataset.learn.tasks import Batch
from simtest.estimators.covariance_scale import CovarianceScale
from simtest.estimators.learned_spot import FORMAT, log_deviation
from simtest.estimators.spot_inputs import EXTRAS, LOG_RANGE, RATIO, RATIO_DEVIATION, SURFACES
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.runtime.training_range import inflation


def export_spots(network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> Path:
    """Write model.onnx into a folder and return its path; `about` goes into the file's metadata."""
    network = network.cpu().eval()
    taught, judged = ({name: values.cpu() for name, values in split.items()} for split in (taught, judged))
    content = {"format": FORMAT, **_calibration(network, taught, judged), "about": about}
    examples = {name: taught[name][:2] for name in ("crops", "extras")}
    outputs = ("outputs", "features")
    axes = {name: {0: "n"} for name in (*examples, *outputs)}
    return export(network, examples, outputs, axes, content, out / MODEL)


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
