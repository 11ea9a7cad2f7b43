"""The second stage: where the specularities are, and the smoothed crop of each that the estimators see.

Two detectors, by name: "peaks" looks for local maxima of the mean of the channels, "colour" for light that lacks the
tissue's colour. Both return a `Found`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, CorrectedFrame, Response
from simtest.detection import Region, detect, estimate_noise, flat_pixels, peak_shape
from simtest.detection.blobs import Highlight
from simtest.detection.colour import ColourDetection, detect_colour
from simtest.detection.view_mask import WHOLE, View, find_view
from simtest.errors import Failure
from simtest.geometry import Patch, smooth
from simtest.reconstruction.linear_light import LinearPicture, clipped_pixels, decode

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class SmoothedFrame:
    """A corrected frame, smoothed, that patches are cut from.

    `noise` is the standard deviation of the intensity's noise before smoothing, one for all pixels or each, shape
    (H, W); `seen` are the pixels inside the view mask, None where all are.
    """

    corrected: CorrectedFrame
    smoothed: Image
    noise: float | Image
    smoothing_px: float
    seen: Mask | None

    @classmethod
    def of(
        cls, corrected: CorrectedFrame, calibration: Calibration, smoothing_px: float, seen: Mask | None
    ) -> "SmoothedFrame":
        """Smooth a frame and estimate its noise."""
        smoothed = smooth(corrected.intensity, smoothing_px, seen)
        return cls(corrected, smoothed, _noise(corrected, calibration, smoothing_px, seen), smoothing_px, seen)

    def patch(self, box: Box, peak: tuple[int, int] | None = None) -> Patch | Failure:
        """Cut a region of interest out (see `Patch.cut`)."""
        return Patch.cut(
            self.smoothed, box, peak, saturated=self.corrected.saturated, seen=self.seen, raw=self.corrected.intensity,
            noise=self.noise, smoothing_px=self.smoothing_px,
        )  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What a detector found in a picture: regions of interest, the brightest first, and the frame's patch at each.

    `frame` is the light that the estimators see: all of it for peaks, the specular part by colour. `highlights` says
    how each region was judged and `others` what was left out, both empty where the detector judges none; `view` is the
    part of the picture that shows tissue, as far as that was looked for.
    """

    frame: SmoothedFrame
    regions: list[Region]
    patches: list[Patch | Failure]
    highlights: Sequence[Highlight] = ()
    others: Sequence[Highlight] = ()
    view: View = WHOLE


Detector = Callable[[LinearPicture, Calibration, float, bool], Found]
"""Takes a picture, what is known of its camera, the smoothing in px, and whether isolated highlights alone count."""


def find_peaks(light: LinearPicture, calibration: Calibration, smoothing_px: float, isolated: bool) -> Found:
    """Find the local maxima that stand out of the noise; where `isolated`, those shaped like one point highlight."""
    seen = calibration.camera.seen
    frame = SmoothedFrame.of(light.corrected, calibration, smoothing_px, seen)
    # candidates
    regions = detect(frame.smoothed, frame.noise, isolated, seen)
    found = [(region, frame.patch(region.box, region.peak)) for region in regions]
    # reject
    if isolated:
        left, flat = _noise_left(smoothing_px), flat_pixels(light.encoded)
        noise = np.broadcast_to(frame.noise, frame.smoothed.shape)
        found = [(r, patch) for r, patch in found if _is_highlight(r, patch, left * float(noise[r.peak[::-1]]), flat)]
    return Found(frame, [region for region, _ in found], [patch for _, patch in found])


