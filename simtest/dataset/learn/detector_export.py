"""Writes a network of the task `highlight_instances` as ONNX, with its threshold and the range that it was taught."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Generator, nn

from simtest.calibration import srgb_decode
from simtest.calibration.calibration import brightest_channel
from simtest.dataset.learn.calibration import fitted_range
from simtest.dataset.learn.detector_frames import FULL, OUTSIDE, UNJUDGED
from simtest.dataset.learn.detector_moves import ZOOM, inputs_of, other_camera
from simtest.dataset.learn.onnx_export import MODEL, export
from simtest.dataset.learn.tasks import Batch
from simtest.detection.highlight_inputs import INPUTS, frame_statistics, highlight_inputs
from simtest.detection.judging import plateaus
from simtest.detection.learned_detector import FORMAT, MULTIPLE, RANGED, basins_of, highlights_of
from simtest.detection.light_split import split_light
from simtest.runtime.arrays import AnyArray, Array, Image

NEAR_PX = 1.5
"""A top within this distance of a highlight's pixels lies on it."""

MOST_FRAMES = 60
"""Frames of the train split, spread over it, from which the range of the features is taken."""

PASSES, COARSE = 5, 4
"""Moved pictures of each frame from which the range of the median light is taken, and the step between their pixels."""

RADII_PX = (1.0, 2.0, 4.0, 8.0)
"""Least radius of each class of highlights."""

LEAST_NEEDED = 20
"""Highlights of a class from which its F1 counts for the threshold."""

LOWEST = 0.1
"""Lower bumps are no highlights, whatever the threshold."""

UPPER = 2.576
"""Standard deviations of a Gaussian above which 0.5 % lie."""

SEED = 0
"""Of the moved frames from which the range is taken."""

Maps = Callable[[Image], Image]


