"""Propositions 1 and 2 of [MB] over random cameras, lights and isovalues."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtest.errors import InputError
from simtest.validation.paper import isocurves
from tests import isocurve_formulas as formulas

place = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(1, 100)).map(np.array)
cosine = st.floats(0.02, 0.999)


def polar(foot, radius):
    angle = np.linspace(0, 2 * np.pi, 50)
    return np.asarray(foot)[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def test_check_values():
    inner, outer = isocurves.isocurve_radii(0.55, 1.0)
    assert inner == pytest.approx(0.44387, abs=5e-6)
    assert outer == pytest.approx(2.25293, abs=5e-6)


@given(place, cosine)
def test_radii_agree_with_the_published_form(camera, tau):
    k = formulas.kappa(tau)
    inner, outer = isocurves.isocurve_radii(k, camera[2])
    quotient = (2 - k) / k
    root = np.sqrt(max(quotient**2 - 1, 0))
    assert outer == pytest.approx(camera[2] * np.sqrt(quotient + root), rel=1e-9)
    assert inner * outer == pytest.approx(camera[2] ** 2, rel=1e-12)
    assert inner < camera[2] < outer
    assert inner == pytest.approx(camera[2] * np.tan(np.arccos(tau) / 2), rel=1e-9)


@given(place, cosine)
def test_endoscopic_isocurve_is_two_circles(camera, tau):
    k = formulas.kappa(tau)
    inner, outer = isocurves.isocurve_radii(k, camera[2])
    for radius, sign in ((inner, 1), (outer, -1)):
        points = polar(camera, radius)
        scale = (radius**2 + camera[2] ** 2) ** 2
        assert np.abs(formulas.endoscopic_isocurve(points, camera, k)).max() < 1e-9 * scale
        # Proposition 2 is Proposition 1 with L = V, and the inner circle is the isophote.
        assert np.abs(isocurves.specular_isocurve(points, camera, camera, tau)).max() < 1e-9 * scale
        np.testing.assert_allclose(formulas.cosine_beta(points, camera, camera), sign * tau, rtol=1e-9, atol=1e-9)
        assert (isocurves.on_isophote_branch(points, camera, camera) == (sign > 0)).all()


@given(place, cosine, st.floats(0, 3))
def test_factorisation_holds_with_the_factor_kappa(camera, tau, ratio):
    k = formulas.kappa(tau)
    inner, outer = isocurves.isocurve_radii(k, camera[2])
    rho = ratio * camera[2]
    value = formulas.endoscopic_isocurve(polar(camera, rho), camera, k)
    product = k * (rho**2 - inner**2) * (rho**2 - outer**2)
    np.testing.assert_allclose(value, product, rtol=1e-7, atol=1e-7 * (rho**2 + camera[2] ** 2) ** 2)


@given(place, place, st.floats(-60, 60), st.floats(-60, 60))
def test_quartic_vanishes_where_the_cosine_is_tau(camera, light, x, y):
    point = np.array([x, y])
    tau = formulas.cosine_beta(point, light, camera)
    value = isocurves.specular_isocurve(point, light, camera, abs(tau))
    size = np.sum((camera - [x, y, 0]) ** 2) * np.sum((light - [x, y, 0]) ** 2)
    assert abs(value) <= 1e-10 * size
    # The mirrored light's direction, reflected by hand.
    to_light, to_camera = light - [x, y, 0], camera - [x, y, 0]
    mirror = np.array([-to_light[0], -to_light[1], to_light[2]])
    by_hand = mirror @ to_camera / np.linalg.norm(mirror) / np.linalg.norm(to_camera)
    assert tau == pytest.approx(by_hand, abs=1e-12)


@pytest.mark.parametrize("values", [(0.0, 1.0), (1.0, 1.0), (0.5, 0.0), (np.nan, 1.0)])
def test_kappa_out_of_range_is_refused(values):
    with pytest.raises(InputError):
        isocurves.isocurve_radii(*values)
