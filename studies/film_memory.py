"""Measure the memory that `simtest reconstruct` takes for a short and for a long film of many highlights.

    python -m studies.film_memory [FRAMES]

Films of 20 and of FRAMES frames, by default 2,000, of 35 highlights that move are reconstructed, each by a process of
its own, and the peaks of their memory are printed. What a frame gave stands in its file alone, so the long film needs
its tracks more: 100 MB at most.
"""

import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.memory import run
from simtest.runtime.arrays import Picture

WIDTH, HEIGHT, COLUMNS, ROWS = 448, 320, 7, 5
SHORT, LONG = 20, 2000
LIMIT_MB = 100.0


def frame(number: int) -> Picture:
    """Return a frame of grey lobes on a grid that drifts to and fro, 8 bits, shape (H, W, 3)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    shift = 4 * np.sin(2 * np.pi * number / 200)
    light = np.full((HEIGHT, WIDTH), 0.1)
    for column in range(COLUMNS):
        for row in range(ROWS):
            centre = ((column + 0.5) * WIDTH / COLUMNS + shift, (row + 0.5) * HEIGHT / ROWS + shift)
            light += 0.7 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 6.0**2))
    return np.repeat(np.rint(255 * light.clip(0, 1)).astype(np.uint8)[:, :, None], 3, axis=2)


def peak_mb(frames: int, folder: Path) -> tuple[float, float]:
    """Return the peak of the memory for a film of so many frames, MB, and the mean number of highlights a frame."""
    film = folder / f"{frames}.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for number in range(frames):
        writer.write(frame(number))
    writer.release()
    out = folder / str(frames)
    used = run(["-m", "simtest", "reconstruct", str(film), "--fov", "60", "--detector", "peaks", "--out", str(out)])
    tracks = json.loads((out / "tracks.json").read_text(encoding="utf-8"))
    return 1e3 * used.peak_gb, sum(len(track["frames"]) for track in tracks) / frames


def main() -> None:
    """Print the peaks; exit 1 where the long film takes more than the limit above the short one."""
    long = int(sys.argv[1]) if len(sys.argv) > 1 else LONG
    with tempfile.TemporaryDirectory() as folder:
        (low, _), (high, highlights) = (peak_mb(frames, Path(folder)) for frames in (SHORT, long))
    print(
        f"{SHORT} frames: {low:.0f} MB; {long} frames of {highlights:.0f} highlights: {high:.0f} MB, {high - low:+.0f}"
    )
    sys.exit(1 if high - low > LIMIT_MB else 0)


if __name__ == "__main__":
    main()