def export_detector(network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> Path:
    """Write model.onnx into a folder and return its path; `about` goes into the file's metadata."""
    network = network.cpu().eval()
    step = -(-len(taught["state"]) // MOST_FRAMES)
    own = _seen(network, {name: values[::step] for name, values in taught.items()})
    others = _seen(network, judged)
    longer_side = max(taught["state"].shape[1:])
    # Frames of the dataset have one size; crops were resized in training.
    ends = np.array([[longer_side * zoom, median] for zoom in ZOOM for median in light_range(taught)])
    fitted = fitted_range(RANGED, ends, own, others)
    # Every second row is a frame as it is.
    fitted = replace(fitted, limit=usual_limit(fitted.distances(others[::2])))
    content = {
        "format": FORMAT,
        "least_top": least_top(lambda inputs: _run(network, inputs)[0], judged),
        **fitted.written(),
        "about": about,
    }
    network = network.to(memory_format=torch.contiguous_format)
    example = torch.zeros((1, len(INPUTS), 8 * MULTIPLE, 12 * MULTIPLE)).normal_(
        generator=Generator().manual_seed(SEED)
    )
    free = {2: "height", 3: "width"}
    return export(
        network, {"inputs": example}, ("outputs", "features"), {"inputs": free, "outputs": free}, content, out / MODEL
    )


def usual_limit(distances: Array) -> float:
    """Return the squared distance of features that 0.5 % of new frames would exceed, where its logarithm is Gaussian.

    The validation split has a few anatomies with some frames each: a quantile so high would be the largest of these.
    """
    logarithms = np.log(np.maximum(distances, 1e-9))
    spread = logarithms.std(ddof=1) if len(logarithms) > 1 else 0.0
    return float(np.exp(logarithms.mean() + UPPER * spread))


def light_range(taught: Batch) -> tuple[float, float]:
    """Return the ends of the logarithm of the median light in a few passes of the moved frames of the train split."""
    generator = Generator().manual_seed(SEED)
    reduced = (slice(None, None, COARSE), slice(None, None, COARSE))
    medians = []
    for picture, state in zip(taught["picture"].cpu().numpy(), taught["state"].cpu().numpy(), strict=True):
        random = np.random.default_rng(int(torch.randint(2**31, (1,), generator=generator)))
        for _ in range(PASSES):
            linear = srgb_decode(other_camera(picture[reduced], random))
            medians.append(frame_statistics(linear, state[reduced] != OUTSIDE, 1)[1])
    return min(medians), max(medians)


def _seen(network: nn.Module, batch: Batch) -> Array:
    """Return the features of frames as they are and as moved ones.

    Moved frames are resized as crops are in training: another camera shows the same tissue finer or coarser.
    """
    features = []
    generator = Generator().manual_seed(SEED)
    for picture, state in zip(batch["picture"].cpu().numpy(), batch["state"].cpu().numpy(), strict=True):
        random = np.random.default_rng(int(torch.randint(2**31, (1,), generator=generator)))
        plain = picture.astype(np.float32) / np.float32(FULL)
        for encoded, own in ((plain, state), _resized(other_camera(picture, random), state, random)):
            features.append(_run(network, inputs_of(encoded, own))[1])
    return np.array(features)


def _resized(encoded: Image, state: AnyArray, random: np.random.Generator) -> tuple[Image, AnyArray]:
    """Return a frame and its states magnified by a factor drawn from `ZOOM`."""
    factor = float(np.exp(random.uniform(*np.log(ZOOM))))
    size = (round(factor * state.shape[1]), round(factor * state.shape[0]))
    way = cv2.INTER_LINEAR if factor > 1 else cv2.INTER_AREA
    return cv2.resize(encoded, size, interpolation=way), cv2.resize(state, size, interpolation=cv2.INTER_NEAREST)


def _run(network: nn.Module, inputs: Image) -> tuple[Image, Array]:
    """Return both maps, in [0, 1], and the features of a frame."""
    height, width = inputs.shape[1:]
    padded = np.pad(inputs, ((0, 0), (0, -height % MULTIPLE), (0, -width % MULTIPLE)), mode="edge")
    with torch.no_grad():
        outputs, features = network(torch.from_numpy(padded[None]))
    return torch.sigmoid(outputs[0, :, :height, :width]).numpy(), features[0].double().numpy()


def least_top(maps: Maps, judged: Batch) -> float:
    """Return the least height of a bump's top with the largest mean of F1 over the radius classes (`best_threshold`).

    A peak on a highlight that need be found finds it, the one with the highest bump first; further
    ones and those on tissue are false; others do not count. A highlight's class is that of its own radius, a false
    peak's that of what was detected.

    Parameters
    ----------
    maps : callable
        Returns both maps of the network, in [0, 1], for inputs, shape (5, H, W).
    judged : dict of Tensor
        The frames of the validation split.
    """
    heights: list[float] = []
    right: list[bool] = []
    classes: list[int] = []
    needed = np.zeros(len(RADII_PX), dtype=np.int64)
    names = ("picture", "state", "region")
    for picture, state, region in zip(*(judged[name].cpu().numpy() for name in names), strict=True):
        own = region.astype(np.int64)
        of_region = _classes(np.bincount(np.abs(own).ravel()))
        needed += np.bincount(of_region[np.unique(own[own > 0])], minlength=len(RADII_PX))
        for height, finds, number in _judged_tops(*_peaks(maps, picture, state), own, state, of_region):
            heights.append(height)
            right.append(finds)
            classes.append(number)
    return best_threshold(np.array(heights), np.array(right, dtype=bool), np.array(classes, dtype=np.int64), needed)


def _classes(area_px: AnyArray) -> AnyArray:
    """Return the number of the radius class of each area; what is smaller than all belongs to the first."""
    return np.maximum(np.searchsorted(RADII_PX, np.sqrt(area_px / np.pi), side="right") - 1, 0)


def _peaks(maps: Maps, picture: AnyArray, state: AnyArray) -> tuple[AnyArray, Array, AnyArray]:
    """Return column and row of the peaks that a detector with the threshold `LOWEST` finds, their tops and classes."""
    encoded, seen = picture.astype(np.float32) / np.float32(FULL), state != OUTSIDE
    linear, clipped = srgb_decode(encoded), brightest_channel(encoded) >= 1
    light, full = split_light(linear, clipped, seen), plateaus(linear, clipped)
    pixels, bumps = maps(highlight_inputs(linear, clipped, light, seen))
    basins, tops = basins_of(pixels, bumps, light, full[0], seen)
    # What is left out later, such as pale tissue, must not raise the threshold.
    made = highlights_of(basins, tops >= LOWEST, light, linear, (clipped, *full), seen).highlights
    peaks = np.concatenate([each.peaks for each in made] or [np.empty((0, 2), dtype=np.int64)])
    areas = np.array([each.area_px / len(each.peaks) for each in made for _ in each.peaks], dtype=float)
    return peaks, tops[basins.labels[peaks[:, 1], peaks[:, 0]] - 1].astype(float), _classes(areas)


def _judged_tops(
    peaks: AnyArray, tops: Array, classes: AnyArray, region: AnyArray, state: AnyArray, of_region: AnyArray
) -> Iterator[tuple[float, bool, int]]:
    """Yield of each peak that counts, the highest first, its bump's height, whether it finds a highlight, its class."""
    from skimage.segmentation import expand_labels

    # Numbers must be above 0; those that need not be found come behind the others.
    many = int(np.abs(region).max(initial=0))
    around = expand_labels(np.where(region < 0, many - region, region), NEAR_PX)
    found: set[int] = set()
    for index in np.argsort(-tops, kind="stable"):
        at = int(peaks[index, 1]), int(peaks[index, 0])
        owner = int(around[at])
        if owner > many or (owner == 0 and state[at] in (UNJUDGED, OUTSIDE)):
            continue
        finds = 0 < owner not in found
        yield float(tops[index]), finds, int(of_region[owner] if finds else classes[index])
        found.add(owner)


def best_threshold(heights: Array, right: AnyArray, classes: AnyArray, needed: AnyArray) -> float:
    """Return the height from which on tops have the largest mean of F1 over classes; 0.5 where none is right.

    Classes with fewer than `LEAST_NEEDED` highlights do not count, unless all have fewer.

    Parameters
    ----------
    heights : ndarray, shape (N,)
        Of the bumps' tops.
    right : ndarray of bool, shape (N,)
        Which find a highlight.
    classes : ndarray of int, shape (N,)
        Numbers of their classes.
    needed : ndarray of int, shape (C,)
        Highlights that need be found, by class.
    """
    if not right.any():
        return 0.5
    order = np.argsort(-heights)
    counted = needed >= (LEAST_NEEDED if (needed >= LEAST_NEEDED).any() else 1)
    total = np.zeros(len(order))
    for number in np.flatnonzero(counted):
        mine = classes[order] == number
        total += 2 * np.cumsum(right[order] & mine) / (needed[number] + np.cumsum(mine))
    best = int(np.argmax(total))
    following = heights[order[best + 1]] if best + 1 < len(order) else 0.0
    return float(np.clip((heights[order[best]] + following) / 2, 0.01, 0.99))
