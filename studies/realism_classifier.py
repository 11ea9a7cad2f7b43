"""How well a small classifier tells real crops from generated ones, scenes held out.

Print the table of docs/howto/realism.md, section "A classifier":

    python -m studies.realism_classifier REAL... --against FOLDER...

Each FOLDER is a dataset or holds pictures; each is compared with the real frames apart. Both sides go the same way: all
frames are reduced to the height of the lowest one (none is enlarged) and coded once as JPEG 75, 4:2:0, so that neither
size nor the grid of an earlier coding tells them apart. Crops of 64 px are cut around highlights, with seeded shifts.

Features are moments of CIELAB colours, and of the luma: energy and kurtosis of band-passed crops, gradients, quantiles,
local binary patterns, the share that is clipped. The classifier is a logistic regression with a ridge. Each pair of a
real and a generated scene is left out in turn: trained without both, their crops give one area under the curve (AUC).
Stated is the mean over all pairs, with a 95 % interval by bootstrap over the scenes of both sides. Controls: halves of
one set, split by scenes; stated are the mean over several splits, and the least and the greatest.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from simtest.calibration import Calibration, Frame, Response
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection.colour import ColourDetector
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.realism.frames import NamedFrame, open_frames, open_generated
from simtest.runtime.arrays import Array, Image, Picture
from simtest.runtime.seeds import from_integer

CROP_PX, SHIFT_PX, CROPS = 64, 8, 24
"""Side of a crop, greatest shift of its centre from the highlight, and crops of a frame at most."""

LEAST_PX = 2
"""Pixels above half height of a highlight that is cropped: one pixel alone is a shoulder of another highlight."""

JPEG_QUALITY = 75
RIDGE = 1.0
SPLITS, RESAMPLES = 10, 2000
COLOURS = 9
"""Of the features, the first so many are of colour."""

Scenes = dict[str, Array]
"""Features of the crops by scene, shape (crops, features)."""


def main() -> None:
    """Print a row for each set, then the controls."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("real", nargs="+", type=Path)
    parser.add_argument("--against", nargs="+", required=True)
    parser.add_argument("--frames", type=int, default=48, help="generated frames that are taken, at most")
    options = parser.parse_args()
    sets = {"real": open_frames(options.real)}
    sets |= {Path(folder).name: open_generated(folder, options.frames) for folder in options.against}
    height = min(_height(frame) for frames in sets.values() for frame in frames)
    print(f"all frames reduced to {height} rows, JPEG {JPEG_QUALITY}, crops of {CROP_PX} px")
    held = {name: crops_of(frames, height) for name, frames in sets.items()}
    for name, scenes in held.items():
        print(f"{name}: {len(scenes)} scenes, {sum(map(len, scenes.values()))} crops")
    print("| set | AUC, all features | AUC, without colour |\n|---|---|---|")
    for name in list(held)[1:]:
        cells = [_cell(*separation(held["real"], held[name], first)) for first in (0, COLOURS)]
        print(f"| real against {name} | " + " | ".join(cells) + " |")
    for name, scenes in held.items():
        cells = [_cell(*control(scenes, first)) for first in (0, COLOURS)]
        print(f"| control: {name}, halves | " + " | ".join(cells) + " |")


def _height(frame: NamedFrame) -> int:
    try:
        return frame.read().shape[0]
    except InputError:
        # Left out, and said so, when crops are cut.
        return 1 << 30


def _cell(value: float, low: float, high: float) -> str:
    return f"{value:.2f} ({low:.2f} to {high:.2f})"


# Crops and features ---------------------------------------------------------------------------------------------------


