"""Widths and curvatures of lobes against the lobes written out, and Mitsuba's facets as they are rendered."""

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.spec import scene_from_dict

ALPHA = 0.2
FILM = {"index": 1.33, "alpha": 0.08}


def spec(**reflectance):
    return scene_from_dict({"surface": {"type": "plane"}, "reflectance": reflectance}).reflectance


def ggx(angle, alpha):
    return (1 + np.tan(angle) ** 2 / alpha**2) ** -2.0


WIDTHS = {
    "phong": (spec(type="phong", exponent=40.0), lambda a: np.cos(2 * a) ** 40),
    "plastic": (spec(type="rough_plastic", alpha=ALPHA), lambda a: ggx(a, ALPHA)),
    "conductor": (spec(type="rough_conductor", alpha=ALPHA), lambda a: ggx(a, ALPHA)),
    "principled": (spec(type="principled", roughness=0.4), lambda a: ggx(a, 0.16)),
    "film, GGX": (
        spec(type="tissue", film={**FILM, "distribution": "ggx"}), lambda a: ggx(a, 0.08),
    ),
    "film, Beckmann": (
        spec(type="tissue", film={**FILM, "distribution": "beckmann"}),
        lambda a: np.exp(-np.tan(a) ** 2 / 0.08**2),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WIDTHS)
def test_the_half_width_is_where_the_lobe_is_half_as_high(name):
    reflectance, lobe = WIDTHS[name]
    assert lobe(reflectance.half_width) == pytest.approx(0.5 * lobe(0.0), rel=1e-9)


CURVATURES = {
    "phong": (spec(type="phong", exponent=40.0), lambda a: np.cos(2 * a) ** 40),
    "normalised": (spec(type="phong", exponent=40.0, normalised=True), lambda a: np.cos(2 * a) ** 40 * np.cos(a)),
    "film": (
        spec(type="tissue", film={**FILM, "distribution": "beckmann"}),
        lambda a: np.exp(-np.tan(a) ** 2 / 0.08**2) / np.cos(a) ** 5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CURVATURES)
def test_the_curvature_is_the_second_difference_of_the_lobes_logarithm(name):
    reflectance, lobe = CURVATURES[name]
    step = 1e-3
    second = np.log(lobe(step)) + np.log(lobe(-step)) - 2 * np.log(lobe(0.0))
    assert reflectance.lobe_curvature == pytest.approx(-second / step**2, rel=1e-4)


@pytest.mark.render
@pytest.mark.parametrize("kind", ["rough_conductor", "rough_plastic"])
@pytest.mark.parametrize("alpha", [0.1, 0.3])
def test_rendered_facets_have_the_lobe_of_their_alpha(kind, alpha):
    """Light at the camera, plane across the axis: D G / (4 cos) over the squared distance, facets met straight on."""
    camera = {"width": 64, "height": 64, "fx": 80.0, "fy": 80.0}
    reflectance = {"type": kind, "alpha": ALPHA, "diffuse": 0.0}
    session = Session(scene_from_dict({"surface": {"type": "plane"}, "camera": camera, "reflectance": reflectance}))
    # As built, and after an update.
    session.update(scene_from_dict({"surface": {"type": "plane"}, "camera": camera,
                                    "reflectance": {**reflectance, "alpha": alpha}}))  # fmt: skip
    seen = session.radiance().specular.astype(float)
    y, x = np.mgrid[:64, :64] + 0.5
    cosine = 1 / np.sqrt(1 + ((x - 32) ** 2 + (y - 32) ** 2) / 80.0**2)
    tangent2 = 1 / cosine**2 - 1
    density = 1 / (cosine**4 * (1 + tangent2 / alpha**2) ** 2)
    hidden = (2 / (1 + np.sqrt(1 + alpha**2 * tangent2))) ** 2
    expected = density * hidden / cosine * cosine**2
    np.testing.assert_allclose(seen / seen.max(), expected / expected.max(), rtol=2e-4, atol=1e-6)
