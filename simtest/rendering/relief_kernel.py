"""The relief of a surface inside a kernel: the splines of `simtest.surfaces.relief_field`, gathered at each hit."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.runtime.arrays import Array
from simtest.surfaces.relief_field import NODES, ReliefField

if TYPE_CHECKING:
    from simtest.rendering.rest_map import RestMap

Order = tuple[int, ...]
"""Orders of a derivative along x, y and z of the lattice."""


@dataclass(frozen=True)
class KernelJets:
    """Jets of the height at the lanes of a kernel, model frame, mm.

    Parameters
    ----------
    height : mitsuba.Float
        Of the tissue, mm.
    gradient, diffused : mitsuba.Vector3f
        Gradients of the surface that the film's reflection sees, and of the one that diffuse light sees.
    hessian : tuple of mitsuba.Float, or None
        xx, xy, xz, yy, yz, zz of the former, 1/mm; None where not asked for.
    """

    height: Any
    gradient: Any
    diffused: Any
    hessian: tuple[Any, ...] | None


@dataclass(frozen=True)
class _Band:
    """One band in the kernel: lattice from model, its field, and the field that diffuse light sees, if it sees any."""

    lattice: Any
    fine: Any
    diffused: Any


class ReliefKernel:
    """Evaluates a relief.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    field : ReliefField
        The relief.
    rest : RestMap, optional
        Where the tissue was, of a deformed surface.
    """

    def __init__(self, mi: Any, field: ReliefField, rest: "RestMap | None" = None) -> None:
        import drjit as dr

        self.mi, self.field, self._rest = mi, field, rest
        self._bands = [
            _Band(
                mi.Matrix3f(band.lattice_from_model.tolist()),
                _stored(mi, band.coefficients),
                _stored(mi, band.diffused) if band.is_seen_diffusely else None,
            )
            for band in field.bands
        ]
        self._pool = None if field.level is None else (mi.Float(field.level), mi.Float(field.meniscus))
        # Opaque, so that another relief of as many bands compiles no new kernel.
        dr.make_opaque([band.lattice for band in self._bands], self._pool)

    @property
    def key(self) -> tuple[tuple[bool, ...], bool]:
        """What of the relief is compiled into the kernel: each band, whether diffuse light sees it; and a film."""
        return tuple(band.diffused is not None for band in self._bands), self._pool is not None

    def jets_at(self, si: Any, bent: bool = False) -> KernelJets:
        """Compute the jets at surface points, mitsuba.SurfaceInteraction3f, as `jets` does."""
        active = si.is_valid()
        if self._rest is None:
            return self.jets(si.p, active, bent)
        return self._rest.carry(si, active, self.jets(self._rest.point(si, active), active, bent))

    def jets(self, p: Any, active: Any, bent: bool = False) -> KernelJets:
        """Compute the jets at points, mitsuba.Point3f, model frame; with second derivatives if `bent`."""
        mi = self.mi
        height, gradient, diffused = mi.Float(0), mi.Vector3f(0), mi.Vector3f(0)
        hessian = [mi.Float(0) for _ in range(6)]
        for band in self._bands:
            own = _band(mi, band, mi.Vector3f(p), active, bent)
            height += own.height
            gradient += own.gradient
            diffused += own.diffused
            if own.hessian is not None:
                hessian = [total + part for total, part in zip(hessian, own.hessian, strict=True)]
        return self._fill(KernelJets(height, gradient, diffused, tuple(hessian) if bent else None))

    def pool(self, jets: KernelJets) -> Any:
        """Return at which lanes a film fills a valley, mitsuba.Bool."""
        return self.mi.Bool(False) if self._pool is None else jets.height < self._pool[0]

    def _fill(self, jets: KernelJets) -> KernelJets:
        """Fill valleys as `ReliefField.fill` does."""
        if self._pool is None:
            return jets
        import drjit as dr

        level, meniscus = self._pool
        share = dr.rcp(1 + dr.exp(-dr.clip((jets.height - level) / meniscus, -60, 60)))
        hessian = jets.hessian
        if hessian is not None:
            bend, g = share * (1 - share) / meniscus, jets.gradient
            outer = (g.x * g.x, g.x * g.y, g.x * g.z, g.y * g.y, g.y * g.z, g.z * g.z)
            hessian = tuple(share * own + bend * product for own, product in zip(hessian, outer, strict=True))
        return KernelJets(jets.height, share * jets.gradient, jets.diffused, hessian)


def turned(mi: Any, si: Any, gradient: Any) -> Any:
    """Return a copy of surface points whose shading normal is that of a relief with this gradient.

    The normal is N - grad h, the gradient along the surface, normalised.
    """
    import drjit as dr

    copy = mi.SurfaceInteraction3f(si)
    N, view = si.sh_frame.n, si.to_world(si.wi)
    m = N - gradient + N * dr.dot(N, gradient)
    copy.sh_frame = mi.Frame3f(dr.normalize(m))
    copy.wi = copy.to_local(view)
    return copy


def _stored(mi: Any, coefficients: Array) -> Any:
    """Store coefficients, mitsuba.UInt64: each node's own and the next along z in one number, for fewer reads."""
    own = coefficients.astype(np.float32)
    return mi.UInt64(np.stack([own, np.roll(own, -1, axis=2)], axis=-1).view(np.uint64).ravel())


