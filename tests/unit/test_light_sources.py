"""Sources of finite size: geometry, radiance against closed forms and sums of point lights, refused values."""

import math

import numpy as np
import pytest

import simtest
from simtest.rendering import Session
from simtest.spec import LightSpec, scene_from_dict
from simtest.spec.lights import CrescentSource
from tests.refusals import refused

render = pytest.mark.render

WIDTH, HEIGHT, FOCAL, D = 96, 80, 70.0, 10.0
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL}
MATT = {"type": "phong", "specular": 0.0, "diffuse": 0.5}
GLOSSY = {"type": "phong", "exponent": 60.0, "diffuse": 0.3}
LAMBERTIAN = {"type": "cosine", "power": 1.0}
DISC = {"type": "disc", "radius_mm": 2.0}
RING = {"type": "ring", "radius_mm": 3.0, "inner_mm": 2.0}
CRESCENT = {"type": "crescent", "radius_mm": 3.0, "cut_radius_mm": 2.0, "cut_offset_mm": 2.0, "azimuth_deg": 40.0}
SOURCES = {"disc": DISC, "ring": RING, "crescent": CRESCENT}
ASKEW = {"position_mm": [1.0, -0.5, -0.5], "direction": [0.2, -0.3, 1.0], "profile": {"type": "cosine", "power": 2.0}}


def scene(lights, surface=None, reflectance=None, **render):
    tables = {"surface": surface or {"type": "plane"}, "rig": {"lights": list(lights)}, "camera": CAMERA}
    return scene_from_dict(tables | {"render": render, "reflectance": reflectance or MATT})


@pytest.fixture(scope="module")
def session():
    return Session(scene([{}]))


# Geometry ------------------------------------------------------------------------------------------------------------

CUTS = [(3, 2, 1.5), (3, 2, 0.5), (3, 1, 1), (2, 5, 4.5), (3, 1, 3.5), (3, 3, 1), (3, 0.5, 0), (2, 4, 3)]


def inside(source, points):
    """Which points of the source's plane belong to it, by the words of the manual."""
    radius = np.hypot(*points.T)
    kept = radius <= source["radius_mm"]
    if source["type"] == "ring":
        return kept & (radius >= source["inner_mm"])
    if source["type"] == "crescent":
        angle = math.radians(source.get("azimuth_deg", 0.0))
        cut = source["cut_offset_mm"] * np.array([math.cos(angle), math.sin(angle)])
        return kept & (np.hypot(*(points - cut).T) >= source["cut_radius_mm"])
    return kept


def lattice(source, step):
    """Points of a square lattice that lie in the source."""
    ticks = np.arange(-source["radius_mm"] + step / 2, source["radius_mm"], step)
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    return points[inside(source, points)]


@pytest.mark.parametrize("cut", CUTS, ids=str)
def test_area_and_centroid_of_a_crescent_are_those_of_a_lattice(cut):
    values = dict(zip(("radius_mm", "cut_radius_mm", "cut_offset_mm"), cut, strict=True))
    values |= {"type": "crescent", "azimuth_deg": 200.0}
    source, points = CrescentSource.model_validate(values), lattice(values, 0.005)
    assert source.area_mm2 == pytest.approx(len(points) * 0.005**2, rel=3e-3)
    np.testing.assert_allclose(source.centroid_mm, points.mean(axis=0), atol=3e-3)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.3, 0.2, 1), (0, 0, -1), (1, 0, 0), (0.1, 0.2, -1)], ids=str)
def test_the_sources_plane_is_across_its_direction(direction):
    light = LightSpec(direction=direction)
    frame = np.vstack([light.across, light.axis])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)


def test_the_place_that_estimators_know_is_the_centroid():
    for source in (None, DISC, RING):
        assert LightSpec(position_mm=(1, 2, 3), source=source).nominal_mm == (1, 2, 3)
    centroid = lattice(CRESCENT, 0.005).mean(axis=0)
    light = LightSpec(position_mm=(1, 2, 3), source=CRESCENT)
    np.testing.assert_allclose(light.nominal_mm, [1 + centroid[0], 2 + centroid[1], 3], atol=3e-3)


def test_each_light_of_a_preset_may_have_a_size():
    rig = scene_from_dict(
        {"surface": {"type": "plane"}, "rig": {"preset": "colonoscope_2", "each": {"source": DISC}}}
    ).rig
    assert [light.source.radius_mm for light in rig.lights] == [2.0, 2.0]
    assert all(light.source is None for light in scene([{}]).rig.lights)


# Radiance ------------------------------------------------------------------------------------------------------------


