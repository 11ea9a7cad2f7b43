"""The plugins' samples follow their density, and it is one: chi-square tests with negative controls.

Family-wise alpha 0.01 over all cases of a plugin together, by Holm's correction. Phong's bins and integrals are laid
out about the mirror direction, in the quantiles of the lobe within it and in equal steps of angle beyond. On tissue
each direction stands for the facet that mirrors the incidence into it, in bins of the facets' slope over alpha. So a
narrow lobe is resolved.
"""

from itertools import product

import numpy as np
import pytest
from scipy import stats

from simtest.rendering import backend, elements
from tests.hypothesis_tests import ALPHA, chi_square, rejected
from tests.lobe_formulas import drawn, evaluate, facets, fresnel, incidence, plugin, smith

pytestmark = pytest.mark.render

AROUND, FINE = 8, 24
"""Bins around the axis, and cells along each side of a bin for its integral."""


@pytest.fixture(scope="module")
def mi():
    mi = backend.load()
    elements.register(mi.variant())
    return mi


def spherical(edges):
    """Return directions about z, shape (B, A, FINE^2, 3), and their solid angles, of cells between polar edges."""
    share = (np.arange(FINE) + 0.5) / FINE
    polar = (edges[:-1, None] + np.diff(edges)[:, None] * share)[:, None, :, None]
    # The cell's own solid angle: its sum over a bin is exact.
    ends = edges[:-1, None] + np.diff(edges)[:, None] * np.arange(FINE + 1) / FINE
    height = -np.diff(np.cos(ends), axis=1)[:, None, :, None]
    angle = (2 * np.pi * (np.arange(AROUND)[:, None] + share) / AROUND)[None, :, None, :]
    parts = np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar) + 0 * angle
    directions = np.stack(parts, axis=-1)
    solid = np.broadcast_to(height * 2 * np.pi / AROUND / FINE, directions.shape[:-1])
    bins = (len(edges) - 1, AROUND, FINE * FINE)
    return directions.reshape(*bins, 3), solid.reshape(bins)


def binned(local, edges):
    """Count directions, (3, N), about z in the bins of `spherical`."""
    polar = np.arctan2(np.hypot(local[0], local[1]), local[2])
    row = np.clip(np.searchsorted(edges, polar, side="right") - 1, 0, len(edges) - 2)
    column = np.floor(np.arctan2(local[1], local[0]) % (2 * np.pi) / (2 * np.pi) * AROUND).astype(int) % AROUND
    return np.bincount(row * AROUND + column, minlength=(len(edges) - 1) * AROUND)


class Phong:
    """Cases: exponent, angle of incidence in deg, albedo of the base, whether normalised."""

    samples = 150_000
    exponents, albedos = (1.0, 2.0, 5.0, 20.0, 50.0, 100.0, 500.0), (0.0, 0.3, 0.9)
    angles_deg = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 85.0)
    cases = tuple(
        [(*case, False) for case in product(exponents, angles_deg, albedos)]
        + [(*case, 0.5, True) for case in product((1.0, 20.0, 500.0), (0.0, 45.0, 85.0))]
    )
    integrated, tolerance = cases, 1e-3
    wrong = ((50.0, 15.0, 0.3, False), (5.0, 60.0, 0.9, False), (500.0, 75.0, 0.0, False), (20.0, 45.0, 0.5, True))
    off = 1.1
    """Samples of a lobe that is so much off in n must be told apart."""
    quantiles = np.array([1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.02, 1e-3, 1e-6])

    def __init__(self, case):
        self.exponent, angle_deg, self.albedo, self.normalised = case
        self.wi = incidence(angle_deg)
        inside = np.arccos(self.quantiles ** (1 / (self.exponent + 1)))
        self.edges = np.concatenate([inside, np.linspace(inside[-1], np.pi, 6)[1:]])
        mirror, side = self.wi * [-1, -1, 1], np.array([0.0, 1.0, 0.0])
        self.axes = np.stack([np.cross(side, mirror), side, mirror])

    def material(self, mi, off=1.0, specular=None):
        scale = specular if specular is not None else (1 - self.albedo if self.normalised else 1.0)
        lobe = {"exponent": off * self.exponent, "specular": scale, "normalised": self.normalised}
        return plugin(mi, "phong", self.albedo, **lobe)

    def cells(self):
        """Return the cells' directions and solid angles."""
        local, solid = spherical(self.edges)
        return local @ self.axes, solid

    def local(self, wo):
        return self.axes @ wo

    def refused(self):
        """Share of samples that fall below the surface, in float64."""
        u = (np.arange(4000) + 0.5) / 4000
        cosine = u ** (1 / (self.exponent + 1))
        sine = np.sqrt(1 - cosine**2)
        # A direction's height is cos(beta) cos(theta) + sin(beta) sin(theta) cos(phi): below for an arc of phi.
        with np.errstate(divide="ignore"):
            limit = np.clip(-cosine * self.wi[2] / np.where(self.wi[0] > 0, sine * self.wi[0], 1e-300), -1, 1)
        lobe = 1 - self.albedo if self.normalised else 2 * np.pi / (self.exponent + 1)
        return lobe / (lobe + self.albedo) * float(np.mean(np.arccos(-limit) / np.pi))

    def lobe_albedo(self):
        """Integral of the lobe's f cos(theta) of scale 1 over the upper hemisphere, in float64."""
        directions, solid = self.cells()
        cosine, height = np.clip(directions @ self.axes[2], 0, 1), directions[..., 2]
        scale = (self.exponent + 2) / (2 * np.pi) * height if self.normalised else 1.0
        return float((np.where(height > 0, scale * cosine**self.exponent, 0) * solid).sum())


