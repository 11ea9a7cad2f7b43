"""`learned_detector`: highlights that a trained network finds and separates, run by ONNX Runtime, without PyTorch."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.detection.basins import Basins, find_basins, given_basins
from simtest.detection.colour import NOISE_LEFT, SMOOTHING_PX, colour_spots
from simtest.detection.detector import Detection
from simtest.detection.highlight_inputs import frame_statistics, highlight_inputs
from simtest.detection.judging import ColourDetection, detection_of, judge_spots, plateaus, tissue_spots
from simtest.detection.light_split import SplitLight, split_light
from simtest.detection.spots import SADDLE, SADDLE_NOISE, rise_of_clipped, spots_of
from simtest.detection.view_mask import view_of
from simtest.errors import Failure, Reason
from simtest.geometry import Camera, Image, Mask, smooth
from simtest.runtime.onnx_model import OnnxModel
from simtest.runtime.resources import data_root
from simtest.runtime.training_range import TrainingRange

FORMAT = "simtest highlight_instances, version 1"

SHIPPED = ("learning", "weights", "learned_detector.onnx")
"""Below the shipped scenes; its card lies beside it."""

MULTIPLE = 8
"""Height and width of what the network sees are multiples of this."""

RANGED = ("longer side, px", "logarithm of the median light")
"""Statistics of a frame, as the network sees it, whose range is checked."""

PIXEL = 0.3
"""A pixel may be a highlight's where the network gives it at least this probability."""

LEAST_VALUE = 1e-4
"""Least specular light of a spot, share of full scale: the split by colour may find none where the network does."""