def from_lambertian_disc(radius, place):
    """Radiance of a matt plane, albedo 1/2, under a Lambertian disc of power 1 parallel to it: its view factor."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (u - WIDTH / 2) / FOCAL * D - place[0], (v - HEIGHT / 2) / FOCAL * D - place[1]
    aside, depth = x**2 + y**2, (D - place[2]) ** 2
    root = np.sqrt((aside + depth + radius**2) ** 2 - 4 * aside * radius**2)
    irradiance = (1 - (aside + depth - radius**2) / root) / (2 * radius**2)
    return 0.5 / np.pi * irradiance


@render
@pytest.mark.parametrize("samples", [1, 16])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (2.0, -1.0, 1.0)], ids=str)
def test_a_lambertian_disc_lights_a_plane_as_its_view_factor_says(session, samples, place):
    light = {"position_mm": place, "profile": LAMBERTIAN}
    session.update(scene([{**light, "source": {"type": "disc", "radius_mm": 3.0}}], samples_per_pixel=samples))
    expected = from_lambertian_disc(3.0, place)
    total = session.radiance().total
    assert np.abs(total / expected - 1).max() < (5e-3 if samples == 1 else 0.02)
    assert total.mean() == pytest.approx(expected.mean(), rel=5e-4)
    # A point of the same power does not.
    session.update(scene([light], samples_per_pixel=samples))
    assert np.abs(session.radiance().total / expected - 1).max() > 0.08


@render
@pytest.mark.parametrize("samples", [1, 16])
def test_a_ring_is_a_disc_without_a_smaller_one(session, samples):
    ring = {"profile": LAMBERTIAN, "source": RING}
    session.update(scene([ring], samples_per_pixel=samples))
    # Radiances of equal sources, so powers by area: 9 : 4.
    expected = (9 * from_lambertian_disc(3.0, (0, 0, 0)) - 4 * from_lambertian_disc(2.0, (0, 0, 0))) / 5
    np.testing.assert_allclose(session.radiance().total, expected, rtol=5e-3 if samples == 1 else 0.02)


def sum_of_points(session, light, source, step, surface, reflectance, **render):
    """Radiance of point lights at the centroids of the source's parts in square cells, by area; 32 a frame."""
    fine = lattice(source, 0.02)
    _, cells, count = np.unique(np.floor(fine / step), axis=0, return_inverse=True, return_counts=True)
    centroids = np.stack([np.bincount(cells.ravel(), axis) / count for axis in fine.T], axis=1)
    points = centroids @ LightSpec.model_validate(light).across + np.array(light["position_mm"])
    lights = [
        {**light, "position_mm": place.tolist(), "power": share}
        for place, share in zip(points, count / len(fine), strict=True)
    ]
    total = 0.0
    for first in range(0, len(lights), 32):
        some = lights[first : first + 32]
        session.update(scene(some, surface, reflectance, **render))
        total = total + session.radiance().total.astype(float)
    return total


@render
@pytest.mark.parametrize("name", SOURCES)
def test_a_source_is_the_sum_of_point_lights_over_its_area(session, name):
    """On a tilted glossy plane, the source askew; the centroid's point light differs by much more."""
    surface = {"type": "plane", "tilt_deg": 15.0}
    expected = sum_of_points(session, ASKEW, SOURCES[name], 0.3, surface, GLOSSY)
    peak = expected.max()
    for samples, bound in ((1, 0.03), (16, 0.08)):
        session.update(scene([{**ASKEW, "source": SOURCES[name]}], surface, GLOSSY, samples_per_pixel=samples))
        total = session.radiance().total
        assert np.abs(total - expected).max() < bound * peak
        assert total.mean() == pytest.approx(expected.mean(), rel=4e-3)
    place = LightSpec.model_validate({**ASKEW, "source": SOURCES[name]}).nominal_mm
    session.update(scene([{**ASKEW, "position_mm": place}], surface, GLOSSY))
    assert np.abs(session.radiance().total - expected).max() > 0.4 * peak


@pytest.mark.slow
@render
def test_penumbrae_are_those_of_many_point_lights(session):
    """Behind a fold that hides parts of the source from 6 % of the frame, where the point light's shadow is hard."""
    surface = {"type": "anatomy", "path": "colon", "viewpoint": 1}
    light = {"position_mm": [0.0, -6.0, 8.0]}
    session.update(scene([light], surface))
    hard = session.radiance().total
    expected = sum_of_points(session, light, DISC, 0.35, surface, MATT)
    session.update(scene([{**light, "source": DISC}], surface))
    fixed = session.radiance().total
    drawn = 0.0
    for seed in range(2):
        session.update(scene([{**light, "source": DISC}], surface, samples_per_pixel=32, seed=seed))
        drawn = drawn + session.radiance().total.astype(float) / 2
    partial = (hard == 0) & (expected > 0)
    assert partial.mean() > 0.03
    for total in (fixed, drawn):
        assert total[partial].mean() == pytest.approx(expected[partial].mean(), rel=0.03)
        assert np.abs(total - expected)[partial].mean() < 0.15 * expected[partial].mean()
        assert total.mean() == pytest.approx(expected.mean(), rel=4e-3)
    # What no point of the source sees stays dark.
    umbra = expected == 0
    assert umbra.mean() > 0.05
    assert fixed[umbra].mean() < 1e-3 * expected.mean()


