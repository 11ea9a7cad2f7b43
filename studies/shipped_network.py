"""Store a network's weights with half the digits, as the shipped file of `learned_spot` has them.

`python -m studies.shipped_network models/spots/model.onnx scenes/learning/weights/learned_spot.onnx`

The weights are the larger part of the wheel's room. Half precision has 11 bits, so a weight moves by 0.05 % at most;
what that changes is measured by `studies.learned_spots`, which takes the shipped file. Metadata, inputs and outputs
stay.
"""

import sys

import onnx
from onnx import TensorProto, helper, numpy_helper

LEAST_VALUES = 1000
"""Smaller tensors keep all their digits."""


def halved(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a model whose large weights are stored in half precision and cast to single at the start."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    casts = []
    for tensor in made.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if tensor.data_type == TensorProto.FLOAT and values.size >= LEAST_VALUES:
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(values.astype("float16"), f"{name}_half"))
            casts.append(helper.make_node("Cast", [f"{name}_half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *made.graph.node]
    del made.graph.node[:]
    made.graph.node.extend(nodes)
    onnx.checker.check_model(made)
    return made


def main() -> None:
    """Read the first file named, write the second."""
    source, target = sys.argv[1:]
    onnx.save(halved(onnx.load(source)), target)


if __name__ == "__main__":
    main()
