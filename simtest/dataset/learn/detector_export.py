"""Writes a network of the task `highlight_instances` as ONNX, with its threshold and the range that it was taught."""

from collections.abc import Iterator
from pathlib import Path

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

MOST_FRAMES = 48
"""Frames of the train split, spread over it, from which the range is taken."""

LOWEST = 0.1
"""Lower bumps are no highlights, whatever the threshold."""

SEED = 0
"""Of the moved frames from which the range is taken."""


def export_detector(network: nn.Module, taught: Batch, judged: Batch, out: Path, about: dict[str, str]) -> Path:
    """Write model.onnx into a folder and return its path; `about` goes into the file's metadata."""
    network = network.cpu().eval()
    step = -(-len(taught["state"]) // MOST_FRAMES)
    statistics, own = _seen(network, {name: values[::step] for name, values in taught.items()})
    _, others = _seen(network, judged)
    longer_side = max(taught["state"].shape[1:])
    # Frames of the dataset have one size; crops were resized in training.
    ends = np.array([[longer_side * zoom, median] for zoom in ZOOM for median in statistics[[0, -1], 1]])
    content = {
        "format": FORMAT,
        "least_top": least_top(network, judged),
        **fitted_range(RANGED, ends, own, others).written(),
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


def _seen(network: nn.Module, batch: Batch) -> tuple[Array, Array]:
    """Return the statistics, by rising median light, and the features of frames as they are and as moved ones."""
    statistics, features = [], []
    generator = Generator().manual_seed(SEED)
    for picture, state in zip(batch["picture"].cpu().numpy(), batch["state"].cpu().numpy(), strict=True):
        random = np.random.default_rng(int(torch.randint(2**31, (1,), generator=generator)))
        for encoded in (picture.astype(np.float32) / np.float32(FULL), other_camera(picture, random)):
            statistics.append(frame_statistics(srgb_decode(encoded), state != OUTSIDE, max(state.shape)))
            features.append(_run(network, inputs_of(encoded, state))[1])
    order = np.array(statistics)
    return order[np.argsort(order[:, 1])], np.array(features)


def _run(network: nn.Module, inputs: Image) -> tuple[Image, Array]:
    """Return both maps, in [0, 1], and the features of a frame."""
    height, width = inputs.shape[1:]
    padded = np.pad(inputs, ((0, 0), (0, -height % MULTIPLE), (0, -width % MULTIPLE)), mode="edge")
    with torch.no_grad():
        outputs, features = network(torch.from_numpy(padded[None]))
    return torch.sigmoid(outputs[0, :, :height, :width]).numpy(), features[0].double().numpy()


def least_top(network: nn.Module, judged: Batch) -> float:
    """Return the least height of a bump's top that gives the best F1 on frames.

    A peak on a highlight that need be found finds it, the one with the highest bump first; further
    ones and those on tissue are false; others do not count.
    """
    heights: list[float] = []
    right: list[bool] = []
    needed = 0
    names = ("picture", "state", "region")
    for picture, state, region in zip(*(judged[name].cpu().numpy() for name in names), strict=True):
        needed += len(np.unique(region[region > 0]))
        encoded, seen = picture.astype(np.float32) / np.float32(FULL), state != OUTSIDE
        linear, clipped = srgb_decode(encoded), brightest_channel(encoded) >= 1
        light, full = split_light(linear, clipped, seen), plateaus(linear, clipped)
        pixels, bumps = _run(network, highlight_inputs(linear, clipped, light, seen))[0]
        basins, tops = basins_of(pixels, bumps, light, full[0], seen)
        # What is left out later, such as pale tissue, must not raise the threshold.
        made = highlights_of(basins, tops >= LOWEST, light, linear, (clipped, *full), seen)
        peaks = np.concatenate([each.peaks for each in made.highlights] or [np.empty((0, 2), dtype=np.int64)])
        numbers = basins.labels[peaks[:, 1], peaks[:, 0]] - 1
        for height, found in _judged_tops(peaks, tops[numbers], region.astype(np.int64), state):
            heights.append(height)
            right.append(found)
    return best_threshold(np.array(heights), np.array(right, dtype=bool), needed)


def _judged_tops(peaks: AnyArray, tops: Image, region: AnyArray, state: AnyArray) -> Iterator[tuple[float, bool]]:
    """Yield the height of the bump of each peak that counts, the highest first, and whether it finds a highlight."""
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
        yield float(tops[index]), 0 < owner not in found
        found.add(owner)


def best_threshold(heights: Array, right: AnyArray, needed: int) -> float:
    """Return the height from which on tops have the best F1; 0.5 where none is right."""
    if not right.any():
        return 0.5
    order = np.argsort(-heights)
    hits = np.cumsum(right[order])
    best = int(np.argmax(2 * hits / (needed + np.arange(1, len(hits) + 1))))
    following = heights[order[best + 1]] if best + 1 < len(hits) else 0.0
    return float(np.clip((heights[order[best]] + following) / 2, 0.01, 0.99))
