"""Direct light off a plane and a sphere against formulas in double precision, written here from theory.md section 1.

Phong, as published and normalised, with and without a base, one point light wherever it may be: at every pixel.
"""

from itertools import product

import numpy as np
import pytest
from scipy import stats

from simtest.rendering import Session
from simtest.spec import scene_from_dict
from tests.marked import marked

pytestmark = pytest.mark.render

WIDTH, HEIGHT, FOCAL, CX, CY = 120, 96, 110.0, 63.0, 45.0
DISTANCE, RADIUS = 10.0, 6.0
PLACES = [
    (0.0, 0.0, 0.0),
    (0.01, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, 2.0, 0.0),
    (-3.0, 1.0, 0.0),
    (2.0, -1.5, 1.0),
    (5.0, 5.0, 0.0),
    (0.0, 0.0, 3.0),
    (-8.0, 0.0, 2.0),
    (1.0, 1.0, -5.0),
    (10.0, -4.0, 4.0),
    (0.0, 12.0, 6.0),
    (20.0, 0.0, 5.0),
    (-2.0, 3.0, 7.0),
    (30.0, 10.0, 2.0),
    (0.3, -0.2, 9.0),
]
"""mm, camera frame: at the camera, beside, before and behind it, grazing, and next to the surface."""

SHARES = [(1.0, 0.0, False), (1.0, 0.0, True), (0.6, 0.4, False), (0.6, 0.4, True), (0.0, 0.9, False)]
"""Specular scale, albedo of the base, whether normalised."""

TINY = 1e-30
"""Where cos^n is smaller still, single precision has no digits left."""


def sightlines(x, y):
    rays = np.stack([(x - CX) / FOCAL, (y - CY) / FOCAL, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def anchor_normal(tilt_deg, azimuth_deg):
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])


def plane(s):
    N = anchor_normal(20.0, 130.0)
    t = DISTANCE * N[2] / (s @ N)
    return np.where(t > 0, t, np.nan)[..., None] * s, np.broadcast_to(N, s.shape)


def sphere(s):
    centre = np.array([0.0, 0.0, DISTANCE]) - RADIUS * anchor_normal(15.0, 70.0)
    along = s @ centre
    with np.errstate(invalid="ignore"):
        P = (along - np.sqrt(along**2 - centre @ centre + RADIUS**2))[..., None] * s
    return P, (P - centre) / RADIUS


SURFACES = {
    "plane": ({"type": "plane", "tilt_deg": 20.0, "azimuth_deg": 130.0}, plane),
    "sphere": ({"type": "sphere", "radius_mm": RADIUS, "tilt_deg": 15.0, "azimuth_deg": 70.0}, sphere),
}


def radiance(P, N, place, exponent, specular, albedo, normalised):
    """Return the radiance of a light of power 1; 0 in its own shadow, where the normal turns away from it."""
    to_camera = -P / np.linalg.norm(P, axis=-1, keepdims=True)
    to_light = np.asarray(place) - P
    squared = np.sum(to_light**2, axis=-1)
    to_light = to_light / np.sqrt(squared)[..., None]
    cos_light = np.sum(N * to_light, axis=-1)
    mirrored = 2 * cos_light[..., None] * N - to_light
    cos_beta = np.maximum(np.sum(mirrored * to_camera, axis=-1), 0)
    scale = (exponent + 2) / (2 * np.pi) * cos_light if normalised else 1.0
    value = specular * scale * cos_beta**exponent + albedo / np.pi * cos_light
    return np.nan_to_num(np.where(cos_light > 0, value / squared, 0.0)), cos_light


