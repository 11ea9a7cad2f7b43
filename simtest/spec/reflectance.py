"""The reflectances of a scene, the colour of tissue, and how its diffuse light spreads below the surface."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from simtest.spec.spec_model import UNSAID, Share, Spec, with_preset

TissuePreset = Literal["colon_mucosa", "liver_capsule", "gallbladder", "stomach"]

MAX_CALIBRE_RATIO = 30.0
"""Largest over smallest calibre: a tree has its cube of twigs (Murray's law), more than fit on any surface here."""

TISSUE_PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "colon_mucosa": {
            "base": (0.66, 0.29, 0.19),
            "blood": 0.04,
            "mottling": {"amplitude": 0.10, "wavelength_mm": 7.0},
            "vessels": {"largest_mm": 0.5, "smallest_mm": 0.06, "spacing_mm": 1.3, "depth_mm": 0.12},
            "capillaries": {"spacing_mm": 0.11, "strength": 0.10},
        },
        "liver_capsule": {
            "base": (0.20, 0.040, 0.033),
            "blood": 0.15,
            "mottling": {"amplitude": 0.10, "wavelength_mm": 10.0},
            "vessels": {"largest_mm": 0.5, "smallest_mm": 0.08, "spacing_mm": 4.5, "depth_mm": 0.15},
            "capillaries": {"spacing_mm": 1.2, "strength": 0.10},
        },
        "gallbladder": {
            "base": (0.72, 0.47, 0.31),
            "blood": 0.015,
            "mottling": {"amplitude": 0.08, "wavelength_mm": 9.0},
            "vessels": {"largest_mm": 0.7, "smallest_mm": 0.07, "spacing_mm": 2.2, "depth_mm": 0.15},
            "capillaries": {"spacing_mm": 0.4, "strength": 0.05},
        },
        "stomach": {
            "base": (0.66, 0.28, 0.17),
            "blood": 0.05,
            "mottling": {"amplitude": 0.13, "wavelength_mm": 5.0},
            "vessels": {"largest_mm": 0.4, "smallest_mm": 0.06, "spacing_mm": 2.5, "depth_mm": 0.25},
            "capillaries": {"spacing_mm": 0.3, "strength": 0.16},
        },
    }
)
"""Numbers of the presets; docs/concepts/tissue.md gives their sources."""

_COLON = TISSUE_PRESETS["colon_mucosa"]


class Mottling(Spec):
    """Blood content that varies from place to place."""

    amplitude: float = Field(ge=0, le=1, description="standard deviation of the ground's absorbance in green; 0: none")
    wavelength_mm: float = Field(ge=0.2, le=200, description="mean wavelength, mm")


class Vessels(Spec):
    """Trees of vessels, arteries and veins, whose radii obey Murray's law."""

    largest_mm: float = Field(ge=0.02, le=5, description="calibre (diameter) of a whole tree's trunk, about, mm")
    smallest_mm: float = Field(ge=0.005, le=2, description="calibre of the twigs, mm")
    spacing_mm: float = Field(ge=0.2, le=50, description="mean distance between the ends of neighbouring twigs, mm")
    depth_mm: float = Field(ge=0, le=3, description="depth of the vessels below the surface, mm")
    deepest_mm: float | None = Field(
        None,
        ge=0,
        le=3,
        description="depth of the largest, mm, the twigs' being depth_mm; default: all at depth_mm",
        **UNSAID,
    )
    arterial_saturation: Share = Field(0.97, description="share of oxygenated haemoglobin in arteries")
    venous_saturation: Share = Field(0.75, description="the same in veins")
    tortuosity: float = Field(0.6, ge=0, le=1, description="how much vessels wind; 0: straight")
    strength: float = Field(1.0, ge=0, le=2, description="haemoglobin over that of normal blood; 0: no vessels")

    @model_validator(mode="after")
    def _ordered(self) -> "Vessels":
        if not self.smallest_mm < self.largest_mm <= MAX_CALIBRE_RATIO * self.smallest_mm:
            raise ValueError(
                f"largest_mm = {self.largest_mm:g} and smallest_mm = {self.smallest_mm:g}: the largest calibre must "
                f"be more than the smallest and at most {MAX_CALIBRE_RATIO:g} times as much"
            )
        if self.largest_mm > self.spacing_mm:
            raise ValueError(
                f"largest_mm = {self.largest_mm:g} and spacing_mm = {self.spacing_mm:g}: vessels must not be wider "
                "than their spacing"
            )
        if self.deepest_mm is not None and self.deepest_mm < self.depth_mm:
            raise ValueError(f"deepest_mm = {self.deepest_mm:g}: must be at least depth_mm, {self.depth_mm:g}")
        return self


