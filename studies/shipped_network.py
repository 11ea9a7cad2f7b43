"""Store a network's weights with half the digits, as the shipped file of `learned_spot` has them.

`python -m studies.shipped_network models/spots/model.onnx scenes/learning/weights/learned_spot.onnx`

The weights are the larger part of the wheel's room. Half precision has 11 bits, so a weight moves by 0.05 % at most;
what that changes is measured by `studies.learned_spots`, which takes the shipped file. Metadata, inputs and outputs
stay. The card beside the second file is made again from that file; what stands below its last heading, the figures on
unseen anatomies, is kept.
"""

import sys
from pathlib import Path

import onnx

from simtest.dataset.learn.model_card import write_card
from simtest.dataset.learn.onnx_export import halved


def main() -> None:
    """Read the first file named, write the second and its card."""
    source, target = map(Path, sys.argv[1:])
    onnx.save(halved(onnx.load(source)), target)
    print(write_card(target))


if __name__ == "__main__":
    main()
