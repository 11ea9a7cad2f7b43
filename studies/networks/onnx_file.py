"""Writes a network with its metadata as a checked ONNX file, and stores its weights with fewer digits.

The weights are the larger part of the wheel's room. Half precision has 11 bits, so a weight moves by 0.05 % at most.
With 8 bits each output channel, the first axis, has a scale of its own: a weight moves by 0.4 % of the channel's
largest at most. Both are made single at the start; metadata, inputs and outputs stay.
"""

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
from simtest.estimators.learned import METADATA
from simtest.runtime.files import JsonObject, write_atomically

OPSET = 17

LARGEST_DIFFERENCE = 1e-5
"""Difference of ONNX Runtime from PyTorch, as a share of an output's largest value, above which the file is wrong.

Rounding gives about 1e-6. Outputs whose largest value is below 1 are compared as they are.
"""

LEAST_STORED = 1000
"""Tensors with fewer values keep all their digits."""

LARGEST_STEP = 127


def export(
    network: nn.Module, inputs: Mapping[str, Tensor], outputs: Sequence[str], metadata: JsonObject, path: Path
) -> Path:
    """Write a network as an ONNX file; return its path.

    `network`: on the processor and in evaluation mode; its ``forward`` takes the inputs in their order and returns
    a tensor or a tuple of them; `inputs`: example inputs by name, whose first axis may have any length. The file is
    run on them and compared; `outputs`: names of the outputs; `metadata`: kept in the file under the key
    ``simtest``; holds ``format``; `path`: the file, replaced in one piece. Raises `SimtestError`: if ONNX Runtime's
    outputs are not those of PyTorch.
    """
    buffer = BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        # The exporter that PyTorch calls old: its successor needs the package onnxscript (10 MB with onnx_ir), takes
        # 5 s instead of 0.1 s for a small network, and writes the same layers.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, tuple(inputs.values()), buffer, input_names=list(inputs), output_names=list(outputs), dynamo=False,
            dynamic_axes={name: {0: "n"} for name in (*inputs, *outputs)}, opset_version=OPSET,
        )  # fmt: skip
        made = network(*inputs.values())
    model = onnx.load_from_string(buffer.getvalue())
    helper.set_model_props(model, {METADATA: json.dumps(metadata, allow_nan=False)})
    onnx.checker.check_model(model)
    data = model.SerializeToString()
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    found = session.run(None, {name: values.numpy() for name, values in inputs.items()})
    for one, other in zip(found, [made] if isinstance(made, Tensor) else made, strict=True):
        values = other.numpy()
        off = float(np.abs(one - values).max(initial=0) / max(1.0, float(np.abs(values).max(initial=0))))
        if not off <= LARGEST_DIFFERENCE:
            raise SimtestError(f"{path}: ONNX Runtime differs from PyTorch by {off:.2g} of the largest output")
    write_atomically(path, lambda part: part.write_bytes(data))
    return path


def stored(model: onnx.ModelProto, bits: int) -> onnx.ModelProto:
    """Return a copy of a model whose large weights are stored with 16 or 8 bits, or as it is with 32."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    nodes, scales = [], []
    for tensor in made.graph.initializer:
        values, name = numpy_helper.to_array(tensor), tensor.name
        if bits == 32 or tensor.data_type != TensorProto.FLOAT or values.size < LEAST_STORED:
            continue
        if bits == 16:
            tensor.CopyFrom(numpy_helper.from_array(values.astype("float16"), f"{name}_half"))
            nodes.append(helper.make_node("Cast", [f"{name}_half"], [name], to=TensorProto.FLOAT))
        elif values.ndim >= 2:
            largest = np.maximum(np.abs(values).max(axis=tuple(range(1, values.ndim))), 1e-12)
            scale = largest.astype(np.float32) / LARGEST_STEP
            steps = np.rint(values / scale.reshape(-1, *[1] * (values.ndim - 1))).astype(np.int8)
            tensor.CopyFrom(numpy_helper.from_array(steps, f"{name}_steps"))
            scales.append(numpy_helper.from_array(scale, f"{name}_scale"))
            nodes.append(helper.make_node("DequantizeLinear", [f"{name}_steps", f"{name}_scale"], [name], axis=0))
    nodes += made.graph.node
    del made.graph.node[:]
    made.graph.node.extend(nodes)
    made.graph.initializer.extend(scales)
    onnx.checker.check_model(made)
    return made
