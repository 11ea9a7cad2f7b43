"""Lights: emission and sources of finite size against closed forms and Mitsuba's integrators, presets, positions."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import simtest
from simtest.errors import InputError
from simtest.rendering import Session
from simtest.runtime.seeds import Stage, integer
from simtest.spec import LightSpec, scene_from_dict
from simtest.spec.lights import AT_CAMERA_MM, PRESETS, CrescentSource, Rig
from simtest.spec.recipes import Experiment
from simtest.spec.toml_files import apply_settings
from simtest.validation.cases import expand
from tests.refusals import refused

render = pytest.mark.render

WIDTH, HEIGHT, FOCAL, D = 96, 80, 70.0, 10.0
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL}
MATT = {"type": "phong", "specular": 0.0, "diffuse": 0.5}
COSINE = {"type": "cosine", "power": 4.0}
TABLE = {"type": "table", "angle_deg": [0, 10, 35, 60], "value": [1.0, 0.9, 0.4, 0.1]}
LAMBERTIAN = {"type": "cosine", "power": 1.0}
DISC = {"type": "disc", "radius_mm": 2.0}
RING = {"type": "ring", "radius_mm": 3.0, "inner_mm": 2.0}
CRESCENT = {"type": "crescent", "radius_mm": 3.0, "cut_radius_mm": 2.0, "cut_offset_mm": 2.0, "azimuth_deg": 40.0}
SOURCES = {"disc": DISC, "ring": RING, "crescent": CRESCENT}


def scene(lights=({},), surface=None, reflectance=None, rig=None, **render):
    rig = {"lights": list(lights)} if rig is None else rig
    tables = {"surface": surface or {"type": "plane"}, "rig": rig, "camera": CAMERA, "render": render}
    return scene_from_dict(tables | {"reflectance": reflectance or MATT})


@pytest.fixture(scope="module")
def session():
    return Session(scene())


def positions():
    """Points of the plane z = D on the pixels' sightlines."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([(u - WIDTH / 2) / FOCAL * D, (v - HEIGHT / 2) / FOCAL * D, np.full(u.shape, D)], axis=-1)


def matt(light, factor):
    """Radiance of a Lambertian plane of albedo 1/2 under a light; factor over the angle from its axis."""
    spec = LightSpec.model_validate(light)
    P = positions()
    away = P - np.array(spec.nominal_mm)
    squared = np.sum(away**2, axis=-1)
    away /= np.sqrt(squared)[..., None]
    axis = np.array(spec.direction) / np.linalg.norm(spec.direction)
    angle = np.arctan2(np.linalg.norm(np.cross(away, axis), axis=-1), away @ axis)
    return 0.5 / np.pi * spec.power * factor(angle) * np.abs(away[..., 2]) / squared


EMISSIONS = {
    "cosine": ({"profile": COSINE}, lambda a: np.maximum(np.cos(a), 0) ** 4),
    "table": ({"profile": TABLE}, lambda a: np.interp(np.degrees(a), TABLE["angle_deg"], TABLE["value"])),
    "soft spot": (
        {"spot_deg": 60.0, "soft_edge_deg": 12.0}, lambda a: np.clip((30 - np.degrees(a)) / 12, 0, 1)
    ),
    "spot of a half-space": ({"spot_deg": 180.0}, lambda a: (a <= np.pi / 2) * 1.0),
    "soft cosine spot": (
        {"profile": COSINE, "spot_deg": 80.0, "soft_edge_deg": 40.0},
        lambda a: np.maximum(np.cos(a), 0) ** 4 * np.clip((40 - np.degrees(a)) / 40, 0, 1),
    ),
}  # fmt: skip


