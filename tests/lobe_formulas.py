"""Reflectances in double precision, from the textbooks' dot products, that only tests compare with.

Directions are unit, shape (..., 3), and stand in the frame of the surface, z along its normal.
"""

from functools import cache

import numpy as np
from scipy.special import erf


@cache
def gauss(count):
    """Nodes and weights over [-1, 1]."""
    return np.polynomial.legendre.leggauss(count)


def unit(values):
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def mirror_cosine(wi, wo):
    """cos(beta) between a direction and the mirrored other, at least 0."""
    return np.clip(np.sum(wi * [-1, -1, 1] * wo, axis=-1), 0, 1)


def phong_value(wi, wo, exponent, specular, normalised):
    """c cos^n(beta), or normalised c (n + 2)/(2 pi) cos^n(beta) cos_o."""
    scale = (exponent + 2) / (2 * np.pi) * wo[..., 2] if normalised else 1.0
    return specular * scale * mirror_cosine(wi, wo) ** exponent


def fresnel(cosine, index):
    """Unpolarised, by Snell's angles."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return (s**2 + p**2) / 2


def facets(cosine, alpha, kind):
    """D of Walter et al. 2007, eqs 25 and 33."""
    tangent = np.sqrt(np.clip(1 - cosine**2, 0, 1)) / cosine
    if kind == "beckmann":
        return np.exp(-((tangent / alpha) ** 2)) / (np.pi * alpha**2 * cosine**4)
    return alpha**2 / (np.pi * cosine**4 * (alpha**2 + tangent**2) ** 2)


def smith(cosine, alpha, kind):
    """G1 of Walter et al. 2007, eqs 26 and 34."""
    tangent = np.maximum(np.sqrt(np.clip(1 - cosine**2, 0, 1)) / cosine, 1e-12)
    if kind == "ggx":
        return 2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2))
    a = 1 / (alpha * tangent)
    return 2 / (1 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))


def film_value(wi, wo, alpha, index, kind):
    """F D G / (4 cos_i), of directions above the surface."""
    half = unit(wi + wo)
    facing = np.clip(np.sum(wi * half, axis=-1), 0, 1)
    lobe = fresnel(facing, index) * facets(np.clip(half[..., 2], 1e-9, 1), alpha, kind)
    return lobe * smith(wi[..., 2], alpha, kind) * smith(wo[..., 2], alpha, kind) / (4 * wi[..., 2])


def diffuse_share(index):
    """Share of diffuse light that passes the smooth film from outside, by quadrature."""
    x, w = gauss(200)
    mu = (x + 1) / 2
    return float(np.sum(w * mu * (1 - fresnel(mu, index))))


def base_value(wi, wo, alpha, index, albedo):
    """The base below a film: T(i) T(o) / eta^2 albedo/pi / (1 - albedo r) cos_o, less the margin of 1/40 alpha."""
    passed = diffuse_share(index) / index**2
    through = (1 - fresnel(wi[..., 2], index)) * (1 - fresnel(wo[..., 2], index)) * (1 - alpha / 40)
    return through / index**2 * albedo / np.pi / (1 - albedo * (1 - passed)) * wo[..., 2]


# As Mitsuba evaluates them -------------------------------------------------------------------------------------------


def lanes(mi, values):
    return mi.Vector3f(np.ascontiguousarray(values.T, dtype=np.float32))


def interaction(mi, wi, count=None):
    """Return a surface interaction for directions of incidence, shape (N, 3), or `count` times one, shape (3,)."""
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, count or len(wi))
    si.t, si.wi = 1.0, mi.Vector3f(*map(float, wi)) if count else lanes(mi, wi)
    return si


def evaluate(mi, bsdf, wi, wo, method="eval", component=None):
    """Return value or density towards directions wo, shape (..., 3), from wi, (N, 3) or (3,); one component, or all."""
    context, flat = mi.BSDFContext(), wo.reshape(-1, 3)
    if component is not None:
        context.component = component
    si = interaction(mi, wi, len(flat) if wi.ndim == 1 else None)
    found = getattr(bsdf, method)(context, si, lanes(mi, flat), True)
    return np.array(found, dtype=float).ravel().reshape(wo.shape[:-1])


def drawn(mi, bsdf, wi, seed, count, component=None):
    """Return Mitsuba's sample, and directions, (3, N), densities and weights of samples from one incidence, (3,)."""
    sampler, context = mi.load_dict({"type": "independent"}), mi.BSDFContext()
    sampler.seed(seed, count)
    if component is not None:
        context.component = component
    si = interaction(mi, wi, count)
    sample, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), True)
    return sample, *(np.array(part, dtype=float).squeeze() for part in (sample.wo, sample.pdf, weight))


def incidence(angle_deg):
    return np.array([np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))])


def plugin(mi, kind, albedo, **values):
    """Return the plugin "phong" or "tissue" over a base of an albedo."""
    base = {"type": "uniform", "value": albedo}
    return mi.load_dict({"type": f"simtest_{kind}", **values, "diffuse_reflectance": base})
