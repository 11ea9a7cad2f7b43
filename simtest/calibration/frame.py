"""A frame as detectors and frame estimators see it, its noise estimated from itself.

Each step of its correction is computed when first asked for.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration.calibration import Calibration, CorrectedFrame, mean_channel
from simtest.errors import Failure
from simtest.geometry.camera import Camera
from simtest.geometry.patch import Patch, share_of_noise, smooth
from simtest.runtime.arrays import Image, Mask, short_repr

_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
"""Difference of two Laplacians: blind to any quadratic image (Immerkaer 1996); its norm is 6."""

MAD_TO_SIGMA = 1.4826

CLEAR_SIDE_PX = 7
"""A pixel counts if at most one pixel is clipped in the square of this side around it."""

COLOURED = 1.15
"""A smoothed frame with so many times the noise that white noise leaves has noise that is not white; less is chance, or
the tissue's shading."""

SPACING = 2
"""Spacing of the second differences over the width of the smoothing: nearer pixels share their noise."""

MIN_CLEAR = 100
"""With fewer pixels clear of clipped ones, all pixels are the better sample."""

SAMPLE = 2048
"""So many values show where the median of many more lies."""

FINEST_SHARE = 0.8
"""Of a told noise that nothing has correlated, the finest scale shows so much or more."""

Box = tuple[int, int, int, int]


def estimate_noise(frame: npt.ArrayLike, seen: Mask | None = None, clipped: Mask | None = None) -> float:
    """Estimate the standard deviation of white noise in a frame before smoothing, robust against edges and highlights.

    Parameters
    ----------
    frame : array_like, shape (H, W)
        Intensities; frames, or views, under 3 x 3 px have noise 0.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all. Outside it there is more than the sensor's noise.
    clipped : ndarray of bool, shape (H, W), optional
        Pixels at either end of the sensor's range. Their noise is truncated, on a dark ground by half, so pixels near
        them are left out where enough others remain.
    """
    image = np.ascontiguousarray(frame, dtype=np.float32)
    if min(image.shape) < 3:
        return 0.0
    # second differences: noise, edges and highlights are left
    response = cv2.filter2D(image, cv2.CV_32F, _KERNEL)[1:-1, 1:-1]
    # reject pixels at the view's border and near clipped ones
    whole = np.ones(response.shape, dtype=bool)
    if seen is not None:
        whole = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)[1:-1, 1:-1] > 0
    if clipped is not None and clipped.any():
        size = (CLEAR_SIDE_PX, CLEAR_SIDE_PX)
        near = cv2.boxFilter(clipped.astype(np.float32), -1, size, normalize=False)[1:-1, 1:-1]
        clear = whole & (near < 1.5)
        whole = clear if np.count_nonzero(clear) >= MIN_CLEAR else whole
    response = response[whole]
    if not response.size:
        return 0.0
    # robust spread
    return float(MAD_TO_SIGMA * median(np.abs(response)) / 6.0)


def estimate_coarse_noise(
    smoothed: Image, sigma_px: float, seen: Mask | None = None, clipped: Mask | None = None
) -> float:
    """Estimate the noise of a smoothed frame, as the standard deviation of white noise that would leave as much of it.

    Demosaicing and coding take noise from the finest scale, where `estimate_noise` looks, and leave or add it at the
    coarser one that isophotes are found at. Second differences of the frame, smoothed by a Gaussian of `sigma_px`, two
    widths of the smoothing apart, show it there. It is 0, not known, of a width below 1 px, where pixels are no fine
    grid, and of frames too small for the differences. `seen` and `clipped` are as in `estimate_noise`.
    """
    step = round(sigma_px)
    reach = 2 * SPACING * step
    if sigma_px < 1 or min(smoothed.shape) <= 2 * reach:
        return 0.0
    # The smoothed frame is smooth over a step: every pixel of a coarser grid suffices.
    coarse = np.ascontiguousarray(smoothed[::step, ::step])
    kernel = np.zeros(2 * SPACING + 1, dtype=np.float32)
    kernel[[0, SPACING, -1]] = 1, -2, 1
    inner = (slice(SPACING, -SPACING),) * 2
    response = cv2.sepFilter2D(coarse, cv2.CV_32F, kernel, kernel)[inner]
    # reject what a clipped or unseen pixel is near to
    whole = np.ones(smoothed.shape, dtype=np.uint8) if seen is None else seen.astype(np.uint8)
    if clipped is not None:
        whole[clipped] = 0
    around = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    kept = cv2.erode(whole, around, borderValue=1)[::step, ::step][inner] > 0
    if np.count_nonzero(kept) < MIN_CLEAR:
        return 0.0
    # Smoothed white noise has the correlation exp(-l^2 / 4 s^2) at a distance l.
    near, far = (math.exp(-((SPACING * step * k / sigma_px) ** 2) / 4) for k in (1, 2))
    left = (6 - 8 * near + 2 * far) * share_of_noise(sigma_px)
    return MAD_TO_SIGMA * float(median(np.abs(response[kept]))) / left