class Capillaries(Spec):
    """The net of capillaries between the vessels, such as the honeycomb around the pits of mucosa."""

    spacing_mm: float = Field(ge=0.05, le=20, description="mean width of the net's meshes, mm")
    strength: float = Field(ge=0, le=1, description="absorbance of the net in green; 0: none")


class Debris(Spec):
    """What lies on the tissue, without a thickness of its own: stool, and bile. Depth and normals are the tissue's."""

    stool: float = Field(0.0, ge=0, le=0.5, description="share of the surface below stool: opaque, no film reflects")
    stool_colour: tuple[Share, Share, Share] = Field((0.55, 0.30, 0.05), description="its albedo, linear RGB")
    bile: float = Field(0.0, ge=0, le=0.5, description="share of the surface below bile: clear, under the film")
    bile_absorbance: float = Field(1.5, ge=0, le=5, description="of the bile in blue; yellow where it is thin")
    size_mm: float = Field(6.0, ge=0.5, le=50, description="mean wavelength of the patches, mm")


class TissueColour(Spec):
    """The albedo of tissue. A preset gives all numbers; each may be replaced."""

    preset: TissuePreset = Field("colon_mucosa", description="whose numbers hold where none is given")
    base: tuple[Share, Share, Share] = Field(_COLON["base"], description="albedo of the ground, linear RGB")
    blood: Annotated[float, Field(ge=0.001, le=1)] = Field(
        _COLON["blood"], description="share of the ground's volume that is blood: how deep light reaches"
    )
    mottling: Mottling = Mottling(**_COLON["mottling"])
    vessels: Vessels = Vessels(**_COLON["vessels"])
    capillaries: Capillaries = Capillaries(**_COLON["capillaries"])
    debris: Debris | None = Field(None, description="stool and bile on the tissue; default none", **UNSAID)
    seed: int = Field(0, ge=0, lt=2**32, description="of the pattern")

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, data: Any) -> Any:
        """Fill in the preset's numbers; an unknown preset is refused by its field."""
        if not isinstance(data, Mapping):
            return data
        named = data.get("preset", "colon_mucosa")
        preset = TISSUE_PRESETS.get(named) if isinstance(named, str) else None
        return data if preset is None else with_preset(data, preset)


Scattering = Annotated[float, Field(ge=0.1, le=100)]
Absorption = Annotated[float, Field(ge=1e-3, le=100)]


class Translucency(Spec):
    """Optical properties that the spread of diffuse light follows, per channel; sources in docs/concepts/tissue.md."""

    scattering_per_mm: tuple[Scattering, Scattering, Scattering] = Field(
        (1.0, 1.1, 1.25), description="reduced scattering coefficient in red, green and blue, 1/mm"
    )
    absorption_per_mm: tuple[Absorption, Absorption, Absorption] = Field(
        (0.056, 0.83, 0.63), description="absorption coefficient in red, green and blue, 1/mm: 3 % of blood"
    )
    index: float = Field(1.37, ge=1, le=1.6, description="refractive index of the tissue, against air")


ROUNDING = 1e-9
"""By how much a sum of shares written in decimals may exceed 1."""


