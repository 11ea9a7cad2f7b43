"""The tissue plugin's samples follow its density, and its density is one: chi-square tests with negative controls.

Family-wise alpha 0.01 over all cases together, by Holm's correction. Each direction stands for the facet that mirrors
the incidence into it; bins are laid out in the facets' slope over alpha, so that a narrow lobe is resolved.
"""

import numpy as np
import pytest
from scipy import stats
from scipy.special import erf

from simtest.rendering import backend, elements
from tests.hypothesis_tests import ALPHA, chi_square, rejected

pytestmark = pytest.mark.render

SAMPLES = 100_000
INDEX = 1.36
CASES = [
    (alpha, kind, angle, albedo)
    for alpha in (0.01, 0.03, 0.1)
    for kind in ("beckmann", "ggx")
    for angle in (0.0, 30.0, 60.0, 80.0, 88.0)
    for albedo in (0.0, 0.3, 0.9)
]

SLOPES = (0.0, 0.3, 0.5, 0.7, 0.9, 1.1, 1.4, 1.8, 2.3, 3.0, 4.0, 7.0, 15.0, 40.0)
"""Edges in slope over alpha; beyond the last come equal steps of the facet's angle."""

AROUND, FINE = 8, 24
"""Bins around the normal, and cells along each side of a bin for its integral."""


@pytest.fixture(scope="module")
def mi():
    mi = backend.load()
    elements.register(mi.variant())
    return mi


def material(mi, alpha, kind, albedo):
    base = {"type": "uniform", "value": albedo}
    film = {"alpha": alpha, "index": INDEX, "distribution": kind}
    return mi.load_dict({"type": "simtest_tissue", **film, "diffuse_reflectance": base})


def incidence(angle_deg):
    return np.array([np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))])


def interaction(mi, wi, count):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.t = 1.0
    si.wi = mi.Vector3f(*map(float, wi))
    return si


def edges(alpha):
    """Return the edges in the facet's angle, rad, up to 90 deg."""
    inside = np.arctan(alpha * np.array(SLOPES))
    return np.concatenate([inside, np.linspace(inside[-1], np.pi / 2, 7)[1:]])


def cells(alpha, wi):
    """Return facets' normals, shape (B, A, FINE^2, 3), and the solid angles of the facets and of what they mirror."""
    at = edges(alpha)
    share = (np.arange(FINE) + 0.5) / FINE
    theta = at[:-1, None] + np.diff(at)[:, None] * share
    ends = at[:-1, None] + np.diff(at)[:, None] * np.arange(FINE + 1) / FINE
    height = -np.diff(np.cos(ends), axis=1)[:, None, :, None]
    phi = (2 * np.pi * (np.arange(AROUND)[:, None] + share) / AROUND)[None, :, None, :]
    theta = theta[:, None, :, None]
    h = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)
    solid = np.broadcast_to(height * 2 * np.pi / AROUND / FINE, h.shape[:-1])
    bins = (len(at) - 1, AROUND, FINE * FINE)
    h, solid = h.reshape(*bins, 3), solid.reshape(bins)
    return h, solid, 4 * np.clip(h @ wi, 0, None) * solid


def mirrored(h, wi):
    return 2 * (h @ wi)[..., None] * h - wi


def expected_shares(mi, bsdf, alpha, wi):
    """Integrate the density over each bin."""
    h, _, solid = cells(alpha, wi)
    wo = mirrored(h, wi)
    flat = mi.Vector3f(np.ascontiguousarray(wo.reshape(-1, 3).T, dtype=np.float32))
    density = bsdf.pdf(mi.BSDFContext(), interaction(mi, wi, wo[..., 0].size), flat, True)
    return (np.array(density, dtype=float).reshape(solid.shape) * solid).sum(axis=-1).ravel()