class Tissue:
    """Cases: alpha, distribution, angle of incidence in deg, albedo of the base."""

    samples, index = 100_000, 1.36
    cases = tuple(product((0.01, 0.03, 0.1), ("beckmann", "ggx"), (0.0, 30.0, 60.0, 80.0, 88.0), (0.0, 0.3, 0.9)))
    integrated, tolerance = cases[::2], 2e-3
    wrong = (
        (0.03, "beckmann", 30.0, 0.0),
        (0.1, "ggx", 60.0, 0.0),
        (0.01, "beckmann", 88.0, 0.3),
        (0.1, "ggx", 0.0, 0.3),
    )
    off = 1.25
    """Samples of a film that is so much rougher must be told apart."""
    slopes = np.array([0.0, 0.3, 0.5, 0.7, 0.9, 1.1, 1.4, 1.8, 2.3, 3.0, 4.0, 7.0, 15.0, 40.0])
    """Edges in slope over alpha; beyond the last come equal steps of the facet's angle."""

    def __init__(self, case):
        self.alpha, self.kind, angle_deg, self.albedo = case
        self.wi = incidence(angle_deg)
        inside = np.arctan(self.alpha * self.slopes)
        self.edges = np.concatenate([inside, np.linspace(inside[-1], np.pi / 2, 7)[1:]])

    def material(self, mi, off=1.0):
        film = {"alpha": off * self.alpha, "index": self.index, "distribution": self.kind}
        return plugin(mi, "tissue", self.albedo, **film)

    def mirrored(self, h):
        return 2 * (h @ self.wi)[..., None] * h - self.wi

    def cells(self):
        """Return the directions that the cells' facets mirror the incidence into, and their solid angles."""
        h, solid = spherical(self.edges)
        return self.mirrored(h), 4 * np.clip(h @ self.wi, 0, None) * solid

    def local(self, wo):
        return wo + self.wi[:, None]

    def refused(self):
        """Share of samples mirrored below the surface, in double precision from the distribution of facets."""
        h, solid = spherical(self.edges)
        facing, height = h @ self.wi, self.wi[2]
        seen = smith(height, self.alpha, self.kind) * facets(h[..., 2], self.alpha, self.kind) * facing / height
        below = (facing > 0) & (self.mirrored(h)[..., 2] <= 0)
        # The film's share of the samples.
        F, passed = fresnel(height, self.index), (1 - 0.0706431683) / self.index**2  # of diffuse light, index 1.36
        base = (1 - F) * passed * self.albedo / (1 - self.albedo * (1 - passed))
        return F / (F + base) * float(np.sum(np.where(below, seen * solid, 0)))


LOBES = [Phong, Tissue]
STEPS = [4, pytest.param(1, marks=pytest.mark.slow)]


def density_of(mi, lobe):
    """Integrate the density over each bin."""
    directions, solid = lobe.cells()
    return (evaluate(mi, lobe.material(mi), lobe.wi, directions, "pdf") * solid).sum(axis=-1).ravel()


def p_value(mi, lobe, seed, off=1.0, factor=1.0):
    """Test samples against the density; the last bin is that of samples that are refused, below the surface."""
    _, wo, density, _ = drawn(mi, lobe.material(mi, off), lobe.wi, seed, lobe.samples)
    observed = np.append(binned(lobe.local(wo[:, density > 0]), lobe.edges), np.count_nonzero(density <= 0))
    return chi_square(observed, lobe.samples * np.append(factor * density_of(mi, lobe), lobe.refused()))


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kind", LOBES)
def test_samples_follow_the_density(mi, kind, step):
    """Every fourth case meets each value of each parameter."""
    cases = kind.cases[::step]
    p_values = [p_value(mi, kind(case), seed) for seed, case in enumerate(cases)]
    bad = rejected(p_values)
    assert not bad.any(), [(cases[i], p_values[i]) for i in np.flatnonzero(bad)]
    # Over so many cases the p-values themselves are even; a test without power would pile them up at 1.
    assert stats.kstest(p_values, "uniform").pvalue > ALPHA


