"""The sensor of a scene, which turns radiance into a frame."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from simtest.calibration import NoiseModel, Response
from simtest.calibration.response import check_table
from simtest.errors import InputError
from simtest.spec.falloff import CosineProfile, Profile
from simtest.spec.processing import Coding, ColourProcessing, Mosaic, Overlay, Scaling, Sharpening
from simtest.spec.sensor_presets import PRESETS, SensorPreset
from simtest.spec.spec_model import Share, Spec, with_preset

FullWell = Annotated[float, Field(ge=1, le=1e9)]
ReadNoise = Annotated[float, Field(ge=0, le=1e6)]
Bits = Annotated[int, Field(ge=8, le=16)]


def check_electrons(full_well: float | None, read_noise: float) -> None:
    """Raise `ValueError` for a read noise in electrons without a full well, which relates it to full scale."""
    if read_noise > 0 and full_well is None:
        raise ValueError(f"read_noise = {read_noise:g} electrons: needs full_well as well")


class LinearResponse(Spec):
    """Values are proportional to light."""

    type: Literal["linear"] = "linear"

    def model(self) -> Response:
        """Return the response as reconstruction uses it."""
        return Response()


class GammaResponse(Spec):
    """value = light^(1/gamma)."""

    type: Literal["gamma"] = "gamma"
    gamma: float = Field(2.2, ge=0.1, le=10, description="2.2: dark values are spread, as in most pictures")

    def model(self) -> Response:
        """Return the response as reconstruction uses it."""
        return Response("gamma", self.gamma)


class SrgbResponse(Spec):
    """The curve of sRGB pictures (IEC 61966-2-1)."""

    type: Literal["srgb"] = "srgb"

    def model(self) -> Response:
        """Return the response as reconstruction uses it."""
        return Response("srgb")


class TableResponse(Spec):
    """A measured curve, linear between its points; both lists rise from 0 to 1."""

    type: Literal["table"] = "table"
    light: tuple[Share, ...] = Field(min_length=2, max_length=4096, description="light, share of full scale")
    value: tuple[Share, ...] = Field(min_length=2, max_length=4096, description="value, share of the largest")

    @model_validator(mode="after")
    def _rising(self) -> "TableResponse":
        try:
            # The rule is the response's own, so that both ways to make one agree.
            check_table(self.light, self.value)
        except InputError as error:
            raise ValueError(str(error)) from None
        return self

    def model(self) -> Response:
        """Return the response as reconstruction uses it."""
        return Response("table", light=self.light, value=self.value)


ResponseSpec = Annotated[LinearResponse | GammaResponse | SrgbResponse | TableResponse, Field(discriminator="type")]


class Exposure(Spec):
    """Which radiance becomes full scale: that of the brightest isolated highlight, unless one of the keys says else."""

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
    gain: float = Field(1.0, ge=1e-6, le=1e6, description="exposure over that of the rule; 2 halves full scale")

    @model_validator(mode="after")
    def _one_way(self) -> "Exposure":
        given = [name for name in ("full_scale", "percentile", "average") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other; give one of them")
        return self


def _rules(exposure: Any) -> dict[str, Any]:
    """Return what a table of exposure gives of the keys that exclude each other."""
    given = exposure if isinstance(exposure, Mapping) else {}
    return {name: given[name] for name in ("full_scale", "percentile", "average") if name in given}


def _optional(model: type[Spec]) -> set[str]:
    """Return the names of what is None where it is not given."""
    return {name for name, field in model.model_fields.items() if field.default is None} - {"preset"}


class Sensor(Spec):
    """From radiance to a frame, in this order.

    Point spread, vignetting, exposure, colour filter mosaic, noise, demosaicing, white balance and colour matrix,
    saturation, response, sharpening, scaling, captions, quantisation, coding.
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
    sharpening: Sharpening | None = Field(None, description="default none")
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
        if any(value is not None for value in _rules(data.get("exposure")).values()):
            # The rules of exposure exclude each other, so a given one replaces the preset's.
            filled["exposure"] = data["exposure"]
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
        return any(stage is not None for stage in (self.sharpening, self.scaling, self.overlay, self.coding))

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
