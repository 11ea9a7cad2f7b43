"""Rendering against closed forms written here: normals, radiance, true highlights, updates, repeatability."""

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


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def sightlines():
    """Unit rays through the pixels' centres, from K written out."""
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    y = (v - 57.0) / 120.0
    x = (u - 83.0 - 4.0 * y) / 130.0
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def leaned(tilt_deg, azimuth_deg):
    """Return the anchor's normal."""
    t, a = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), -np.cos(t)])


def plane(tilt=0.0, azimuth=0.0):
    """Return positions and normals of a plane seen by the camera; NaN where it is not."""
    s, N = sightlines(), leaned(tilt, azimuth)
    t = N[2] * D / (s @ N)
    return np.where(t > 0, t, np.nan)[..., None] * s, np.broadcast_to(N, s.shape)


def sphere(radius, inside=False, tilt=0.0, azimuth=0.0):
    s = sightlines()
    centre = np.array([0, 0, D]) + leaned(tilt, azimuth) * (radius if inside else -radius)
    along = s @ centre
    with np.errstate(invalid="ignore"):
        root = np.sqrt(along**2 - centre @ centre + radius**2)
    P = (along + (root if inside else -root))[..., None] * s
    return P, (P - centre) / radius * (-1 if inside else 1)


def cylinder(radius, inside=False):
    """At tilt 0 and spin 0: curved along x, straight along y."""
    s = sightlines()
    z = D + (-radius if inside else radius)
    across = s[..., 0] ** 2 + s[..., 2] ** 2
    with np.errstate(invalid="ignore"):
        root = np.sqrt((s[..., 2] * z) ** 2 - across * (z**2 - radius**2))
    P = ((s[..., 2] * z + (root if inside else -root)) / across)[..., None] * s
    return P, (P - [0, 0, z]) * [1, 0, 1] / radius * (-1 if inside else 1)


def phong(P, N, light, power=1.0, exponent=50.0, specular=1.0, albedo=0.0, normalised=False):
    """Return the two parts of the radiance of direct light [P75, theory.md section 1], without shadows."""
    to_camera = -P / np.linalg.norm(P, axis=-1, keepdims=True)
    to_light = np.asarray(light, float) - P
    squared = np.sum(to_light**2, axis=-1)
    to_light = to_light / np.sqrt(squared)[..., None]
    mirrored = 2 * np.sum(N * to_light, axis=-1)[..., None] * N - to_light
    cos_beta = np.maximum(np.sum(mirrored * to_camera, axis=-1), 0)
    cos_light, cos_camera = np.sum(N * to_light, axis=-1), np.sum(N * to_camera, axis=-1)
    lit = (cos_light > 0) & (cos_camera > 0)
    scale = (exponent + 2) / (2 * np.pi) * cos_light if normalised else 1.0
    lobe = specular * scale * cos_beta**exponent
    base = albedo / np.pi * cos_light
    return (np.where(lit, part * power / squared, 0.0) for part in (lobe, base))


def leaning(kind, radius, tilt, azimuth=0.0, **settings):
    return {"type": kind, "radius_mm": radius, "tilt_deg": tilt, "azimuth_deg": azimuth, **settings}


