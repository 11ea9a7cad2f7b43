"""Normals and direct light against formulas in double precision, written here from theory.md section 1.

Phong, as published and normalised, with and without a base, point lights wherever they may be: at every pixel.
"""

from itertools import product

import numpy as np
import pytest
from scipy import stats
from surface_helpers import angle

from simtest.rendering import Session
from simtest.spec import scene_from_dict
from tests.marked import marked

pytestmark = pytest.mark.render

WIDTH, HEIGHT, FX, FY, CX, CY, SKEW = 120, 96, 110.0, 105.0, 63.0, 45.0, 4.0
DISTANCE = 10.0
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
    """Unit rays through pixel positions, from K written out."""
    down = (y - CY) / FY
    rays = np.stack([(x - CX - SKEW * down) / FX, down, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def centres():
    return sightlines(*np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5))


def anchor_normal(tilt_deg, azimuth_deg):
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])


def plane(s, tilt_deg, azimuth_deg):
    """Return positions and normals on sightlines; NaN where there is none."""
    N = anchor_normal(tilt_deg, azimuth_deg)
    t = DISTANCE * N[2] / (s @ N)
    return np.where(t > 0, t, np.nan)[..., None] * s, np.broadcast_to(N, s.shape)


def sphere(s, radius, inside, tilt_deg, azimuth_deg):
    centre = np.array([0.0, 0.0, DISTANCE]) + anchor_normal(tilt_deg, azimuth_deg) * (radius if inside else -radius)
    along = s @ centre
    with np.errstate(invalid="ignore"):
        root = np.sqrt(along**2 - centre @ centre + radius**2)
    P = (along + (root if inside else -root))[..., None] * s
    return P, (P - centre) / radius * (-1 if inside else 1)


def cylinder(s, radius, inside):
    """At tilt 0 and spin 0: curved along x, straight along y."""
    z = DISTANCE + (-radius if inside else radius)
    across = s[..., 0] ** 2 + s[..., 2] ** 2
    with np.errstate(invalid="ignore"):
        root = np.sqrt((s[..., 2] * z) ** 2 - across * (z**2 - radius**2))
    P = ((s[..., 2] * z + (root if inside else -root)) / across)[..., None] * s
    return P, (P - [0, 0, z]) * [1, 0, 1] / radius * (-1 if inside else 1)


def shape(kind, *placed, radius=None, inside=False):
    """Return the table of a surface, and its formula; a plane or sphere placed by its tilt and azimuth."""
    leaned = dict(zip(("tilt_deg", "azimuth_deg"), placed, strict=False))
    if kind == "plane":
        return {"type": kind, **leaned}, lambda s: plane(s, *placed)
    table = {"type": kind, "radius_mm": radius, **leaned} | ({"side": "inside"} if inside else {})
    return table, lambda s: (sphere if kind == "sphere" else cylinder)(s, radius, inside, *placed)


SURFACES = {
    "plane": shape("plane", 20.0, 130.0),
    "sphere": shape("sphere", 15.0, 70.0, radius=6.0),
    "grazing plane": shape("plane", 75.0, -20.0),
    "large sphere": shape("sphere", 0.0, 0.0, radius=1000.0),
    "sphere inside": shape("sphere", 15.0, 0.0, radius=14.0, inside=True),
    "cylinder": shape("cylinder", radius=4.0),
    "large cylinder": shape("cylinder", radius=1000.0),
    "cylinder inside": shape("cylinder", radius=11.2, inside=True),
}


def parts(P, N, place, exponent, specular, albedo, normalised):
    """Return lobe and base of a light of power 1; 0 in its own shadow, where the normal turns away, and cos_light."""
    to_camera = -P / np.linalg.norm(P, axis=-1, keepdims=True)
    to_light = np.asarray(place) - P
    squared = np.sum(to_light**2, axis=-1)
    to_light = to_light / np.sqrt(squared)[..., None]
    cos_light = np.sum(N * to_light, axis=-1)
    mirrored = 2 * cos_light[..., None] * N - to_light
    cos_beta = np.maximum(np.sum(mirrored * to_camera, axis=-1), 0)
    scale = (exponent + 2) / (2 * np.pi) * cos_light if normalised else 1.0
    values = specular * scale * cos_beta**exponent, albedo / np.pi * cos_light
    return [np.nan_to_num(np.where(cos_light > 0, value / squared, 0.0)) for value in values], cos_light


def radiance(*given):
    values, cos_light = parts(*given)
    return sum(values), cos_light


def described(surface, places, exponent, specular, albedo, normalised, powers=None):
    reflectance = {"type": "phong", "exponent": exponent, "specular": specular, "diffuse": albedo}
    camera = {"width": WIDTH, "height": HEIGHT, "fx": FX, "fy": FY, "cx": CX, "cy": CY, "skew": SKEW}
    lights = zip(places, powers or [1.0] * len(places), strict=True)
    return scene_from_dict(
        {
            "surface": surface,
            "camera": camera,
            "rig": {"lights": [{"position_mm": list(place), "power": power} for place, power in lights]},
            "reflectance": {**reflectance, "normalised": normalised},
        }
    )