@render
@pytest.mark.parametrize("name", EMISSIONS)
@pytest.mark.parametrize(
    "place",
    [{}, {"position_mm": [2.0, -1.0, 1.0], "direction": [0.3, 0.1, 2.0], "power": 3.0}],
    ids=["camera", "aside"],
)
def test_radiance_of_a_plane_follows_the_emission(session, name, place):
    emission, factor = EMISSIONS[name]
    session.update(scene([{**place, **emission}]))
    expected = matt({**place, **emission}, factor)
    total = session.radiance().total
    np.testing.assert_allclose(total, expected, rtol=1e-4, atol=3e-6 * expected.max())
    assert total.max() > 0


@render
@pytest.mark.parametrize(("power", "direction"), [(100.0, [0.0, 0.0, 1.0]), (1000.0, [0.2, 0.1, 1.0])])
def test_a_narrow_emission_keeps_its_digits(session, power, direction):
    """Down to 1e-3 of the peak; by the power of a dot product the error would be up to 4e-5."""
    light = {"profile": {"type": "cosine", "power": power}, "direction": direction}
    session.update(scene([light]))
    expected = matt(light, lambda a: np.maximum(np.cos(a), 0) ** power)
    lobe = expected > 1e-3 * expected.max()
    assert lobe.sum() > 30
    np.testing.assert_allclose(session.radiance().total[lobe], expected[lobe], rtol=1e-5)


@render
def test_a_hard_spot_ends_at_its_rim(session):
    session.update(scene([{"spot_deg": 50.0}]))
    total, angle = (
        session.radiance().total,
        np.degrees(np.arctan(np.hypot(*positions()[..., :2].transpose(2, 0, 1)) / D)),
    )
    assert (total[angle > 25.01] == 0).all()
    isotropic = matt({}, lambda a: 1.0)
    np.testing.assert_allclose(total[angle < 24.99], isotropic[angle < 24.99], rtol=1e-4)


@render
def test_the_numbers_of_a_light_are_updated_without_a_rebuild(session):
    session.update(scene([{"profile": COSINE, "spot_deg": 80.0, "soft_edge_deg": 40.0}]))
    built = session.rebuilds
    for k, spot in ((1.0, 70.0), (9.0, 120.0)):
        light = {"profile": {"type": "cosine", "power": k}, "spot_deg": spot, "soft_edge_deg": 10.0, "power": k}
        session.update(scene([light]))
        expected = matt(
            light, lambda a, k=k, spot=spot: np.cos(a) ** k * np.clip((spot / 2 - np.degrees(a)) / 10, 0, 1)
        )
        np.testing.assert_allclose(session.radiance().total, expected, rtol=1e-4, atol=3e-6 * expected.max())
    assert session.rebuilds == built


# Against Mitsuba's integrators ---------------------------------------------------------------------------------------

RIG = [
    {"position_mm": [3.0, 1.0, 0.0], "profile": COSINE, "power": 2.0},
    {"position_mm": [-3.0, 0.5, 0.0], "profile": TABLE, "direction": [0.2, 0.0, 1.0]},
    {"offset_mm": 2.0, "azimuth_deg": 90.0, "spot_deg": 70.0, "soft_edge_deg": 15.0},
    {"offset_mm": 1.0},
]
GLOSSY = {"type": "phong", "exponent": 20.0, "specular": 0.6, "diffuse": 0.4, "normalised": True}
BALL = {"type": "sphere", "radius_mm": 6.0, "tilt_deg": 10.0}
INSIDE = {"type": "sphere", "radius_mm": 9.0, "side": "inside"}


def mitsuba_mean(session, integrator, seeds, samples):
    """Means of the frame by one of Mitsuba's integrators, from the session's own scene, for several seeds."""
    mi, camera = session.mi, session.camera
    pose = session.surface.model_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    sensor = mi.load_dict(
        {
            "type": "perspective", "fov": float(2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))),
            "fov_axis": "x", "near_clip": 1e-3, "far_clip": 1e5, "to_world": mi.ScalarTransform4f(pose.tolist()),
            "film": {
                "type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
                "pixel_format": "luminance",
            },
        }
    )  # fmt: skip
    integrator = mi.load_dict(integrator)
    frames = [
        np.array(mi.render(session._built.scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed))
        for seed in seeds
    ]
    return np.array([frame.astype(float).mean() for frame in frames])


