"""Sets of pixels and chi-squared quantiles are SciPy's, which reconstruction does without."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import array_shapes, arrays
from scipy import ndimage, stats

from simtest.geometry.patch import closed, connected, dilated, rows_and_columns
from simtest.runtime import chi_squared

SQUARE = np.ones((3, 3), dtype=bool)
masks = arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24))


@given(masks, st.booleans())
def test_connected_sets_are_those_of_scipy(mask, diagonally):
    ours = connected(mask, diagonally)
    theirs, count = ndimage.label(mask, SQUARE if diagonally else None)
    assert ours.shape == mask.shape
    assert (ours.max(), ours.min() == 0) == (count, not mask.all())
    # The same sets, whatever their numbers
    pairs = {(int(a), int(b)) for a, b in zip(ours.ravel(), theirs.ravel(), strict=True)}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})
    assert ((ours > 0) == mask).all()


@given(masks, st.booleans())
def test_dilation_and_closing_are_those_of_scipy(mask, as_view):
    # A part of a larger array, as regions of interest are
    mask = np.pad(mask, 2, constant_values=True)[2:-2, 2:-2] if as_view else mask
    assert (dilated(mask) == ndimage.binary_dilation(mask, SQUARE)).all()
    assert (closed(mask) == (mask | ndimage.binary_closing(mask, SQUARE))).all()


@given(st.floats(1e-6, 1 - 1e-6), st.integers(1, 60))
def test_quantiles_are_those_of_scipy(share, freedom):
    x = chi_squared.quantile(share, freedom)
    assert x == pytest.approx(stats.chi2.ppf(share, freedom), rel=1e-9)
    assert chi_squared.survival(x, freedom) == pytest.approx(stats.chi2.sf(x, freedom), rel=1e-9)


@pytest.mark.parametrize(("share", "freedom"), [(0.0, 2), (1.0, 2), (0.5, 0)])
def test_quantiles_need_a_share_and_freedom(share, freedom):
    with pytest.raises(ValueError, match="must be inside"):
        chi_squared.quantile(share, freedom)


@given(masks)
def test_rows_and_columns_are_those_of_numpy(mask):
    for ours, theirs in zip(rows_and_columns(mask), np.nonzero(mask), strict=True):
        assert np.array_equal(ours, theirs)