def crops_of(frames: Sequence[NamedFrame], height: int) -> Scenes:
    """Return the features of the crops of all frames, by scene; scenes without a crop are named and left out."""
    found: dict[str, list[Array]] = {frame.scene: [] for frame in frames}
    for number, frame in enumerate(frames):
        try:
            picture = same_way(frame.read(), height)
        except InputError as error:
            print(f"left out: {frame.name}: {error}")
            continue
        found[frame.scene] += [features(crop) for crop in crops(picture, number)]
    if bare := [scene for scene, rows in found.items() if not rows]:
        print(f"left out, no crop with a highlight: {', '.join(bare)}")
    return {scene: np.stack(rows) for scene, rows in found.items() if rows}


def same_way(picture: Image, height: int) -> Picture:
    """Reduce a frame to a height and code it as JPEG; RGB as bytes."""
    share = height / picture.shape[0]
    reduced = picture if share == 1 else cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    values = np.rint(255 * np.clip(reduced, 0, 1)).astype(np.uint8)
    data = cv2.imencode(".jpg", values[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def crops(picture: Picture, seed: int) -> list[Picture]:
    """Cut crops around a frame's highlights, at most `CROPS`, each from inside the view."""
    height, width = picture.shape[:2]
    values = picture.astype(np.float32) / np.float32(255)
    calibration = Calibration(Camera.from_fov(60.0, width, height), response=Response("srgb"), saturation_level=1.0)
    found = ColourDetector(isolated=False).detect(Frame(values, calibration, DEFAULT_SMOOTHING_PX), calibration.camera)
    assert found.view is not None
    seen = np.ones((height, width), bool) if found.view.seen is None else found.view.seen
    rng, cut = from_integer(seed), []
    shown = [highlight for highlight in found.highlights if highlight.area_px >= LEAST_PX]
    for i in rng.permutation(len(shown)):
        x, y = np.array(shown[i].region.peak) + rng.integers(-SHIFT_PX, SHIFT_PX + 1, 2) - CROP_PX // 2
        inside = 0 <= x <= width - CROP_PX and 0 <= y <= height - CROP_PX
        if inside and seen[y : y + CROP_PX, x : x + CROP_PX].all():
            cut.append(picture[y : y + CROP_PX, x : x + CROP_PX])
        if len(cut) == CROPS:
            break
    return cut


def features(crop: Picture) -> Array:
    """Return a crop's features: `COLOURS` of colour, then those of the luma."""
    values = crop.astype(np.float32) / np.float32(255)
    lab = cv2.cvtColor(values, cv2.COLOR_RGB2Lab).reshape(-1, 3).astype(float)
    centred = lab - lab.mean(axis=0)
    spread = lab.std(axis=0)
    skew = (centred**3).mean(axis=0) / (spread + 1e-3) ** 3
    luma = cv2.cvtColor(values, cv2.COLOR_RGB2GRAY)
    bands = []
    for sigma in (0.7, 1.4, 2.8, 5.6):
        band = cv2.GaussianBlur(luma, (0, 0), sigma) - cv2.GaussianBlur(luma, (0, 0), 2 * sigma)
        power = float(np.mean(band**2)) + 1e-9
        third, fourth = (float(np.mean(band**n)) / power ** (n / 2) for n in (3, 4))
        bands += [np.log(power), third, np.log(fourth + 1e-3)]
    across, down = cv2.Sobel(luma, cv2.CV_32F, 1, 0), cv2.Sobel(luma, cv2.CV_32F, 0, 1)
    slopes = np.log(np.quantile(np.hypot(across, down), [0.1, 0.25, 0.5, 0.75, 0.9, 0.99]) + 1e-4)
    levels = np.quantile(luma, [0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98])
    clipped = [float((values.max(axis=2) >= level).mean()) for level in (0.8, 0.9, 0.98)]
    return np.concatenate([lab.mean(axis=0), spread, skew, bands, slopes, levels, clipped, patterns(luma)])


def patterns(luma: Image) -> Array:
    """Return the histogram of uniform local binary patterns of eight neighbours, at distances of 1 and 2 px."""
    found = []
    for reach in (1, 2):
        ring = [(-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1)]
        centre = luma[reach:-reach, reach:-reach]
        above = np.stack([np.roll(luma, (-reach * r, -reach * c), (0, 1))[reach:-reach, reach:-reach] >= centre
                          for r, c in ring])  # fmt: skip
        changes = (above != np.roll(above, 1, axis=0)).sum(axis=0)
        # Patterns of one run are named by its length, all others are one.
        code = np.where(changes <= 2, above.sum(axis=0), 9)
        found.append(np.bincount(code.ravel(), minlength=10) / code.size)
    return np.concatenate(found)


# Classifier -----------------------------------------------------------------------------------------------------------


def separation(real: Scenes, generated: Scenes, first: int = 0) -> tuple[float, float, float]:
    """Return the AUC of two sets by the features from `first` on, with its interval over scenes."""
    areas = _areas(real, generated, first)
    rng = from_integer(1)
    drawn = [areas[np.ix_(*(rng.integers(n, size=n) for n in areas.shape))].mean() for _ in range(RESAMPLES)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(areas.mean()), float(low), float(high)


def control(scenes: Scenes, first: int = 0) -> tuple[float, float, float]:
    """Return the mean AUC of halves of one set over several splits by scenes, and the least and greatest of them."""
    names, rng, found = list(scenes), from_integer(2), []
    for _ in range(SPLITS):
        order = [names[i] for i in rng.permutation(len(names))]
        halves = [{name: scenes[name] for name in order[k::2]} for k in (0, 1)]
        found.append(float(_areas(halves[0], halves[1], first).mean()))
    return float(np.mean(found)), min(found), max(found)


def _areas(real: Scenes, generated: Scenes, first: int) -> Array:
    """Return the AUC of each pair of a real and a generated scene that is left out, shape (real, generated)."""
    sides = [[rows[:, first:] for rows in side.values()] for side in (real, generated)]
    return np.array([[_pair(sides, i, j) for j in range(len(sides[1]))] for i in range(len(sides[0]))])


def _pair(sides: list[list[Array]], i: int, j: int) -> float:
    """Return the AUC of a real and a generated scene under a classifier that saw neither."""
    kept = [[rows for k, rows in enumerate(side) if k != out] for side, out in zip(sides, (i, j), strict=True)]
    if not all(kept):
        return np.nan
    rows = np.concatenate([each for side in kept for each in side])
    # Each scene has the same weight, and so has each side.
    weights = np.concatenate([np.full(len(each), 1 / len(each) / len(side)) for side in kept for each in side])
    labels = np.concatenate([np.full(sum(map(len, side)), k) for k, side in enumerate(kept)])
    centre, spread = rows.mean(axis=0), rows.std(axis=0) + 1e-6
    slope = fitted((rows - centre) / spread, labels, weights * len(rows) / weights.sum())
    scores = [((side[out] - centre) / spread) @ slope for side, out in zip(sides, (i, j), strict=True)]
    return auc(scores[0], scores[1])


def fitted(rows: Array, labels: Array, weights: Array) -> Array:
    """Return the coefficients of a logistic regression with a ridge, without its constant, by minimisation."""
    inputs = np.column_stack([rows, np.ones(len(rows))])
    ridge = np.append(np.full(rows.shape[1], RIDGE), 0.0)
    signs = 2 * labels - 1

    def loss(theta: Array) -> float:
        return float(weights @ np.logaddexp(0, -signs * (inputs @ theta)) + 0.5 * ridge @ theta**2)

    def slope(theta: Array) -> Array:
        return inputs.T @ (weights * (expit(inputs @ theta) - labels)) + ridge * theta

    return np.asarray(minimize(loss, np.zeros(len(ridge)), jac=slope, method="BFGS", options={"gtol": 1e-6}).x[:-1])


def auc(low: Array, high: Array) -> float:
    """Return the share of pairs whose second score is the higher one, ties half."""
    ordered = np.sort(low)
    below, upto = (np.searchsorted(ordered, high, side=side) for side in ("left", "right"))
    return float((below + upto).mean() / 2 / len(low))


if __name__ == "__main__":
    main()
