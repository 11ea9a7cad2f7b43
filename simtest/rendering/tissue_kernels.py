"""What belongs to the tissue inside a kernel: relief, albedo, and where the tissue was before a deformation.

Relief and colour are looked up at the point at rest, and derivatives are carried to the deformed surface.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import channels
from simtest.runtime.arrays import Array
from simtest.surfaces.deformation import DeformedSurface, inverse_transpose
from simtest.surfaces.relief_field import NODES, ReliefField
from simtest.surfaces.vessels import BLUR_PER_DEPTH, ENDLESS, LEAST_CHORD, PRIMES

if TYPE_CHECKING:
    from simtest.surfaces.tissue_pattern import Lattice, TissuePattern


UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Of a symmetric matrix: xx, xy, xz, yy, yz, zz."""

Order = tuple[int, ...]
"""Orders of a derivative along x, y and z of the lattice."""


@dataclass(frozen=True)
class KernelJets:
    """Jets of the height at the lanes of a kernel, model frame, mm."""

    height: Any  # Of the tissue, mm
    # gradient, diffused: Gradients of the surface that the film's reflection sees, and of the one that diffuse light
    # sees
    gradient: Any
    diffused: Any
    hessian: tuple[Any, ...] | None  # xx, xy, xz, yy, yz, zz of the former, 1/mm; None where not asked for
    gain: Any = None  # What the film's level gains in patches, mm; None where it is constant


@dataclass(frozen=True)
class _Band:
    """One band in the kernel: lattice from model, its field, and the field that diffuse light sees, if it sees any."""

    lattice: Any
    fine: Any
    diffused: Any


class ReliefKernel:
    """Evaluates a relief; of a deformed surface `rest` says where the tissue was."""

    def __init__(self, field: ReliefField, rest: "RestMap | None" = None) -> None:
        self.field, self._rest = field, rest
        self._bands = [
            _Band(
                mi.Matrix3f(band.lattice_from_model.tolist()),
                _stored(band.coefficients),
                _stored(band.diffused) if band.is_seen_diffusely else None,
            )
            for band in field.bands
        ]
        self._pool = None if field.level is None else (mi.Float(field.level), mi.Float(field.meniscus))
        self._patches, self._wetting = None, None
        if field.patches is not None:
            lattice = mi.Matrix3f(field.patches.lattice_from_model.tolist())
            self._patches = _Band(lattice, _stored(field.patches.coefficients), None)
            self._wetting = mi.Float(field.wetting[0]), mi.Float(field.wetting[1])
        # Opaque, so that another relief of as many bands compiles no new kernel.
        bands = [*self._bands, *([self._patches] if self._patches else [])]
        dr.make_opaque([band.lattice for band in bands], self._pool, self._wetting)

    @property
    def key(self) -> tuple[tuple[bool, ...], bool, bool]:
        """What of the relief is compiled into the kernel: of each band whether diffuse light sees it, film, patches."""
        return tuple(band.diffused is not None for band in self._bands), self._pool is not None, self.is_patchy

    @property
    def is_patchy(self) -> bool:
        """Whether the film's level varies over the surface, and with it the roughness."""
        return self._patches is not None

    def jets_at(self, si: Any, bent: bool = False) -> KernelJets:
        """Compute the jets at surface points, mitsuba.SurfaceInteraction3f, as `jets` does."""
        active = si.is_valid()
        if self._rest is None:
            return self.jets(si.p, active, bent)
        return self._rest.carry(si, active, self.jets(self._rest.point(si, active), active, bent))

    def jets(self, p: Any, active: Any, bent: bool = False) -> KernelJets:
        """Compute the jets at points, mitsuba.Point3f, model frame; with second derivatives if `bent`."""
        height, gradient, diffused = mi.Float(0), mi.Vector3f(0), mi.Vector3f(0)
        hessian = [mi.Float(0) for _ in range(6)]
        for band in self._bands:
            own = _band(band, mi.Vector3f(p), active, bent)
            height += own.height
            gradient += own.gradient
            diffused += own.diffused
            if own.hessian is not None:
                hessian = [total + part for total, part in zip(hessian, own.hessian, strict=True)]
        patches = None if self._patches is None else _band(self._patches, mi.Vector3f(p), active, bent)
        return self._fill(KernelJets(height, gradient, diffused, tuple(hessian) if bent else None), patches)

    def pool(self, jets: KernelJets) -> Any:
        """Return at which lanes a film fills a valley, mitsuba.Bool."""
        if self._pool is None:
            return mi.Bool(False)
        return (jets.height if jets.gain is None else jets.height - jets.gain) < self._pool[0]

    def wet(self, gain: Any) -> Any:
        """Return the share by which ground is wet, as `ReliefField.wet` does, where the film's level gains so much."""
        assert self._wetting is not None
        level, width = self._wetting
        return dr.rcp(1 + dr.exp((level - gain) / width))

    def wet_at(self, si: Any, active: Any) -> Any:
        """Return the share by which ground is wet at surface points, mitsuba.SurfaceInteraction3f."""
        assert self._patches is not None
        p = si.p if self._rest is None else self._rest.point(si, active)
        return self.wet(_band(self._patches, mi.Vector3f(p), active, False).height)

    def _fill(self, jets: KernelJets, patches: KernelJets | None) -> KernelJets:
        """Fill valleys as `ReliefField.fill` does."""
        if self._pool is None:
            return jets
        level, meniscus = self._pool
        height, g, hessian = jets.height, jets.gradient, jets.hessian
        if patches is not None:
            height, g, hessian = height - patches.height, g - patches.gradient, _added(hessian, patches.hessian, -1)
        share = dr.rcp(1 + dr.exp(-dr.clip((height - level) / meniscus, -60, 60)))
        if hessian is not None:
            bend = share * (1 - share) / meniscus
            hessian = tuple(share * h + bend * (g[i] * g[j]) for h, (i, j) in zip(hessian, UPPER, strict=True))
        if patches is None:
            return KernelJets(jets.height, share * g, jets.diffused, hessian)
        hessian = _added(hessian, patches.hessian, 1)
        return KernelJets(jets.height, share * g + patches.gradient, jets.diffused, hessian, patches.height)


