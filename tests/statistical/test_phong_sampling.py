"""The Phong plugin's samples follow its density: chi-square tests with a negative control.

Family-wise alpha 0.01 over all cases, by Sidak's correction, which Mitsuba's test applies from `test_count`.
"""

import pytest

from simtest.rendering import backend, phong

pytestmark = pytest.mark.render

ALPHA = 0.01
CASES = [(exponent, cosine) for exponent in (1.0, 50.0, 500.0) for cosine in (0.95, 0.5)]


@pytest.fixture(scope="module")
def mi():
    mi = backend.load()
    phong.register(mi, mi.variant())
    return mi


def accepted(mi, drawn_exponent, density_exponent, cosine):
    """Test samples drawn at one exponent against the density at another."""
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    def functors(exponent):
        description = {
            "type": phong.PLUGIN,
            "exponent": exponent,
            "specular": 1.0,
            "diffuse_reflectance": {"type": "uniform", "value": 0.5},
        }
        return BSDFAdapter(phong.PLUGIN, description, wi=[(1 - cosine**2) ** 0.5, 0.0, cosine])

    sample, _ = functors(drawn_exponent)
    _, density = functors(density_exponent)
    test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=3, sample_count=200_000, res=201, seed=5)
    return test.run(significance_level=ALPHA, test_count=len(CASES), quiet=True)


@pytest.mark.parametrize(("exponent", "cosine"), CASES)
def test_samples_follow_the_density(mi, exponent, cosine):
    assert accepted(mi, exponent, exponent, cosine)


def test_negative_control_is_rejected(mi):
    assert not accepted(mi, 50.0, 55.0, 0.95)
