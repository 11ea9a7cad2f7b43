"""Shadows, bounces, true highlights and meshes; normals and direct light stand in test_closed_form."""

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.rendering.built_scene import make_shape
from simtest.spec import scene_from_dict
from simtest.surfaces import Shape, TriangleMesh
from tests.marked import marked

pytestmark = pytest.mark.render

CAMERA = {"width": 160, "height": 120, "fx": 130.0, "fy": 120.0, "cx": 83.0, "cy": 57.0, "skew": 4.0}
D = 10.0
AT_CAMERA = {"offset_mm": 0.0}
ASIDE = {"position_mm": [2.0, -1.5, 1.0], "power": 3.0}


def scene(surface, lights=(AT_CAMERA,), reflectance=None, render=None, camera=None):
    tables = {"surface": {"type": "plane", **surface}, "camera": {**CAMERA, **(camera or {})}}
    tables |= {"rig": {"lights": list(lights)}, "render": render or {}}
    return scene_from_dict(tables | {"reflectance": {"type": "phong", **(reflectance or {})}})


@pytest.fixture(scope="module")
def session():
    return Session(scene({}))


# Shadows -------------------------------------------------------------------------------------------------------------


def test_the_far_side_of_a_convex_body_is_dark(session):
    """A light behind the horizon: no radiance, neither by the cosine nor by a shadow."""
    session.update(scene({"type": "sphere", "radius_mm": 4.0}, ({"position_mm": [25.0, 0.0, 14.0]},), {"diffuse": 0.5}))
    P = session.truth().position
    to_light = np.array([25.0, 0, 14]) - P
    facing = np.sum((P - [0, 0, D + 4.0]) / 4.0 * to_light, axis=-1) / np.linalg.norm(to_light, axis=-1)
    total = session.radiance().total
    with np.errstate(invalid="ignore"):
        assert (facing < -0.01).sum() > 100
        assert (total[facing < -0.01] == 0).all()
        assert (total[facing > 0.01] > 0).all()


def test_one_wall_throws_a_shadow_on_another(session):
    """A light outside the sphere that the camera is in: its wall is in the way everywhere."""
    inside = {"type": "sphere", "radius_mm": 8.0, "side": "inside"}
    session.update(scene(inside, ({"position_mm": [0.0, 0.0, 13.0]},), {"diffuse": 0.5}))
    assert session.radiance().total.max() == 0
    # One behind the wall at the camera's back, and one beside the camera: both have a highlight, the latter is lit.
    lights = tuple({"position_mm": place} for place in ([1.0, 0.0, -20.0], [2.0, 0.0, 0.0]))
    session.update(scene(inside | {"radius_mm": 14.0}, lights))
    assert {(highlight.light, bool(highlight.lit)) for highlight in session.highlights()} == {(0, False), (1, True)}


def test_lights_of_equal_power_are_updated_apart(session):
    """Mitsuba merges equal objects of a scene: two lights of one power would then share their parameter."""
    surface, (left, right) = {"tilt_deg": 5.0}, ([-2.0, 0.0, 0.0], [2.0, 0.5, 0.0])

    def total(*lights):
        given = [{"position_mm": place, "power": power} for place, power in lights]
        session.update(scene(surface, given, {"diffuse": 0.3}, {"path_depth": 3}))
        return session.radiance().total

    alone = [total((place, 1.0)) for place in (left, right)]
    for powers in ((1.0, 1.0), (4.0, 1.0), (4.0, 0.5), (1.0, 1.0)):
        expected = sum(power * radiance for power, radiance in zip(powers, alone, strict=True))
        np.testing.assert_allclose(total(*zip((left, right), powers, strict=True)), expected, rtol=1e-4)
        # The lights that further bounces use are Mitsuba's own objects.
        parameters = session._built.parameters
        in_mitsuba = [np.array(parameters[f"light_{i}.intensity.value"]).item() for i in range(2)]
        assert in_mitsuba == pytest.approx(list(powers))
        places = [np.array(parameters[f"light_{i}.position"]).ravel() for i in range(2)]
        np.testing.assert_allclose(places, session.to_model(np.array([left, right])), atol=1e-6)


# Inter-reflections ---------------------------------------------------------------------------------------------------


def closed_sphere(depth, seed=0, specular=0.0, samples=4):
    inside = {"type": "sphere", "radius_mm": 8.0, "side": "inside"}
    render = {"path_depth": depth, "samples_per_pixel": samples, "seed": seed}
    return scene(inside, (AT_CAMERA,), {"specular": specular, "diffuse": 0.5}, render)


def test_light_that_bounces_in_a_closed_sphere(session):
    """The integrating sphere: after k bounces the irradiance is albedo^k I / R^2 everywhere."""
    sums = []
    for depth in (2, 3, 4):
        session.update(closed_sphere(depth))
        radiance = session.radiance()
        sums.append(float(radiance.total.sum()))
        expected = 0.5 / np.pi * sum(0.5**k for k in range(1, depth - 1)) / 8.0**2
        if depth == 2:
            assert radiance.indirect.max() == 0
        else:
            spread = 4 * float(radiance.indirect.std()) / np.sqrt(radiance.indirect.size)
            assert abs(float(radiance.indirect.mean()) - expected) < spread < 0.02 * expected
    assert sums[0] < sums[1] < sums[2]


