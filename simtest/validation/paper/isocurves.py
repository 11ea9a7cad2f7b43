"""Specular isocurves on a plane [MB, sections 2.1 and 2.2]: the quartic Q, and its two circles where L = V.

The plane is z = 0, p = (x, y) a point of it, P = (x, y, 0); the camera centre V and the light L lie at z > 0. With the
mirrored light R = (L_X, L_Y, -L_Z), the angle beta between view and mirror direction obeys
cos(beta) = -(R - P) . (V - P) / (abs(R - P) abs(V - P)).
"""

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.runtime.arrays import Array, Mask


def specular_isocurve(points: npt.ArrayLike, light: npt.ArrayLike, camera: npt.ArrayLike, tau: npt.ArrayLike) -> Array:
    """Evaluate Q(p) = ((R-P).(V-P))^2 - tau^2 abs(R-P)^2 abs(V-P)^2 [MB, section 2.1, Proposition 1].

    Its zeros are a quartic with two branches: cos(beta) = tau, which is the isophote, and cos(beta) = -tau, which is
    none (see `on_isophote_branch`). Points p, shape (..., 2), lie on the plane z = 0; L and V have shape (3,) or (...,
    3); tau is (t / c)^(1/n) on the isophote at t of a lobe c cos(beta)^n. The unit is the fourth power of the length's.
    """
    product, mirrored, direct = _products(points, light, camera)
    return np.asarray(product**2 - np.asarray(tau, dtype=float) ** 2 * mirrored * direct)


def on_isophote_branch(points: npt.ArrayLike, light: npt.ArrayLike, camera: npt.ArrayLike) -> Mask:
    """Return which points lie where cos(beta) > 0: on the branch of the quartic that is the isophote."""
    return np.asarray(_products(points, light, camera)[0] < 0)


def _products(points: npt.ArrayLike, light: npt.ArrayLike, camera: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Return (R - P) . (V - P), abs(R - P)^2 and abs(V - P)^2."""
    p, L, V = (np.asarray(value, dtype=float) for value in (points, light, camera))
    # In the plane's coordinates; along its normal R - P is -L_Z, and V - P is V_Z.
    rx, ry, rz = L[..., 0] - p[..., 0], L[..., 1] - p[..., 1], -L[..., 2]
    vx, vy, vz = V[..., 0] - p[..., 0], V[..., 1] - p[..., 1], V[..., 2]
    return rx * vx + ry * vy + rz * vz, rx**2 + ry**2 + rz**2, vx**2 + vy**2 + vz**2


def isophote_radius(isovalue: float, exponent: float, height: float) -> float:
    """Return the radius r- of the isophote at t about the foot of V = L, abs(V_Z) tan(acos(tau)/2) [MB, section 2.2].

    t is in (0, 1), the exponent n > 0, and the height V_Z sets the unit.
    """
    # From log tau, which keeps its digits for large n and for small ones.
    log_tau = np.log(isovalue) / exponent
    # tan(acos(tau) / 2)^2 = (1 - tau) / (1 + tau)
    return float(abs(height) * np.sqrt(-np.expm1(log_tau) / (1 + np.exp(log_tau))))


def isocurve_radii(kappa_value: npt.ArrayLike, height: npt.ArrayLike) -> tuple[Array, Array]:
    """Return the radii r- and r+ of the endoscopic isocurve's two circles [MB, section 2.2], in the unit of V_Z.

    r+- = abs(V_Z) sqrt((2-kappa)/kappa +- sqrt(((2-kappa)/kappa)^2 - 1)). The isophote is r-; r+ is the branch
    cos(beta) = -tau; r+ r- = V_Z^2. Computed in the form r- = abs(V_Z) tan(acos(tau)/2), which does not cancel.
    """
    k, z = np.asarray(kappa_value, dtype=float), np.abs(np.asarray(height, dtype=float))
    if not (np.all(k > 0) and np.all(k < 1)):
        raise InputError(f"kappa = {kappa_value!r}: must be inside (0, 1)")
    if not np.all(z > 0):
        raise InputError(f"V_Z = {height!r}: must not be 0, else the camera lies in the plane")
    # tan(acos(tau) / 2) = sqrt(kappa) / (1 + tau)
    ratio = np.sqrt(k) / (1 + np.sqrt(1 - k))
    return np.asarray(z * ratio), np.asarray(z / ratio)


def brightest_point(light: Array, camera: Array) -> Array:
    """Return the BP on the plane z = 0, shape (2,), for L and V, shape (3,), at z > 0.

    There the mirrored light, the point and the camera are collinear.
    """
    share = camera[2] / (camera[2] + light[2])
    return np.asarray(camera[:2] + share * (light[:2] - camera[:2]))
