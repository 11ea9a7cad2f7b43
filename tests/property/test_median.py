"""Medians and quantiles are NumPy's, without what NumPy loads for them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from simtest.calibration.frame import SAMPLE, median
from simtest.estimators.budget import quantile

VALUES = arrays(np.float32, st.integers(1, 40), elements=st.floats(0, 2.0**100, width=32) | st.just(np.nan))


@given(VALUES)
def test_it_is_numpys_to_the_last_bit(values):
    kept = values.copy()
    assert np.array_equal(median(values), np.median(values), equal_nan=True)
    assert np.array_equal(values, kept, equal_nan=True)


def test_that_of_many_values_is_numpys_too():
    for count in (40 * SAMPLE, 40 * SAMPLE + 1):
        noise = np.random.default_rng(3).normal(size=count).astype(np.float32)
        # The sample, every 40th value, may lie far above the rest.
        periods = np.where(np.arange(count) % 40 == 0, 9, noise).astype(np.float32)
        for values in (noise, np.sort(noise), periods, np.rint(noise), noise.astype(np.float64) / 3):
            found = median(values)
            assert found == np.median(values)
            assert found.dtype == values.dtype


@given(arrays(float, st.integers(1, 70), elements=st.floats(0, 1e30)), st.floats(0.01, 0.99))
def test_a_quantile_is_numpys_to_the_last_bit(values, share):
    assert quantile(values, share) == np.quantile(values, share)
