"""The albedo of tissue inside a kernel: what `simtest.surfaces.tissue_pattern` computes, gathered at each hit."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from simtest.rendering.mitsuba_values import channels
from simtest.surfaces.segment_table import ENDLESS, PRIMES

if TYPE_CHECKING:
    from simtest.rendering.rest_map import RestMap
    from simtest.surfaces.tissue_pattern import Lattice, TissuePattern

CHANNELS = 3

HEADER = 64
"""Numbers at the buffer's start; see `_header`."""

PACKET = 4
"""Numbers that one gather reads."""

TURN, PER_MM, MASK, ROWS, HALF = 32, 50, 51, 52, 53
"""Where the header holds both lattices' turns, cells over mm, what of a hash is the slot, the first row, and half-sizes
beyond which vessels are mirrored."""


class AlbedoKernel:
    """Evaluates the albedo of tissue.

    All numbers of the pattern lie in one buffer. Dr.Jit orders a kernel's arguments at random where there are several,
    and compiles each order once.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    pattern : TissuePattern
        Of the surface.

    Attributes
    ----------
    rest : RestMap or None
        Where the tissue was, of a deformed surface.
    """

    def __init__(self, mi: Any, pattern: "TissuePattern") -> None:
        self.mi, self.pattern = mi, pattern
        self.rest: RestMap | None = None
        lattices = (pattern.mottling, pattern.capillaries)
        self._nodes = len(pattern.mottling.values)
        table = pattern.vessels
        self._is_mirrored = bool((table.half_mm < ENDLESS).any())
        first = np.zeros(-(-len(table.first) // PACKET) * PACKET, dtype=np.float32)
        first.view(np.uint32)[: len(table.first)] = table.first
        parts = [_header(pattern), *(_packets(lattice) for lattice in lattices), first, table.rows.ravel()]
        # The sizes of all but the last two are the same for all patterns.
        self._lattices = [sum(map(len, parts[: 1 + i])) // PACKET for i in range(len(lattices))]
        self._first = sum(map(len, parts[:3]))
        parts[0].view(np.uint32)[ROWS] = sum(map(len, parts[:4])) // PACKET
        self._buffer = mi.Float(np.concatenate(parts))

    def of(self, si: Any, active: Any) -> Any:
        """Compute the albedo, mitsuba.Spectrum, of surface points, mitsuba.SurfaceInteraction3f."""
        return self.at(si.p if self.rest is None else self.rest.point(si, active), active)

    def at(self, p: Any, active: Any) -> Any:
        """Compute the albedo, mitsuba.Spectrum, at points of the surface, mitsuba.Point3f, model frame, mm."""
        import drjit as dr

        mi, p = self.mi, self.mi.Vector3f(p)
        field, net = (self._lattice(i, p, active) for i in range(len(self._lattices)))
        artery, vein = self._chords(p, active)
        colour = []
        for channel in range(CHANNELS):
            numbers = [self._number(8 * channel + i) for i in range(6)]
            base, mottled, netted, share, arterial, venous = numbers
            below = 1 - share * (1 - dr.exp(-arterial * artery))
            below *= 1 - share * (1 - dr.exp(-venous * vein))
            colour.append(dr.clip(base * dr.exp(-field * mottled - net * netted) * below, 0, 1))
        if channels(mi) == CHANNELS:
            return mi.Spectrum(*colour)
        return mi.Spectrum(mi.luminance(mi.Color3f(*colour)))

    def _number(self, index: int) -> Any:
        """Return a number of the header."""
        import drjit as dr

        return dr.gather(self.mi.Float, self._buffer, self.mi.UInt32(index))

    def _whole(self, index: Any, active: Any = True) -> Any:
        """Return a whole number of the buffer."""
        import drjit as dr

        return dr.reinterpret_array(self.mi.UInt32, dr.gather(self.mi.Float, self._buffer, index, active))

    def _packet(self, index: Any, active: Any) -> Any:
        import drjit as dr

        return dr.gather(self.mi.Vector4f, self._buffer, index, active)

    def _chords(self, p: Any, active: Any) -> tuple[Any, Any]:
        """Compute the chords, mm, through arteries and veins below points; see `SegmentTable.chords`."""
        import drjit as dr

        mi = self.mi
        if self._is_mirrored:
            half = mi.Vector3f(*(self._number(HALF + axis) for axis in range(3)))
            number = dr.round(p / (2 * half))
            odd = number - 2 * dr.floor(number / 2)
            p = (p - 2 * number * half) * (1 - 2 * odd)
        cell = mi.Vector3i(dr.floor(p * self._number(PER_MM)))
        parts = [mi.UInt32(cell[axis]) * prime for axis, prime in enumerate(PRIMES)]
        slot = (parts[0] ^ parts[1] ^ parts[2]) & self._whole(mi.UInt32(MASK))
        row, last = (self._whole(self._first + slot + i, active) for i in range(2))
        # A row is two packets.
        rows = self._whole(mi.UInt32(ROWS))
        row, last = rows + 2 * row, rows + 2 * last

        def step(row: Any, artery: Any, vein: Any) -> tuple[Any, Any, Any]:
            start, along = self._packet(row, active), self._packet(row + 1, active)
            gap, d = p - mi.Vector3f(*start[:3]), mi.Vector3f(*along[:3])
            t = dr.clip(dr.dot(gap, d) / dr.squared_norm(d), 0, 1)
            inside = dr.maximum(1 - dr.squared_norm(gap - t * d) / (start[3] * start[3]), 0)
            chord = along[3] * inside * dr.sqrt(inside)
            return row + 2, dr.maximum(artery, chord), dr.maximum(vein, -chord)

        none = mi.Float(0)
        _, artery, vein = dr.while_loop((row, none, none), lambda row, *_: mi.Bool(active) & (row < last), step)
        return artery, vein

    def _lattice(self, which: int, p: Any, active: Any) -> Any:
        """Interpolate a periodic lattice; see `Lattice.at`."""
        import drjit as dr

        mi, nodes = self.mi, self._nodes
        turn = mi.Matrix3f(*(self._number(TURN + 9 * which + i) for i in range(9)))
        cells = turn @ p
        corner = dr.floor(cells)
        share = cells - corner
        # The number of nodes is a power of two.
        x, y, z = (mi.UInt32(cell) & (nodes - 1) for cell in mi.Vector3i(corner))
        total = mi.Float(0)
        for up, weight in ((0, 1 - share.x), (1, share.x)):
            slab = (x + up) & (nodes - 1)
            low = self._packet(self._lattices[which] + (slab * nodes + y) * nodes + z, active)
            first, second = dr.lerp(low[0], low[1], share.z), dr.lerp(low[2], low[3], share.z)
            total += weight * dr.lerp(first, second, share.y)
        return total


def _header(pattern: "TissuePattern") -> npt.NDArray[np.float32]:
    """Return, 8 numbers for each channel, ground, absorbances, share and absorptions; then what `TURN` etc. say."""
    header = np.zeros(HEADER, dtype=np.float32)
    rows = (pattern.base, pattern.mottled, pattern.netted, pattern.share, *pattern.absorption)
    for i, values in enumerate(rows):
        header[i : 8 * CHANNELS : 8] = values
    for i, lattice in enumerate((pattern.mottling, pattern.capillaries)):
        header[TURN + 9 * i : TURN + 9 * (i + 1)] = lattice.lattice_from_model.ravel()
    header[PER_MM] = 1 / pattern.vessels.cell_mm
    header[HALF : HALF + 3] = pattern.vessels.half_mm
    header.view(np.uint32)[MASK] = pattern.vessels.mask
    return header


def _packets(lattice: "Lattice") -> npt.NDArray[np.float32]:
    """Return, for each node, the values there and at the next along z, and the same at the next along y."""
    rows = [np.roll(lattice.values, (-y, -z), axis=(1, 2)) for y in range(2) for z in range(2)]
    return np.stack(rows, axis=-1).astype(np.float32).ravel()
