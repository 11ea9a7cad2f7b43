"""Mitsuba BSDFs of a scene's reflectance: the full one and its diffuse base alone."""

from typing import Any

from simtest.rendering import tissue
from simtest.rendering.mitsuba_values import MitsubaDict, spectrum
from simtest.spec.reflectance import (
    PhongReflectance,
    PrincipledReflectance,
    Reflectance,
    RoughConductorReflectance,
    RoughPlasticReflectance,
    TissueReflectance,
)


def bsdf_dict(reflectance: Reflectance, phong_plugin: str, diffuse_only: bool) -> MitsubaDict:
    """Describe a reflectance to `mi.load_dict`; `phong_plugin` is the registered name of the Phong plugin.

    With `diffuse_only` the specular part is left out: the difference between both radiances is the specular one. Not
    for tissue, whose parts are evaluated one by one.
    """
    specular = 0.0 if diffuse_only else 1.0
    base = {"type": "rgb", "value": [reflectance.diffuse * c for c in reflectance.colour]}
    match reflectance:
        case PhongReflectance():
            return {
                "type": phong_plugin,
                "exponent": reflectance.exponent,
                "specular": specular * reflectance.specular,
                "normalised": reflectance.normalised,
                "diffuse_reflectance": base,
            }
        case RoughPlasticReflectance():
            return {
                "type": "roughplastic",
                "distribution": "ggx",
                "alpha": reflectance.alpha,
                "diffuse_reflectance": base,
                "specular_reflectance": {"type": "uniform", "value": specular},
            }
        case PrincipledReflectance():
            return {
                "type": "principled",
                "base_color": base,
                "roughness": {"type": "uniform", "value": reflectance.roughness},
                "specular": 0.5 * specular,
            }
        # A rough conductor has no base of its own: a matt one is blended in.
        case RoughConductorReflectance():
            return {
                "type": "blendbsdf",
                "weight": reflectance.diffuse,
                "glossy": {
                    "type": "roughconductor",
                    "material": "none",
                    "distribution": "ggx",
                    "alpha": reflectance.alpha,
                    "specular_reflectance": {"type": "uniform", "value": specular},
                },
                "matt": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance.colour)}},
            }
        case TissueReflectance():
            assert not diffuse_only
            return {
                "type": tissue.PLUGIN,
                "alpha": reflectance.film.alpha,
                "index": reflectance.film.index,
                "distribution": reflectance.film.distribution,
                "diffuse_reflectance": base,
            }


def parts_alone(reflectance: Reflectance) -> bool:
    """Return whether components 0 and 1 of the BSDF are the lobe and the base."""
    return isinstance(reflectance, PhongReflectance | TissueReflectance)


def compiled_form(reflectance: Reflectance) -> tuple[object, ...]:
    """Return what of a reflectance is compiled into the kernels."""
    if isinstance(reflectance, TissueReflectance):
        return type(reflectance), reflectance.film.distribution
    return type(reflectance), getattr(reflectance, "normalised", None)


def parameter_updates(mi: Any, reflectance: Reflectance) -> MitsubaDict:
    """Return the values that can change without a rebuild, by Mitsuba's parameter path below the BSDF.

    The paths hold for the whole BSDF and for its diffuse base; Phong's lobe has no base of its own.
    """
    base = spectrum(mi, [reflectance.diffuse * c for c in reflectance.colour])
    match reflectance:
        case PhongReflectance():
            lobe = {"exponent": reflectance.exponent, "specular": reflectance.specular}
            return {**lobe, "diffuse_reflectance.value": base}
        case RoughPlasticReflectance():
            return {"alpha": reflectance.alpha, "diffuse_reflectance.value": base}
        case PrincipledReflectance():
            return {"roughness.value": reflectance.roughness, "base_color.value": base}
        case RoughConductorReflectance():
            matt = {"bsdf_1.reflectance.value": spectrum(mi, list(reflectance.colour))}
            return {"weight.value": reflectance.diffuse, "bsdf_0.alpha.value": reflectance.alpha, **matt}
        case TissueReflectance():
            film = {"alpha": reflectance.film.alpha, "index": reflectance.film.index}
            return {**film, "diffuse_reflectance.value": base}
