"""Store a network's weights with fewer digits, as the shipped files have them.

`python -m studies.shipped_network models/spots/model.onnx scenes/learning/weights/learned_spot.onnx [--bits 8]`

The weights are the larger part of the wheel's room. Half precision has 11 bits, so a weight moves by 0.05 % at most;
what that changes is measured by `studies.learned_spots`, which takes the shipped file. With 8 bits a weight moves by
0.4 % of the largest of its channel at most. Metadata, inputs and outputs stay. The card beside the second file is made
again from that file; what stands below its last heading, the figures on unseen anatomies, is kept.
"""

import argparse
from pathlib import Path

import onnx

from simtest.dataset.learn.model_card import write_card
from simtest.dataset.learn.onnx_export import halved, in_eight_bits


def main() -> None:
    """Read the first file named, write the second and its card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--bits", type=int, choices=(8, 16), default=16)
    options = parser.parse_args()
    stored = {8: in_eight_bits, 16: halved}[options.bits]
    onnx.save(stored(onnx.load(options.source)), options.target)
    print(write_card(options.target))


if __name__ == "__main__":
    main()
