"""The normals for which a noisy isophote is the image of a circle: a region about both members of the pose."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry import chi_squared
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import Array, Mask

CONFIDENCE = 0.95


@dataclass(frozen=True)
class PoseRegion:
    """The normals for which a cone is, within its noise, that of a circle.

    A plane across N cuts the cone C in a circle where, with u and v orthonormal across N,

        g(N) = (u^T C u - v^T C v, 2 u^T C v) = 0,

    two conditions that are linear in the cone's five parameters; the other three are the circle's position and size.
    With Gaussian noise on the cone, g^T cov(g)^-1 g at the true N is therefore exactly chi-squared with two degrees of
    freedom, also where N+ and N- meet and the errors of the normals are not Gaussian.

    Parameters
    ----------
    frame : ndarray, shape (3, 3)
        Rows: two unit vectors across the cone's axis, and the axis, camera frame.
    conic : ndarray, shape (5,)
        (a, b, c, d, e) of a x^2 + b x y + c y^2 + d x + e y = 1, the cone on the plane at unit distance along the axis.
    covariance : ndarray, shape (5, 5)
        Of the conic.
    """

    frame: Array
    conic: Array
    covariance: Array

    def statistic(self, normals: npt.ArrayLike) -> Array:
        """Compute the squared Mahalanobis distance of the cone from the cones of circles perpendicular to normals.

        The normals, shape (..., 3), are unit, camera frame; the distance, shape (...), is 0 at N+ and N-.
        """
        # g = G (a, b, c, d, e, -1) in the basis of each normal
        N = np.asarray(normals, dtype=float)
        local = N.reshape(-1, 3) @ self.frame.T
        u, v = tangent_basis(local)
        G = np.stack([_products(u, u) - _products(v, v), 2 * _products(u, v)], axis=1)
        g = G @ np.append(self.conic, -1.0)
        spread = G[..., :5] @ self.covariance @ np.swapaxes(G[..., :5], 1, 2)
        return np.asarray(np.einsum("ni,ni->n", g, np.linalg.solve(spread, g[..., None])[..., 0]).reshape(N.shape[:-1]))

    def contains(self, normals: npt.ArrayLike, confidence: float = CONFIDENCE) -> Mask:
        """Return which normals, shape (..., 3), lie in the region that holds the truth with a given confidence."""
        return np.asarray(self.statistic(normals) <= chi_squared.quantile(confidence, 2))


def _products(u: Array, v: Array) -> Array:
    """Return u^T C v as weights of the conic's five parameters and of its constant -1, shape (N, 6)."""
    (ux, uy, uz), (vx, vy, vz) = u.T, v.T
    parts = (ux * vx, (ux * vy + uy * vx) / 2, uy * vy, (ux * vz + uz * vx) / 2, (uy * vz + uz * vy) / 2, uz * vz)
    return np.stack(parts, axis=1)
