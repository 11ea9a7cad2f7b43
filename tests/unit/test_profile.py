"""Angular profiles: cos^k and tables."""

import numpy as np
import pytest

from simtest.calibration.photometry import AngularProfile
from simtest.errors import InputError
from simtest.spec.lights import CosineProfile, TableProfile
from simtest.spec.spec_model import validate


def test_cosine_profile_is_the_cosines_power():
    angles = np.radians([0, 30, 60, 89, 91, 180])
    expected = [1, np.cos(np.pi / 6) ** 4, 0.5**4, np.cos(np.radians(89)) ** 4, 0, 0]
    np.testing.assert_allclose(CosineProfile(power=4.0).model().at(np.cos(angles)), expected, atol=1e-15)


def test_no_power_is_uniform_in_all_directions():
    assert AngularProfile().is_uniform
    np.testing.assert_array_equal(AngularProfile().at([-1.0, 0.0, 1.0]), 1.0)


def test_table_is_linear_in_the_angle_and_holds_its_last_value():
    profile = TableProfile(angle_deg=(0.0, 20.0, 40.0), value=(2.0, 1.0, 0.5)).model()
    np.testing.assert_allclose(profile.at(np.cos(np.radians([0, 10, 30, 40, 170]))), [2, 1.5, 0.75, 0.5, 0.5])


def test_a_table_keeps_its_digits_next_to_the_axis():
    profile, angle = AngularProfile(angles=(0.0, 1e-6), values=(1.0, 0.5)), np.array([1e-9, 1e-8, 5e-7])
    expected = 1 - 0.5e6 * angle
    np.testing.assert_allclose(profile.at(np.cos(angle), np.sin(angle)), expected, rtol=1e-12)
    # The cosine alone has lost them.
    assert np.abs(profile.at(np.cos(angle)) - expected).max() > 1e-3


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"angle_deg": [0, 20], "value": [1]}, "value"),
        ({"angle_deg": [5, 20], "value": [1, 1]}, "angle_deg"),
        ({"angle_deg": [0, 20, 20], "value": [1, 1, 1]}, "angle_deg"),
        ({"angle_deg": [0, 20], "value": [0, 1]}, "value"),
        ({"angle_deg": [0, 20], "value": [1, -1]}, "value"),
    ],
)
def test_malformed_tables_are_refused(table, key):
    with pytest.raises(InputError, match=key):
        validate(TableProfile, table, "file")


@pytest.mark.parametrize("power", [-1.0, np.nan, np.inf])
def test_malformed_powers_are_refused(power):
    with pytest.raises(InputError, match="power"):
        AngularProfile(power)