@render
@pytest.mark.parametrize("surface", [BALL, {"type": "plane", "tilt_deg": 20.0}], ids=["sphere", "plane"])
def test_direct_light_is_that_of_mitsubas_direct_integrator(session, surface):
    """Pooled means over seeds within three standard errors; a light of 2 % more power is told apart."""
    ours = []
    for seed in range(6):
        session.update(scene(RIG, surface, GLOSSY, samples_per_pixel=16, seed=seed))
        ours.append(float(session.radiance().total.mean(dtype=float)))
    theirs = mitsuba_mean(session, {"type": "direct"}, range(100, 106), 64)
    error = np.hypot(np.std(ours, ddof=1), np.std(theirs, ddof=1)) / np.sqrt(6)
    gap = abs(np.mean(ours) - theirs.mean())
    assert gap < 3 * error
    session.update(scene([{**RIG[0], "power": 2.04}, *RIG[1:]], surface, GLOSSY, samples_per_pixel=16))
    assert abs(session.radiance().total.mean(dtype=float) - theirs.mean()) > 3 * error


@render
def test_bounces_are_those_of_mitsubas_path_integrator(session):
    ours = []
    for seed in range(6):
        session.update(scene(RIG, INSIDE, GLOSSY, samples_per_pixel=8, path_depth=4, seed=seed))
        radiance = session.radiance()
        ours.append(float(radiance.total.mean(dtype=float)))
    assert radiance.indirect.mean() > 0.05 * radiance.total.mean()
    path = {"type": "path", "max_depth": 4, "rr_depth": 10}
    theirs = mitsuba_mean(session, path, range(100, 106), 32)
    error = np.hypot(np.std(ours, ddof=1), np.std(theirs, ddof=1)) / np.sqrt(6)
    assert abs(np.mean(ours) - theirs.mean()) < 3 * error < 0.03 * theirs.mean()


# Sources of finite size ----------------------------------------------------------------------------------------------

CUTS = [(3, 2, 1.5), (3, 2, 0.5), (2, 5, 4.5), (3, 1, 3.5), (3, 0.5, 0)]


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


@pytest.mark.parametrize("direction", [(0.3, 0.2, 1), (0, 0, -1), (0.1, 0.2, -1)], ids=str)
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


ASKEW = {"position_mm": [1.0, -0.5, -0.5], "direction": [0.2, -0.3, 1.0], "profile": {"type": "cosine", "power": 2.0}}
SHINY = {"type": "phong", "exponent": 60.0, "diffuse": 0.3}


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
    expected = sum_of_points(session, ASKEW, SOURCES[name], 0.3, surface, SHINY)
    peak = expected.max()
    for samples, bound in ((1, 0.03), (16, 0.08)):
        session.update(scene([{**ASKEW, "source": SOURCES[name]}], surface, SHINY, samples_per_pixel=samples))
        total = session.radiance().total
        assert np.abs(total - expected).max() < bound * peak
        assert total.mean() == pytest.approx(expected.mean(), rel=4e-3)
    place = LightSpec.model_validate({**ASKEW, "source": SOURCES[name]}).nominal_mm
    session.update(scene([{**ASKEW, "position_mm": place}], surface, SHINY))
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
        session.update(scene([light], reflectance=SHINY, samples_per_pixel=4, seed=seed))
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


# True highlights -----------------------------------------------------------------------------------------------------