@render
def test_frames_are_the_same_for_the_same_seed_and_other_numbers_compile_nothing(session):
    def at(radius, seed, **own):
        light = {"position_mm": [1.0, 0.0, 0.0], "source": {"type": "disc", "radius_mm": radius}, **own}
        session.update(scene([light], reflectance=GLOSSY, samples_per_pixel=4, seed=seed))
        return session.radiance().total

    first = at(2.0, 1)
    built = session.rebuilds
    np.testing.assert_array_equal(at(2.0, 1), first)
    assert not np.array_equal(at(2.0, 2), first)
    assert not np.array_equal(at(1.0, 1), first)
    assert session.rebuilds == built
    at(2.0, 1, source=CRESCENT)
    assert session.rebuilds == built + 1


@render
def test_bounces_carry_the_power_of_a_point_light(session):
    """In a closed sphere, where most of the light goes around."""
    surface = {"type": "sphere", "radius_mm": 12.0, "side": "inside"}
    matt = {"type": "phong", "specular": 0.0, "diffuse": 0.6}
    light, means = {"position_mm": [2.0, 0.0, 0.0], "profile": LAMBERTIAN}, {}
    own_of = {"point": {}, "half": {"power": 0.5}, "disc": {"source": DISC}, "crescent": {"source": CRESCENT}}
    for name, own in own_of.items():
        session.update(scene([{**light, **own}], surface, matt, samples_per_pixel=16, path_depth=4))
        means[name] = session.radiance().indirect.mean(dtype=float)
    assert means["disc"] == pytest.approx(means["point"], rel=0.02)
    assert means["crescent"] == pytest.approx(means["point"], rel=0.02)
    assert means["half"] < 0.6 * means["point"]


# Refused -------------------------------------------------------------------------------------------------------------

REFUSED = {
    "no type": ({"radius_mm": 1.0}, "source.type: missing; allowed: crescent, disc, ring"),
    "disc with a hole": ({**DISC, "inner_mm": 1.0}, "source.inner_mm = 1.0: unknown key; allowed: type, radius_mm"),
    "inner = radius": ({**RING, "inner_mm": 3.0}, "inner_mm = 3: must be below radius_mm = 3"),
    "inner > radius": ({**RING, "inner_mm": 4.0}, "inner_mm = 4: must be below radius_mm = 3"),
    "crescent without area": ({**CRESCENT, "cut_radius_mm": 6.0}, "must leave at least 1 % of the disc"),
    "cut beside the disc": ({**CRESCENT, "cut_offset_mm": 5.5}, "must overlap the disc of radius_mm = 3"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_malformed_sources_are_refused(name):
    source, message = REFUSED[name]
    refused(lambda: scene([{"source": source}]), "rig.lights.0", message, longest=400)


TOUCHING = {
    "disc in a plane": ({"type": "plane"}, {"position_mm": [0, 0, 9.5], "direction": [1, 0, 0], "source": DISC}),
    "rim of a tilted disc": ({"type": "plane"}, {"position_mm": [0, 0, 9], "direction": [1, 0, 1], "source": DISC}),
    "polyp through a ring": (
        {"type": "sphere", "radius_mm": 1.0, "distance_mm": 5.0}, {"position_mm": [0, 0, 6.0], "source": RING}
    ),
    "disc through the wall of a tube": (
        {"type": "cylinder", "radius_mm": 12.0, "side": "inside"},
        {"position_mm": [0, 1.0, 9], "direction": [1, 0, 0], "source": DISC},
    ),
}  # fmt: skip


@render
@pytest.mark.parametrize("name", TOUCHING)
def test_sources_that_touch_tissue_are_refused(session, name):
    surface, light = TOUCHING[name]
    refused(
        lambda: session.update(scene([light], surface)), "rig.lights.0.source: its ", "touches the ", "clearance is"
    )


@render
def test_a_source_in_free_space_next_to_tissue_is_taken(session):
    session.update(scene([{"position_mm": [0, 0, 9.9], "source": DISC}]))
    session.update(scene([{"position_mm": [0, 0, 7.9], "direction": [1, 0, 0], "source": DISC}]))


# Elsewhere -----------------------------------------------------------------------------------------------------------

EXPORT = {
    "ring": ({"source": RING, "profile": LAMBERTIAN}, "rig.lights.0.source.type = 'ring': cannot be exported"),
    "crescent": ({"source": CRESCENT, "profile": LAMBERTIAN}, "rig.lights.0.source.type = 'crescent': cannot be"),
    "not Lambertian": ({"source": DISC}, "rig.lights.0.profile = 0.0: cannot be exported; Mitsuba's area light is"),
    "spot": ({"source": DISC, "profile": LAMBERTIAN, "spot_deg": 90.0}, "rig.lights.0.spot_deg = 90.0: cannot be"),
    "in sight": (
        {"source": DISC, "profile": LAMBERTIAN, "direction": [1, 0, 1]},
        "must nowhere lie in front of the camera",
    ),
}


@render
@pytest.mark.parametrize("name", EXPORT)
def test_sources_that_mitsuba_lacks_are_not_exported(tmp_path, name):
    light, message = EXPORT[name]
    refused(lambda: simtest.export(scene([light]), tmp_path), message)
