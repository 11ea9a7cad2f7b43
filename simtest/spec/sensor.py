"""From radiance to a picture: the sensor, its video processor, and both by name (docs/howto/realism.md)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from simtest.calibration import NoiseModel, Response
from simtest.calibration.photometry import check_table
from simtest.runtime.arrays import Array
from simtest.spec.lights import CosineProfile, Profile
from simtest.spec.spec_model import UNSAID, Share, Spec, with_preset

SensorPreset = Literal["colonoscope_hd", "laparoscope_hd", "old_sd"]

PRESETS: dict[str, dict[str, Any]] = {
    # One chip behind a mosaic, as in the tip of a colonoscope; coded as the colonoscopies of HyperKvasir are.
    "colonoscope_hd": {
        "point_spread_px": 0.6,
        "exposure": {"average": 0.45},
        "mosaic": {"pattern": "rggb", "demosaicing": "edge_aware"},
        "colour": {
            "white_balance": [1.6, 1.0, 1.8],
            "matrix": [[1.5, -0.4, -0.1], [-0.2, 1.4, -0.2], [0.0, -0.5, 1.5]],
        },
        "full_well": 8000,
        "read_noise": 6.0,
        "response": {"type": "srgb"},
        "sharpening": {"radius_px": 1.3, "amount": 0.9},
        "overlay": {},
        "bits": 8,
        "coding": {"type": "jpeg", "quality": 75, "chroma": "4:2:0"},
    },
    # Three chips behind a prism, outside the patient: no mosaic, less noise.
    "laparoscope_hd": {
        "point_spread_px": 0.8,
        "exposure": {"average": 0.35},
        "full_well": 20000,
        "read_noise": 8.0,
        "response": {"type": "srgb"},
        "sharpening": {"radius_px": 1.5, "amount": 0.7},
        "overlay": {},
        "bits": 8,
        "coding": {"type": "jpeg", "quality": 92, "chroma": "4:2:0"},
    },
    # A processor of standard definition whose picture was enlarged.
    "old_sd": {
        "point_spread_px": 0.8,
        "exposure": {"average": 0.45},
        "mosaic": {"pattern": "rggb", "demosaicing": "bilinear"},
        "colour": {"white_balance": [1.5, 1.0, 1.7]},
        "full_well": 5000,
        "read_noise": 12.0,
        "response": {"type": "srgb"},
        "sharpening": {"radius_px": 2.0, "amount": 1.2},
        "scaling": {"factor": 0.6, "method": "linear"},
        "overlay": {},
        "bits": 8,
        "coding": {"type": "jpeg", "quality": 85, "chroma": "4:2:0"},
    },
}


Gain = Annotated[float, Field(ge=0.05, le=20)]
Shift = Annotated[float, Field(ge=-100, le=100)]
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


class Fringe(Spec):
    """Lateral chromatic aberration: red and blue are scaled about the centre; the truth stays at the place of green."""

    red: float = Field(0.002, ge=-0.01, le=0.01, description="by how much red is larger than green, share")
    blue: float = Field(-0.002, ge=-0.01, le=0.01, description="the same of blue")


class Denoising(Spec):
    """Noise reduction before sharpening: OpenCV's bilateral filter of the encoded picture (Tomasi and Manduchi 1998).

    Its weights fall as Gaussians of the distance and of the difference in colour, so that edges stay.
    """

    radius_px: float = Field(1.5, ge=0.3, le=5, description="standard deviation of the Gaussian of the distance, px")
    level: float = Field(
        0.05, gt=0, le=1, description="that of the colour's difference, summed over the channels, encoded"
    )


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


class Interlacing(Spec):
    """A comb: odd rows, at the recorded size, are of a view that has moved, by whole px; the truth is of even ones."""

    shift_px: tuple[Shift, Shift] = Field((0.0, 0.0), description="how far they have moved to the right and down, px")
    zoom: float = Field(1.0, ge=0.9, le=1.1, description="how they have grown about the centre: the camera advances")


class Caption(Spec):
    """A line of text burnt into the picture."""

    text: str = Field(min_length=1, max_length=200)
    x: Share = Field(0.01, description="left end, share of the width")
    y: Share = Field(0.3, description="base line, share of the height")
    height_px: float = Field(12.0, ge=4, le=500, description="of capital letters")
    colour: tuple[Share, Share, Share] = Field((1.0, 1.0, 1.0), description="encoded red, green, blue")


class _Rectangle(Spec):
    x: Share = Field(description="left side, share of the width")
    y: Share = Field(description="upper side, share of the height")
    width: Share = Field(description="share of the width")
    height: Share = Field(description="share of the height")


class Box(_Rectangle):
    """A filled rectangle, as the ground of a position display."""

    colour: tuple[Share, Share, Share] = Field((0.0, 0.0, 0.0), description="encoded red, green, blue")


class Inset(_Rectangle):
    """The picture itself, small and mirrored, as a frozen frame beside the live one."""


class Overlay(Spec):
    """What the processor draws into the picture; outside the camera's view mask it blanks the picture first."""

    captions: tuple[Caption, ...] = Field((), max_length=100)
    boxes: tuple[Box, ...] = Field((), max_length=100, description="drawn before the captions")
    insets: tuple[Inset, ...] = Field((), max_length=10, description="drawn after the boxes", **UNSAID)


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