INSIDE = {"side": "inside"}
SHAPES = {
    "plane": ({"tilt_deg": 20.0, "azimuth_deg": 130.0}, lambda: plane(20, 130)),
    "grazing plane": ({"tilt_deg": 75.0, "azimuth_deg": -20.0}, lambda: plane(75, -20)),
    "sphere": (leaning("sphere", 6.0, 15.0, 70.0), lambda: sphere(6, False, 15, 70)),
    "large sphere": (leaning("sphere", 1000.0, 0.0), lambda: sphere(1000)),
    "sphere inside": (leaning("sphere", 14.0, 15.0, **INSIDE), lambda: sphere(14, True, 15)),
    "cylinder": (leaning("cylinder", 4.0, 0.0), lambda: cylinder(4)),
    "large cylinder": (leaning("cylinder", 1000.0, 0.0), lambda: cylinder(1000)),
    "cylinder inside": (leaning("cylinder", 11.2, 0.0, **INSIDE), lambda: cylinder(11.2, True)),
}


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_those_of_the_formula_at_every_pixel(session, name):
    surface, formula = SHAPES[name]
    session.update(scene(surface))
    P, N = formula()
    truth = session.truth()
    seen = np.isfinite(P).all(axis=-1) & (np.nan_to_num(P)[..., 2] > 0)
    if surface.get("type") == "cylinder" or "plane" in name:
        # The rendered shape is finite.
        seen &= np.linalg.norm(np.nan_to_num(P), axis=-1) < 45 * D
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


@pytest.mark.parametrize("lights", [(AT_CAMERA,), (ASIDE,), (AT_CAMERA, ASIDE)], ids=["camera", "aside", "both"])
@pytest.mark.parametrize("name", ["plane", "sphere", "sphere inside", "cylinder", "cylinder inside", "large sphere"])
@pytest.mark.parametrize("normalised", [False, True])
def test_radiance_is_that_of_the_formula(session, name, lights, normalised):
    surface, formula = SHAPES[name]
    reflectance = {"exponent": 30.0, "specular": 0.6, "diffuse": 0.4, "normalised": normalised}
    session.update(scene(surface, lights, reflectance))
    radiance = session.radiance()
    P, N = formula()
    expected = [0.0, 0.0]
    for light in lights:
        place = light.get("position_mm", (0.0, 0.0, 0.0))
        parts = phong(P, N, place, light.get("power", 1.0), 30.0, 0.6, 0.4, normalised)
        expected = [total + part for total, part in zip(expected, parts, strict=True)]
    compared = 0
    for part, formula_part in zip((radiance.specular, radiance.diffuse), expected, strict=True):
        assert part.dtype == np.float32
        assert part.shape == (120, 160)
        bright = np.nan_to_num(formula_part) > 1e-3 * np.nanmax(formula_part)
        compared += np.count_nonzero(bright)
        # The specular part is a difference: its rounding is that of the whole.
        allowed = 1e-4 * formula_part[bright] + 1e-7 * np.nanmax(sum(expected))
        assert (np.abs(part[bright] - formula_part[bright]) < allowed).all()
    assert compared > 1000
    np.testing.assert_array_equal(radiance.indirect, 0)
    np.testing.assert_array_equal(radiance.total, radiance.specular + radiance.diffuse)


def test_the_far_side_of_a_convex_body_is_dark(session):
    """A light behind the horizon: no radiance, neither by the cosine nor by a shadow."""
    session.update(scene({"type": "sphere", "radius_mm": 4.0}, ({"position_mm": [25.0, 0.0, 14.0]},), {"diffuse": 0.5}))
    P, N = sphere(4.0)
    to_light = np.array([25.0, 0, 14]) - P
    facing = np.sum(N * to_light, axis=-1) / np.linalg.norm(to_light, axis=-1)
    total = session.radiance().total
    with np.errstate(invalid="ignore"):
        assert (total[facing < -0.01] == 0).all()
        assert (total[facing > 0.01] > 0).all()


def test_one_wall_throws_a_shadow_on_another(session):
    """A light outside the sphere that the camera is in: its wall is in the way everywhere."""
    inside = {"type": "sphere", "radius_mm": 8.0, "side": "inside"}
    session.update(scene(inside, ({"position_mm": [0.0, 0.0, 13.0]},), {"diffuse": 0.5}))
    assert session.radiance().total.max() == 0
    assert not any(highlight.lit for highlight in session.highlights(session.radiance()))


# Updates -------------------------------------------------------------------------------------------------------------