def described(surface, places, exponent, specular, albedo, normalised):
    reflectance = {"type": "phong", "exponent": exponent, "specular": specular, "diffuse": albedo}
    return scene_from_dict(
        {
            "surface": surface,
            "camera": {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": CX, "cy": CY},
            "rig": {"lights": [{"position_mm": list(place)} for place in places]},
            "reflectance": {**reflectance, "normalised": normalised},
        }
    )


@pytest.fixture(scope="module")
def session():
    return Session(described(SURFACES["plane"][0], PLACES[:1], 50.0, 1.0, 0.0, False))


@pytest.mark.parametrize(
    ("name", "exponent"),
    marked(
        product(SURFACES, [10.0, 50.0, 100.0, 500.0]),
        ci=[("plane", 500.0), ("sphere", 10.0)],
        slow=product(SURFACES, [50.0, 100.0]),
    ),
)
def test_every_pixel_has_the_radiance_of_the_formula(session, name, exponent):
    surface, formula = SURFACES[name]
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    P, N = formula(sightlines(x, y))
    compared = dark = 0
    for place in PLACES:
        for specular, albedo, normalised in SHARES:
            expected, cos_light = radiance(P, N, place, exponent, specular, albedo, normalised)
            session.update(described(surface, [place], exponent, specular, albedo, normalised))
            rendered = session.radiance().total.astype(float)
            peak = max(expected.max(), TINY)
            bright = expected > max(1e-3 * peak, TINY)
            relative = np.abs(rendered[bright] / expected[bright] - 1)
            where = (place, specular, albedo, normalised)
            assert relative.max(initial=0) < 1e-4, where
            assert np.abs(rendered - expected)[~bright].max(initial=0) < max(1e-7 * peak, TINY), where
            with np.errstate(invalid="ignore"):
                assert (rendered[cos_light < -1e-6] == 0).all(), where
                dark += np.count_nonzero(cos_light < -1e-6)
            compared += np.count_nonzero(bright)
    assert compared > 50_000
    # Seen from in front of it, a plane has no side that its light does not reach.
    assert dark > 10_000 or name == "plane"


# Mitsuba's own integrators -----------------------------------------------------------------------------------------

SIDE = 6
"""Points along each side of a pixel for its mean."""

SAMPLED = [
    (name, integrator, places)
    for name in SURFACES
    for integrator in ({"type": "direct"}, {"type": "path", "max_depth": 2})
    for places in (PLACES[:1], [PLACES[5], PLACES[9]])
]


def differences(session, name, integrator, places, shares, seed):
    """Return one random sample a pixel, of 3000 pixels, and its formula's mean over the pixel."""
    specular, albedo, normalised = shares
    surface, formula = SURFACES[name]
    session.update(described(surface, places, 20.0, specular, albedo, normalised))
    mi, generator = session.mi, np.random.default_rng(seed)
    pixels = np.stack(np.meshgrid(np.arange(32.0, 92.0), np.arange(20.0, 70.0)), axis=-1).reshape(-1, 2)
    points = pixels + generator.uniform(size=pixels.shape)
    pose = session.surface.model_from_camera
    # The scene with Mitsuba's own lights; each of our rays is sampled by Mitsuba's integrator.
    origin = np.broadcast_to(pose[:3, 3], (len(points), 3))
    directions = sightlines(points[:, 0], points[:, 1]) @ pose[:3, :3].T
    ray = mi.Ray3f(*(np.ascontiguousarray(part.T, dtype=np.float32) for part in (origin, directions)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(points))
    value, _, _ = mi.load_dict(integrator).sample(session._built.scene, sampler, mi.RayDifferential3f(ray), None, True)
    sampled = np.array(value, dtype=float).ravel()
    inside = (np.stack(np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE] * 2), axis=-1)).reshape(-1, 2)
    fine = pixels[:, None] + inside
    P, N = formula(sightlines(fine[..., 0], fine[..., 1]))
    means = sum(radiance(P, N, place, 20.0, specular, albedo, normalised)[0].mean(axis=1) for place in places)
    return sampled, means


def statistic(sampled, means):
    """Return the pooled mean's distance from the formula's in standard errors."""
    difference = sampled - means
    return difference.mean() / (difference.std(ddof=1) / np.sqrt(len(difference)))


@pytest.mark.parametrize("shares", [(0.6, 0.4, False), (0.6, 0.4, True)], ids=["published", "normalised"])
def test_mitsubas_integrators_agree_with_the_formula_in_the_mean(session, shares):
    """Family-wise alpha 0.01 by Bonferroni, and all together within 3 standard errors; 1 % more must be seen."""
    drawn = [differences(session, *case, shares, seed) for seed, case in enumerate(SAMPLED)]
    found = np.array([statistic(*pair) for pair in drawn])
    assert np.abs(found).max() < stats.norm.isf(0.01 / 2 / len(found)), found
    assert abs(found.sum() / np.sqrt(len(found))) < 3, found
    biased = np.array([statistic(1.01 * sampled, means) for sampled, means in drawn])
    assert biased.sum() / np.sqrt(len(biased)) > 3, biased
    assert (biased > found).all()


def test_the_sampled_material_is_the_scenes(session):
    """The integrators above see the plugin, not a stand-in."""
    built = session._built.scene.shapes()[0].bsdf()
    assert type(built).__name__ == "Phong"
    assert session.scene.reflectance.kernel["type"] == "simtest_phong"


def test_colour_tints_the_base_alone():
    """In the colour variant; last here, since the variant is the process's."""
    scene = described(SURFACES["sphere"][0], [PLACES[5]], 50.0, 0.5, 0.5, False)
    colour = (0.9, 0.45, 0.3)
    tinted = scene.reflectance.model_copy(update={"colour": colour})
    rendered = Session(scene.model_copy(update={"reflectance": tinted}), "llvm_ad_rgb").radiance()
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    P, N = sphere(sightlines(x, y))
    lobe, _ = radiance(P, N, PLACES[5], 50.0, 0.5, 0.0, False)
    base, _ = radiance(P, N, PLACES[5], 50.0, 0.0, 0.5, False)
    assert rendered.total.shape == (HEIGHT, WIDTH, 3)
    for channel, share in enumerate(colour):
        expected = lobe + share * base
        np.testing.assert_allclose(rendered.total[:, :, channel], expected, rtol=1e-4, atol=1e-7 * expected.max())
        np.testing.assert_allclose(rendered.diffuse[:, :, channel], share * base, rtol=1e-4, atol=1e-7 * base.max())
