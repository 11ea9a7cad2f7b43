"""The gate's level on nights of fresh seeds, with a rise that it must see as the negative control."""

import polars as pl
import pytest
from gate_nights import night, rows
from scipy import stats

from simtest.nightly.compare import compare


def alarms(nights, factor, seed):
    """Count nights of fresh seeds that are called a regression or changed, tonight's errors times a factor."""
    found = 0
    for i in range(nights):
        tables = [
            rows(count=8, seed=seed + 2 * i + j, settings=tuple("abcdef"), spread=0.9, estimators=("p",))
            for j in (0, 1)
        ]
        after = tables[1].with_columns(error_deg=pl.col("error_deg") * factor)
        found += compare(night(after), night(tables[0])).exit_code
    return found


@pytest.mark.slow
def test_fresh_seeds_alone_are_no_regression():
    """12 nights at a level of 1 %: more than 2 alarms have a chance below 0.001; threefold errors are always seen."""
    assert stats.binom.sf(2, 12, 0.01) < 0.001
    assert alarms(12, 1.0, 100) <= 2
    assert alarms(3, 3.0, 500) == 3
