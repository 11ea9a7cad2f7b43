"""Draw docs/images/detection.jpg: rendered frames with their true masks and what is detected.

python -m studies.detection.figure FIGURE
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from simtest.reconstruction import detect_in_picture
from studies.detection.frames import StudyFrame, study_frames
from studies.detection.truth import specular_truth

SHOWN = (0, 3, 8, 11)
FRAMES = 12
TRUE, ISOLATED, OTHER = (255, 220, 0), (0, 255, 0), (0, 140, 255)


def panel(frame: StudyFrame) -> np.ndarray:
    """Return the frame, and beside it the same with outlines."""
    truth = specular_truth(frame.specular, frame.other, frame.noise, frame.camera.seen)
    found = detect_in_picture(frame.picture.astype(np.float32) / 255).detection
    plain = np.ascontiguousarray(frame.picture[:, :, ::-1])
    drawn = plain.copy()
    for highlight in found.highlights:
        colour = ISOLATED if highlight.is_isolated else OTHER
        if len(highlight.outline):
            cv2.polylines(drawn, [np.rint(highlight.outline - 0.5).astype(np.int32)], True, colour, 4)
    # On top, and thinner, so that both outlines show.
    contours, _ = cv2.findContours(truth.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, TRUE, 1)
    return np.hstack([plain, drawn])


def main(path: Path) -> None:
    """Draw the figure."""
    with tempfile.TemporaryDirectory() as folder:
        frames = study_frames("figures", FRAMES, Path(folder))
        panels = [panel(frame) for number, frame in enumerate(frames) if number in SHOWN]
    rows = np.vstack([np.hstack(panels[i : i + 2]) for i in range(0, len(panels), 2)])
    cv2.imwrite(str(path), cv2.resize(rows, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
