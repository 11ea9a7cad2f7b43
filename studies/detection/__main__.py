"""Detection of specularities on rendered colon and liver frames.

`python -m studies.detection`: 200 frames of anatomies that were not used for tuning, about 3 minutes of processor time.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.measuring import print_markdown
from simtest.conventions import SPECULAR_DIFFUSE_RATIO
from simtest.reconstruction import detect_in_picture
from studies.detection.frames import StudyFrame, study_frames
from studies.detection.scores import Scores, score
from studies.detection.truth import specular_truth

Mask = npt.NDArray[np.bool_]

FRAMES = 200
F1, DICE = 0.90, 0.85
"""Least of both over all frames."""

ROWS = ("all", "colon", "liver", "all, faint ones too")


def _masks(frame: StudyFrame) -> tuple[Mask, Mask]:
    """Return the detected highlights that outshine the tissue somewhere, as those of this study's truth do, and all.

    The detector also reports fainter ones, down to a quarter of the tissue's light, which tissue shows (theory.md
    7.1b); the truth of these frames has none below the tissue's light.
    """
    detection = detect_in_picture(frame.picture.astype(np.float32) / 255).detection
    light = detection.light
    assert light is not None
    _, labels = cv2.connectedComponents(detection.mask.astype(np.uint8), connectivity=8)
    outshine = detection.mask & (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue)
    return detection.mask & np.isin(labels, np.unique(labels[outshine])), detection.mask


def measured(count: int = FRAMES) -> dict[str, Scores]:
    """Return the scores by row of the table."""
    scores = dict.fromkeys(ROWS, Scores())
    with tempfile.TemporaryDirectory() as folder:
        for number, frame in enumerate(study_frames("figures", count, Path(folder)), start=1):
            print(f"\rframe {number} of {count}", end="", file=sys.stderr, flush=True)
            truth = specular_truth(frame.specular, frame.other, frame.noise, frame.camera.seen)
            bright, every = (score(mask, truth) for mask in _masks(frame))
            for row, one in (("all", bright), (frame.name.split("_")[0], bright), (ROWS[-1], every)):
                scores[row] += one
    return scores


def main() -> int:
    """Print the table; return 1 where a limit is missed."""
    scores = measured()
    print_markdown([
        ["detector, frames", "F1", "precision", "recall", "Dice", "highlights"],
        *([f"simtest, {row}", *(f"{each:.3f}" for each in (own.f1, own.precision, own.recall, own.dice)),
           str(own.hits + own.missed)] for row, own in scores.items()),
    ])  # fmt: skip
    return int(scores["all"].f1 < F1 or scores["all"].dice < DICE)


if __name__ == "__main__":
    sys.exit(main())
