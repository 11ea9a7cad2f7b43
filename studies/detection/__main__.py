"""Detection of specularities on rendered colon and liver frames.

`python -m studies.detection`: 200 frames of anatomies that were not used for tuning, about 3 minutes of processor time.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.measuring import Figure, print_figures
from simtest.conventions import SPECULAR_DIFFUSE_RATIO, SPECULAR_PEAK_SHARE
from simtest.reconstruction import detect_in_picture
from studies.detection.frames import StudyFrame, study_frames
from studies.detection.scores import Scores, score
from studies.detection.truth import specular_truth

Mask = npt.NDArray[np.bool_]
Detector = Callable[[StudyFrame], Mask]

FRAMES = 200
SHARES = (SPECULAR_PEAK_SHARE, 0.05, 0.20)
F1, DICE = 0.90, 0.85


FAINT = "simtest, faint ones too"


def _ours(frame: StudyFrame) -> Mask:
    """Return the detected highlights that outshine the tissue somewhere, as those of this study's truth do.

    The detector also reports fainter ones, down to a quarter of the tissue's light, which tissue shows (theory.md
    7.1b); the truth of these frames has none below the tissue's light.
    """
    detection = detect_in_picture(frame.picture.astype(np.float32) / 255).detection
    light = detection.light
    assert light is not None
    _, labels = cv2.connectedComponents(detection.mask.astype(np.uint8), connectivity=8)
    outshine = detection.mask & (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue)
    return detection.mask & np.isin(labels, np.unique(labels[outshine]))


def _all_of_ours(frame: StudyFrame) -> Mask:
    return detect_in_picture(frame.picture.astype(np.float32) / 255).detection.mask


def figures(frames: int = FRAMES) -> list[Figure]:
    """Return the figures beside their limits."""
    detectors: dict[str, Detector] = {"simtest": _ours, FAINT: _all_of_ours}
    with tempfile.TemporaryDirectory() as folder:
        scores = _run("figures", frames, Path(folder), detectors, SHARES)
    shown = []
    for name in detectors:
        for part in ("all", "colon", "liver"):
            shown += _lines(name, part, scores[name, part, SHARES[0]], limit=name == "simtest" and part == "all")
    for share in SHARES[1:]:
        shown += _lines("simtest", f"all, peak share {share:g}", scores["simtest", "all", share])
    return shown


def _lines(name: str, part: str, scores: Scores, limit: bool = False) -> list[Figure]:
    about = f"precision {scores.precision:.3f}, recall {scores.recall:.3f}, Dice {scores.dice:.3f}"
    about += f"; {scores.hits + scores.missed} highlights"
    return [
        Figure(f"Dice, {name}, {part}", scores.dice, DICE if limit else None, True, ""),
        Figure(f"F1, {name}, {part}", scores.f1, F1 if limit else None, True, "", about),
    ]


def _run(
    split: str, count: int, folder: Path, detectors: dict[str, Detector], shares: tuple[float, ...]
) -> dict[tuple[str, str, float], Scores]:
    """Return the scores by detector, kind of anatomy or all, and share of the peak."""
    scores: dict[tuple[str, str, float], Scores] = {}
    for number, frame in enumerate(study_frames(split, count, folder), start=1):
        print(f"\r{split} frame {number} of {count}", end="", file=sys.stderr, flush=True)
        parts = (frame.specular, frame.other, frame.noise, frame.camera.seen)
        truths = {share: specular_truth(*parts, peak_share=share) for share in shares}
        for name, detector in detectors.items():
            mask = detector(frame)
            for share, truth in truths.items():
                if share != shares[0] and name != "simtest":
                    continue
                one = score(mask, truth)
                for part in ("all", frame.name.split("_")[0]):
                    scores[name, part, share] = scores.get((name, part, share), Scores()) + one
    print(file=sys.stderr)
    return scores


if __name__ == "__main__":
    sys.exit(print_figures(figures()))