def ggx_half_width(alpha: float) -> float:
    """Return the half-angle, rad, at which GGX's density of facets falls to half: tan^2 = alpha^2 (sqrt(2) - 1)."""
    return math.atan(alpha * math.sqrt(math.sqrt(2) - 1))


KernelTable = dict[str, Any]
"""A description for `mitsuba.load_dict`, or values by Mitsuba's path below the BSDF; three numbers are a colour."""


class _Reflectance(Spec):
    """What the renderer takes of a reflectance beside its parameters is `kernel`, `updates`, `compiled`, `base_kernel`.

    Each class gives `kernel`, its description, `updates`, the values that change without a rebuild, `half_width`, and
    its name `in_words`.
    """

    diffuse: Share = Field(0.0, description="share of the diffuse base, its albedo")
    colour: tuple[Share, Share, Share] = Field((1.0, 1.0, 1.0), description="linear RGB colour of the diffuse base")

    @property
    def compiled(self) -> tuple[object, ...]:
        """What of the reflectance is compiled into the kernels."""
        return (self.type,)  # type: ignore[attr-defined]

    @property
    def base_kernel(self) -> KernelTable | None:
        """Description without the lobe; None where components 0 and 1 of the BSDF are lobe and base."""
        return None

    @property
    def lobe_curvature(self) -> float | None:
        """Curvature -(log f)''(0) of the lobe with the light at the camera; None where it has no closed form."""
        return None

    @property
    def _base(self) -> list[float]:
        """Linear RGB albedo of the diffuse base."""
        return [self.diffuse * c for c in self.colour]


def _rgb(colour: list[float]) -> KernelTable:
    return {"type": "rgb", "value": colour}


def _grey(value: float) -> KernelTable:
    return {"type": "uniform", "value": value}


class _Painted(_Reflectance):
    """A reflectance whose base may have the colour of tissue."""

    albedo: TissueColour | None = Field(
        None, description="mottling and vessels: the base's albedo in place of diffuse and colour"
    )

    @model_validator(mode="after")
    def _one_albedo(self) -> "_Painted":
        # A dump names the defaults too.
        fields = type(self).model_fields
        given = [name for name in ("colour", "diffuse") if getattr(self, name) != fields[name].default]
        if self.albedo is not None and given:
            raise ValueError(f"{given[0]} and albedo exclude each other; leave out {given[0]} or albedo")
        return self