def find_in_colour(light: LinearPicture, calibration: Calibration, smoothing_px: float, isolated: bool) -> Found:
    """Find the highlights by the tissue's colour; the frame that patches are cut from is the specular light alone."""
    corrected, channels = light.corrected, light.channels
    assert channels is not None
    assert corrected.saturated is not None
    found = _detect(light.encoded, channels, corrected.saturated, calibration.camera.seen)
    detection = found.detection
    # Light is split before the falloff is divided away: there its noise is white.
    specular = detection.light.specular
    own = specular if corrected.gain is None else specular * corrected.gain
    frame = SmoothedFrame.of(
        replace(corrected, intensity=own, linear=specular), calibration, smoothing_px, found.view.seen
    )
    # select
    taken = detection.isolated if isolated else detection.highlights
    return Found(
        frame,
        [highlight.region for highlight in taken],
        [frame.patch(highlight.region.box, highlight.region.peak) for highlight in taken],
        taken,
        [highlight for highlight in detection.highlights if isolated and not highlight.is_isolated],
        found.view,
    )


DETECTORS: dict[str, Detector] = {"peaks": find_peaks, "colour": find_in_colour}


def cut_region(light: LinearPicture, calibration: Calibration, smoothing_px: float, box: Box) -> Found:
    """Take a user's region of interest for the one specularity; raise `InputError` where it leaves the frame."""
    frame = SmoothedFrame.of(light.corrected, calibration, smoothing_px, calibration.camera.seen)
    patch = frame.patch(box)
    x, y = box[:2] if isinstance(patch, Failure) else (int(v) for v in patch.peak_px)
    return Found(frame, [Region(box, (x, y), math.nan)], [patch])


@dataclass(frozen=True)
class PictureDetection:
    """What a colour picture shows: the part of it that is tissue, and its highlights."""

    view: View
    detection: ColourDetection


def detect_in_picture(
    picture: Image, response: Response | None = None, level: float = 1.0, seen: Mask | None = None
) -> PictureDetection:
    """Find the highlights of a colour picture, without a camera.

    Parameters
    ----------
    picture : ndarray of float32, shape (H, W, 3)
        RGB values as encoded, in [0, 1], of 16 bits at most.
    response : Response, optional
        How light became values; default sRGB.
    level : float
        Value at and above which a channel is clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default: found in the picture.

    Returns
    -------
    PictureDetection
    """
    return _detect(picture, decode(picture, response or Response("srgb")), clipped_pixels(picture, level), seen)


def _detect(encoded: Image, channels: Image, clipped: Mask, seen: Mask | None) -> PictureDetection:
    view = find_view(encoded) if seen is None else View(seen)
    return PictureDetection(view, detect_colour(channels, clipped, view.seen))


def _noise(
    corrected: CorrectedFrame, calibration: Calibration, smoothing_px: float, seen: Mask | None
) -> float | Image:
    """Return the noise of a corrected frame before smoothing: the larger of what is known and what is seen."""
    known = None
    # Without a noise model, and with the same gain everywhere, one number serves for all pixels.
    if not calibration.noise.is_silent or corrected.gain is not None:
        known = calibration.noise.at(smooth(corrected.linear, smoothing_px, seen), corrected.channels)
    # A sensor that clips at full scale clips at 0 as well.
    clipped = None if corrected.saturated is None else corrected.saturated | (corrected.linear <= 0)
    # Estimated before the falloff is divided away, where noise is white, and amplified with the frame.
    white = estimate_noise(corrected.linear, seen, clipped)
    if known is None:
        return white
    noise = np.maximum(white, known)
    return np.asarray(noise if corrected.gain is None else noise * corrected.gain, dtype=np.float32)


def _noise_left(smoothing_px: float) -> float:
    """Return the share of white noise that a Gaussian of this width leaves: 1 / (2 sqrt(pi) s) if it is wide."""
    return 1 / math.sqrt(1 + 4 * math.pi * smoothing_px**2)


def _is_highlight(region: Region, patch: Patch | Failure, noise: float, flat: Mask | None) -> bool:
    """Check that nothing in a peak's shape speaks against one point highlight; what has no shape passes."""
    shape = patch if isinstance(patch, Failure) else peak_shape(patch, region, noise, flat)
    return isinstance(shape, Failure) or shape.is_highlight
