"""Points of a source of finite size, as Dr.Jit expressions: uniform over its area, from points of the unit square."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.rendering.mitsuba_values import MitsubaDict
from simtest.rendering.rays import Lanes
from simtest.runtime.arrays import Array
from simtest.spec.lights import CrescentSource, DiscSource, RingSource, Source

DRAWN = 4
"""Points of each source at each of a pixel's samples."""

FIXED = 64
"""Points of each source where a pixel has one sample, the same in all pixels: the picture has no noise."""

SLICES = 5 * FIXED // 2
"""Slices of a crescent, of about equal area; each pair of fixed points lies in the middle of one."""

_GOLDEN = 0x9E3779B9
"""The golden ratio as a share of 2^32: its multiples beside equal steps cover the square evenly (Vogel's spiral)."""

_SILVER = 0x6A09E667
"""The root of 2 the same way, for the choice of a shadow ray's target."""


@dataclass(frozen=True)
class Draw:
    """Which points of the sources a sample of each pixel takes: some of one spiral over all samples of the pixel.

    Parameters
    ----------
    first, step : mitsuba.UInt32
        Number of the first point, and from one to the next; the latter is the number of samples.
    total : mitsuba.Float
        Points of all samples of the pixel together.
    shifts : tuple of mitsuba.UInt32 or None
        Random shifts of the pixel's points and choices, shares of 2^32; None for the fixed points.
    """

    first: Any
    step: Any
    total: Any
    shifts: tuple[Any, Any, Any] | None

    def square(self, mi: Any, kind: str, number: Any, light: int) -> tuple[Any, Any]:
        """Return u and v in [0, 1), mitsuba.Float, of a sample's point by its number, for the light of an index.

        Around a ring v is in equal steps, elsewhere u is.
        """
        index = self.first + number * self.step
        if self.shifts is None:
            # Pairs of opposite points, so that the centroid is exact: where it is off the highlight moves.
            pair, opposite = index >> 1, (index & 1) << 31
            even, turn = (2 * mi.Float(pair) + 1) / self.total, pair * mi.UInt32(_GOLDEN)
            if kind == "ring":
                return _share(mi, turn), even / 2 + _share(mi, opposite)
            return even, _share(mi, turn + opposite)
        # Lights get other points each, else their errors would add up.
        along = _share(mi, self.shifts[0] + mi.UInt32(light * _GOLDEN & 0xFFFFFFFF))
        turn = index * mi.UInt32(_GOLDEN) + self.shifts[1] + mi.UInt32(light * _SILVER & 0xFFFFFFFF)
        even = (mi.Float(index) + along) / self.total
        return (_share(mi, turn), even) if kind == "ring" else (even, _share(mi, turn))

    def choice(self, mi: Any, light: int) -> Any:
        """Return a number in [0, 1), mitsuba.Float, to choose one of the points by."""
        assert self.shifts is not None
        return _share(mi, self.shifts[2] + (self.first + mi.UInt32(light)) * mi.UInt32(_SILVER))


def _share(mi: Any, number: Any) -> Any:
    """Return a share of 2^32 as a number in [0, 1); single precision holds 24 bits."""
    return mi.Float(number >> 8) * 2.0**-24


class Drawer:
    """Draws of one launch's samples; without lanes the fixed points.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    lanes : Lanes or None
        The pixels.
    samples : int
        Of each pixel.
    """

    def __init__(self, mi: Any, lanes: Lanes | None, samples: int) -> None:
        import drjit as dr

        self.mi, self._shifts = mi, None
        self._step = mi.UInt32(1 if lanes is None else samples)
        self._total = mi.Float(FIXED if lanes is None else DRAWN * samples)
        dr.make_opaque(self._step, self._total)
        if lanes is not None:
            # Other numbers than those of the places in the pixel, from the same seed. The golden ratio's field is not
            # that of the places' recurrence: place and point are independent of each other.
            first = mi.sample_tea_32(lanes.shift_x, lanes.shift_y)
            self._shifts = (*first, mi.sample_tea_32(*first)[0])

    def at(self, number: Any) -> Draw:
        """Return the draw of a pixel's sample by its number."""
        return Draw(self.mi.UInt32(number), self._step, self._total, self._shifts)


