"""Draw real and generated frames above each other, and crops of their highlights enlarged, to be looked at.

    python -m studies.realism_strip OUT.png REAL... --against SET...

Each SET is a dataset's folder, a folder of pictures or a scene. OUT holds pictures of the real frames: it stays where
they are.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.pages.pixels import png
from simtest.realism.compare import small
from simtest.realism.frames import NamedFrame, open_frames, open_generated
from simtest.realism.page import draw_strip
from simtest.runtime.arrays import Image, Picture
from simtest.runtime.files import write_atomically
from studies.realism_classifier import CROP_PX, crops

HEIGHT_PX, ENLARGED = 240, 3


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("real", nargs="+", type=Path)
    parser.add_argument("--against", nargs="+", required=True)
    parser.add_argument("--count", type=int, default=6, help="frames of each set")
    options = parser.parse_args()
    sets = {"real": _spread(open_frames(options.real), options.count)}
    for text in options.against:
        name = Path(text).name
        sets[name] = _spread(open_generated(text, options.count), options.count)
    rows, details = [], []
    for name, frames in sets.items():
        pictures = [(frame.name, picture) for frame in frames if (picture := _read(frame)) is not None]
        rows.append((name, [(title, small(picture, HEIGHT_PX)) for title, picture in pictures]))
        cut = [(title, _enlarged(crop)) for title, picture in pictures
               for crop in crops(small(picture, picture.shape[0]), 0)[:1]]  # fmt: skip
        if cut:
            details.append((f"{name}: highlights, {ENLARGED} x", cut))
    whole = [draw_strip(rows, HEIGHT_PX)] + ([draw_strip(details, CROP_PX * ENLARGED)] if details else [])
    width = max(part.shape[1] for part in whole)
    joined = np.vstack([np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in whole])
    write_atomically(options.out, lambda part: part.write_bytes(png(joined)))
    print(options.out)


def _spread(frames: Sequence[NamedFrame], count: int) -> list[NamedFrame]:
    return [frames[int(i)] for i in np.linspace(0, len(frames) - 1, min(count, len(frames)))]


def _read(frame: NamedFrame) -> Image | None:
    try:
        picture = frame.read()
    except InputError as error:
        print(f"left out: {error}")
        return None
    return picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)


def _enlarged(crop: Picture) -> Picture:
    """Return a crop whose pixels are squares of `ENLARGED` px."""
    size = (CROP_PX * ENLARGED, CROP_PX * ENLARGED)
    return np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_NEAREST), np.uint8)


if __name__ == "__main__":
    main()
