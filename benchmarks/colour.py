"""A colour frame of 1280 x 720 with 30 highlights: detection and all normals, against smoothing the frame."""

import statistics
import time
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.measuring import Figure
from benchmarks.timing import in_turns, times_in_turns
from simtest.calibration import Calibration, srgb_encode
from simtest.geometry import Camera
from simtest.reconstruction import Specularities, detect_in_picture, reconstruct
from simtest.reconstruction.options import default_estimators

WIDTH, HEIGHT, HIGHLIGHTS = 1280, 720, 30
MANY = 110
ROUNDS = 9
BLURS = 10
LIMIT_S, MANY_LIMIT_S = 0.5, 1.0


def frame() -> npt.NDArray[np.float32]:
    """Return a shaded, mottled tissue in a round view with 30 highlights of 2 to 9 px, 8 bits."""
    return _picture([(220 + 160 * (i % 6), 120 + 115 * (i // 6)) for i in range(HIGHLIGHTS)], (30, 25), 9)


def spotted(highlights: int) -> npt.NDArray[np.float32]:
    """Return the same tissue with another number of highlights, of 2 to 4 px, spread evenly over the view."""
    columns = int(np.ceil(np.sqrt(highlights * 1.6)))
    rows = -(-highlights // columns)
    across, down = 860 / columns, 540 / rows
    grid = [(210 + across * (i % columns + 0.5), 90 + down * (i // columns + 0.5)) for i in range(highlights)]
    return _picture(grid, (0.1 * across, 0.1 * down), 4)


def _picture(grid: list[tuple[float, float]], shift: tuple[float, float], widest: float) -> npt.NDArray[np.float32]:
    """Return tissue with a highlight near each position of a grid, px, shifted by up to `shift` along both axes."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    shading = 0.35 + 0.2 * np.sin(x / 170) * np.cos(y / 130)
    linear = shading[..., None] * np.array([0.55, 0.28, 0.22])
    for at_x, at_y in grid:
        column, row = at_x + rng.uniform(-shift[0], shift[0]), at_y + rng.uniform(-shift[1], shift[1])
        across, along = rng.uniform(2, widest, 2)
        spot = np.exp(-0.5 * (((x - column) / across) ** 2 + ((y - row) / max(along, across / 2)) ** 2))
        linear += rng.uniform(0.4, 1.2) * spot[..., None]
    linear += rng.normal(0, 0.004, linear.shape)
    linear[np.hypot(x - WIDTH / 2, y - HEIGHT / 2) > 560] = 0.002
    return (np.rint(255 * srgb_encode(np.clip(linear, 0, 1))) / 255).astype(np.float32)


def figures() -> list[Figure]:
    """Return the figures."""
    picture = frame()
    calibration = Calibration(Camera.from_fov(70.0, WIDTH, HEIGHT))
    names = default_estimators(calibration)

    def blurs() -> None:
        for _ in range(BLURS):
            cv2.GaussianBlur(picture, (0, 0), 2.0)

    found = by_colour(picture, calibration, names)
    times = in_turns(
        {
            "blurs": blurs,
            "detection": lambda: detect_in_picture(picture),
            "all": lambda: by_colour(picture, calibration, names),
        },
        ROUNDS,
    )
    about = ", ".join(f"{name} {1e3 * seconds:.0f} ms" for name, seconds in times.items())
    count = len(found)
    return [
        Figure(
            f"1280 x 720, {count} highlights, detection over {BLURS} blurs",
            times["detection"] / times["blurs"],
            4.0,
            about=about,
        ),
        Figure(f"1280 x 720, {count} highlights, all normals over {BLURS} blurs", times["all"] / times["blurs"], 8.0),
        Figure(f"1280 x 720, {count} highlights, all normals", times["all"], LIMIT_S, unit="s"),
        _many(calibration, names),
    ]


def by_colour(picture: npt.NDArray[np.float32], calibration: Calibration, names: Sequence[str]) -> Specularities:
    """Reconstruct an sRGB picture by its colours."""
    return reconstruct(picture, calibration, names, detector="colour", encoding="srgb")


def _many(calibration: Calibration, names: Sequence[str]) -> Figure:
    """Return the processor time of a frame with many highlights, warm, in one process."""
    picture = spotted(MANY)
    found = by_colour(picture, calibration, names)
    seconds = times_in_turns({"all": lambda: by_colour(picture, calibration, names)}, ROUNDS, time.process_time)
    own, count = statistics.median(seconds["all"]), len(found)
    return Figure(f"1280 x 720, {count} highlights, all normals, processor", own, MANY_LIMIT_S, unit="s")