FIRST = scene({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 5.0}, (ASIDE,), {"exponent": 40.0, "diffuse": 0.2})
SECOND = scene({"type": "sphere", "radius_mm": 9.0, "distance_mm": 7.0}, reflectance={"exponent": 90.0, "diffuse": 0.2})


def everything(session, described):
    session.update(described)
    radiance, truth = session.radiance(), session.truth()
    highlights = session.highlights(radiance)
    arrays = [radiance.specular, radiance.diffuse, radiance.indirect]
    arrays += [truth.normal, truth.depth, truth.shading_normal, truth.k_min, truth.direction_max]
    return [array.tobytes() for array in arrays] + [h.bp_px.tobytes() + h.normal.tobytes() for h in highlights]


def test_same_bytes_twice_after_another_scene_and_in_a_fresh_session(session):
    first = everything(session, FIRST)
    assert len(first) > 8
    assert everything(session, FIRST) == first
    other = everything(session, SECOND)
    assert other[0] != first[0]
    everything(session, scene({"type": "cylinder"}, (AT_CAMERA, ASIDE)))
    assert everything(session, FIRST) == first
    assert everything(Session(FIRST), FIRST) == first
    assert everything(session, SECOND) == other


def test_a_sweep_builds_the_scene_once():
    session = Session(FIRST)
    seen = set()
    for i in range(12):
        surface = {"type": "sphere", "radius_mm": 5.0 + i, "distance_mm": 9.0 + i / 3, "tilt_deg": 2.0 * i}
        light = {"offset_mm": 0.2 * i, "azimuth_deg": 30.0 * i, "power": 1.0 + i}
        reflectance = {"exponent": 20.0 + i, "specular": 0.5 + i / 30, "diffuse": 0.2}
        session.update(scene(surface, (light,), reflectance, camera={"fx": 120.0 + i}))
        seen.add(session.radiance().total.tobytes())
    assert session.rebuilds == 1
    assert len(seen) == 12
    session.update(scene({"type": "cylinder"}))
    assert session.rebuilds == 2


def test_truth_follows_a_change_of_the_camera_alone(session):
    session.update(FIRST)
    before = session.truth().normal
    session.update(scene({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 5.0}, camera={"cx": 60.0}))
    after = session.truth().normal
    assert not np.array_equal(before, after, equal_nan=True)
    # A shift of the principal point by whole pixels is a shift of the picture.
    np.testing.assert_allclose(after[:, :137], before[:, 23:], atol=1e-12)


def test_lights_of_equal_power_are_updated_apart(session):
    """Mitsuba merges equal objects of a scene: two lights of one power would then share their parameter."""
    surface, (left, right) = {"tilt_deg": 5.0}, ([-2.0, 0.0, 0.0], [2.0, 0.5, 0.0])

    def total(powers):
        lights = tuple({"position_mm": p, "power": w} for p, w in zip((left, right), powers, strict=True))
        session.update(scene(surface, lights, {"diffuse": 0.3}, {"path_depth": 3}))
        return session.radiance()

    P, N = plane(5.0)
    for powers in ((1.0, 1.0), (4.0, 1.0), (4.0, 0.5), (1.0, 1.0)):
        expected = sum(
            sum(phong(P, N, place, power, albedo=0.3)) for place, power in zip((left, right), powers, strict=True)
        )
        np.testing.assert_allclose(total(powers).total, expected, rtol=1e-4)
        # The lights that further bounces use are Mitsuba's own objects.
        parameters = session._built.parameters
        in_mitsuba = [np.array(parameters[f"light_{i}.intensity.value"]).item() for i in range(2)]
        assert in_mitsuba == pytest.approx(list(powers))
        places = [np.array(parameters[f"light_{i}.position"]).ravel() for i in range(2)]
        np.testing.assert_allclose(places, session.to_model(np.array([left, right])), atol=1e-6)


# Materials -----------------------------------------------------------------------------------------------------------

