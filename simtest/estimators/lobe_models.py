"""Models of a Phong highlight: a quadric with a co-located light, and a plane pictured from aside."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from simtest.geometry import Array
from simtest.geometry.vectors import basis_across

_DARK = 1e-6
"""Least cosine of the lobe's angle: below it the specular term is 0 and has no logarithm."""


@dataclass(frozen=True)
class ColocatedQuadric:
    """A quadric patch with light and camera at one position (theory.md section 3).

    In units of the distance d to the BP, with s its sightline, the surface is P = s (1 + z) + (x, y) in the tangent
    plane, z = (x, y) K (x, y)^T / 2, K = d S. The radiance is c max(0, cos 2 theta)^n over the squared distance.
    Parameters: rotation of s in its tangent plane (2), K11, K12, K22, log c. n is held, because beside the three of K
    it is all but undetermined.

    Parameters
    ----------
    rays : ndarray, shape (m, 3)
        Sightlines of the pixels.
    frame : ndarray, shape (3, 3)
        Rows e, f, s: tangent basis and sightline of the BP, camera frame.
    K : ndarray, shape (3,)
        K11, K12, K22 in the basis e, f.
    log_scale : float
        log c.
    exponent : float
        n.
    """

    rays: Array
    frame: Array
    K: Array
    log_scale: float
    exponent: float

    @property
    def normal(self) -> Array:
        """N = -s, shape (3,)."""
        return -self.frame[2]

    @property
    def shape(self) -> Array:
        """K, shape (2, 2), in the basis e, f."""
        k11, k12, k22 = self.K
        return np.array([[k11, k12], [k12, k22]])

    def moved(self, step: Array) -> Self:
        """Turn s, with the basis carried along the shortest way, and add to K and log c."""
        e, f, s = self.frame
        turned = s + step[0] * e + step[1] * f
        turned /= np.linalg.norm(turned)
        # The basis rotates with s along a great circle.
        carried = [v - (turned @ v) / (1 + s @ turned) * (s + turned) for v in (e, f)]
        frame = np.stack([*carried, turned])
        return replace(self, frame=frame, K=self.K + step[2:5], log_scale=self.log_scale + float(step[5]))

    def evaluate(self) -> tuple[Array, Array]:
        """Return intensities and derivatives."""
        # tangents (a, b) of each ray in the basis, and q = (a, b) K (a, b)^T
        e, f, s = self.frame
        along = self.rays @ s
        a, b = (self.rays @ e) / along, (self.rays @ f) / along
        k11, k12, k22 = self.K
        ka, kb = k11 * a + k12 * b, k12 * a + k22 * b
        q = a * ka + b * kb
        # t: hit along the ray; where the ray misses the quadric, its closest approach
        root = np.sqrt(np.maximum(1 - 2 * q, 1e-6))
        t = 2 / (1 + root)
        across = 1 + a * a + b * b
        A, B = 1 - t * q, 1 + t * t * (ka * ka + kb * kb)
        # cos^2 of the angle between view and normal; cos 2 theta = 2 cos^2 - 1
        squared = A * A / (B * across)
        cosine = np.maximum(2 * squared - 1, _DARK)
        intensity = np.exp(self.log_scale) * cosine**self.exponent / (t * t * across)

        # derivatives by q, g = ka^2 + kb^2 and across
        dt_dq = t * t / (2 * root)
        dA_dq = -(t + q * dt_dq)
        dB_dq = 2 * t * (ka * ka + kb * kb) * dt_dq
        # d log I = on_q dq + on_g dg + on_across d(across)
        lobe = self.exponent / cosine * 2 * squared
        on_q = lobe * (2 * dA_dq / A - dB_dq / B) - 2 * dt_dq / t
        on_g = -lobe * t * t / B
        on_across = -(lobe + 1) / across
        # derivatives by the tangents, then by the six parameters
        by_a = on_q * 2 * ka + on_g * 2 * (ka * k11 + kb * k12) + on_across * 2 * a
        by_b = on_q * 2 * kb + on_g * 2 * (ka * k12 + kb * k22) + on_across * 2 * b
        J = np.empty((len(a), 6))
        J[:, 0] = -by_a * (1 + a * a) - by_b * a * b
        J[:, 1] = -by_a * a * b - by_b * (1 + b * b)
        J[:, 2] = on_q * a * a + on_g * 2 * ka * a
        J[:, 3] = on_q * 2 * a * b + on_g * 2 * (ka * b + kb * a)
        J[:, 4] = on_q * b * b + on_g * 2 * kb * b
        J[:, 5] = 1.0
        J *= intensity[:, None]
        return intensity, J


@dataclass(frozen=True)
class PlaneFromAside:
    """A plane lit and viewed from V above the BP, pictured by a camera that is not at V [MB, section 3.1].

    The intensity is c max(0, cos beta)^n with cos beta = (h^2 - rho^2) / (h^2 + rho^2), rho the distance from the BP
    and h that of V from the plane. h is set to the BP's depth: it is all but degenerate with n, which leaves the normal
    unaffected. Parameters: tilt of the normal (2), BP at unit depth (2), log n, log c.

    Parameters
    ----------
    rays : ndarray, shape (m, 3)
        Sightlines of the pixels.
    normal : ndarray, shape (3,)
        Unit, facing the camera.
    foot : ndarray, shape (3,)
        BP at unit depth.
    log_exponent, log_scale : float
        log n, log c.
    """

    rays: Array
    normal: Array
    foot: Array
    log_exponent: float
    log_scale: float

    def moved(self, step: Array) -> Self:
        """Tilt the normal in its tangent plane, and add to the others."""
        first, second = basis_across(self.normal)
        normal = self.normal + step[0] * first + step[1] * second
        foot = self.foot + np.array([step[2], step[3], 0.0])
        exponent, scale = self.log_exponent + float(step[4]), self.log_scale + float(step[5])
        return replace(self, normal=normal / np.linalg.norm(normal), foot=foot, log_exponent=exponent, log_scale=scale)

    def evaluate(self) -> tuple[Array, Array]:
        """Return intensities and derivatives."""
        # D: from the BP to the point that each ray hits, at BP depth 1
        N, F = self.normal, self.foot
        steepness = self.rays @ N
        reach = (N @ F) / steepness
        D = self.rays * reach[:, None] - F
        rho2 = np.sum(D * D, axis=1)
        cosine = np.maximum((1 - rho2) / (1 + rho2), _DARK)
        exponent = np.exp(self.log_exponent)  # n
        intensity = np.exp(self.log_scale) * cosine**exponent
        by_rho2 = -2 * exponent * intensity / (cosine * (1 + rho2) ** 2)
        # derivatives through rho^2, then by log n and log c
        along = np.sum(D * self.rays, axis=1)
        J = np.empty((len(rho2), 6))
        for i, change in enumerate(basis_across(N)):
            J[:, i] = by_rho2 * 2 * along * ((change @ F) / steepness - reach * (self.rays @ change) / steepness)
        for i in (0, 1):
            J[:, 2 + i] = by_rho2 * 2 * (along * N[i] / steepness - D[:, i])
        J[:, 4] = intensity * np.log(cosine) * exponent
        J[:, 5] = intensity
        return intensity, J
