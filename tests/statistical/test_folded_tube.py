"""Curvature that changes inside a highlight: the best of the default estimators follows the lobe to its peak."""

import numpy as np
import pytest

from studies import folded_tube


@pytest.mark.slow
def test_the_best_of_the_defaults_in_a_folded_tube():
    measured = folded_tube.errors(20.0, 2000, 30, None)
    medians = {name: float(np.median([each[0] for each in own if each])) for name, own in measured.items()}
    assert len(measured[folded_tube.BEST]) >= 8
    assert medians[folded_tube.BEST] <= 0.1
    # what the mean of the cones' axes misses
    assert medians["cone_axis"] > 2 * medians[folded_tube.BEST]