def refused_share(alpha, kind, wi, albedo):
    """Share of samples that are mirrored below the surface, in double precision from the distribution of facets."""
    h, solid, _ = cells(alpha, wi)
    cosine, facing = h[..., 2], h @ wi
    squared = (1 - cosine**2) / cosine**2 / alpha**2
    shape = np.exp(-squared) if kind == "beckmann" else 1 / (1 + squared) ** 2
    D = shape / (np.pi * alpha**2 * cosine**4)
    tangent = max(np.sqrt(1 - wi[2] ** 2) / wi[2], 1e-9)
    a = 1 / (alpha * tangent)
    seen = 2 / (1 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))
    if kind == "ggx":
        seen = 2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2))
    below = (facing > 0) & (mirrored(h, wi)[..., 2] <= 0)
    return lobe_share(wi, albedo) * float(np.sum(np.where(below, seen * D * facing / wi[2] * solid, 0)))


def lobe_share(wi, albedo):
    """Share of the samples that go to the film's reflection."""
    inside = np.sqrt(1 - (1 - wi[2] ** 2) / INDEX**2)
    F = ((wi[2] - INDEX * inside) / (wi[2] + INDEX * inside)) ** 2 / 2
    F += ((INDEX * wi[2] - inside) / (INDEX * wi[2] + inside)) ** 2 / 2
    passed = (1 - 0.0706431683) / INDEX**2  # of diffuse light, index 1.36
    base = (1 - F) * passed * albedo / (1 - albedo * (1 - passed))
    return F / (F + base)


def p_value(mi, case, seed, drawn_alpha=None, factor=1.0):
    """Test samples against the density; the last bin is that of samples that are refused, below the surface."""
    alpha, kind, angle_deg, albedo = case
    wi = incidence(angle_deg)
    expected = factor * expected_shares(mi, material(mi, alpha, kind, albedo), alpha, wi)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, SAMPLES)
    drawn = material(mi, drawn_alpha or alpha, kind, albedo)
    si = interaction(mi, wi, SAMPLES)
    sample, _ = drawn.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True)
    wo, density = np.array(sample.wo, dtype=float), np.array(sample.pdf, dtype=float)
    h = wo[:, density > 0] + wi[:, None]
    theta = np.arctan2(np.hypot(h[0], h[1]), h[2])
    at = edges(alpha)
    row = np.clip(np.searchsorted(at, theta, side="right") - 1, 0, len(at) - 2)
    column = np.floor(np.arctan2(h[1], h[0]) % (2 * np.pi) / (2 * np.pi) * AROUND).astype(int) % AROUND
    observed = np.bincount(row * AROUND + column, minlength=len(expected))
    observed = np.append(observed, np.count_nonzero(density <= 0))
    return chi_square(observed, SAMPLES * np.append(expected, refused_share(alpha, kind, wi, albedo)))


@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_samples_follow_the_density(mi, step):
    """Every fourth case meets each alpha, distribution, angle and albedo."""
    cases = CASES[::step]
    p_values = [p_value(mi, case, seed) for seed, case in enumerate(cases)]
    bad = rejected(p_values)
    assert not bad.any(), [(cases[i], p_values[i]) for i in np.flatnonzero(bad)]
    # Over so many cases the p-values themselves are even; a test without power would pile them up at 1.
    assert stats.kstest(p_values, "uniform").pvalue > ALPHA


WRONG = [(0.03, "beckmann", 30.0, 0.0), (0.1, "ggx", 60.0, 0.0), (0.01, "beckmann", 88.0, 0.3), (0.1, "ggx", 0.0, 0.3)]


@pytest.mark.parametrize("case", WRONG, ids=str)
def test_negative_controls_are_rejected(mi, case):
    """Samples of a film that is rougher by a quarter, and a density that is 3 % off."""
    strict = ALPHA / len(CASES)
    assert p_value(mi, case, 1, drawn_alpha=1.25 * case[0]) < strict
    assert p_value(mi, case, 2, factor=0.97) < strict
    assert p_value(mi, case, 3, factor=1.03) < strict


def test_the_density_integrates_to_the_share_of_samples_above_the_surface(mi):
    for alpha, kind, angle_deg, albedo in CASES[::2]:
        wi = incidence(angle_deg)
        whole = expected_shares(mi, material(mi, alpha, kind, albedo), alpha, wi).sum()
        kept = 1 - refused_share(alpha, kind, wi, albedo)
        assert whole == pytest.approx(kept, abs=2e-3), (alpha, kind, angle_deg, albedo)