def kind_of(source: Source | None) -> str:
    """Return which form of source is compiled into the kernel."""
    return "point" if source is None else source.type


def parameters(mi: Any, source: Source, centroid: Array, across: Array) -> MitsubaDict:
    """Return a source's parameters by name.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    source : Source
        Disc, ring or crescent.
    centroid : ndarray, shape (3,)
        Of its area, model frame, mm.
    across : ndarray, shape (2, 3)
        Unit vectors x and y of its plane, model frame.
    """
    centre = centroid - source.centroid_mm @ across
    if not isinstance(source, CrescentSource):
        inner = source.inner_mm if isinstance(source, RingSource) else 0.0
        own = {"inner2": mi.Float(inner**2), "outer2": mi.Float(source.radius_mm**2)}
    else:
        # x of the plane points towards the cut.
        x = source.towards_cut @ across
        across = np.stack([x, [-source.towards_cut[1], source.towards_cut[0]] @ across])
        own = {
            "outer2": mi.Float(source.radius_mm**2),
            "cut2": mi.Float(source.cut_radius_mm**2),
            "cut_at": mi.Float(source.cut_offset_mm),
            "area": mi.Float(source.area_mm2),
            "knots": mi.Float(source.quantiles(SLICES).astype(np.float32)),
        }
    return {
        "centre": mi.Point3f(*centre.tolist()),
        "side": mi.Vector3f(*across[0].tolist()),
        "up": mi.Vector3f(*across[1].tolist()),
        **own,
    }


def blank(mi: Any, kind: str) -> MitsubaDict:
    """Return parameters of some source of a kind, for a plugin that gets its values later."""
    some: dict[str, Source] = {
        "disc": DiscSource(type="disc", radius_mm=1.0),
        "ring": RingSource(type="ring", radius_mm=1.0, inner_mm=0.5),
        "crescent": CrescentSource(type="crescent", radius_mm=1.0, cut_radius_mm=1.0, cut_offset_mm=1.0),
    }
    return {} if kind == "point" else parameters(mi, some[kind], np.zeros(3), np.eye(3)[:2])


def point(mi: Any, kind: str, values: MitsubaDict, u: Any, v: Any) -> tuple[Any, Any]:
    """Compute a point of a source, mitsuba.Point3f, mm, and its weight, 1 on average over the unit square."""
    import drjit as dr

    if kind != "crescent":
        radius = dr.sqrt(dr.lerp(values["inner2"], values["outer2"], u))
        sine, cosine = dr.sincos(dr.two_pi * v)
        return values["centre"] + radius * (cosine * values["side"] + sine * values["up"]), mi.Float(1)
    # Slice by slice: along the knots, then over both parts of the chord, beyond the cut and this side of it.
    slices = dr.minimum(mi.UInt32(u * SLICES), SLICES - 1)
    low, high = dr.gather(mi.Float, values["knots"], slices), dr.gather(mi.Float, values["knots"], slices + 1)
    along = dr.lerp(low, high, u * SLICES - mi.Float(slices))
    outer = dr.safe_sqrt(values["outer2"] - dr.square(along))
    cut = dr.minimum(dr.safe_sqrt(values["cut2"] - dr.square(along - values["cut_at"])), outer)
    across = 2 * v - 1
    height = dr.copysign(dr.lerp(cut, outer, dr.abs(across)), across)
    # Slices are of equal area only nearly: the weight makes up for the rest.
    weight = 2 * (outer - cut) * (high - low) * SLICES / values["area"]
    return values["centre"] + along * values["side"] + height * values["up"], weight