MATERIALS = {
    "phong": {"type": "phong", "diffuse": 0.3},
    "rough plastic": {"type": "rough_plastic", "alpha": 0.15},
    "principled": {"type": "principled", "roughness": 0.3},
    "rough conductor": {"type": "rough_conductor", "alpha": 0.2, "diffuse": 0.3},
    "albedo": {"type": "tissue", "film": {"index": 1.36, "alpha": 0.1}},
}


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_render_finite_with_their_peak_at_the_highlight(session, name):
    described = scene({"tilt_deg": 8.0, "azimuth_deg": 40.0}, reflectance=MATERIALS[name])
    session.update(described)
    radiance = session.radiance()
    for part in (radiance.specular, radiance.diffuse, radiance.indirect):
        assert np.isfinite(part).all()
        assert (part >= 0).all()
    assert radiance.specular.max() > 0
    assert radiance.diffuse.max() > 0
    row, column = np.unravel_index(radiance.specular.argmax(), radiance.specular.shape)
    bp = session.highlights(radiance)[0].bp_px
    assert np.abs(bp - [column + 0.5, row + 0.5]).max() <= 0.75
    # The lobe falls off: the split leaves no base in the specular part.
    assert radiance.specular[0, -1] < 0.05 * radiance.specular.max()


@pytest.mark.parametrize("name", ["phong", "rough conductor"])
def test_the_split_is_that_of_the_materials_parts(session, name):
    """The specular part is that of the same lobe without its base, and the other way round."""
    surface = {"type": "sphere", "radius_mm": 8.0}
    full = MATERIALS[name]
    share = 1 - full["diffuse"] if name == "rough conductor" else 1.0
    session.update(scene(surface, reflectance=full))
    radiance = session.radiance()
    session.update(scene(surface, reflectance={**full, "diffuse": 0.0}))
    lobe = session.radiance()
    assert lobe.diffuse.max() == 0
    np.testing.assert_allclose(radiance.specular, share * lobe.specular, rtol=1e-4, atol=1e-6 * lobe.specular.max())
    np.testing.assert_array_equal(radiance.total, radiance.specular + radiance.diffuse + radiance.indirect)


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


def test_bounces_are_repeatable_and_hang_on_the_seed(session):
    session.update(closed_sphere(4, specular=1.0))
    first = session.radiance()
    assert (first.indirect >= 0).all()
    assert first.indirect.max() > 0
    session.update(FIRST)
    session.update(closed_sphere(4, specular=1.0))
    again = session.radiance()
    for name in ("specular", "diffuse", "indirect"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    session.update(closed_sphere(4, seed=1, specular=1.0))
    assert session.radiance().indirect.tobytes() != first.indirect.tobytes()
    session.update(closed_sphere(2, specular=1.0))
    assert session.radiance().total.sum() < again.total.sum()


def test_phong_samples_have_the_density_they_claim(session):
    """Mean of value / density = the integral of the value, and mean of g / density over samples = integral of g."""
    import drjit as dr

    mi = session.mi
    settings = {"exponent": 12.0, "specular": 0.4, "diffuse": 0.6, "normalised": True}
    reflectance = scene({}, reflectance=settings).reflectance
    bsdf = mi.load_dict(reflectance.kernel)
    count = 200_000
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(float(np.sin(0.6)), 0.0, float(np.cos(0.6)))
    si.t = 1.0
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True)
    weight, density = np.array(weight).ravel(), np.array(sample.pdf)
    value = np.array(bsdf.eval(mi.BSDFContext(), si, sample.wo, True)).ravel()
    np.testing.assert_allclose(np.array(bsdf.pdf(mi.BSDFContext(), si, sample.wo, True)), density, rtol=1e-4, atol=1e-5)
    ok = density > 0
    np.testing.assert_allclose(weight[ok], value[ok] / density[ok], rtol=1e-3)
    # Quadrature over the hemisphere.
    z, a = np.meshgrid((np.arange(400) + 0.5) / 400, 2 * np.pi * (np.arange(800) + 0.5) / 800)
    sine = np.sqrt(1 - z**2)
    wo = np.stack([sine * np.cos(a), sine * np.sin(a), z], axis=-1).reshape(-1, 3)
    beta = np.maximum(wo @ [-np.sin(0.6), 0, np.cos(0.6)], 0)
    lobe = 0.4 * 14 / (2 * np.pi) * beta**12 * wo[:, 2] + 0.6 / np.pi * wo[:, 2]
    directions = np.array(sample.wo).T
    for g in (lambda w: np.ones(len(w)), lambda w: w[:, 0], lambda w: w[:, 2]):
        integral = 2 * np.pi * np.mean(lobe * g(wo))
        terms = weight * g(directions)
        assert abs(terms.mean() - integral) < 5 * terms.std() / np.sqrt(count)
        assert 5 * terms.std() / np.sqrt(count) < 0.02


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
        assert angle(N, half / np.linalg.norm(half)) < 1e-6
        np.testing.assert_allclose(session.camera.project(P), highlight.bp_px, atol=1e-9)
        assert highlight.distance == pytest.approx(np.linalg.norm(P), rel=1e-12)
        # Alone, this light's brightest pixel holds the point or lies next to it.
        alone = scene(surface, (lights[highlight.light],), {"exponent": exponent})
        session.update(alone)
        total = session.radiance().total
        row, column = np.unravel_index(total.argmax(), total.shape)
        assert np.abs(highlight.bp_px - [column + 0.5, row + 0.5]).max() <= 1.0
        session.update(scene(surface, lights, {"exponent": exponent}))