@render
def test_each_light_has_its_own_highlight_at_the_mirror_condition(session):
    """The emission shifts the brightest pixel, not the true BP; where a spot does not reach, the BP is not lit."""
    shiny = {"type": "phong", "exponent": 300.0}
    plain = [{"offset_mm": 2.0}, {"offset_mm": 2.0, "azimuth_deg": 180.0}]
    session.update(scene(plain, reflectance=shiny))
    expected = {h.light: h for h in session.highlights(session.radiance())}
    assert sorted(expected) == [0, 1]
    profiled = [{**plain[0], "profile": COSINE, "direction": [1.0, 0.0, 1.0]}, {**plain[1], "spot_deg": 5.0}]
    session.update(scene(profiled, reflectance=shiny))
    found = {h.light: h for h in session.highlights(session.radiance())}
    for light in (0, 1):
        np.testing.assert_allclose(found[light].bp_px, expected[light].bp_px, atol=1e-6)
    assert found[0].lit
    assert not found[1].lit


@render
def test_displaced_lights_are_rendered_and_their_highlights_are_true(session):
    light = {"offset_mm": 2.0, "position_error_mm": 0.5}
    shiny = {"type": "phong", "exponent": 300.0}
    described = scene(rig={"lights": [light], "seed": 5}, reflectance=shiny)
    (place,) = described.rig.true_mm()
    assert 0.05 < np.linalg.norm(place - [2.0, 0, 0]) < 3
    session.update(described)
    displaced = session.radiance().total
    (highlight,) = session.highlights(session.radiance())
    P = highlight.position
    half = -P / np.linalg.norm(P) + (place - P) / np.linalg.norm(place - P)
    np.testing.assert_allclose(highlight.normal, half / np.linalg.norm(half), atol=1e-6)
    session.update(scene([{"position_mm": place.tolist()}], reflectance=shiny))
    np.testing.assert_allclose(session.radiance().total, displaced, rtol=1e-5)


def test_position_errors_hang_on_the_seed_and_have_the_standard_deviation_given():
    def places(seed, **light):
        rig = {"preset": "laparoscope", "each": {"position_error_mm": 0.3, **light}, "seed": seed}
        return scene(rig=rig).rig

    assert places(1) == places(1)
    np.testing.assert_array_equal(places(1).true_mm(), places(1).true_mm())
    assert not np.array_equal(places(1).true_mm(), places(2).true_mm())
    np.testing.assert_array_equal(places(1).nominal_mm(), places(2).nominal_mm())
    errors = np.array([places(seed).true_mm() - places(seed).nominal_mm() for seed in range(400)]).ravel()
    # 9600 numbers: 5 standard errors of the mean and of the standard deviation.
    assert abs(errors.mean()) < 5 * 0.3 / np.sqrt(errors.size)
    assert abs(errors.std() / 0.3 - 1) < 5 / np.sqrt(2 * errors.size)
    np.testing.assert_array_equal(places(1, position_error_mm=0.0).true_mm(), places(1).nominal_mm())


def test_an_experiment_draws_the_position_errors_anew_for_each_realisation():
    group = {"scene": "plane", "set": {"rig.lights.0.offset_mm": 2.0, "rig.lights.0.position_error_mm": 0.1}}
    experiment = Experiment.model_validate({"name": "rigs", "groups": [group], "seed": 3})
    (case,) = expand(experiment)
    rigs = [case.scene(experiment, number)[0].rig for number in (0, 1, 0)]
    assert rigs[0] == rigs[2] != rigs[1]
    assert rigs[0].seed == integer(3, "rigs", case.name, 0, Stage.RIG)
    assert f"rig.seed={rigs[1].seed}" in case.reproduce_command(experiment, 1)
    fixed = Experiment.model_validate({"name": "rigs", "groups": [{"scene": "plane"}], "seed": 3})
    (case,) = expand(fixed)
    assert case.scene(fixed, 0)[0] == case.scene(fixed, 1)[0]
    assert "rig.seed" not in case.reproduce_command(fixed, 1)


