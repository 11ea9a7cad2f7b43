"""Detection in a colour picture without a camera."""

from dataclasses import dataclass

from simtest.calibration import Calibration, Frame, Response
from simtest.detection.colour import ColourDetection, detect_colour
from simtest.detection.view import View, find_view
from simtest.geometry import Camera
from simtest.reconstruction.choices import SMOOTHING_BY_COLOUR_PX
from simtest.runtime.arrays import Image, Mask


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
    # Detection by colour uses no angle, so any field of view serves.
    camera = Camera.from_fov(60.0, picture.shape[1], picture.shape[0])
    calibration = Calibration(camera, response=response or Response("srgb"), saturation_level=level)
    frame = Frame(picture, calibration, SMOOTHING_BY_COLOUR_PX, seen=seen)
    view = find_view(picture) if seen is None else View(seen)
    return PictureDetection(view, detect_colour(frame.channels, frame.clipped, view.seen))
