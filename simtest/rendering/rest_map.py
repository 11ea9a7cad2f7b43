"""Where tissue was before its deformation, inside a kernel: gathered at the corners of the hit triangle.

Relief and colour belong to the tissue, so a kernel looks them up at the point at rest, and carries their derivatives to
the deformed surface as `simtest.surfaces.deformation.MapJets.carry` does.
"""

from typing import Any

import numpy as np

from simtest.rendering.relief_kernel import KernelJets
from simtest.surfaces import SurfaceModel
from simtest.surfaces.deformed import DeformedSurface

PACKET = 4
"""Numbers that one gather reads."""

ROW = 8
"""Packets of a vertex: its position at rest, J^-T, and the second derivatives, upper triangles, padded."""

_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class RestMap:
    """Finds points at rest, and carries derivatives from there.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    surface : DeformedSurface
        The deformed surface; the rendered shape is its mesh.
    """

    def __init__(self, mi: Any, surface: DeformedSurface) -> None:
        mesh, jets = surface.rest.shape().mesh, surface.vertex_jets
        assert mesh is not None
        rows, columns = np.transpose(_UPPER)
        upper = jets.hessian[:, :, rows, columns].reshape(-1, 18)
        parts = [mesh.vertices, jets.inverse_transpose.reshape(-1, 9), upper]
        packed = np.zeros((len(mesh.vertices), PACKET * ROW), dtype=np.float32)
        packed[:, :30] = np.concatenate(parts, axis=1)
        self.mi = mi
        self._rows, self._faces = mi.Float(packed.ravel()), mi.UInt32(mesh.faces.astype(np.uint32).ravel())

    def point(self, si: Any, active: Any) -> Any:
        """Return the points at rest, mitsuba.Point3f, of surface points of the deformed mesh."""
        return self.mi.Point3f(*self._numbers(si, active, 0, 3))

    def carry(self, si: Any, active: Any, jets: KernelJets) -> KernelJets:
        """Return the jets of a height at the deformed surface points, from those at rest."""
        mi = self.mi
        K = mi.Matrix3f(*self._numbers(si, active, 3, 12))
        gradient, hessian = K @ jets.gradient, jets.hessian
        if hessian is not None:
            second = self._numbers(si, active, 12, 30)
            # H - sum_i g_i Hess phi_i, by its upper triangle.
            own = [h - sum(gradient[i] * second[6 * i + n] for i in range(3)) for n, h in enumerate(hessian)]
            xx, xy, xz, yy, yz, zz = own
            whole = K @ mi.Matrix3f(xx, xy, xz, xy, yy, yz, xz, yz, zz) @ K.T
            hessian = tuple(whole[i, j] for i, j in _UPPER)
        return KernelJets(jets.height, gradient, K @ jets.diffused, hessian)

    def _numbers(self, si: Any, active: Any, first: int, last: int) -> list[Any]:
        """Interpolate numbers of the vertices' rows between the corners of the hit triangle."""
        import drjit as dr

        mi = self.mi
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


def rest_map(mi: Any, surface: SurfaceModel) -> RestMap | None:
    """Return the map of a deformed surface; None of any other."""
    return RestMap(mi, surface) if isinstance(surface, DeformedSurface) else None