# Presets -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "count"), [("colocated", 1), ("laparoscope", 8), ("colonoscope_2", 2), ("colonoscope_3", 3)]
)
def test_presets_stand_on_a_ring_and_share_the_power(preset, count):
    rig = scene(rig={"preset": preset}).rig
    places = rig.nominal_mm()
    assert len(places) == count == PRESETS[preset].count
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), PRESETS[preset].radius_mm, atol=1e-12)
    assert sum(light.power for light in rig.lights) == pytest.approx(1)
    if count > 1:
        np.testing.assert_allclose(places.mean(axis=0), 0, atol=1e-12)
        assert 3 <= PRESETS[preset].radius_mm <= 5
    else:
        assert np.linalg.norm(places) <= AT_CAMERA_MM


@given(
    count=st.integers(2, 12),
    radius=st.floats(0.5, 9),
    azimuth=st.floats(-360, 360),
    axial=st.floats(-3, 3),
    power=st.floats(0.1, 50),
)
def test_a_presets_numbers_can_be_overridden_and_read_back(count, radius, azimuth, axial, power):
    rig = {"preset": "laparoscope", "count": count, "radius_mm": radius, "azimuth_deg": azimuth, "axial_mm": axial}
    described = scene(rig={**rig, "power": power, "each": {"spot_deg": 120.0, "profile": TABLE, "source": DISC}})
    places = described.rig.nominal_mm()
    first = np.radians(azimuth)
    np.testing.assert_allclose(places[0], [radius * np.cos(first), radius * np.sin(first), axial], atol=1e-9)
    gaps = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)
    np.testing.assert_allclose(gaps, 2 * radius * np.sin(np.pi / count), rtol=1e-9)
    assert all(light.spot_deg == 120 and light.power == pytest.approx(power / count) for light in described.rig.lights)
    assert {light.source.radius_mm for light in described.rig.lights} == {2.0}
    assert scene_from_dict(json.loads(described.model_dump_json())) == described


def test_a_dumped_preset_can_be_changed():
    described = scene(rig={"preset": "laparoscope"})
    dumped = described.model_dump()
    assert "lights" not in dumped["rig"]
    changed = scene_from_dict(apply_settings(dumped, {"rig.radius_mm": 2.0}, "dump"))
    np.testing.assert_allclose(np.linalg.norm(changed.rig.nominal_mm(), axis=1), 2.0)
    # Older dumps held both.
    lights = [light.model_dump() for light in described.rig.lights]
    assert scene_from_dict({**dumped, "rig": {**dumped["rig"], "lights": lights}}) == described
    assert len(scene([{}, {"offset_mm": 2.0}]).model_dump()["rig"]["lights"]) == 2


@pytest.mark.parametrize("size", [5e-324, 1e-200, 1.0, 1e6])
def test_a_direction_of_any_length_is_an_axis(size):
    np.testing.assert_array_equal(LightSpec(direction=(size, 0, 0)).axis, [1, 0, 0])


# Tissue --------------------------------------------------------------------------------------------------------------

SOLIDS = {
    "plane": {"type": "plane"},
    "sphere": {"type": "sphere", "radius_mm": 4.0},
    "cylinder": {"type": "cylinder", "radius_mm": 4.0},
    "quadric": {"type": "quadric", "k1_per_mm": 0.1, "k2_per_mm": 0.1},
    "liver": {"type": "anatomy", "path": "liver"},
}


@render
@pytest.mark.parametrize("name", [*list(SOLIDS)[:-1], pytest.param("liver", marks=pytest.mark.slow)])
def test_a_light_inside_a_body_is_refused_and_the_session_stays(session, name):
    session.update(scene())
    before = session.radiance().total
    depth = 13.0 if name != "liver" else float(np.nanmin(_depth(SOLIDS[name])) + 10.0)
    with pytest.raises(InputError, match=r"rig\.lights\.1 at .* lies .* mm inside the"):
        session.update(scene([{}, {"position_mm": [0.0, 0.0, depth]}], SOLIDS[name]))
    np.testing.assert_array_equal(session.radiance().total, before)
    session.update(scene([{}, {"position_mm": [0.0, 0.0, 0.5 * depth if name != "liver" else 1.0]}], SOLIDS[name]))


