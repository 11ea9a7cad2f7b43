"""Student's t without SciPy, against SciPy's."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from simtest.geometry.student_t import quantile, within


@given(st.floats(0.001, 0.999), st.integers(1, 3000))
def test_quantiles_are_those_of_scipy(share, freedom):
    assert quantile(share, freedom) == pytest.approx(stats.t.ppf(share, freedom), rel=1e-11, abs=1e-12)


@given(st.floats(0, 100), st.integers(1, 500))
def test_probabilities_are_those_of_scipy(t, freedom):
    assert within(t, freedom) == pytest.approx(1 - 2 * stats.t.sf(t, freedom), abs=1e-12)


@pytest.mark.parametrize("freedom", [998, 999, 1000, 1001, 1002, 10**6, 10**9])
def test_sums_and_expansion_agree_where_they_meet(freedom):
    assert quantile(0.975, freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-13)


def test_closed_forms():
    # Cauchy's distribution, and two degrees of freedom.
    assert quantile(0.975, 1) == pytest.approx(math.tan(math.pi * 0.475), rel=1e-13)
    assert quantile(0.975, 2) == pytest.approx(0.95 * math.sqrt(2 / (1 - 0.95**2)), rel=1e-13)
    assert quantile(0.5, 7) == pytest.approx(0.0, abs=1e-300)


@pytest.mark.parametrize(("share", "freedom"), [(0.0, 3), (1.0, 3), (math.nan, 3), (0.5, 0)])
def test_what_has_no_quantile_is_refused(share, freedom):
    with pytest.raises(ValueError, match="must be inside"):
        quantile(share, freedom)