FullWell = Annotated[float, Field(ge=1, le=1e9)]
ReadNoise = Annotated[float, Field(ge=0, le=1e6)]
Bits = Annotated[int, Field(ge=8, le=16)]


def check_electrons(full_well: float | None, read_noise: float) -> None:
    """Raise `ValueError` for a read noise in electrons without a full well, which relates it to full scale."""
    if read_noise > 0 and full_well is None:
        raise ValueError(f"read_noise = {read_noise:g} electrons: needs full_well as well")


class _Response(Spec):
    def model(self) -> Response:
        """Return the response as reconstruction uses it."""
        told = self.model_dump()
        return Response(told.pop("type"), **told)


class LinearResponse(_Response):
    """Values are proportional to light."""

    type: Literal["linear"] = "linear"


class GammaResponse(_Response):
    """value = light^(1/gamma)."""

    type: Literal["gamma"] = "gamma"
    gamma: float = Field(2.2, ge=0.1, le=10, description="2.2: dark values are spread, as in most pictures")


class SrgbResponse(_Response):
    """The curve of sRGB pictures (IEC 61966-2-1)."""

    type: Literal["srgb"] = "srgb"


class TableResponse(_Response):
    """A measured curve, linear between its points; both lists rise from 0 to 1."""

    type: Literal["table"] = "table"
    light: tuple[Share, ...] = Field(min_length=2, max_length=4096, description="light, share of full scale")
    value: tuple[Share, ...] = Field(min_length=2, max_length=4096, description="value, share of the largest")

    @model_validator(mode="after")
    def _rising(self) -> "TableResponse":
        # The rule is the response's own, so that both ways to make one agree.
        check_table(self.light, self.value)
        return self


ResponseSpec = Annotated[LinearResponse | GammaResponse | SrgbResponse | TableResponse, Field(discriminator="type")]


class Exposure(Spec):
    """Which radiance becomes full scale: that of the brightest isolated highlight, unless one of the keys says else."""

    exclusive = (("full_scale", "percentile", "average"),)

    full_scale: float | None = Field(None, ge=1e-12, le=1e12, description="radiance at full scale, fixed")
    percentile: float | None = Field(
        None,
        gt=0,
        le=100,
        description="automatic: this percentile of the frame's radiance, inside the view mask, becomes full scale",
    )
    average: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="automatic: the mean of the pixels' grey light, clipped and encoded, inside the view mask, where a "
        "surface is seen; tissue keeps its level, and highlights clip. The mean over the encoded channels is lower",
    )
    centre: float | None = Field(
        None,
        ge=0.05,
        le=10,
        description="of average: standard deviation of Gaussian weights about the view's centre, share of half the "
        "frame's diagonal; default all pixels weigh alike",
        **UNSAID,
    )
    gain: float = Field(1.0, ge=1e-6, le=1e6, description="exposure over that of the rule; 2 halves full scale")

    @model_validator(mode="after")
    def _weighs_a_mean(self) -> "Exposure":
        if self.centre is not None and self.average is None:
            raise ValueError(f"centre = {self.centre:g}: weighs the mean of average; must be left out without it")
        return self


def _optional(model: type[Spec]) -> set[str]:
    """Return the names of what is None where it is not given."""
    return {name for name, field in model.model_fields.items() if field.default is None} - {"preset"}


