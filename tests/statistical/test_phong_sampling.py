"""The Phong plugin's samples follow its density, and its density is one: chi-square tests with negative controls.

Family-wise alpha 0.01 over all cases together, by Holm's correction. Bins and integrals are laid out about the mirror
direction, in the quantiles of the lobe within it and in equal steps of angle beyond, so that a narrow lobe is resolved.
"""

import numpy as np
import pytest
from scipy import stats

from simtest.rendering import backend, elements
from tests.hypothesis_tests import ALPHA, chi_square, rejected

pytestmark = pytest.mark.render

SAMPLES = 150_000
ANGLES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 85.0)
EXPONENTS = (1.0, 2.0, 5.0, 20.0, 50.0, 100.0, 500.0)
ALBEDOS = (0.0, 0.3, 0.9)
CASES = [(n, angle, albedo, False) for n in EXPONENTS for angle in ANGLES_DEG for albedo in ALBEDOS]
CASES += [(n, angle, 0.5, True) for n in (1.0, 20.0, 500.0) for angle in (0.0, 45.0, 85.0)]

QUANTILES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.02, 1e-3, 1e-6)
AROUND, FINE = 8, 24
"""Bins around the mirror direction, and cells along each side of a bin for its integral."""


@pytest.fixture(scope="module")
def mi():
    mi = backend.load()
    elements.register(mi.variant())
    return mi


def material(mi, exponent, albedo, normalised=False, specular=None):
    scale = specular if specular is not None else (1 - albedo if normalised else 1.0)
    base = {"type": "uniform", "value": albedo}
    description = {"exponent": exponent, "specular": scale, "normalised": normalised, "diffuse_reflectance": base}
    return mi.load_dict({"type": "simtest_phong", **description})


def incidence(angle_deg):
    return np.array([np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))])


def interaction(mi, wi, count):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.t = 1.0
    si.wi = mi.Vector3f(*map(float, wi))
    return si


def lobe_edges(exponent):
    """Return the edges in beta, rad: quantiles of cos^(n+1)(beta), then equal steps to the far side."""
    inside = np.arccos(np.array(QUANTILES) ** (1 / (exponent + 1)))
    steps = np.linspace(inside[-1], np.pi, 6)[1:]
    return np.concatenate([inside, steps])


def lobe_frame(wi):
    """Return the axes of coordinates about the mirror direction, as rows."""
    mirror = np.array([-wi[0], -wi[1], wi[2]])
    side = np.array([0.0, 1.0, 0.0])
    return np.stack([np.cross(side, mirror), side, mirror])


def cells(exponent, wi, fine=FINE):
    """Return the cells' directions, shape (B, A, fine^2, 3), and solid angles, of B x A bins."""
    edges = lobe_edges(exponent)
    share = (np.arange(fine) + 0.5) / fine
    beta = edges[:-1, None] + np.diff(edges)[:, None] * share
    # The cell's own solid angle: its sum over a bin is exact.
    ends = edges[:-1, None] + np.diff(edges)[:, None] * np.arange(fine + 1) / fine
    height = -np.diff(np.cos(ends), axis=1)
    angle = 2 * np.pi * (np.arange(AROUND)[:, None] + share) / AROUND
    beta, angle, height = beta[:, None, :, None], angle[None, :, None, :], height[:, None, :, None]
    local = np.stack([np.sin(beta) * np.cos(angle), np.sin(beta) * np.sin(angle), np.cos(beta) + 0 * angle], axis=-1)
    solid = np.broadcast_to(height * 2 * np.pi / AROUND / fine, local.shape[:-1])
    bins = (len(edges) - 1, AROUND, fine * fine)
    return (local @ lobe_frame(wi)).reshape(*bins, 3), solid.reshape(bins)


def evaluated(mi, bsdf, wi, directions, method):
    flat = directions.reshape(-1, 3)
    wo = mi.Vector3f(np.ascontiguousarray(flat.T, dtype=np.float32))
    values = getattr(bsdf, method)(mi.BSDFContext(), interaction(mi, wi, len(flat)), wo, True)
    return np.array(values, dtype=float).ravel().reshape(directions.shape[:-1])