def _modulo(cell: Any) -> Any:
    """Return whole numbers, mitsuba.Float, modulo `NODES`."""
    import drjit as dr

    return cell - NODES * dr.floor(cell * (1 / NODES))


def _weights(t: Any, bent: bool) -> list[list[Any]]:
    """Return the four cubic B-splines at a share t of a cell, and their derivatives, as `relief` has them."""
    one = 1 - t
    value = [one**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - one**2 + one**3 / 2, t**3 / 6]
    first = [-(one**2) / 2, -2 * t + 1.5 * t**2, 2 * one - 1.5 * one**2, t**2 / 2]
    second = [one, 3 * t - 2, 3 * one - 2, t]
    return [value, first, second] if bent else [value, first]


def _band(mi: Any, band: _Band, p: Any, active: Any, bent: bool) -> KernelJets:
    """Compute one band's jets."""
    import drjit as dr

    cells = band.lattice @ p
    corner = dr.floor(cells)
    weights = [_weights(cells[axis] - corner[axis], bent) for axis in range(3)]
    # The four nodes along each axis.
    nodes = [[mi.UInt32(_modulo(corner[axis] + (step - 1))) for step in range(4)] for axis in range(3)]
    back = band.lattice.T
    fine = _contract(mi, band.fine, nodes, weights, active, 2 if bent else 1)
    diffused = mi.Vector3f(0)
    if band.diffused is not None:
        diffused = back @ _gradient(mi, _contract(mi, band.diffused, nodes, weights, active, 1))
    hessian = None
    if bent:
        rows = [[fine[_order(i, j)] for j in range(3)] for i in range(3)]
        whole = back @ mi.Matrix3f(*rows[0], *rows[1], *rows[2]) @ band.lattice
        hessian = tuple(whole[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return KernelJets(fine[0, 0, 0], back @ _gradient(mi, fine), diffused, hessian)


def _contract(mi: Any, pairs: Any, nodes: Any, weights: Any, active: Any, order: int) -> dict[Order, Any]:
    """Sum coefficients times B-splines, for all derivatives up to an order; axis by axis, from z to x."""
    import drjit as dr

    totals: dict[Order, Any] = {}
    depths = [mi.Vector4f(*weights[2][k]) for k in range(order + 1)]
    for a in range(4):
        plane: dict[tuple[int, int], Any] = {}
        for b in range(4):
            row = (nodes[0][a] * NODES + nodes[1][b]) * NODES
            read = (dr.gather(mi.UInt64, pairs, row + nodes[2][z], active) for z in (0, 2))
            packet = mi.Vector4f(*(half for pair in read for half in _halves(mi, pair)))
            for k in range(order + 1):
                along = dr.dot(packet, depths[k])
                for j in range(order + 1 - k):
                    plane[j, k] = dr.fma(weights[1][j][b], along, plane.get((j, k), 0))
        for (j, k), value in plane.items():
            for i in range(order + 1 - j - k):
                totals[i, j, k] = dr.fma(weights[0][i][a], value, totals.get((i, j, k), 0))
    return totals


def _halves(mi: Any, pair: Any) -> list[Any]:
    """Return the two numbers that one of 64 bits holds."""
    import drjit as dr

    return [dr.reinterpret_array(mi.Float, mi.UInt32(half)) for half in (pair, pair >> 32)]


def _gradient(mi: Any, derivatives: dict[Order, Any]) -> Any:
    return mi.Vector3f(derivatives[1, 0, 0], derivatives[0, 1, 0], derivatives[0, 0, 1])


def _order(i: int, j: int) -> Order:
    """Return the orders of derivative along x, y, z of the derivative along axes i and j."""
    return tuple((axis == i) + (axis == j) for axis in range(3))