class Sensor(Spec):
    """From radiance to a frame, in this order.

    Point spread, vignetting, colour fringe, exposure, colour filter mosaic, noise, demosaicing, white balance and
    colour matrix, saturation, response, noise reduction, sharpening, interlacing and scaling, captions, quantisation,
    coding.
    """

    preset: SensorPreset | None = Field(
        None,
        description="whose numbers hold where none are given; false for a stage, "
        "full_well or bits switches off what it gives; default none",
    )
    point_spread_px: float = Field(0.0, ge=0, le=50, description="standard deviation of the Gaussian point spread, px")
    vignetting: Profile = Field(
        CosineProfile(), description="share of the light that is left, over the angle from the optical axis"
    )
    exposure: Exposure = Exposure()
    full_well: FullWell | None = Field(
        None, description="electrons at full scale, Poisson distributed; default no shot noise"
    )
    read_noise: ReadNoise = Field(0.0, description="standard deviation, electrons; needs full_well")
    noise_sigma: float = Field(
        0.0, ge=0, le=1, description="standard deviation of the white noise, share of full scale"
    )
    saturation: bool = Field(
        False, description="clip to [0, full scale]; a response that is not linear and bits clip as well"
    )
    response: ResponseSpec = LinearResponse()
    bits: Bits | None = Field(None, description="of the values; default not quantised")
    mosaic: Mosaic | None = Field(None, description="default: each pixel measures all colours")
    colour: ColourProcessing | None = Field(None, description="default: the sensor's colours are the picture's")
    fringe: Fringe | None = Field(None, description="colour fringe; default none", **UNSAID)
    denoising: Denoising | None = Field(None, description="noise reduction; default none", **UNSAID)
    sharpening: Sharpening | None = Field(None, description="default none")
    interlacing: Interlacing | None = Field(None, description="default none", **UNSAID)
    scaling: Scaling | None = Field(None, description="default: recorded at the camera's size")
    overlay: Overlay | None = Field(None, description="default: nothing is drawn")
    coding: Coding | None = Field(None, description="lossy coding of the picture; needs bits = 8; default none")
    response_known: bool = Field(True, description="whether reconstruction knows the response; else it assumes linear")
    vignetting_known: bool = Field(
        True, description="whether reconstruction knows the vignetting; else it assumes none"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="seed of the noise; experiments draw one for each realisation")

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, data: Any) -> Any:
        """Fill in the preset's numbers; an unknown preset is refused by its field.

        TOML has no null: false switches off what a preset gives and a sensor need not have.
        """
        if isinstance(data, Mapping):
            off = [name for name, value in data.items() if value is False and name in _optional(cls)]
            data = {**data, **dict.fromkeys(off)}
        named = data.get("preset") if isinstance(data, Mapping) else None
        preset = PRESETS.get(named) if isinstance(named, str) else None
        if preset is None:
            return data
        filled = with_preset(data, preset)
        exposure = data.get("exposure")
        if isinstance(exposure, Mapping) and any(exposure.get(key) is not None for key in Exposure.exclusive[0]):
            # The rules of exposure exclude each other, so a given one replaces the preset's.
            filled["exposure"] = exposure
        return filled

    @model_validator(mode="after")
    def _electrons(self) -> "Sensor":
        check_electrons(self.full_well, self.read_noise)
        return self

    @model_validator(mode="after")
    def _codable(self) -> "Sensor":
        if self.coding is not None and self.bits != 8:
            raise ValueError(f"bits = {self.bits}: must be 8 where coding is given")
        return self

    @property
    def is_processed(self) -> bool:
        """Whether the picture goes through stages behind the response, which change neighbouring pixels."""
        return any((self.denoising, self.sharpening, self.interlacing, self.scaling, self.overlay, self.coding))

    @property
    def encodes(self) -> bool:
        """Whether the frame's values are encoded: by a response, or to a number of bits."""
        return self.bits is not None or self.response.type != "linear"

    @property
    def clips(self) -> bool:
        """Whether values end at full scale."""
        return self.saturation or self.encodes or self.mosaic is not None

    def noise_model(self) -> NoiseModel:
        """Return the noise of one channel of the linear frame by its level, before pixels or channels are mixed."""
        return NoiseModel(self.noise_sigma, self.full_well, self.read_noise, self.bits, self.response.model())
