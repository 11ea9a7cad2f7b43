"""What a camera and its video processor do to a picture: mosaic, colour, sharpening, scaling, captions, coding."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Share, Spec

Gain = Annotated[float, Field(ge=0.05, le=20)]
Row = tuple[float, float, float]

IDENTITY: tuple[Row, Row, Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Mosaic(Spec):
    """A colour filter mosaic: each pixel measures one colour, and demosaicing fills in the other two."""

    pattern: Literal["rggb", "bggr", "grbg", "gbrg"] = Field(
        "rggb", description="colours of the first two pixels of the first two rows"
    )
    demosaicing: Literal["bilinear", "vng", "edge_aware"] = Field(
        "edge_aware", description="OpenCV's method; vng works on 8 bits of the square root, the others on 16 bits"
    )


class ColourProcessing(Spec):
    """From the sensor's own colours to those of the picture, linear: gains, then a matrix.

    The scene's colours are those of the picture, so the sensor sees their inverse image: a channel of large gain
    receives little light and has the more noise.
    """

    white_balance: tuple[Gain, Gain, Gain] = Field(
        (1.0, 1.0, 1.0), description="gains of red, green and blue; only their ratios count, the smallest is 1"
    )
    matrix: tuple[Row, Row, Row] = Field(
        IDENTITY, description="rows: the picture's red, green and blue from the sensor's, behind the gains"
    )

    @model_validator(mode="after")
    def _invertible(self) -> "ColourProcessing":
        matrix = np.array(self.matrix)
        if abs(np.linalg.det(matrix)) < 1e-3:
            raise ValueError(f"matrix = {matrix.tolist()}: must be invertible")
        if not np.allclose(matrix.sum(axis=1), 1, atol=1e-3):
            raise ValueError(f"matrix: rows sum to {matrix.sum(axis=1).tolist()}; must be 1, so that white stays white")
        return self

    @property
    def gains(self) -> Array:
        """Gains of red, green and blue, shape (3,), the smallest 1."""
        gains = np.array(self.white_balance)
        return np.asarray(gains / gains.min())


class Sharpening(Spec):
    """Unsharp masking of the encoded picture's luma: value + amount (value - value smoothed by a Gaussian).

    It draws the dark halos that surround highlights in real frames.
    """

    radius_px: float = Field(1.5, ge=0.3, le=20, description="standard deviation of the Gaussian, px")
    amount: float = Field(0.8, ge=0, le=10, description="0 leaves the picture as it is")


class Scaling(Spec):
    """The picture was recorded at another size and scaled back: an old processor's picture on a new screen."""

    factor: float = Field(ge=0.1, le=4, description="recorded size over the camera's")
    method: Literal["linear", "cubic", "area", "lanczos"] = Field(
        "linear", description="how it is scaled back; towards a smaller size areas are averaged"
    )


class Caption(Spec):
    """A line of text burnt into the picture."""

    text: str = Field(min_length=1, max_length=200)
    x: Share = Field(0.01, description="left end, share of the width")
    y: Share = Field(0.3, description="base line, share of the height")
    height_px: float = Field(12.0, ge=4, le=500, description="of capital letters")
    colour: tuple[Share, Share, Share] = Field((1.0, 1.0, 1.0), description="encoded red, green, blue")


class Box(Spec):
    """A filled rectangle, as the inset of a position display."""

    x: Share = Field(description="left side, share of the width")
    y: Share = Field(description="upper side, share of the height")
    width: Share = Field(description="share of the width")
    height: Share = Field(description="share of the height")
    colour: tuple[Share, Share, Share] = Field((0.0, 0.0, 0.0), description="encoded red, green, blue")


class Overlay(Spec):
    """What the processor draws into the picture; outside the camera's view mask it blanks the picture first."""

    captions: tuple[Caption, ...] = Field((), max_length=100)
    boxes: tuple[Box, ...] = Field((), max_length=100, description="drawn before the captions")


class JpegCoding(Spec):
    """JPEG, by libjpeg."""

    type: Literal["jpeg"] = "jpeg"
    quality: int = Field(90, ge=1, le=100)
    chroma: Literal["4:4:4", "4:2:2", "4:2:0"] = Field("4:2:0", description="how the two colour channels are sampled")
    generations: int = Field(1, ge=1, le=20, description="how often the picture is coded, each time from the last")


class H264Coding(Spec):
    """H.264, by libx264: one film of the picture, repeated; needs the extra `video`."""

    type: Literal["h264"] = "h264"
    crf: int = Field(23, ge=0, le=51, description="libx264's constant rate factor; larger is coarser")
    frames: int = Field(1, ge=1, le=60, description="how long the film is; its last frame is the picture")


Coding = Annotated[JpegCoding | H264Coding, Field(discriminator="type")]
