"""A frame as detectors and frame estimators see it, each step of its correction computed when first asked for."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from simtest.calibration.calibration import Calibration, CorrectedFrame
from simtest.calibration.noise_estimate import COLOURED, estimate_coarse_noise, estimate_noise
from simtest.errors import Failure
from simtest.geometry import Camera, Image, Mask, Patch, smooth
from simtest.runtime.arrays import short_repr

FINEST_SHARE = 0.8
"""Of a told noise that nothing has correlated, the finest scale shows so much or more."""

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame with its calibration and smoothing.

    Parameters
    ----------
    encoded : ndarray of float32, shape (H, W) or (H, W, C)
        Values as the camera gave them, finite.
    calibration : Calibration
        Of a camera of the same size.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px.
    seen : ndarray of bool, shape (H, W), optional
        The pixels that show tissue; default the camera's view mask. None: all.
    light : ndarray of float32, shape (H, W), optional
        Linear light that stands in for the mean of the channels: the specular part of a colour frame, for example.
    """

    encoded: Image
    calibration: Calibration
    smoothing_px: float
    seen: Mask | None = None
    light: Image | None = None
    _patches: dict[tuple[Box, tuple[int, int] | None], Patch | Failure] = field(
        default_factory=dict, init=False, repr=False
    )

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.seen is None:
            object.__setattr__(self, "seen", self.camera.seen)

    @property
    def camera(self) -> Camera:
        """The calibration's camera."""
        return self.calibration.camera

    @cached_property
    def channels(self) -> Image:
        """Linear light of each channel, same shape as `encoded` (`Response.decode_picture`)."""
        response = self.calibration.response
        return self.encoded if response is None else response.decode_picture(self.encoded)

    @cached_property
    def clipped(self) -> Mask:
        """Where a channel is clipped, shape (H, W); nowhere if the calibration knows no level."""
        clipped = self.calibration.clipped(self.encoded)
        return np.zeros(self.encoded.shape[:2], dtype=bool) if clipped is None else clipped

    @cached_property
    def corrected(self) -> CorrectedFrame:
        """The frame, or `light`, with everything undone that the calibration knows."""
        if self.light is None:
            return self.calibration.correct(self.encoded)
        # Light is linear, so no response is left to undo; the falloff is.
        plain = replace(self.calibration, response=None, saturation_level=None)
        return replace(
            plain.correct(self.light),
            saturated=self.calibration.clipped(self.encoded),
            channels=1 if self.encoded.ndim == 2 else self.encoded.shape[2],
        )

    @cached_property
    def smoothed(self) -> Image:
        """The corrected intensity, smoothed, shape (H, W)."""
        return smooth(self.corrected.intensity, self.smoothing_px, self.seen)

    @cached_property
    def noise(self) -> float | Image:
        """Standard deviation of the corrected intensity's noise before smoothing; in each pixel, where it differs."""
        corrected, model, white = self.corrected, self.calibration.noise, self._white
        if model.is_silent and corrected.gain is None:
            return white
        known = model.at(smooth(corrected.linear, self.smoothing_px, self.seen), corrected.channels)
        noise = np.maximum(white, known)
        return np.asarray(noise if corrected.gain is None else noise * corrected.gain, dtype=np.float32)

    @cached_property
    def _white(self) -> float:
        """Noise at the finest scale, where it is white, before the falloff's correction amplifies it."""
        corrected = self.corrected
        # A sensor that clips at full scale clips at 0 as well.
        clipped = None if corrected.saturated is None else corrected.saturated | (corrected.linear <= 0)
        return estimate_noise(corrected.linear, self.seen, clipped)

    @cached_property
    def noise_as_smoothed(self) -> float | Image:
        """Standard deviation of white noise before smoothing that leaves as much noise as the smoothed frame has.

        That of `noise`, unless coding or demosaicing has correlated it. These take noise from the finest scale; where a
        told noise is all there, what a coarser scale has more is a texture, which other parts of a budget are for.
        """
        noise = self.noise
        level = float(np.median(noise)) if isinstance(noise, np.ndarray) else noise
        if not self.calibration.noise.is_silent and self._white > FINEST_SHARE * level:
            return noise
        found = estimate_coarse_noise(self.smoothed, self.smoothing_px, self.seen, self.corrected.saturated)
        if found <= COLOURED * level:
            return noise
        return noise * (found / level) if level > 0 else found

    def patch(self, box: Box, peak: tuple[int, int] | None = None) -> Patch | Failure:
        """Cut a region of interest out (see `Patch.cut`); the same box and peak give the same patch again."""
        if (box, peak) not in self._patches:
            self._patches[box, peak] = Patch.cut(
                self.smoothed, box, peak, saturated=self.corrected.saturated, seen=self.seen,
                raw=self.corrected.intensity, noise=self.noise_as_smoothed, smoothing_px=self.smoothing_px,
            )  # fmt: skip
        return self._patches[box, peak]
