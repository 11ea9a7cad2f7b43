"""`learned_detector`: highlights that a trained network finds and separates, run by ONNX Runtime, without PyTorch."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.detection.basins import given_basins
from simtest.detection.colour import SMOOTHING_PX, colour_spots
from simtest.detection.detector import Detection
from simtest.detection.highlight_inputs import frame_statistics, highlight_inputs
from simtest.detection.judging import ColourDetection, detection_of, judge_spots, plateaus, tissue_spots
from simtest.detection.light_split import split_light
from simtest.detection.spots import rise_of_clipped, spots_of
from simtest.detection.view_mask import View, find_view
from simtest.errors import Failure, Reason
from simtest.geometry import Camera, Image, Mask, smooth
from simtest.runtime.arrays import Index
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

PIXEL = 0.5
"""A pixel is a highlight's where the network gives it at least this probability."""

SADDLE = 0.9
"""A maximum of the bumps counts if its saddle to any higher one is below this share of it."""

LEAST_VALUE = 1e-4
"""Least specular light of a spot, share of full scale: the split by colour may find none where the network does."""


@dataclass(frozen=True)
class LearnedDetector:
    """A network of the task ``highlight_instances`` (`simtest train`) as a detector.

    The network gives each pixel's probability of being a highlight's, and a map with a bump in the middle of each
    highlight. Maxima of the bumps are the highlights, and a watershed from them shares out the pixels. Light is split
    and highlights are classified as `colour` does it; estimators see the specular light alone.

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
        view = find_view(frame.encoded) if frame.seen is None else View(frame.seen)
        found = self.find(frame.channels, frame.clipped, view.seen)
        if isinstance(found, Failure):
            return Detection((), replace(frame, seen=view.seen), view=view, refusal=found)
        return detection_of(found, frame, view, self.isolated)

    def find(self, linear: Image, clipped: Mask, seen: Mask | None = None) -> ColourDetection | Failure:
        """Find the highlights of linear values, shape (H, W, 3), share of full scale, or say why they are refused.

        `clipped`, shape (H, W), is where a channel is clipped, `seen` the pixels inside the view, default all.
        """
        return self._network.detect(linear, clipped, seen)


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
        pixels, bumps, features, seen_size = self._maps(inputs)
        statistics = dict(zip(RANGED, frame_statistics(linear, seen, seen_size), strict=True))
        refusal = self._range.refusal(statistics) or self._range.refusals(features)[0]
        if refusal is not None:
            return refusal
        inside = pixels >= PIXEL if seen is None else (pixels >= PIXEL) & seen
        labels = share_out(bumps, inside, self._least_top)
        smoothed = np.maximum(smooth(light.specular, SMOOTHING_PX, seen), np.float32(LEAST_VALUE))
        tissue = smooth(light.tissue, SMOOTHING_PX, seen)
        flat, white = plateaus(linear, clipped)
        climbed = np.asarray(smoothed * rise_of_clipped(flat), dtype=np.float32)
        spots = spots_of(given_basins(climbed, labels), smoothed, tissue)
        # The network knows no text or instruments; where they shine, the split by colour sees all of it.
        shining, _, _ = colour_spots(light, clipped, flat, seen)
        spots, bright, foreign = tissue_spots(spots, clipped.shape, shining)
        return judge_spots(spots, light, linear, bright, (flat, white), (labels > 0) & ~foreign, seen)

    def _maps(self, inputs: Image) -> tuple[Image, Image, Image, int]:
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


def share_out(bumps: Image, pixels: Mask, least_top: float) -> Index:
    """Share out pixels among the highlights whose bumps rise in them.

    Parameters
    ----------
    bumps : ndarray, shape (H, W)
        Height of a bump around the middle of each highlight, in [0, 1].
    pixels : ndarray of bool, shape (H, W)
        Pixels of highlights; those that no bump is connected with are left out.
    least_top : float
        Least height of a bump's top.

    Returns
    -------
    ndarray of int, shape (H, W)
        Number of the highlight from 1; 0 where none.
    """
    from skimage.segmentation import watershed

    tops = bump_tops(bumps)
    tops[bumps < least_top] = 0
    labels: Index = watershed(-bumps, tops, mask=pixels | (tops > 0)).astype(np.int64)
    return labels


def bump_tops(bumps: Image) -> Index:
    """Return the maxima of bumps that count, numbered from 1, shape (H, W); 0 elsewhere (see `SADDLE`)."""
    from skimage.measure import label
    from skimage.morphology import local_maxima, reconstruction

    # In logarithms the ratio of saddle and top is a height, and these are the h-maxima.
    log = np.log(np.maximum(bumps, LEAST_BUMP)).astype(np.float64)
    flooded = reconstruction(log + np.log(SADDLE), log, method="dilation")
    tops: Index = label(local_maxima(flooded) & (bumps > LEAST_BUMP), connectivity=2)
    return tops


LEAST_BUMP = 0.02
"""Lower bumps are none."""


learned_detector = LearnedDetector()
"""The shipped network; it is read at its first use."""