@dataclass(frozen=True)
class LearnedDetector:
    """A network of the task ``highlight_instances`` (`simtest train`) as a detector.

    The network gives each pixel's probability of being a highlight's, and a map with a bump in the middle of each
    highlight. Specular light is climbed on the pixels that may be a highlight's: saddles tell highlights apart as the
    definition of a visible highlight does (theory.md 7.1b). A summit's basin is a highlight where a bump rises in it.
    Light is split and highlights are classified as `colour` does it; estimators see the specular light alone.

    The detector refuses (`Detection.refusal`) frames without colour, of a size or brightness outside the training's
    range, or whose features lie far from those of the train split.

    Parameters
    ----------
    model : Path, optional
        The network, ``model.onnx`` of a training; default the shipped one. It is read at the first use.
    isolated : bool
        Leave out highlights of kinds that carry no single normal, but for clusters.
    """

    model: Path | None = None
    isolated: bool = True

    def with_model(self, model: Path) -> "LearnedDetector":
        """Return the same detector with another network, which is read at once; raise `InputError` if it is none."""
        made = replace(self, model=model)
        made.check()
        return made

    def check(self) -> None:
        """Read the network; raise `InputError` if onnxruntime is missing or the file is no network of this task."""
        _ = self._network

    @cached_property
    def _network(self) -> "_Network":
        return _Network(self.model or data_root("scenes").joinpath(*SHIPPED))

    def detect(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> Detection:
        """Find the highlights of a frame (see `simtest.detection.Detector`)."""
        if frame.encoded.ndim != 3 or frame.encoded.shape[2] != 3:
            told = f"outside the network's training: a frame of shape {frame.encoded.shape} without three channels"
            return Detection((), frame, refusal=Failure(Reason.NO_ESTIMATE, told))
        view = view_of(frame)
        found = self.find(frame.channels, frame.clipped, view.seen)
        if isinstance(found, Failure):
            return Detection((), replace(frame, seen=view.seen), view=view, refusal=found)
        return detection_of(found, frame, view, self.isolated)

    def find(self, linear: Image, clipped: Mask, seen: Mask | None = None) -> ColourDetection | Failure:
        """Find the highlights of linear values, shape (H, W, 3), share of full scale, or say why they are refused.

        `clipped`, shape (H, W), is where a channel is clipped, `seen` the pixels inside the view, default all.
        """
        return self._network.detect(linear, clipped, seen)

    def maps(self, inputs: Image) -> tuple[Image, Image]:
        """Return both maps of the network, in [0, 1], shape (H, W), for the inputs of a frame (`highlight_inputs`)."""
        return self._network.maps(inputs)[:2]


class _Network:
    """The network with its threshold and the range that it was taught."""

    def __init__(self, path: Path) -> None:
        self._model = OnnxModel(path, FORMAT, "learned_detector")
        with self._model.reading():
            content = self._model.content
            self._least_top = float(content["least_top"])
            if not 0 < self._least_top < 1:
                raise ValueError(f"least_top = {self._least_top:g}: must be in (0, 1)")
            self._range = TrainingRange.read(content, RANGED)
            if not self._range.high[RANGED[0]] >= MULTIPLE:
                raise ValueError(f"{RANGED[0]} reaches {self._range.high[RANGED[0]]:g}; must be {MULTIPLE} at least")

    def detect(self, linear: Image, clipped: Mask, seen: Mask | None) -> ColourDetection | Failure:
        """Find the highlights of a frame (see `LearnedDetector.find`)."""
        light = split_light(linear, clipped, seen)
        inputs = highlight_inputs(linear, clipped, light, seen)
        pixels, bumps, features, seen_size = self.maps(inputs)
        statistics = dict(zip(RANGED, frame_statistics(linear, seen, seen_size), strict=True))
        refusal = self._range.refusal(statistics) or self._range.refusals(features)[0]
        if refusal is not None:
            return refusal
        full = plateaus(linear, clipped)
        basins, tops = basins_of(pixels, bumps, light, full[0], seen)
        return highlights_of(basins, tops >= self._least_top, light, linear, (clipped, *full), seen)

    def maps(self, inputs: Image) -> tuple[Image, Image, Image, int]:
        """Return both maps of probabilities at full size, the features, and the longer side as seen, px."""
        height, width = inputs.shape[1:]
        # A large frame is seen reduced by the least whole factor that fits the training.
        factor = max(int(np.ceil(max(height, width) / self._range.high[RANGED[0]])), 1)
        size = (-(-width // factor), -(-height // factor))
        if factor > 1:
            inputs = np.stack([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in inputs])
        below, right = (-side % MULTIPLE for side in (size[1], size[0]))
        padded = np.pad(inputs, ((0, 0), (0, below), (0, right)), mode="edge")
        outputs, features = self._model.run(
            {"inputs": padded[None].astype(np.float32)},
            {"outputs": (1, 2, *padded.shape[1:]), "features": (1, len(self._range.mean))},
        )
        maps = 1 / (1 + np.exp(-outputs[0, :, : size[1], : size[0]]))
        if factor > 1:
            maps = np.stack([cv2.resize(each, (width, height), interpolation=cv2.INTER_LINEAR) for each in maps])
        return maps[0], maps[1], features, max(size)


def basins_of(
    pixels: Image, bumps: Image, light: SplitLight, flat: Mask, seen: Mask | None
) -> tuple[Basins, npt.NDArray[np.float32]]:
    """Return the basins of the specular light where highlights may be, and the height of the highest bump in each.

    Parameters
    ----------
    pixels, bumps : ndarray of float32, shape (H, W)
        The network's maps: probability of a highlight's pixel, and bumps in the middles of highlights, in [0, 1].
    light : SplitLight
        The frame's two parts.
    flat : ndarray of bool, shape (H, W)
        Where all channels are clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.
    """
    smoothed, tissue = smoothed_light(light, seen)
    mask = pixels >= PIXEL if seen is None else (pixels >= PIXEL) & seen
    rise, noise = rise_of_clipped(flat), NOISE_LEFT * light.noise
    base = np.asarray(tissue * rise, dtype=np.float32)
    basins = find_basins(climbed_light(smoothed, flat), mask, base, SADDLE, SADDLE_NOISE * noise)
    tops = np.zeros(len(basins.rows) + 1, dtype=np.float32)
    np.maximum.at(tops, basins.labels[mask], bumps[mask])
    return basins, tops[1:]


def highlights_of(
    basins: Basins, kept: Mask, light: SplitLight, linear: Image, clipped: tuple[Mask, Mask, Mask], seen: Mask | None
) -> ColourDetection:
    """Return the highlights of basins.

    Parameters
    ----------
    basins : Basins
        Of a frame (`basins_of`).
    kept : ndarray of bool, shape (N,)
        Which of them are highlights.
    light : SplitLight
        The frame's two parts.
    linear : ndarray of float32, shape (H, W, 3)
        The frame.
    clipped : tuple of ndarray of bool
        Where a channel is clipped, where all are, and where they are nearly so.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.
    """
    any_channel, flat, white = clipped
    labels = np.where(np.append(False, kept)[basins.labels], basins.labels, 0)
    smoothed, tissue = smoothed_light(light, seen)
    spots = spots_of(given_basins(climbed_light(smoothed, flat), labels), smoothed, tissue)
    # The network knows no text or instruments; where they shine, the split by colour sees all of it.
    shining, _, _ = colour_spots(light, any_channel, flat, seen)
    spots, bright, foreign = tissue_spots(spots, flat.shape, shining)
    return judge_spots(spots, light, linear, bright, (flat, white), (labels > 0) & ~foreign, seen)


def smoothed_light(light: SplitLight, seen: Mask | None) -> tuple[Image, Image]:
    """Return the specular light, at least `LEAST_VALUE`, and the tissue's, both smoothed."""
    specular = np.maximum(smooth(light.specular, SMOOTHING_PX, seen), np.float32(LEAST_VALUE))
    return specular, smooth(light.tissue, SMOOTHING_PX, seen)


def climbed_light(specular: Image, flat: Mask) -> Image:
    """Return the light whose summits are highlights: clipped light is taken to rise from its rim."""
    return np.asarray(specular * rise_of_clipped(flat), dtype=np.float32)


learned_detector = LearnedDetector()
"""The shipped network; it is read at its first use."""
