"""The median of a frame's noise is NumPy's, without what NumPy loads for it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from simtest.calibration.noise_estimate import median

VALUES = arrays(np.float32, st.integers(1, 40), elements=st.floats(0, 2.0**100, width=32) | st.just(np.nan))


@given(VALUES)
def test_it_is_numpys_to_the_last_bit(values):
    kept = values.copy()
    assert np.array_equal(median(values), np.median(values), equal_nan=True)
    assert np.array_equal(values, kept, equal_nan=True)
