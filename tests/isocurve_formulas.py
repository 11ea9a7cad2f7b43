"""Formulas of [MB], sections 2.1 and 2.2, that only tests compare with; points lie on the plane z = 0."""

import numpy as np


def cosine_of_isovalue(isovalue, exponent, scale=1.0):
    """tau = (t / c)^(1/n), the cosine of beta on the isophote at t."""
    return (isovalue / scale) ** (1 / exponent)


def kappa(tau):
    """kappa = 1 - tau^2."""
    return 1 - tau**2


def cosine_beta(points, light, camera):
    """cos(beta) at points p, shape (..., 2): between view and mirror direction."""
    P = np.concatenate([points, np.zeros((*np.shape(points)[:-1], 1))], axis=-1)
    to_mirrored, to_camera = light * np.array([1.0, 1.0, -1.0]) - P, camera - P
    lengths = np.linalg.norm(to_mirrored, axis=-1) * np.linalg.norm(to_camera, axis=-1)
    return -np.sum(to_mirrored * to_camera, axis=-1) / lengths


def endoscopic_isocurve(points, camera, k):
    """E(p) = kappa rho^4 + 2 V_Z^2 (kappa - 2) rho^2 + kappa V_Z^4, Q with L = V: Proposition 2.

    E = kappa q+ q- with the circles q+- = rho^2 - r+-^2; the article's factorisation omits the factor kappa.
    """
    squared, height = np.sum((points - camera[:2]) ** 2, axis=-1), camera[2] ** 2
    return k * squared**2 + 2 * height * (k - 2) * squared + k * height**2
