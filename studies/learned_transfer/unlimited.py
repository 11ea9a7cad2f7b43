"""Write a network that never refuses by its inner features, to measure what its refusals hide.

`python -m studies.learned_transfer.unlimited models/spots/model.onnx data/spots_unlimited.onnx`

A network taught on smooth surfaces refuses most highlights of tissue, so few errors of it can be seen. The written file
is for studies alone: what it answers outside its training is not calibrated. Ranges of lens and lights still hold.
"""

import json
import sys
from pathlib import Path

import onnx

from simtest.estimators.learned import METADATA

LIMIT = 1e12
"""Above the squared Mahalanobis distance of any features."""


def unlimited(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a network without the limit of its features."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    own = {prop.key: prop.value for prop in made.metadata_props}
    content = json.loads(own[METADATA]) | {"feature_limit": LIMIT}
    onnx.helper.set_model_props(made, own | {METADATA: json.dumps(content)})
    return made


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:3])
    onnx.save(unlimited(onnx.load(source)), target)