@render
def test_a_draw_into_a_body_names_the_keys(session):
    light = {"position_mm": [0.0, 0.0, 9.99], "position_error_mm": 0.1}
    inside = [seed for seed in range(20) if Rig(lights=(light,), seed=seed).true_mm()[0, 2] > D]
    with pytest.raises(InputError, match=rf"position_error_mm = 0\.1 drew that place with rig\.seed = {inside[0]}"):
        session.update(scene(rig={"lights": [light], "seed": inside[0]}))
    with pytest.raises(InputError, match=r"a light must be in free space$"):
        session.update(scene(rig={"lights": [{**light, "position_mm": [0.0, 0.0, 15.0]}]}))


def _depth(surface):
    return Session(scene(surface=surface)).truth(8).depth


@render
def test_a_camera_inside_the_wall_is_refused():
    bowl = {"type": "quadric", "k1_per_mm": -0.5, "k2_per_mm": 0.0, "tilt_deg": 60.0}
    with pytest.raises(InputError, match=r"the camera lies .* mm inside the wall"):
        Session(scene(surface=bowl))


@render
def test_a_frame_that_no_light_reaches_is_dark(session):
    """A light behind the lumen's wall, a spot that looks away: zeros, no NaN."""
    for light, depth in (({"position_mm": [0.0, 0.0, 30.0]}, 3), ({"spot_deg": 60.0, "direction": [0, 0, -1.0]}, 2)):
        session.update(scene([light], INSIDE, GLOSSY, samples_per_pixel=2, path_depth=depth))
        frame = session.frame()
        for part in (frame.radiance.specular, frame.radiance.diffuse, frame.radiance.indirect):
            np.testing.assert_array_equal(part, 0)
        assert not any(h.lit for h in session.highlights(frame.radiance))


COLON = {"type": "anatomy", "path": "colon", "viewpoint": 1}
"""38 mm aside of its camera the wall is 0.6 mm away."""

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
    "disc through the wall of a mesh": (COLON, {"position_mm": [0, 38.0, 0], "source": DISC}),
    "disc beyond the wall of a mesh": (COLON, {"position_mm": [0, 60.0, 0], "source": DISC}),
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
    session.update(scene([{"position_mm": [0, 34.0, 0], "source": DISC}], COLON))


# Export --------------------------------------------------------------------------------------------------------------

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


# Colour --------------------------------------------------------------------------------------------------------------

_COLOURS = """
import numpy as np, sys
from simtest.rendering import Session
from simtest.spec import scene_from_dict
def frame(colour, depth):
    tables = {"surface": {"type": "sphere", "radius_mm": 9.0, "side": "inside"},
              "rig": {"lights": [{"colour": colour}]}, "reflectance": {"type": "phong", "diffuse": 0.5},
              "render": {"path_depth": depth, "samples_per_pixel": 2},
              "camera": {"width": 32, "height": 32, "fx": 30, "fy": 30}}
    return Session(scene_from_dict(tables), "llvm_ad_rgb").radiance()
white, tinted = frame([1, 1, 1], 3), frame([1.0, 0.5, 0.0], 3)
assert white.total.shape == (32, 32, 3)
for part in ("specular", "diffuse", "indirect"):
    a, b = getattr(white, part), getattr(tinted, part)
    assert a.max() > 0, part
    np.testing.assert_allclose(b, a * [1.0, 0.5, 0.0], rtol=1e-4, atol=1e-8)
"""


@render
def test_colour_tints_all_parts():
    done = subprocess.run([sys.executable, "-c", _COLOURS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@render
def test_mono_variants_take_the_colours_luminance(session):
    session.update(scene([{"colour": [1.0, 0.5, 0.0]}]))
    tinted = session.radiance().total
    session.update(scene())
    np.testing.assert_allclose(tinted, (0.212671 + 0.5 * 0.715160) * session.radiance().total, rtol=1e-5)
