"""`peaks`: the isolated peaks of a frame that have the shape of a point highlight."""

from dataclasses import dataclass

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.detection.detector import Detection
from simtest.detection.regions import Region, detect
from simtest.detection.shape import flat_pixels, peak_shape
from simtest.detection.view_mask import view_of
from simtest.errors import Failure
from simtest.geometry import Camera, Mask
from simtest.geometry.patch import share_of_noise


@dataclass(frozen=True)
class PeakDetector:
    """Peaks of the smoothed mean of the channels.

    Parameters
    ----------
    isolated : bool
        Leave out peaks whose isophote at t = 0.5 does not close inside the frame and the view, and those whose shape is
        not that of one point highlight (`simtest.detection.peak_shape`).
    """

    isolated: bool = True

    def detect(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> Detection:
        """Find the peaks of a frame (see `simtest.detection.Detector`)."""
        regions = detect(frame.smoothed, frame.noise, self.isolated, frame.seen)
        if self.isolated:
            flat = flat_pixels(frame.encoded, frame.seen)
            regions = [region for region in regions if _is_highlight(region, frame, flat)]
        return Detection(tuple(regions), frame, view=view_of(frame, search=False))


peaks = PeakDetector()


def _is_highlight(region: Region, frame: Frame, flat: Mask | None) -> bool:
    """Return whether nothing in a peak's shape speaks against one point highlight."""
    patch, noise, (column, row) = frame.patch(region.box, region.peak), frame.noise, region.peak
    at_peak = noise if isinstance(noise, float) else float(noise[row, column])
    left = share_of_noise(frame.smoothing_px) * at_peak
    shape = patch if isinstance(patch, Failure) else peak_shape(patch, region, left, flat)
    return isinstance(shape, Failure) or shape.is_highlight