def _added(hessian: tuple[Any, ...] | None, other: tuple[Any, ...] | None, sign: int) -> tuple[Any, ...] | None:
    """Return the sum of two Hessians, of which neither or both were asked for, or their difference."""
    if hessian is None or other is None:
        return None
    return tuple(h + sign * own for h, own in zip(hessian, other, strict=True))


def turned(si: Any, gradient: Any) -> Any:
    """Return a copy of surface points with the normal of a relief, N - grad h along the surface, normalised."""
    copy = mi.SurfaceInteraction3f(si)
    N, view = si.sh_frame.n, si.to_world(si.wi)
    m = N - gradient + N * dr.dot(N, gradient)
    copy.sh_frame = mi.Frame3f(dr.normalize(m))
    copy.wi = copy.to_local(view)
    return copy


def _stored(coefficients: Array) -> Any:
    """Store coefficients, mitsuba.UInt64: each node's own and the next along z in one number, for fewer reads."""
    nodes = coefficients.astype(np.float32)
    return mi.UInt64(np.stack([nodes, np.roll(nodes, -1, axis=2)], axis=-1).view(np.uint64).ravel())


def _modulo(cell: Any) -> Any:
    """Return whole numbers, mitsuba.Float, modulo `NODES`."""
    return cell - NODES * dr.floor(cell * (1 / NODES))


def _weights(t: Any, bent: bool) -> list[list[Any]]:
    """Return the four cubic B-splines at a share t of a cell, and their derivatives, as `relief` has them."""
    one = 1 - t
    value = [one**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - one**2 + one**3 / 2, t**3 / 6]
    first = [-(one**2) / 2, -2 * t + 1.5 * t**2, 2 * one - 1.5 * one**2, t**2 / 2]
    second = [one, 3 * t - 2, 3 * one - 2, t]
    return [value, first, second] if bent else [value, first]


def _band(band: _Band, p: Any, active: Any, bent: bool) -> KernelJets:
    """Compute one band's jets."""
    cells = band.lattice @ p
    corner = dr.floor(cells)
    weights = [_weights(cells[axis] - corner[axis], bent) for axis in range(3)]
    # The four nodes along each axis.
    nodes = [[mi.UInt32(_modulo(corner[axis] + (step - 1))) for step in range(4)] for axis in range(3)]
    back = band.lattice.T
    fine = _contract(band.fine, nodes, weights, active, 2 if bent else 1)
    diffused = mi.Vector3f(0)
    if band.diffused is not None:
        diffused = back @ _gradient(_contract(band.diffused, nodes, weights, active, 1))
    hessian = None
    if bent:
        orders = [[tuple((axis == i) + (axis == j) for axis in range(3)) for j in range(3)] for i in range(3)]
        rows = [[fine[order] for order in row] for row in orders]
        whole = back @ mi.Matrix3f(*rows[0], *rows[1], *rows[2]) @ band.lattice
        hessian = tuple(whole[i, j] for i, j in UPPER)
    return KernelJets(fine[0, 0, 0], back @ _gradient(fine), diffused, hessian)


