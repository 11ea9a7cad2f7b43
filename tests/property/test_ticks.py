"""Ticks of linear axes: even, inside the ends, few, and told apart."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simtest.pages.axes import even_ticks

ENDS = st.floats(-1e6, 1e6, allow_nan=False)
SPANS = st.floats(1e-6, 1e6)


@given(low=ENDS, span=SPANS, most=st.integers(1, 12), is_turned=st.booleans())
def test_even_ticks(low, span, most, is_turned):
    high = low + span
    if not (high - low) > 1e-9 * max(abs(low), abs(high), 1e-6):
        return
    ticks = even_ticks(*((high, low) if is_turned else (low, high)), most)
    values = np.array([at for at, _ in ticks])
    assert len(values) <= most + 1
    slack = 1e-5 * span + 1e-9 * abs(low)
    assert ((values >= low - slack) & (values <= high + slack)).all()
    if len(values) > 1:
        steps = np.diff(values)
        step = steps.mean()
        assert np.allclose(steps, step, rtol=1e-4)
        digit = step / 10.0 ** np.floor(np.log10(step * (1 + 1e-9)))
        assert min(abs(digit - known) for known in (1.0, 2.0, 2.5, 5.0, 10.0)) < 1e-3
    if span > 1e-4 * abs(low):
        texts = [text for _, text in ticks]
        assert len(set(texts)) == len(texts)
        for (at, text), (following, _) in itertools.pairwise(ticks):
            assert abs(float(text) - at) < 0.01 * (following - at) + 1e-9
    assert "-0" not in {text for _, text in ticks}