def test_curvatures_of_a_true_highlight_count_distances(session):
    for surface, gains in (
        ({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 9.0}, (1 / 6.0, 1 / 6.0)),
        ({"type": "cylinder", "radius_mm": 20.0, "side": "inside", "tilt_deg": 9.0}, (-1 / 20.0, 0.0)),
    ):
        session.update(scene(surface, (AT_CAMERA,)))
        (highlight,) = session.highlights(session.radiance())
        expected = np.linalg.norm(highlight.position) * np.array(gains)
        np.testing.assert_allclose([highlight.kd_min, highlight.kd_max], expected, atol=1e-6)


def test_true_highlight_of_a_plane_has_a_closed_form(session):
    """The sightline meets the mirrored light; at the camera it is the foot of the perpendicular."""
    N = leaned(12.0, 30.0)
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


def test_d_k_of_a_highlight(session):
    session.update(scene({"type": "cylinder", "radius_mm": 20.0, "side": "inside"}))
    (highlight,) = session.highlights(session.radiance())
    assert highlight.kd_min == pytest.approx(-0.5, abs=1e-6)
    assert highlight.kd_max == pytest.approx(0, abs=1e-9)
    assert highlight.min_gain == pytest.approx(0.5, abs=1e-6)


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


@pytest.mark.parametrize(
    ("surface", "limit"),
    [
        ({"type": "quadric", "k1_per_mm": 0.08, "k2_per_mm": -0.05, "tilt_deg": 20.0}, 1e-5),
        pytest.param({"type": "anatomy", "path": "colon"}, 3e-3, marks=pytest.mark.ci),
    ],
    ids=["quadric", "colon"],
)
def test_vertex_normals_of_rendered_meshes_are_the_exact_ones(session, surface, limit):
    session.update(scene(surface))
    session.update(scene(surface, (ASIDE,), {"exponent": 77.0}))  # an update must not recompute them
    mesh = session._shape.mesh
    parameters = session._built.parameters
    stored = np.array(parameters["surface.vertex_normals"]).reshape(-1, 3)
    np.testing.assert_array_equal(stored, mesh.normals.astype(np.float32))
    truth = session.truth()
    away = angle(truth.normal, truth.shading_normal)[truth.mask]
    assert np.median(away) < limit / 5
    assert np.percentile(away, 99) < limit
