"""The published protocol's picture and its Cramer-Rao bound."""

import numpy as np
import pytest
from pydantic import ValidationError

from simtest.errors import InputError
from simtest.spec.recipes import PaperSetting, paper_from_dict
from simtest.validation.paper.isocurves import brightest_point, isocurve_radii, isophote_radius
from simtest.validation.paper.predictions import cramer_rao_bound
from simtest.validation.paper.protocol import (
    draw_light,
    picture,
    plane_from_image,
    texture,
    window_centre,
)
from tests.isocurve_formulas import cosine_beta, cosine_of_isovalue, kappa


@pytest.mark.parametrize(
    ("theta", "sigma", "bound_deg"),
    [(58, 0.05, 0.136), (58, 0.01, 0.027), (58, 0.1, 0.272), (10, 0.05, 0.717), (30, 0.05, 0.289), (75, 0.05, 0.083)],
)
def test_bound_has_the_known_values(theta, sigma, bound_deg):
    bound = np.degrees(cramer_rao_bound(PaperSetting(theta_deg=theta, sigma=sigma)))
    assert bound == pytest.approx(bound_deg, rel=0.02)


def test_bound_is_proportional_to_the_noise():
    small = PaperSetting(size=128, sigma=0.01)
    assert cramer_rao_bound(PaperSetting(size=128, sigma=0.04)) == pytest.approx(4 * cramer_rao_bound(small), rel=1e-9)
    assert cramer_rao_bound(PaperSetting(size=128, sigma=0.0)) == 0


@pytest.mark.parametrize("theta", [0.0, 30.0, 58.0, 80.0])
def test_picture_is_the_specular_term_on_the_slanted_plane(theta):
    setting = PaperSetting(theta_deg=theta)
    light = np.array([0.0, 0.0, setting.height])
    seen = picture(setting, light)
    # By hand: cast each pixel's ray onto the plane, take the closed form at the distance from the foot.
    rays = setting.camera.unproject(setting.camera.pixel_centres())
    centre = np.array([0.0, 0.0, setting.height])
    points = rays * ((setting.normal @ centre) / (rays @ setting.normal))[..., None]
    squared = np.sum((points - centre) ** 2, axis=-1)
    cosine = (setting.height**2 - squared) / (setting.height**2 + squared)
    expected = np.maximum(cosine, 0) ** setting.exponent
    near = (squared < (setting.size / 2 - 2) ** 2) & (np.sum(points * rays, axis=-1) > 0)
    assert near.sum() > 1000
    # Bilinear interpolation of a texture of this width is exact to a quarter per mille of the peak.
    assert np.abs(seen - expected)[near].max() < 2.5e-4


def test_texture_is_centred_at_the_brightest_point():
    setting = PaperSetting(eps=400.0, exponent=100.0)
    rng = np.random.default_rng(3)
    for _ in range(5):
        light = draw_light(setting, rng)
        values = texture(setting, light)
        row, column = np.unravel_index(values.argmax(), values.shape)
        assert abs(row - 202.5) <= 1
        assert abs(column - 202.5) <= 1
        assert values.max() <= 1
        offset = np.linalg.norm(light[:2])
        assert offset == pytest.approx(400.0)
        assert abs(light[2] - setting.height) <= 200.0
        # The mirrored light, the BP and the camera are in line.
        bp = np.append(brightest_point(light, np.array([0, 0, setting.height])), 0)
        line = np.cross(bp - light * [1, 1, -1], np.array([0, 0, setting.height]) - bp)
        assert np.abs(line).max() < 1e-6 * setting.height**2
    fixed = PaperSetting(eps=400.0, recentre=False)
    assert (window_centre(fixed, light) == 0).all()


def test_homography_maps_the_image_centre_to_the_window_centre():
    centre = plane_from_image(PaperSetting()) @ np.array([203.0, 203.0, 1.0])
    np.testing.assert_allclose(centre[:2] / centre[2], 0, atol=1e-9)


@pytest.mark.parametrize(
    "values",
    [
        {"sigma": -0.1}, {"sigma": np.nan}, {"theta_deg": 90.0}, {"theta_deg": -1.0}, {"exponent": 0.0},
        {"exponent": -5.0}, {"isovalue": 0.0}, {"isovalue": 1.0}, {"size": 15}, {"height": 0.0}, {"eps": -1.0},
        {"smoothing_px": -1.0}, {"eps": np.inf},
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused_by_name(values):
    (name,) = values
    with pytest.raises(InputError, match=rf"^scene: paper\.{name} = .*must be"):
        paper_from_dict({"paper": values}, "scene")


def test_texture_is_the_specular_term_of_the_isocurves():
    setting = PaperSetting(size=64, eps=300.0)
    light = draw_light(setting, np.random.default_rng(5))
    side = np.arange(64) + 0.5 - 32
    points = np.stack(np.meshgrid(side, side), axis=-1) + window_centre(setting, light)
    expected = np.maximum(cosine_beta(points, light, np.array([0, 0, setting.height])), 0) ** setting.exponent
    np.testing.assert_allclose(texture(setting, light), expected, rtol=1e-11)


@pytest.mark.parametrize(
    "values", [{"size": 16}, {"size": 32}, {"height": 1e5}, {"theta_deg": 89.99}, {"exponent": 1e5}]
)
def test_a_frame_that_determines_nothing_has_no_bound(values):
    assert cramer_rao_bound(PaperSetting(**values)) is None


@pytest.mark.parametrize("eps", [2000.0, 5000.0])
def test_a_light_behind_the_plane_is_refused(eps):
    with pytest.raises(ValidationError, match="eps must be less than 2 height"):
        PaperSetting(eps=eps)
    PaperSetting(eps=1999.0)


def test_the_isophotes_radius_keeps_its_digits():
    """For n where tau or 1 - tau is rounding; in between it is that of the circles."""
    assert isophote_radius(0.1, 0.1, 2.0) == pytest.approx(2.0, rel=1e-9)
    assert isophote_radius(0.5, 1e12, 1.0) == pytest.approx(np.sqrt(np.log(2) / 2e12), rel=1e-9)
    tau = cosine_of_isovalue(0.3, 40.0)
    assert isophote_radius(0.3, 40.0, 5.0) == pytest.approx(float(isocurve_radii(kappa(tau), 5.0)[0]), rel=1e-12)
