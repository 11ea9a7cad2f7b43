"""Laws of glints on relief (theory.md section 7), at alpha = 0.001 where a test is statistical; seeds are fixed."""

import numpy as np
import pytest
from scipy import stats

from simtest.validation import laws
from studies.relief_laws import Case, cloud, collect, count, normals

pytestmark = pytest.mark.slow

ALPHA = 0.001


@pytest.mark.parametrize(("surface", "slope"), [("plane", 4.0), ("kd = -0.5", 4.0), ("kd = 1", 6.0)])
def test_glints_stand_off_the_base_by_the_reliefs_slope(surface, slope):
    row = normals(Case(surface, slope, 0.5), 800)
    assert abs(row.ratio - 1) < 0.05
    if surface == "plane":
        assert row.distance <= 0.03 + stats.kstwo.ppf(1 - ALPHA, row.glints) - stats.kstwo.ppf(0.5, row.glints)


def test_normals_negative_control():
    """Glints of 4 deg are no sample of the law of 4.6 deg."""
    angle = np.concatenate([frame.angle for frame in collect(Case("plane", 4.0, 0.5), 800)])
    wrong = np.radians(4.6)
    assert stats.kstest(angle, lambda a: laws.relief_error_share(a, wrong)).pvalue < ALPHA


@pytest.mark.parametrize(("surface", "slope", "wave"), [("plane", 6.0, 1.5), ("kd = -0.5", 4.0, 1.5)])
def test_number_of_glints(surface, slope, wave):
    mean, error, expected, frames = count(Case(surface, slope, wave), 400, 10)
    assert abs(mean - expected) < stats.t.ppf(1 - ALPHA / 2, frames - 1) * error + 0.02 * expected
    # Negative control: relief of half the slope.
    other = laws.glint_count(np.radians(slope / 2), wave, 20.0, Case(surface, slope, wave).gains)
    assert abs(mean - other) > stats.t.ppf(1 - ALPHA / 2, frames - 1) * error


def test_cloud_lies_about_the_bases_point():
    case = Case("kd = -0.5", 4.0, 0.5)
    mean, error, ratio, number = cloud(case, 2500)
    assert np.all(np.abs(mean) < stats.norm.ppf(1 - ALPHA / 4) * error)
    # The ratio of two deviations of n glints has a relative error of about 1/sqrt(n).
    assert abs(ratio / laws.cloud_axis_ratio(case.gains) - 1) < 0.03 + 3.3 / np.sqrt(number)