class PhongReflectance(_Painted):
    """Phong: specular c cos^n(beta) as published, or the energy-conserving form."""

    in_words: ClassVar[str] = "Phong lobe"

    type: Literal["phong"] = "phong"
    exponent: float = Field(50.0, gt=0, le=1e5, description="roughness exponent n")
    specular: float = Field(1.0, ge=0, le=1e6, description="scale c of the specular lobe")
    normalised: bool = Field(
        False,
        description="energy-conserving form: (n + 2)/(2 pi) cos^n(beta) cos(theta); specular + diffuse at most 1",
    )

    @model_validator(mode="after")
    def _conserves_energy(self) -> "PhongReflectance":
        # At normal incidence the albedo is the sum, in the colour's strongest channel; mottling reaches up to 1.
        base = self.diffuse * max(self.colour) if self.albedo is None else 1.0
        if self.normalised and self.specular + base > 1 + ROUNDING:
            raise ValueError(
                f"specular = {self.specular:g} and a diffuse base of {base:g} reflect more light than arrives; "
                "their sum must be at most 1 when normalised is true"
            )
        return self

    @property
    def compiled(self) -> tuple[object, ...]:
        """What of the reflectance is compiled into the kernels."""
        return self.type, self.normalised

    @property
    def kernel(self) -> KernelTable:
        """Description for `mitsuba.load_dict`."""
        lobe = {"exponent": self.exponent, "specular": self.specular, "normalised": self.normalised}
        return {"type": "simtest_phong", **lobe, "diffuse_reflectance": _rgb(self._base)}

    @property
    def updates(self) -> KernelTable:
        """Values that change without a rebuild."""
        return {"exponent": self.exponent, "specular": self.specular, "diffuse_reflectance.value": self._base}

    @property
    def lobe_curvature(self) -> float:
        """Curvature -(log f)''(0) of the lobe: 4 n as published, one more with the cosine of the normalised form."""
        return 4 * self.exponent + (1.0 if self.normalised else 0.0)

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad, light and camera together."""
        return math.acos(2 ** (-1 / self.exponent)) / 2


class RoughPlasticReflectance(_Reflectance):
    """Mitsuba's rough plastic, GGX."""

    in_words: ClassVar[str] = "rough plastic"

    type: Literal["rough_plastic"] = "rough_plastic"
    alpha: float = Field(0.15, gt=0, le=1, description="GGX roughness")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")

    @property
    def kernel(self) -> KernelTable:
        """Description for `mitsuba.load_dict`."""
        lobe = {"distribution": "ggx", "alpha": self.alpha, "specular_reflectance": _grey(1.0)}
        return {"type": "roughplastic", **lobe, "diffuse_reflectance": _rgb(self._base)}

    @property
    def updates(self) -> KernelTable:
        """Values that change without a rebuild."""
        return {"alpha": self.alpha, "diffuse_reflectance.value": self._base}

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad (`ggx_half_width`)."""
        return ggx_half_width(self.alpha)


class PrincipledReflectance(_Reflectance):
    """Mitsuba's principled material, not metallic."""

    in_words: ClassVar[str] = "principled lobe"

    type: Literal["principled"] = "principled"
    roughness: float = Field(0.3, gt=0, le=1, description="roughness (alpha is its square)")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")

    @property
    def kernel(self) -> KernelTable:
        """Description for `mitsuba.load_dict`."""
        lobe = {"roughness": _grey(self.roughness), "specular": 0.5}
        return {"type": "principled", "base_color": _rgb(self._base), **lobe}

    @property
    def base_kernel(self) -> KernelTable:
        """Description without the lobe: Mitsuba's material evaluates no component alone."""
        return {**self.kernel, "specular": 0.0}

    @property
    def updates(self) -> KernelTable:
        """Values that change without a rebuild."""
        return {"roughness.value": self.roughness, "base_color.value": self._base}

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad (`ggx_half_width`)."""
        return ggx_half_width(self.roughness**2)


class RoughConductorReflectance(_Reflectance):
    """Mitsuba's rough conductor, GGX, blended with a diffuse base by its share."""

    in_words: ClassVar[str] = "rough conductor"

    type: Literal["rough_conductor"] = "rough_conductor"
    alpha: float = Field(0.2, gt=0, le=1, description="GGX roughness")

    @property
    def kernel(self) -> KernelTable:
        """Description for `mitsuba.load_dict`: a rough conductor has no base, a matt one is blended in."""
        lobe = {"material": "none", "distribution": "ggx", "alpha": self.alpha, "specular_reflectance": _grey(1.0)}
        matt = {"type": "diffuse", "reflectance": _rgb(list(self.colour))}
        return {"type": "blendbsdf", "weight": self.diffuse, "glossy": {"type": "roughconductor", **lobe}, "matt": matt}

    @property
    def updates(self) -> KernelTable:
        """Values that change without a rebuild."""
        matt = {"bsdf_1.reflectance.value": list(self.colour)}
        return {"weight.value": self.diffuse, "bsdf_0.alpha.value": self.alpha, **matt}

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad (`ggx_half_width`)."""
        return ggx_half_width(self.alpha)


class Patches(Spec):
    """Patches of deep and shallow film with dry ground between: the film's level is a random field over the surface."""

    wavelength_mm: float = Field(
        8.0, ge=1, le=20, description="mean wavelength of the level, mm; a patch is about half as wide"
    )
    amplitude: float = Field(
        2.0, gt=0, le=5, description="standard deviation of the level, in those of the relief's height"
    )
    dry_level: float = Field(
        -2.5, ge=-30, le=3, description="ground is dry where the level is lower, in deviations as the level itself"
    )
    dry_alpha: float = Field(0.45, ge=0.05, le=0.5, description="roughness of dry ground, in place of alpha")


