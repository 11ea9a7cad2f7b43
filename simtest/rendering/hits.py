"""Surface points of a kernel's hits: of the base, and as the two kinds of light see them."""

from dataclasses import dataclass
from typing import Any

from simtest.rendering.relief_kernel import KernelJets, ReliefKernel, turned


@dataclass(frozen=True)
class Hit:
    """A surface point, mitsuba.SurfaceInteraction3f, with three shading normals; without a relief they are one object.

    Parameters
    ----------
    base : mitsuba.SurfaceInteraction3f
        Of the smooth surface.
    fine : mitsuba.SurfaceInteraction3f
        Of the relief: what light off the lobe sees.
    diffuse : mitsuba.SurfaceInteraction3f
        Of the smoothed relief: what light sees that has travelled below the surface.
    jets : KernelJets or None
        Of the relief.
    """

    base: Any
    fine: Any
    diffuse: Any
    jets: KernelJets | None = None


def make_hit(mi: Any, si: Any, relief: ReliefKernel | None, bent: bool = False) -> Hit:
    """Make a hit of the base's surface points; with the relief's second derivatives if `bent`."""
    if relief is None:
        return Hit(si, si, si)
    jets = relief.jets_at(si, bent)
    return Hit(si, turned(mi, si, jets.gradient), turned(mi, si, jets.diffused), jets)
