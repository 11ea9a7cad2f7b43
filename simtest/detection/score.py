"""How sure it is that a detection is a highlight: a score in [0, 1] of what its patch shows, and no probability.

The light of a lobe depends on the misfit alone, so that it falls alike all around one ellipse. It stands alone on its
ground, has a round top, and is among the brightest of the frame. The maximum of a body's shading has a side towards the
terminator that is steeper than the others, and a dark one beyond; a pale place in a texture has others beside it.
"""

import math
from collections.abc import Sequence

import numpy as np

from simtest.calibration import Frame
from simtest.calibration.calibration import mean_channel
from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure
from simtest.geometry import Patch
from simtest.runtime.arrays import Array, Image
from simtest.runtime.fitted import fitted_number

NAMES = ("uneven", "ground", "bright", "flat", "clipped")
"""Of what a score is made of, in the order of `features`; fitted.toml says what each is."""

BIAS, LEAST_SCORE = fitted_number("score.bias"), fitted_number("score.least")
WEIGHTS = np.array(
    [
        fitted_number("score.uneven"), fitted_number("score.ground"), fitted_number("score.bright"),
        fitted_number("score.flat"), fitted_number("score.clipped"),
    ]
)  # fmt: skip

MOST_SIDE = 40
"""Of a larger patch every n-th pixel is looked at, so that about so many remain along its longer side."""

CENTRE, CONTOUR, AROUND = (0.0, 0.35), (0.8, 1.2), (1.4, 2.0)
"""Rings about a highlight, over the radius of its ellipse at half height."""

FLAT_ISOVALUE = 0.75
RESOLVED = 2.5
"""Radius over the smoothing from which a highlight has a shape of its own."""

LEAST_SHARE, MOST_CLIPPED = 0.01, 0.3
"""What is added to spreads, as shares of a rise, as less is noise; and the clipped share that says all."""


def highlight_scores(patches: Sequence[Patch | Failure], frame: Frame) -> list[float | None]:
    """Return how sure it is that each patch of a frame holds a highlight, in [0, 1]; None if it is too small.

    Detectors and estimators do not count, so that the score does not depend on which of them ran.
    """
    return [
        None if found is None else 1 / (1 + math.exp(-float(np.clip(BIAS + WEIGHTS @ found, -30, 30))))
        for found in features(patches, frame)
    ]


def features(patches: Sequence[Patch | Failure], frame: Frame) -> list[Array | None]:
    """Return what each score is made of, shape (5,), in the order of `NAMES`; None where a patch shows too little."""
    channels, seen = frame.channels, frame.seen
    total, brightest = mean_channel(channels), float((channels if seen is None else channels[seen]).max(initial=0.0))
    # Of a colour frame's patch, which holds the specular part alone, all light counts.
    of = None if frame.light is None else total
    return [None if isinstance(each, Failure) else _features(each, total, of, brightest) for each in patches]


def _features(patch: Patch, total: Image, of: Image | None, brightest: float) -> Array | None:
    """Return the features of a patch: `total` is all light of its frame, `of` what it is seen in, if not in itself."""
    step = max(1, round(max(patch.values.shape) / MOST_SIDE))
    values = np.asarray(patch.values[::step, ::step], dtype=float)
    inside = patch.inside(HIGHLIGHT_ISOVALUE, cut=True)
    thin = inside[::step, ::step]
    rows, columns = np.nonzero(thin)
    if len(rows) < 4 or min(values.shape) < 3:
        return None
    # pixels by the radius of the ellipse at half height that they lie on
    x0, y0 = float(columns.mean()), float(rows.mean())
    x, y = columns - x0, rows - y0
    xx, xy, yy = x @ x / len(x) + 1 / 12, x @ y / len(x), y @ y / len(x) + 1 / 12
    height, width = values.shape
    across, down = np.arange(width) - x0, (np.arange(height) - y0)[:, None]
    square = (yy * across**2 - 2 * xy * across * down + xx * down**2) / (4 * (xx * yy - xy * xy))
    if patch.seen is not None:
        square[~patch.seen[::step, ::step]] = np.inf
    centre, contour, around = (
        (square >= low * low) & (square < high * high) for low, high in (CENTRE, CONTOUR, AROUND)
    )
    if not (contour.any() and around.any()):
        return None
    (left, top), (h, w) = patch.origin_px, patch.values.shape
    crop = np.s_[top : top + h : step, left : left + w : step]
    brightness = float(total[crop][thin].max()) / max(brightest, 1e-12)
    light = values if of is None else of[crop]
    ring = light[around]
    peak = float(light[centre].mean() if centre.any() else light[thin].max())
    ranked = np.sort(ring)
    ground = float(ranked[(len(ranked) - 1) // 2] + ranked[len(ranked) // 2]) / 2  # the median, without masked arrays
    rise = max(peak - ground, LEAST_SHARE * peak, 1e-12)
    # how evenly light falls where it has fallen to half: on an ellipse x . grad I is one number
    by_row, by_column = np.gradient(values)
    falls = -(by_column * across + by_row * down)[contour]
    uneven = float(falls.std()) / max(float(falls.mean()), LEAST_SHARE * patch.peak_value)
    area = int(np.count_nonzero(inside))
    radius = math.sqrt(area / math.pi) / max(patch.smoothing_px, 0.5)
    resolved = 1 - math.exp(-((radius / RESOLVED) ** 2))
    clipped = 0.0 if patch.saturated is None else float(patch.saturated[inside].mean())
    return np.array(
        [
            resolved * (min(math.log(uneven + LEAST_SHARE), 0.5) + 2),
            min(math.log(float(ring.std()) / rise + LEAST_SHARE), 0.5),
            min(max(brightness, 0.0), 1.0),
            np.count_nonzero(patch.inside(FLAT_ISOVALUE, cut=True)) / area,
            min(clipped, MOST_CLIPPED),
        ]
    )