def drawn(mi, bsdf, wi, seed, count=SAMPLES):
    """Return the directions, densities and weights of samples."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    si = interaction(mi, wi, count)
    sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True)
    return (np.array(part, dtype=float) for part in (sample.wo, sample.pdf, weight))


def below_share(exponent, wi):
    """Share of the lobe's samples that fall below the surface, in float64."""
    u = (np.arange(4000) + 0.5) / 4000
    cosine = u ** (1 / (exponent + 1))
    sine = np.sqrt(1 - cosine**2)
    # The height of a direction is cos(beta) cos(theta) + sin(beta) sin(theta) cos(phi): below for an arc of phi.
    with np.errstate(divide="ignore"):
        limit = np.clip(-cosine * wi[2] / np.where(wi[0] > 0, sine * wi[0], 1e-300), -1, 1)
    return float(np.mean(np.arccos(-limit) / np.pi))


def lobe_share(exponent, albedo, normalised):
    """Share of the samples that go to the lobe."""
    lobe = 1 - albedo if normalised else 2 * np.pi / (exponent + 1)
    return lobe / (lobe + albedo)


def p_value(mi, case, seed, drawn_exponent=None, factor=1.0):
    """Test samples against the density; the last bin is that of samples that are refused, below the surface."""
    exponent, angle_deg, albedo, normalised = case
    wi = incidence(angle_deg)
    bsdf = material(mi, exponent, albedo, normalised)
    directions, solid = cells(exponent, wi)
    expected = factor * (evaluated(mi, bsdf, wi, directions, "pdf") * solid).sum(axis=-1).ravel()
    refused = lobe_share(exponent, albedo, normalised) * below_share(exponent, wi)
    wo, density, _ = drawn(mi, material(mi, drawn_exponent or exponent, albedo, normalised), wi, seed)
    local = lobe_frame(wi) @ wo[:, density > 0]
    beta = np.arctan2(np.hypot(local[0], local[1]), local[2])
    edges = lobe_edges(exponent)
    row = np.clip(np.searchsorted(edges, beta, side="right") - 1, 0, len(edges) - 2)
    column = np.floor(np.arctan2(local[1], local[0]) % (2 * np.pi) / (2 * np.pi) * AROUND).astype(int) % AROUND
    observed = np.bincount(row * AROUND + column, minlength=len(expected))
    observed = np.append(observed, np.count_nonzero(density <= 0))
    return chi_square(observed, SAMPLES * np.append(expected, refused))


@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_samples_follow_the_density(mi, step):
    """Every fourth case meets each exponent, angle and albedo."""
    cases = CASES[::step]
    p_values = [p_value(mi, case, seed) for seed, case in enumerate(cases)]
    bad = rejected(p_values)
    assert not bad.any(), [(cases[i], p_values[i]) for i in np.flatnonzero(bad)]
    # Over so many cases the p-values themselves are even; a test without power would pile them up at 1.
    assert stats.kstest(p_values, "uniform").pvalue > ALPHA


WRONG = [(50.0, 15.0, 0.3, False), (5.0, 60.0, 0.9, False), (500.0, 75.0, 0.0, False), (20.0, 45.0, 0.5, True)]


@pytest.mark.parametrize("case", WRONG, ids=str)
def test_negative_controls_are_rejected(mi, case):
    """Samples of a lobe that is 10 % off in n, and a density that is 3 % off."""
    strict = ALPHA / len(CASES)
    assert p_value(mi, case, 1, drawn_exponent=1.1 * case[0]) < strict
    assert p_value(mi, case, 2, factor=0.97) < strict
    assert p_value(mi, case, 3, factor=1.03) < strict


def test_the_density_integrates_to_the_share_of_samples_above_the_surface(mi):
    for exponent, angle_deg, albedo, normalised in CASES:
        wi = incidence(angle_deg)
        directions, solid = cells(exponent, wi)
        density = evaluated(mi, material(mi, exponent, albedo, normalised), wi, directions, "pdf")
        kept = 1 - lobe_share(exponent, albedo, normalised) * below_share(exponent, wi)
        assert (density * solid).sum() == pytest.approx(kept, abs=1e-3), (exponent, angle_deg, albedo)