class Film(Spec):
    """A liquid film over the tissue: a rough dielectric surface."""

    index: float = Field(ge=1.33, le=1.40, description="refractive index; water 1.33, mucus up to about 1.40")
    alpha: float = Field(0.03, ge=0.01, le=0.1, description="roughness; alpha^2/2 is the variance of Beckmann's slopes")
    distribution: Literal["beckmann", "ggx"] = Field("beckmann", description="of the slopes of the film's surface")
    level: float | None = Field(
        None,
        ge=-3,
        le=3,
        description="height up to which the film fills the valleys of surface.relief, in standard deviations of the "
        "relief's height about its mean; default: the film follows the relief",
    )
    patches: Patches | None = Field(
        None, description="how the level varies over the surface about `level`; default: it does not", **UNSAID
    )

    @model_validator(mode="after")
    def _has_level(self) -> "Film":
        if self.patches is not None and self.level is None:
            raise ValueError("patches vary the film's level: give level too, or leave out patches")
        return self

    def half_width(self, wet: float = 1.0) -> float:
        """Return the half-angle at which the lobe falls to half, rad, where ground is wet by a share.

        Beckmann's exp(-tan^2/alpha^2), or `ggx_half_width`.
        """
        alpha = self.alpha if self.patches is None else wet * self.alpha + (1 - wet) * self.patches.dry_alpha
        return math.atan(alpha * math.sqrt(math.log(2))) if self.distribution == "beckmann" else ggx_half_width(alpha)


class TissueReflectance(_Painted):
    """Wet tissue: the film's reflection, and a diffuse base whose light passes the film twice."""

    in_words: ClassVar[str] = "film over tissue"

    type: Literal["tissue"] = "tissue"
    film: Film
    diffuse: Share = Field(0.5, description="albedo of the diffuse base below the film")
    translucency: Translucency | None = Field(
        None, description="how the diffuse light spreads below the surface; default: it leaves where it entered"
    )

    @property
    def compiled(self) -> tuple[object, ...]:
        """What of the reflectance is compiled into the kernels."""
        return self.type, self.film.distribution, self.film.patches is not None

    @property
    def kernel(self) -> KernelTable:
        """Description for `mitsuba.load_dict`."""
        film = {"distribution": self.film.distribution, **self._film}
        return {"type": "simtest_tissue", **film, "diffuse_reflectance": _rgb(self._base)}

    @property
    def updates(self) -> KernelTable:
        """Values that change without a rebuild."""
        return {**self._film, "diffuse_reflectance.value": self._base}

    @property
    def _film(self) -> KernelTable:
        dry = {} if self.film.patches is None else {"dry_alpha": self.film.patches.dry_alpha}
        return {"alpha": self.film.alpha, "index": self.film.index, **dry}

    @property
    def lobe_curvature(self) -> float | None:
        """Curvature -(log f)''(0) of the lobe with the light at the camera.

        None for GGX, whose tails it misses, and where dry ground has another lobe.

        Beckmann: f cos(theta) is proportional to exp(-tan^2(theta)/alpha^2) / cos^5(theta), so 2/alpha^2 - 5. Smith's
        function is 1 next to the normal, and the facets that reflect back are met straight on.
        """
        is_one = self.film.distribution == "beckmann" and self.film.patches is None
        return 2 / self.film.alpha**2 - 5 if is_one else None

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe of wet ground falls to half, rad."""
        return self.film.half_width()


Reflectance = Annotated[
    PhongReflectance | RoughPlasticReflectance | PrincipledReflectance | RoughConductorReflectance | TissueReflectance,
    Field(discriminator="type"),
]
