"""What Mitsuba lacks, a file each: reflectances and lights as plugins, for any integrator."""

from functools import cache

from simtest.rendering.backend import mi
from simtest.rendering.elements.lights import LIGHT, make_light
from simtest.rendering.elements.phong import make_phong
from simtest.rendering.elements.tissue import make_tissue

REFLECTANCES = {"simtest_phong": make_phong, "simtest_tissue": make_tissue}
"""By the type that a reflectance's `kernel` names."""


@cache
def register(variant: str) -> None:
    """Register all plugins for a variant, whose own classes they derive from, once."""
    for name, make in REFLECTANCES.items():
        mi.register_bsdf(name, lambda props, make=make: make(variant)(props))
    mi.register_emitter(LIGHT, lambda props: make_light(variant)(props))