# True highlights -----------------------------------------------------------------------------------------------------

CASES = {
    "plane": ({"tilt_deg": 12.0, "azimuth_deg": 30.0}, (AT_CAMERA,)),
    "plane, light aside": ({"tilt_deg": 12.0, "azimuth_deg": 30.0}, (ASIDE,)),
    "sphere, light aside": ({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 9.0}, (ASIDE,)),
    "inside cylinder": ({"type": "cylinder", "radius_mm": 20.0, "side": "inside", "tilt_deg": 9.0}, (AT_CAMERA,)),
    "saddle, two lights": ({"type": "quadric", "k1_per_mm": 0.05, "k2_per_mm": -0.03}, (AT_CAMERA, ASIDE)),
}  # fmt: skip


@pytest.mark.parametrize("name", marked(CASES, ci=["saddle, two lights"]))
def test_true_highlights_bisect_and_are_where_the_frame_is_brightest(session, name):
    surface, lights = CASES[name]
    exponent = 400.0  # a narrow lobe: the falloff moves its peak by O(1/n) alone
    session.update(scene(surface, lights, {"exponent": exponent}))
    found = session.highlights(session.radiance())
    assert sorted(h.light for h in found) == list(range(len(lights)))
    assert all(h.lit for h in found)
    for highlight in found:
        P, N = highlight.position, highlight.normal
        light = np.array(lights[highlight.light].get("position_mm", (0.0, 0.0, 0.0)))
        to_camera, to_light = -P / np.linalg.norm(P), (light - P) / np.linalg.norm(light - P)
        half = to_camera + to_light
        assert np.linalg.norm(np.cross(N, half)) < 1e-9
        assert N @ half > 0
        np.testing.assert_allclose(session.camera.project(P), highlight.bp_px, atol=1e-9)
        assert highlight.distance == pytest.approx(np.linalg.norm(P), rel=1e-12)
        # Alone, this light's brightest pixel holds the point or lies next to it.
        alone = scene(surface, (lights[highlight.light],), {"exponent": exponent})
        session.update(alone)
        total = session.radiance().total
        row, column = np.unravel_index(total.argmax(), total.shape)
        assert np.abs(highlight.bp_px - [column + 0.5, row + 0.5]).max() <= 1.0
        session.update(scene(surface, lights, {"exponent": exponent}))


@pytest.mark.parametrize(
    ("surface", "gains"),
    [
        ({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 9.0}, (1 / 6.0, 1 / 6.0)),
        ({"type": "cylinder", "radius_mm": 20.0, "side": "inside", "tilt_deg": 9.0}, (-1 / 20.0, 0.0)),
    ],
)
def test_curvatures_of_a_true_highlight_count_distances(session, surface, gains):
    session.update(scene(surface, (AT_CAMERA,)))
    (highlight,) = session.highlights(session.radiance())
    expected = np.linalg.norm(highlight.position) * np.array(gains)
    np.testing.assert_allclose([highlight.kd_min, highlight.kd_max], expected, atol=1e-6)
    assert highlight.min_gain == pytest.approx(np.abs(1 + expected).min(), abs=1e-6)


def test_true_highlight_of_a_plane_has_a_closed_form(session):
    """The sightline meets the mirrored light; at the camera it is the foot of the perpendicular."""
    tilt, azimuth = np.radians([12.0, 30.0])
    N = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    foot = N * N[2] * D
    for light in ((0.0, 0.0, 0.0), (2.0, -1.5, 1.0)):
        session.update(scene({"tilt_deg": 12.0, "azimuth_deg": 30.0}, ({"position_mm": light},)))
        (highlight,) = session.highlights(session.radiance())
        L = np.array(light)
        mirrored = L - 2 * ((L - foot) @ N) * N
        P = mirrored * (foot @ N) / (mirrored @ N)
        np.testing.assert_allclose(highlight.position, P, atol=1e-6)
        np.testing.assert_allclose(highlight.bp_px, session.camera.project(P), atol=1e-5)
        assert highlight.kd_min == highlight.kd_max == 0


# Meshes --------------------------------------------------------------------------------------------------------------


def test_a_mesh_is_shaded_with_the_normals_given(session):
    """One triangle whose vertex normals lean by 10 deg: nothing that can be computed from its positions."""
    mi = session.mi
    vertices = np.array([[-50.0, -50, 0], [50, -50, 0], [0, 80, 0]])
    normal = np.array([np.sin(np.radians(10)), 0, np.cos(np.radians(10))])
    mesh = TriangleMesh(vertices, np.array([[0, 1, 2]]), np.tile(normal, (3, 1)))
    made = make_shape(Shape("mesh", False, {}, mesh, "triangle"), {"type": "diffuse"})
    hit = mi.load_dict({"type": "scene", "shape": made}).ray_intersect(mi.Ray3f([1.0, 2.0, 10.0], [0.0, 0.0, -1.0]))
    np.testing.assert_allclose(np.array(hit.sh_frame.n).ravel(), normal, atol=1e-6)
    np.testing.assert_allclose(np.array(hit.n).ravel(), [0, 0, 1], atol=1e-6)
