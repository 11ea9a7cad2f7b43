"""How PNG's settings trade time for size on the images of a dataset's sample; processor time of one core.

Those of the project's own writer (ISA-L) beside those of OpenCV (zlib).
"""

import itertools
import sys
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from isal import isal_zlib

from benchmarks.measuring import Figure, print_figures
from simtest.dataset import png
from simtest.dataset.fields import BY_NAME
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.spec import load_dataset

ROUNDS = 5
OWN_LEVELS = range(isal_zlib.ISAL_BEST_COMPRESSION + 1)
FILTERS = {"none": cv2.IMWRITE_PNG_FILTER_NONE, "up": cv2.IMWRITE_PNG_FILTER_UP, "all": cv2.IMWRITE_PNG_ALL_FILTERS}
STRATEGIES = {"default": cv2.IMWRITE_PNG_STRATEGY_DEFAULT, "Huffman": cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY}


def figures() -> list[Figure]:
    """Measure each image's own encoding, then the same pixels under each setting."""
    members = Maker(Plan(load_dataset("smooth", {"samples": 100}))).make(0).encode()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        made = []
        for name in ("image", "depth", "normal", "curvature"):
            pixels = png.decode(members[BY_NAME[name].suffix])
            made += [_own(name, pixels, rows, level) for rows in ("none", "up") for level in OWN_LEVELS]
            made += [_figure(name, pixels, level, kind, way) for level, kind, way in _settings()]
        return made
    finally:
        cv2.setNumThreads(threads)


def _settings() -> Iterator[tuple[int, str, str]]:
    return itertools.product((1, 3), FILTERS, STRATEGIES)


def _own(name: str, pixels: np.ndarray, rows: png.Filter, level: int) -> Figure:  # type: ignore[type-arg]
    data = png.encode(pixels, rows, level)
    encoding, decoding = _least(lambda: png.encode(pixels, rows, level)), _least(lambda: png.decode(data))
    about = f"{1e3 * decoding:.1f} ms to decode, {len(data) / 1e6:.3f} MB"
    return Figure(f"{name}: ISA-L level {level}, filter {rows}", 1e3 * encoding, unit="ms", about=about)


def _figure(name: str, pixels: np.ndarray, level: int, kind: str, way: str) -> Figure:  # type: ignore[type-arg]
    if pixels.ndim == 3:
        pixels = np.ascontiguousarray(pixels[:, :, ::-1])
    options = [cv2.IMWRITE_PNG_COMPRESSION, level, cv2.IMWRITE_PNG_FILTER, FILTERS[kind],
               cv2.IMWRITE_PNG_STRATEGY, STRATEGIES[way]]  # fmt: skip
    data = cv2.imencode(".png", pixels, options)[1]
    encoding = _least(lambda: cv2.imencode(".png", pixels, options))
    decoding = _least(lambda: cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    about = f"{1e3 * decoding:.1f} ms to decode, {len(data) / 1e6:.3f} MB"
    return Figure(f"{name}: OpenCV level {level}, filter {kind}, {way}", 1e3 * encoding, unit="ms", about=about)


def _least(function: Callable[[], object]) -> float:
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


if __name__ == "__main__":
    sys.exit(print_figures(figures()))
