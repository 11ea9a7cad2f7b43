"""Frames moved at random for the training of a detector: other light, colour, sharpness and noise; crops, turned."""

import cv2
import numpy as np
import torch
from torch import Generator, Tensor

from simtest.calibration import srgb_decode, srgb_encode
from simtest.calibration.calibration import brightest_channel, mean_channel
from simtest.dataset.learn.detector_frames import FULL, HIGHLIGHT, OUTSIDE
from simtest.dataset.learn.tasks import Batch
from simtest.detection.highlight_inputs import highlight_inputs
from simtest.detection.light_split import split_light
from simtest.runtime.arrays import AnyArray, Image

CROP_PX, CROPS = 128, 3
"""Side of a crop, and crops of a frame in each pass."""

CHANNEL_GAIN, LIGHT_GAIN, GAMMA = 0.05, 0.5, 0.15
"""Logarithms: standard deviation of a channel's gain; largest gain of all light, and exponent of the encoded values."""

SATURATION = (0.75, 1.2)
"""Factor of the colours' distance from grey."""

BLUR_PX, SHARPENING, NOISE = 0.8, 0.8, 0.012
"""Largest blur, and amount of an unsharp mask of 1 px; largest noise, share of full scale, encoded."""

ZOOM = (0.8, 2.0)
"""Least and largest magnification of a crop; half of the crops have none."""

ON_HIGHLIGHT = 0.7
"""Share of the crops that hold a pixel of a highlight for sure."""


def inputs_of(encoded: Image, state: AnyArray) -> Image:
    """Return the inputs, shape (5, H, W), of an sRGB-encoded picture in [0, 1] with the view of its states."""
    seen = state != OUTSIDE
    linear, clipped = srgb_decode(encoded), brightest_channel(encoded) >= 1
    return highlight_inputs(linear, clipped, split_light(linear, clipped, seen), seen)


def plain_inputs(batch: Batch) -> Batch:
    """Return whole frames as inputs and targets."""
    pictures, states = batch["picture"].cpu().numpy(), batch["state"].cpu().numpy()
    pairs = zip(pictures, states, strict=True)
    made = [inputs_of(picture.astype(np.float32) / np.float32(FULL), state) for picture, state in pairs]
    return {
        "inputs": torch.from_numpy(np.stack(made)).to(batch["picture"].device),
        "state": batch["state"], "bump": batch["bump"],
    }  # fmt: skip


def moved_crops(batch: Batch, generator: Generator, crop_px: int = CROP_PX) -> Batch:
    """Return crops of frames, moved at random, as inputs and targets."""
    device = batch["picture"].device
    parts: list[tuple[AnyArray, ...]] = []
    for picture, state, bump in zip(*(batch[name].cpu().numpy() for name in ("picture", "state", "bump")), strict=True):
        random = np.random.default_rng(int(torch.randint(2**31, (1,), generator=generator)))
        inputs = inputs_of(other_camera(picture, random), state)
        parts += [_crop(inputs, state, bump, crop_px, random) for _ in range(CROPS)]
    names = ("inputs", "state", "bump")
    tensors: list[Tensor] = [torch.from_numpy(np.stack(each)) for each in zip(*parts, strict=True)]
    return {name: tensor.to(device) for name, tensor in zip(names, tensors, strict=True)}


def other_camera(picture: AnyArray, random: np.random.Generator) -> Image:
    """Return a picture as a slightly different camera would have encoded it; what is clipped stays so."""
    clipped = picture >= FULL
    linear = srgb_decode(picture.astype(np.float32) / np.float32(FULL))
    gains = np.exp(random.normal(0, CHANNEL_GAIN, 3) + random.uniform(-LIGHT_GAIN, LIGHT_GAIN)).astype(np.float32)
    encoded = srgb_encode(np.minimum(linear * gains, np.float32(1))) ** np.float32(
        np.exp(random.uniform(-GAMMA, GAMMA))
    )
    grey = mean_channel(encoded)[..., None]
    encoded = grey + np.float32(random.uniform(*SATURATION)) * (encoded - grey)
    encoded[clipped] = 1
    if random.random() < 0.5:
        encoded = cv2.GaussianBlur(encoded, (0, 0), random.uniform(0.2, BLUR_PX))
    else:
        soft = cv2.GaussianBlur(encoded, (0, 0), 1.0)
        encoded = encoded + np.float32(random.uniform(0, SHARPENING)) * (encoded - soft)
    encoded += random.uniform(0, NOISE) * random.standard_normal(encoded.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(FULL * encoded), 0, FULL) / FULL, dtype=np.float32)


def _crop(
    inputs: Image, state: AnyArray, bump: AnyArray, side: int, random: np.random.Generator
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Return a crop, resized in half of all cases, mirrored and turned by right angles."""
    height, width = state.shape
    zoom = 1.0 if random.random() < 0.5 else float(np.exp(random.uniform(*np.log(ZOOM))))
    own = min(round(side / zoom), height, width)
    y, x = int(random.integers(height - own + 1)), int(random.integers(width - own + 1))
    if random.random() < ON_HIGHLIGHT and (state == HIGHLIGHT).any():
        rows, columns = np.nonzero(state == HIGHLIGHT)
        middle = int(random.integers(len(rows)))
        y = int(np.clip(rows[middle] - random.integers(own), 0, height - own))
        x = int(np.clip(columns[middle] - random.integers(own), 0, width - own))
    window = np.s_[y : y + own, x : x + own]
    parts = [*inputs[:, *window], state[window], bump[window]]
    if own != side:
        smooth = cv2.INTER_LINEAR if own < side else cv2.INTER_AREA
        ways = [smooth] * len(inputs) + [cv2.INTER_NEAREST, smooth]
        parts = [cv2.resize(part, (side, side), interpolation=way) for part, way in zip(parts, ways, strict=True)]
    mirrored, turns = bool(random.integers(2)), int(random.integers(4))
    parts = [np.rot90(part[:, ::-1] if mirrored else part, turns) for part in parts]
    return np.stack(parts[:-2]), np.ascontiguousarray(parts[-2]), np.ascontiguousarray(parts[-1])
