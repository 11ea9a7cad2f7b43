"""Store a network's weights with fewer digits, as the shipped files have them.

`python -m studies.shipped_network models/spots/model.onnx scenes/learning/weights/learned_spot.onnx [--bits 8]
[--judged DATA]`

The weights are the larger part of the wheel's room. Half precision has 11 bits, so a weight moves by 0.05 % at most;
what that changes is measured by `studies.learned_spots`, which takes the shipped file. With 8 bits a weight moves by
0.4 % of the largest of its channel at most. Metadata, inputs and outputs stay. The card beside the second file is made
again from that file; what stands below its last heading, the figures on unseen anatomies, is kept. `--judged` fits the
threshold of a network that finds highlights anew, with the stored weights, on the validation split of a dataset.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import onnx

from simtest.dataset.learn.model_card import write_card
from simtest.dataset.learn.onnx_export import halved, in_eight_bits
from simtest.errors import InputError
from simtest.runtime.arrays import Image
from simtest.runtime.onnx_model import METADATA


def refit_threshold(path: Path, data: Path) -> tuple[float, float]:
    """Fit the threshold of a detector's file on the validation split of a dataset; return the old and the new one.

    Raises `InputError` if the file is no network that finds highlights, or the split is empty.
    """
    from simtest.dataset.learn.detector_export import least_top
    from simtest.dataset.learn.detector_task import HighlightInstances
    from simtest.detection.learned_detector import LearnedDetector

    detector = LearnedDetector(path)
    detector.check()
    judged = HighlightInstances().examples(data, "validation")
    if not len(judged["state"]):
        raise InputError(f"{data}: split validation holds no frame")

    def maps(inputs: Image) -> Image:
        return np.stack(detector.maps(inputs))

    model = onnx.load(path)
    content = json.loads({each.key: each.value for each in model.metadata_props}[METADATA])
    before, after = float(content["least_top"]), least_top(maps, judged)
    onnx.helper.set_model_props(model, {METADATA: json.dumps({**content, "least_top": after}, allow_nan=False)})
    onnx.save(model, path)
    return before, after


def main() -> None:
    """Read the first file named, write the second and its card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--bits", type=int, choices=(8, 16), default=16)
    parser.add_argument("--judged", type=Path)
    options = parser.parse_args()
    stored = {8: in_eight_bits, 16: halved}[options.bits]
    onnx.save(stored(onnx.load(options.source)), options.target)
    if options.judged:
        before, after = refit_threshold(options.target, options.judged)
        print(f"threshold {before:.3f}, with the stored weights {after:.3f}")
    print(write_card(options.target))


if __name__ == "__main__":
    main()