def test_weights_are_value_over_density(mi):
    for seed, (exponent, angle_deg, albedo, normalised) in enumerate(CASES):
        wi = incidence(angle_deg)
        bsdf = material(mi, exponent, albedo, normalised)
        wo, density, weight = drawn(mi, bsdf, wi, seed, 2000)
        value = evaluated(mi, bsdf, wi, wo.T, "eval")
        again = evaluated(mi, bsdf, wi, wo.T, "pdf")
        weight = weight.ravel()
        ok = density > 0
        assert ok.mean() > 0.3
        np.testing.assert_allclose(again, density, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(weight[ok], value[ok] / density[ok], rtol=1e-5)
        assert (weight[~ok] == 0).all()
        if not normalised:
            # The mix is the best there is for this form: every sample weighs the same.
            np.testing.assert_allclose(weight[ok], 2 * np.pi / (exponent + 1) + albedo, rtol=1e-4)


# Energy --------------------------------------------------------------------------------------------------------------


def lobe_albedo(exponent, wi, normalised):
    """Integral of the lobe's f cos(theta) of scale 1 over the upper hemisphere, in float64."""
    directions, solid = cells(exponent, wi)
    cosine = np.clip(directions @ lobe_frame(wi)[2], 0, 1)
    height = directions[..., 2]
    scale = (exponent + 2) / (2 * np.pi) * height if normalised else 1.0
    return float((np.where(height > 0, scale * cosine**exponent, 0) * solid).sum())


@pytest.mark.parametrize("albedo", ALBEDOS)
def test_the_normalised_form_conserves_energy(mi, albedo):
    for exponent in EXPONENTS:
        at_normal = None
        for angle_deg in ANGLES_DEG:
            wi = incidence(angle_deg)
            expected = (1 - albedo) * lobe_albedo(exponent, wi, True) + albedo
            directions, solid = cells(exponent, wi)
            bsdf = material(mi, exponent, albedo, normalised=True)
            rendered = float((evaluated(mi, bsdf, wi, directions, "eval") * solid).sum())
            # The base's share of the cells below and at the horizon costs up to 1e-3.
            assert rendered == pytest.approx(expected, abs=1e-3)
            assert expected < 1 + 1e-3
            at_normal = at_normal or expected
            assert expected <= at_normal + 1e-9
        assert at_normal == pytest.approx(1.0, abs=1e-3)


def test_a_sum_of_shares_above_one_would_create_energy(mi):
    """Why a scene with such a sum is refused: at normal incidence the albedo is the sum."""
    wi = incidence(0.0)
    directions, solid = cells(50.0, wi)
    bsdf = material(mi, 50.0, 0.3, normalised=True, specular=0.8)
    assert (evaluated(mi, bsdf, wi, directions, "eval") * solid).sum() == pytest.approx(1.1, abs=1e-3)


# In Mitsuba's integrators --------------------------------------------------------------------------------------------

FAMILY = [(n, angle, albedo, form) for n in (1.0, 20.0, 500.0) for angle in (0.0, 60.0, 85.0) for albedo, form in
          ((0.0, False), (0.9, False), (0.5, True))]  # fmt: skip


def furnace(mi, case, count=4000):
    """Return the radiance that Mitsuba's `direct` samples off a plane under an even sky, from the lobe alone."""
    import drjit as dr

    exponent, angle_deg, albedo, normalised = case
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    shape = {"type": "rectangle", "bsdf": material(mi, exponent, albedo, normalised)}
    scene = mi.load_dict({"type": "scene", "surface": shape, "sky": sky})
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 1})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(11, count)
    wi = incidence(angle_deg)
    direction = dr.zeros(mi.Vector3f, count) - mi.Vector3f(*map(float, wi))
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*map(float, wi)), direction))
    radiance, _, _ = integrator.sample(scene, sampler, ray, None, True)
    return np.array(radiance, dtype=float).ravel()


def furnace_statistic(mi, case, bias=1.0):
    """Return the mean's distance from the quadrature in standard errors."""
    exponent, angle_deg, albedo, normalised = case
    scale = 1 - albedo if normalised else 1.0
    expected = scale * lobe_albedo(exponent, incidence(angle_deg), normalised) + albedo
    sampled = bias * furnace(mi, case)
    # Where all samples weigh the same there is no spread, but rounding and the quadrature's error.
    error = max(sampled.std(ddof=1) / np.sqrt(len(sampled)), 2e-4 * expected)
    return (sampled.mean() - expected) / error


def test_an_even_sky_gives_the_albedo(mi):
    statistics = np.array([furnace_statistic(mi, case) for case in FAMILY])
    assert not rejected(2 * stats.norm.sf(np.abs(statistics))).any(), statistics
    pooled = statistics.sum() / np.sqrt(len(FAMILY))
    assert abs(pooled) < 3
    biased = np.array([furnace_statistic(mi, case, 1.01) for case in FAMILY])
    assert abs(biased.sum() / np.sqrt(len(FAMILY))) > 3