@pytest.fixture(scope="module")
def session():
    return Session(described(SURFACES["plane"][0], PLACES[:1], 50.0, 1.0, 0.0, False))


LIT = ["plane", "sphere"]


@pytest.mark.parametrize("name", SURFACES)
def test_normals_are_those_of_the_formula_at_every_pixel(session, name):
    surface, formula = SURFACES[name]
    session.update(described(surface, PLACES[:1], 50.0, 1.0, 0.0, False))
    P, N = formula(centres())
    truth = session.truth()
    seen = np.isfinite(P).all(axis=-1) & (np.nan_to_num(P)[..., 2] > 0)
    if surface["type"] != "sphere":
        # The rendered shape is finite.
        seen &= np.linalg.norm(np.nan_to_num(P), axis=-1) < 45 * DISTANCE
        assert not (seen & ~truth.mask).any()
    else:
        # At the silhouette single precision may decide otherwise than double.
        assert np.count_nonzero(seen != truth.mask) <= 2
    both = seen & truth.mask
    assert both.sum() > 2000
    cosine = -np.sum(N * P, axis=-1)[both] / np.linalg.norm(P, axis=-1)[both]
    well = cosine > 0.01
    assert angle(truth.normal[both], N[both])[well].max() < 1e-6
    assert angle(truth.shading_normal[both], N[both])[well].max() < 1e-4
    assert angle(truth.geometric_normal[both], N[both])[well].max() < 1e-4
    np.testing.assert_allclose(truth.position[both][well], P[both][well], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(truth.depth[both][well], np.linalg.norm(P, axis=-1)[both][well], rtol=1e-9)
    for normal in (truth.normal, truth.shading_normal, truth.geometric_normal):
        assert (np.sum(normal * P, axis=-1)[both][well] < 0).all()
        assert np.isnan(normal[~truth.mask]).all()


@pytest.mark.parametrize(
    ("name", "exponent"),
    marked(
        product(LIT, [10.0, 50.0, 100.0, 500.0]),
        ci=[("plane", 500.0), ("sphere", 10.0)],
        slow=product(LIT, [50.0, 100.0]),
    ),
)
def test_every_pixel_has_the_radiance_of_the_formula(session, name, exponent):
    surface, formula = SURFACES[name]
    P, N = formula(centres())
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


@pytest.mark.parametrize("name", [name for name in SURFACES if name not in ("grazing plane", "large cylinder")])
def test_lobe_and_base_of_several_lights_are_those_of_the_formula(session, name):
    surface, formula = SURFACES[name]
    P, N = formula(centres())
    at_camera, aside = ((0.0, 0.0, 0.0), 1.0), ((2.0, -1.5, 1.0), 3.0)
    for lights, normalised in product([(at_camera,), (aside,), (at_camera, aside)], [False, True]):
        places, powers = zip(*lights, strict=True)
        given = (30.0, 0.6, 0.4, normalised)
        session.update(described(surface, places, *given, powers))
        rendered = session.radiance()
        expected = np.sum([power * np.array(parts(P, N, place, *given)[0]) for place, power in lights], axis=0)
        compared = 0
        for part, formula_part in zip((rendered.specular, rendered.diffuse), expected, strict=True):
            assert part.dtype == np.float32
            assert part.shape == (HEIGHT, WIDTH)
            bright = formula_part > 1e-3 * formula_part.max()
            compared += np.count_nonzero(bright)
            # The specular part is a difference: its rounding is that of the whole.
            allowed = 1e-4 * formula_part[bright] + 1e-7 * sum(expected).max()
            assert (np.abs(part[bright] - formula_part[bright]) < allowed).all()
        assert compared > 1000
        np.testing.assert_array_equal(rendered.indirect, 0)
        np.testing.assert_array_equal(rendered.total, rendered.specular + rendered.diffuse)


# Mitsuba's own integrators -----------------------------------------------------------------------------------------

SIDE = 6
"""Points along each side of a pixel for its mean."""

SAMPLED = [
    (name, integrator, places)
    for name in LIT
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
    P, N = SURFACES["sphere"][1](centres())
    (lobe, base), _ = parts(P, N, PLACES[5], 50.0, 0.5, 0.5, False)
    assert rendered.total.shape == (HEIGHT, WIDTH, 3)
    for channel, share in enumerate(colour):
        expected = lobe + share * base
        np.testing.assert_allclose(rendered.total[:, :, channel], expected, rtol=1e-4, atol=1e-7 * expected.max())
        np.testing.assert_allclose(rendered.diffuse[:, :, channel], share * base, rtol=1e-4, atol=1e-7 * base.max())
