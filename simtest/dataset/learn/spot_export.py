"""Writes a network of the task `spot_normals` as ONNX, with its calibration and the range that it was taught."""

from pathlib import Path

import torch
from torch import nn

from simtest.dataset.learn.calibration import fitted_range, fitted_scale
from simtest.dataset.learn.onnx_export import MODEL, export
from simtest.dataset.learn.spot_task import squared_distance
from simtest.dataset.learn.tasks import Batch
from simtest.estimators.learned_spot import FORMAT, log_deviation
from simtest.estimators.spot_inputs import EXTRAS, SURFACES
from simtest.runtime.files import JsonObject


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
    scales = {}
    for number, surface in enumerate(SURFACES):
        known = torch.isfinite(judged[surface][:, 0])
        made = outputs[known, number]
        distances = squared_distance(made, judged[surface][known]).double().numpy()
        scales[surface] = fitted_scale(distances, log_deviation(made.double().numpy())).written()
    taught_range = fitted_range(EXTRAS, taught["extras"].numpy(), own.numpy(), features.numpy())
    return {"scales": scales, **taught_range.written()}