def median(values: npt.NDArray[np.floating]) -> np.floating:
    """Return the median of real numbers, shape (n,), as `np.median` does, which loads `numpy.ma` first."""
    largest: np.floating = values.max()
    if np.isnan(largest):
        return largest
    middle = len(values) // 2
    lower = middle if len(values) % 2 else middle - 1
    below, near = _around_median(values)
    if not below <= lower <= middle < below + len(near):
        below, near = 0, values
    ordered = np.partition(near, (lower - below, middle - below))
    if lower == middle:
        return values.dtype.type(ordered[middle - below])
    return values.dtype.type((ordered[lower - below] + ordered[middle - below]) / values.dtype.type(2))


def _around_median(values: npt.NDArray[np.floating]) -> tuple[int, npt.NDArray[np.floating]]:
    """Return the values in a range that usually holds the median of many, and how many lie below it.

    The tenth of the values about the median of a sample: the rest need not be put in order.
    """
    if len(values) < 16 * SAMPLE:
        return 0, values
    sample = np.sort(values[:: len(values) // SAMPLE])
    low, high = sample[int(0.45 * len(sample))], sample[int(0.55 * len(sample))]
    return int(np.count_nonzero(values < low)), values[(values >= low) & (values <= high)]


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
        # Shot noise and steps are those of all the light, also where `light` is a part of it.
        whole = corrected.linear if self.light is None else mean_channel(self.channels)
        known = model.at(smooth(whole, self.smoothing_px, self.seen), corrected.channels)
        if self.light is not None:
            # Such a part has more noise than the mean of the channels, at most that of one channel.
            own, most = estimate_noise(whole, self.seen, self._ends), math.sqrt(corrected.channels)
            known = known * min(max(white / own, 1.0), most) if own > 0 else known * most
        noise = np.maximum(white, known)
        return np.asarray(noise if corrected.gain is None else noise * corrected.gain, dtype=np.float32)

    @cached_property
    def _white(self) -> float:
        """Noise at the finest scale, where it is white, before the falloff's correction amplifies it."""
        return estimate_noise(self.corrected.linear, self.seen, self._ends)

    @property
    def _ends(self) -> Mask | None:
        """Pixels at either end of the sensor's range: one that clips at full scale clips at 0 as well."""
        corrected = self.corrected
        return None if corrected.saturated is None else corrected.saturated | (corrected.linear <= 0)

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
            cut = Patch.cut(
                self.smoothed, box, peak, saturated=self.corrected.saturated, seen=self.seen,
                raw=self.corrected.intensity, noise=self.noise_as_smoothed, smoothing_px=self.smoothing_px,
            )  # fmt: skip
            if isinstance(cut, Patch) and (self.light is not None or self.encoded.ndim == 3):
                x, y, width, height = box
                crop, gain = np.s_[y : y + height, x : x + width], self.corrected.gain
                light = self.corrected.linear if self.light is None else self.light
                left = self.channels[crop].reshape(height, width, -1).max(axis=2) - light[crop]
                left = left if gain is None else left * gain[crop]
                cut = replace(cut, diffuse=max(float(median(left.ravel())), 0.0))
            self._patches[box, peak] = cut
        return self._patches[box, peak]
