"""Writes a network with its metadata as a checked ONNX file, for `simtest.runtime.onnx_model`."""

import json
import warnings
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from simtest.errors import SimtestError
from simtest.runtime.files import JsonObject, write_atomically
from simtest.runtime.onnx_model import METADATA

MODEL = "model.onnx"
"""Name of the file in a training's folder."""

OPSET = 17

LARGEST_DIFFERENCE = 1e-5
"""Difference of ONNX Runtime from PyTorch, as a share of an output's largest value, above which the file is wrong.

Rounding gives about 1e-6. Outputs whose largest value is below 1 are compared as they are.
"""

LEAST_HALVED = 1000
"""Tensors with fewer values keep all their digits in `halved`."""


def export(
    network: nn.Module, inputs: Mapping[str, Tensor], outputs: Sequence[str], axes: Mapping[str, Mapping[int, str]],
    metadata: JsonObject, path: Path,
) -> Path:  # fmt: skip
    """Write a network, on the processor and in evaluation mode, as an ONNX file; return its path.

    Parameters
    ----------
    network : Module
        Its ``forward`` takes the inputs in their order and returns a tensor or a tuple of them.
    inputs : mapping
        Example inputs by name. The file is run on them and compared with the network.
    outputs : sequence of str
        Names of the outputs.
    axes : mapping
        Names of the axes of any length, by input or output, then by number of the axis.
    metadata : dict
        Kept in the file under the key ``simtest``; holds ``format``.
    path : Path
        The file, replaced in one piece.

    Raises
    ------
    SimtestError
        If ONNX Runtime's outputs are not those of PyTorch.
    """
    network = network.cpu().eval()
    examples = tuple(values.cpu() for values in inputs.values())
    buffer = BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        # The exporter that PyTorch calls old: its successor needs the package onnxscript (10 MB with onnx_ir), takes
        # 5 s instead of 0.1 s for a small network, and writes the same layers.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, examples, buffer, input_names=list(inputs), output_names=list(outputs), dynamo=False,
            dynamic_axes={name: dict(names) for name, names in axes.items()}, opset_version=OPSET,
        )  # fmt: skip
        made = network(*examples)
    model = onnx.load_from_string(buffer.getvalue())
    helper.set_model_props(model, {METADATA: json.dumps(metadata, allow_nan=False)})
    onnx.checker.check_model(model)
    data = model.SerializeToString()
    wanted = [made] if isinstance(made, Tensor) else list(made)
    _compare(data, dict(zip(inputs, examples, strict=True)), wanted, path)
    write_atomically(path, lambda part: part.write_bytes(data))
    return path


def _compare(data: bytes, inputs: Mapping[str, Tensor], wanted: Sequence[Tensor], path: Path) -> None:
    """Raise `SimtestError` if a file does not compute what the network does."""
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    made = session.run(None, {name: values.numpy() for name, values in inputs.items()})
    for one, other in zip(made, wanted, strict=True):
        values = other.float().numpy()
        off = float(np.abs(one - values).max(initial=0) / max(1.0, float(np.abs(values).max(initial=0))))
        if not off <= LARGEST_DIFFERENCE:
            raise SimtestError(f"{path}: ONNX Runtime differs from PyTorch by {off:.2g} of the largest output")


def halved(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a model whose large weights are stored in half precision and cast to single at the start."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    casts = []
    for tensor in made.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if tensor.data_type == TensorProto.FLOAT and values.size >= LEAST_HALVED:
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(values.astype("float16"), f"{name}_half"))
            casts.append(helper.make_node("Cast", [f"{name}_half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *made.graph.node]
    del made.graph.node[:]
    made.graph.node.extend(nodes)
    onnx.checker.check_model(made)
    return made


LARGEST_STEP = 127


def in_eight_bits(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a model whose large weights are stored as integers of 8 bits, and made single at the start.

    Each output channel, the first axis, has a scale of its own: a weight moves by 0.4 % of the channel's largest at
    most.
    """
    made = onnx.ModelProto()
    made.CopyFrom(model)
    nodes, scales = [], []
    for tensor in made.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if tensor.data_type != TensorProto.FLOAT or values.size < LEAST_HALVED or values.ndim < 2:
            continue
        name, axes = tensor.name, tuple(range(1, values.ndim))
        scale = np.maximum(np.abs(values).max(axis=axes), 1e-12).astype(np.float32) / LARGEST_STEP
        steps = np.rint(values / scale.reshape(-1, *(1 for _ in axes))).astype(np.int8)
        tensor.CopyFrom(numpy_helper.from_array(steps, f"{name}_steps"))
        scales.append(numpy_helper.from_array(scale, f"{name}_scale"))
        nodes.append(helper.make_node("DequantizeLinear", [f"{name}_steps", f"{name}_scale"], [name], axis=0))
    nodes += made.graph.node
    del made.graph.node[:]
    made.graph.node.extend(nodes)
    made.graph.initializer.extend(scales)
    onnx.checker.check_model(made)
    return made