@pytest.mark.parametrize(("kind", "case"), [(kind, case) for kind in LOBES for case in kind.wrong], ids=str)
def test_negative_controls_are_rejected(mi, kind, case):
    """Samples of another lobe, and a density that is 3 % off."""
    strict, lobe = ALPHA / len(kind.cases), kind(case)
    assert p_value(mi, lobe, 1, off=kind.off) < strict
    assert p_value(mi, lobe, 2, factor=0.97) < strict
    assert p_value(mi, lobe, 3, factor=1.03) < strict


@pytest.mark.parametrize("kind", LOBES)
def test_the_density_integrates_to_the_share_of_samples_above_the_surface(mi, kind):
    for case in kind.integrated:
        lobe = kind(case)
        assert density_of(mi, lobe).sum() == pytest.approx(1 - lobe.refused(), abs=kind.tolerance), case


@pytest.mark.parametrize("kind", LOBES)
def test_weights_are_value_over_density(mi, kind):
    for seed, case in enumerate(kind.cases):
        lobe = kind(case)
        bsdf = lobe.material(mi)
        _, wo, density, weight = drawn(mi, bsdf, lobe.wi, seed, 2000)
        value, again = (evaluate(mi, bsdf, lobe.wi, wo.T, method) for method in ("eval", "pdf"))
        ok = density > 0
        assert ok.mean() > 0.3
        np.testing.assert_allclose(again, density, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(weight[ok], value[ok] / density[ok], rtol=1e-5)
        assert (weight[~ok] == 0).all()
        if kind is Phong and not lobe.normalised:
            # The mix is the best there is for this form: every sample weighs the same.
            np.testing.assert_allclose(weight[ok], 2 * np.pi / (lobe.exponent + 1) + lobe.albedo, rtol=1e-4)


# Phong's energy ------------------------------------------------------------------------------------------------------


def rendered_albedo(mi, lobe, **settings):
    directions, solid = lobe.cells()
    return float((evaluate(mi, lobe.material(mi, **settings), lobe.wi, directions, "eval") * solid).sum())


@pytest.mark.parametrize("albedo", Phong.albedos)
def test_the_normalised_form_conserves_energy(mi, albedo):
    for exponent in Phong.exponents:
        at_normal = None
        for angle_deg in Phong.angles_deg:
            lobe = Phong((exponent, angle_deg, albedo, True))
            expected = (1 - albedo) * lobe.lobe_albedo() + albedo
            # The base's share of the cells below and at the horizon costs up to 1e-3.
            assert rendered_albedo(mi, lobe) == pytest.approx(expected, abs=1e-3)
            assert expected < 1 + 1e-3
            at_normal = at_normal or expected
            assert expected <= at_normal + 1e-9
        assert at_normal == pytest.approx(1.0, abs=1e-3)


def test_a_sum_of_shares_above_one_would_create_energy(mi):
    """Why a scene with such a sum is refused: at normal incidence the albedo is the sum."""
    assert rendered_albedo(mi, Phong((50.0, 0.0, 0.3, True)), specular=0.8) == pytest.approx(1.1, abs=1e-3)


FAMILY = [(n, angle, albedo, form) for n in (1.0, 20.0, 500.0) for angle in (0.0, 60.0, 85.0) for albedo, form in
          ((0.0, False), (0.9, False), (0.5, True))]  # fmt: skip


def furnace(mi, lobe, count=4000):
    """Return the radiance that Mitsuba's `direct` samples off a plane under an even sky, from the lobe alone."""
    import drjit as dr

    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    scene = mi.load_dict({"type": "scene", "surface": {"type": "rectangle", "bsdf": lobe.material(mi)}, "sky": sky})
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 1})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(11, count)
    wi = list(map(float, lobe.wi))
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*wi), dr.zeros(mi.Vector3f, count) - mi.Vector3f(*wi)))
    radiance, _, _ = integrator.sample(scene, sampler, ray, None, True)
    return np.array(radiance, dtype=float).ravel()


def furnace_statistic(mi, case, bias=1.0):
    """Return the mean's distance from the quadrature in standard errors."""
    lobe = Phong(case)
    expected = (1 - lobe.albedo if lobe.normalised else 1.0) * lobe.lobe_albedo() + lobe.albedo
    sampled = bias * furnace(mi, lobe)
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