def _contract(pairs: Any, nodes: Any, weights: Any, active: Any, order: int) -> dict[Order, Any]:
    """Sum coefficients times B-splines, for all derivatives up to an order; axis by axis, from z to x."""
    totals: dict[Order, Any] = {}
    depths = [mi.Vector4f(*weights[2][k]) for k in range(order + 1)]
    for a in range(4):
        plane: dict[tuple[int, int], Any] = {}
        for b in range(4):
            row = (nodes[0][a] * NODES + nodes[1][b]) * NODES
            read = (dr.gather(mi.UInt64, pairs, row + nodes[2][z], active) for z in (0, 2))
            halves = (mi.UInt32(half) for pair in read for half in (pair, pair >> 32))
            packet = mi.Vector4f(*(dr.reinterpret_array(mi.Float, half) for half in halves))
            for k in range(order + 1):
                along = dr.dot(packet, depths[k])
                for j in range(order + 1 - k):
                    plane[j, k] = dr.fma(weights[1][j][b], along, plane.get((j, k), 0))
        for (j, k), value in plane.items():
            for i in range(order + 1 - j - k):
                totals[i, j, k] = dr.fma(weights[0][i][a], value, totals.get((i, j, k), 0))
    return totals


def _gradient(derivatives: dict[Order, Any]) -> Any:
    return mi.Vector3f(derivatives[1, 0, 0], derivatives[0, 1, 0], derivatives[0, 0, 1])


CHANNELS = 3

HEADER = 64
"""Numbers at the buffer's start; see `_header`."""

PACKET = 4
"""Numbers that one gather reads."""

FALL, TURN, PER_MM, MASK, ROWS, HALF, LISTED = 6, 32, 50, 51, 52, 53, 56
"""Where the header holds how fast vessels fade with depth (of each channel), both lattices' turns, cells over mm, what
of a hash is the slot, the first row, half-sizes beyond which vessels are mirrored, and where the lists start."""


