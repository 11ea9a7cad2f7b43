"""Lossy coding of the sensor's picture: coded and decoded again. Pictures are uint8, (H, W) or (H, W, 3), red first."""

import io
from fractions import Fraction

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Picture
from simtest.spec.sensor import Coding, H264Coding, JpegCoding

_SAMPLING = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}


def check_codec(coding: Coding | None) -> None:
    """Raise `InputError` where the package of a coding is missing: before anything is rendered for it."""
    if isinstance(coding, H264Coding):
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise InputError('sensor.coding.type = "h264": needs the package av; install simtest[video]') from error


def code(picture: Picture, coding: Coding) -> Picture:
    """Return a picture as it is after lossy coding."""
    return _jpeg(picture, coding) if isinstance(coding, JpegCoding) else _h264(picture, coding)


def _jpeg(picture: Picture, coding: JpegCoding) -> Picture:
    options = [cv2.IMWRITE_JPEG_QUALITY, coding.quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, _SAMPLING[coding.chroma]]
    # OpenCV wants blue first.
    values = np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    for _ in range(coding.generations):
        ok, data = cv2.imencode(".jpg", values, options)
        assert ok
        values = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    return np.asarray(values if values.ndim == 2 else cv2.cvtColor(values, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _h264(picture: Picture, coding: H264Coding) -> Picture:
    check_codec(coding)
    import av

    height, width = picture.shape[:2]
    # Chroma of half size needs even sides.
    even = cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    colour = even if even.ndim == 3 else np.repeat(even[..., None], 3, axis=2)
    film = io.BytesIO()
    with av.open(film, "w", format="matroska") as container:
        # One thread: the number of threads changes the bytes.
        stream = container.add_stream("libx264", rate=Fraction(25), options={"crf": str(coding.crf), "threads": "1"})
        stream.width, stream.height, stream.pix_fmt = even.shape[1], even.shape[0], "yuv420p"
        for _ in range(coding.frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(colour, format="rgb24")))
        container.mux(stream.encode())
    film.seek(0)
    with av.open(film) as container:
        *_, last = container.decode(video=0)
    decoded = last.to_ndarray(format="gray" if picture.ndim == 2 else "rgb24")
    return np.ascontiguousarray(decoded[:height, :width])