class AlbedoKernel:
    """Evaluates the albedo of tissue; of a deformed surface `rest` says where the tissue was.

    All numbers of the pattern lie in one buffer. Dr.Jit orders a kernel's arguments at random where there are several,
    and compiles each order once.
    """

    def __init__(self, pattern: "TissuePattern") -> None:
        self.pattern = pattern
        self.rest: RestMap | None = None
        lattices = (pattern.mottling, pattern.capillaries)
        self._nodes = len(pattern.mottling.values)
        table = pattern.vessels
        self._is_mirrored, self._is_layered = bool((table.half_mm < ENDLESS).any()), bool(pattern.fall.any())
        first, listed = (
            np.pad(part, (0, -len(part) % PACKET)).view(np.float32) for part in (table.first, table.listed)
        )
        debris = [] if (own := pattern.debris) is None else [own.numbers.astype(np.float32), _packets(own.field)]
        parts = [_header(pattern), *(_packets(lattice) for lattice in lattices), *debris]
        parts += [first, table.rows.ravel(), listed]
        # The sizes of all but the last three are the same for all patterns.
        self._lattices = [sum(map(len, parts[: 1 + i])) // PACKET for i in range(len(lattices))]
        self._debris = sum(map(len, parts[:3]))
        self._first = sum(map(len, parts[:-3]))
        parts[0].view(np.uint32)[ROWS] = sum(map(len, parts[:-2])) // PACKET
        parts[0].view(np.uint32)[LISTED] = sum(map(len, parts[:-1]))
        self._buffer = mi.Float(np.concatenate(parts))

    def of(self, si: Any, active: Any) -> Any:
        """Compute the albedo, mitsuba.Spectrum, of surface points, mitsuba.SurfaceInteraction3f."""
        return self.at(self._rest_point(si, active), active)

    def at(self, p: Any, active: Any) -> Any:
        """Compute the albedo, mitsuba.Spectrum, at points of the surface, mitsuba.Point3f, model frame, mm."""
        p = mi.Vector3f(p)
        field, net = (self._lattice(TURN + 9 * i, first, p, active) for i, first in enumerate(self._lattices))
        artery, vein, depths = self._chords(p, active)
        colour = []
        for channel in range(CHANNELS):
            numbers = [self._number(8 * channel + i) for i in range(6)]
            base, mottled, netted, share, arterial, venous = numbers
            shares = [share] * 2
            if self._is_layered:
                shares = [share * dr.exp(-self._number(8 * channel + FALL) * depth) for depth in depths]
            below = 1 - shares[0] * (1 - dr.exp(-arterial * artery))
            below *= 1 - shares[1] * (1 - dr.exp(-venous * vein))
            colour.append(dr.clip(base * dr.exp(-field * mottled - net * netted) * below, 0, 1))
        if self.pattern.debris is not None:
            colour = self._soiled(colour, p, active)
        if channels() == CHANNELS:
            return mi.Spectrum(*colour)
        return mi.Spectrum(mi.luminance(mi.Color3f(*colour)))

    def covers(self, si: Any, active: Any) -> tuple[Any, Any]:
        """Compute the shares that stool and bile cover, mitsuba.Float, at surface points (`DebrisPattern`)."""
        stool, bile, _ = self._covers(self._rest_point(si, active), active)
        return dr.select(active, stool, 0), dr.select(active, bile, 0)

    def _rest_point(self, si: Any, active: Any) -> Any:
        return si.p if self.rest is None else self.rest.point(si, active)

    def _covers(self, p: Any, active: Any) -> tuple[Any, Any, list[Any]]:
        """Compute the shares of `covers` at points at rest; return the pattern's other numbers too."""
        numbers = [self._number(self._debris + i) for i in range(9, 20)]
        field = self._lattice(self._debris, self._debris // PACKET + 5, mi.Vector3f(p), active)
        high, low, sharpness = numbers[:3]
        stool, bile = (dr.clip(0.5 + (f - level) * sharpness, 0, 1) for f, level in ((field, high), (-field, low)))
        return stool, bile, numbers[3:]

    def _soiled(self, albedo: list[Any], p: Any, active: Any) -> list[Any]:
        """Lay debris over an albedo, by channel."""
        stool, bile, (lumps, scale, *colours) = self._covers(p, active)
        matter = dr.exp(-lumps * self._lattice(self._debris, self._debris // PACKET + 5, scale * p, active))
        return [
            dr.clip(dr.lerp(own * dr.exp(-bile * absorbed), brown * matter, stool), 0, 1)
            for own, brown, absorbed in zip(albedo, colours[:CHANNELS], colours[CHANNELS:], strict=True)
        ]

    def _number(self, index: int) -> Any:
        """Return a number of the header."""
        return dr.gather(mi.Float, self._buffer, mi.UInt32(index))

    def _whole(self, index: Any, active: Any = True) -> Any:
        """Return a whole number of the buffer."""
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._buffer, index, active))

    def _packet(self, index: Any, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._buffer, index, active)

    def _chords(self, p: Any, active: Any) -> tuple[Any, Any, list[Any]]:
        """Compute the chords, mm, through arteries and veins below points, and depths; see `SegmentTable.seen`."""
        if self._is_mirrored:
            half = mi.Vector3f(*(self._number(HALF + axis) for axis in range(3)))
            number = dr.round(p / (2 * half))
            odd = number - 2 * dr.floor(number / 2)
            p = (p - 2 * number * half) * (1 - 2 * odd)
        cell = mi.Vector3i(dr.floor(p * self._number(PER_MM)))
        parts = [mi.UInt32(cell[axis]) * prime for axis, prime in enumerate(PRIMES)]
        slot = (parts[0] ^ parts[1] ^ parts[2]) & self._whole(mi.UInt32(MASK))
        row, last = (self._whole(self._first + slot + i, active) for i in range(2))
        rows, listed = (self._whole(mi.UInt32(i)) for i in (ROWS, LISTED))
        row, last = row + listed, last + listed

        def step(row: Any, artery: Any, vein: Any, *sums: Any) -> tuple[Any, ...]:
            # A row is two packets.
            place = rows + 2 * self._whole(row, active)
            start, along = self._packet(place, active), self._packet(place + 1, active)
            gap, d = p - mi.Vector3f(*start[:3]), mi.Vector3f(*along[:3])
            t = dr.clip(dr.dot(gap, d) / dr.squared_norm(d), 0, 1)
            inside = dr.maximum(1 - dr.squared_norm(gap - t * d) / (start[3] * start[3]), 0)
            chord = along[3] * inside * dr.sqrt(inside)
            if sums:
                # As `seen_depth` of the profile
                squared = dr.square(start[3]) / 6 - 3 / 32 * start[3] * dr.abs(along[3])
                depth, weights = dr.safe_sqrt(squared) / BLUR_PER_DEPTH, (dr.maximum(chord, 0), dr.maximum(-chord, 0))
                parts = [part for weight in weights for part in (weight, weight * depth)]
                sums = tuple(total + part for total, part in zip(sums, parts, strict=True))
            return row + 1, dr.maximum(artery, chord), dr.maximum(vein, -chord), *sums

        sums = [mi.Float(0)] * (6 if self._is_layered else 2)
        state = (row, *sums)
        _, artery, vein, *sums = dr.while_loop(state, lambda row, *_: mi.Bool(active) & (row < last), step)
        depths = [deep / dr.maximum(weight, LEAST_CHORD) for weight, deep in zip(sums[::2], sums[1::2], strict=True)]
        return artery, vein, depths

    def _lattice(self, turn: int, packets: int, p: Any, active: Any) -> Any:
        """Interpolate a periodic lattice, by the places of its turn and its packets; see `Lattice.at`."""
        nodes = self._nodes
        cells = mi.Matrix3f(*(self._number(turn + i) for i in range(9))) @ p
        corner = dr.floor(cells)
        share = cells - corner
        # The number of nodes is a power of two.
        x, y, z = (mi.UInt32(cell) & (nodes - 1) for cell in mi.Vector3i(corner))
        total = mi.Float(0)
        for up, weight in ((0, 1 - share.x), (1, share.x)):
            slab = (x + up) & (nodes - 1)
            low = self._packet(packets + (slab * nodes + y) * nodes + z, active)
            first, second = dr.lerp(low[0], low[1], share.z), dr.lerp(low[2], low[3], share.z)
            total += weight * dr.lerp(first, second, share.y)
        return total


def _header(pattern: "TissuePattern") -> npt.NDArray[np.float32]:
    """Return, 8 numbers for each channel, ground, absorbances, share and absorptions; then what `TURN` etc. say."""
    header = np.zeros(HEADER, dtype=np.float32)
    rows = (pattern.base, pattern.mottled, pattern.netted, pattern.share, *pattern.absorption, pattern.fall)
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


ROW = 8
"""Packets of a vertex: its position at rest, J^-T, and the second derivatives, upper triangles, padded."""


class RestMap:
    """Finds points at rest on a deformed surface, whose mesh is rendered, and carries derivatives from there."""

    def __init__(self, surface: DeformedSurface) -> None:
        mesh, jets = surface.rest.shape().mesh, surface.vertex_jets
        assert mesh is not None
        rows, columns = np.transpose(UPPER)
        upper = jets.hessian[:, :, rows, columns].reshape(-1, 18)
        parts = [mesh.vertices, inverse_transpose(jets).reshape(-1, 9), upper]
        packed = np.zeros((len(mesh.vertices), PACKET * ROW), dtype=np.float32)
        packed[:, :30] = np.concatenate(parts, axis=1)
        self._rows, self._faces = mi.Float(packed.ravel()), mi.UInt32(mesh.faces.astype(np.uint32).ravel())

    def point(self, si: Any, active: Any) -> Any:
        """Return the points at rest, mitsuba.Point3f, of surface points of the deformed mesh."""
        return mi.Point3f(*self._numbers(si, active, 0, 3))

    def carry(self, si: Any, active: Any, jets: KernelJets) -> KernelJets:
        """Return the jets of a height at the deformed surface points, from those at rest."""
        K = mi.Matrix3f(*self._numbers(si, active, 3, 12))
        gradient, hessian = K @ jets.gradient, jets.hessian
        if hessian is not None:
            second = self._numbers(si, active, 12, 30)
            # H - sum_i g_i Hess phi_i, by its upper triangle.
            upper = [h - sum(gradient[i] * second[6 * i + n] for i in range(3)) for n, h in enumerate(hessian)]
            xx, xy, xz, yy, yz, zz = upper
            whole = K @ mi.Matrix3f(xx, xy, xz, xy, yy, yz, xz, yz, zz) @ K.T
            hessian = tuple(whole[i, j] for i, j in UPPER)
        return KernelJets(jets.height, gradient, K @ jets.diffused, hessian, jets.gain)

    def _numbers(self, si: Any, active: Any, first: int, last: int) -> list[Any]:
        """Interpolate numbers of the vertices' rows between the corners of the hit triangle."""
        # A mesh without texture coordinates has its barycentric ones there.
        u, v = si.uv
        index = dr.select(active, si.prim_index, 0) * 3
        totals = [mi.Float(0)] * (last - first)
        for corner, weight in enumerate((1 - u - v, u, v)):
            row = dr.gather(mi.UInt32, self._faces, index + corner, active) * ROW
            packets: dict[int, Any] = {}
            for n in range(first, last):
                which, part = divmod(n, PACKET)
                if which not in packets:
                    packets[which] = dr.gather(mi.Vector4f, self._rows, row + which, active)
                totals[n - first] = dr.fma(weight, packets[which][part], totals[n - first])
        return totals
