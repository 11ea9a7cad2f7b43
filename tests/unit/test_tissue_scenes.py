"""Tissue in a scene: the plane's highlight by closed form, the lobe that is told, pools and crests of the film."""

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import scene_from_dict
from tests.lobe_formulas import film_value

pytestmark = pytest.mark.render

DISTANCE, FOCAL, SIZE = 12.0, 400.0, 61


def scene(film, relief=None, diffuse=0.4, lights=({},), focal=FOCAL, **surface):
    described = {"type": "plane", "distance_mm": DISTANCE, **surface}
    if relief is not None:
        described["relief"] = relief
    return scene_from_dict(
        {
            "surface": described,
            "reflectance": {"type": "tissue", "film": film, "diffuse": diffuse},
            "rig": {"lights": list(lights)},
            "camera": {"width": SIZE, "height": SIZE, "fx": focal, "fy": focal},
        }
    )


def plane_film(alpha, index, tilt_deg, light):
    """Radiance of a tilted plane's Beckmann film at all pixels, by theory: I/r^2 F D G / (4 cos) towards the camera."""
    tilt = np.radians(tilt_deg)
    N = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    x, y = np.meshgrid(*2 * [(np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL])
    s = np.stack([x, y, np.ones_like(x)], axis=-1)
    P = s * (DISTANCE * N[2] / (s @ N))[..., None]
    towards = np.array(light) - P
    squared = np.sum(towards**2, axis=-1)
    wi, wo = -P / np.linalg.norm(P, axis=-1, keepdims=True), towards / np.sqrt(squared)[..., None]
    first = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    axes = np.stack([first, np.cross(N, first), N], axis=1)
    return film_value(wi @ axes, wo @ axes, alpha, index, "beckmann") / squared


@pytest.mark.parametrize(("alpha", "index"), [(0.01, 1.33), (0.03, 1.36), (0.1, 1.4)])
def test_a_planes_highlight_is_the_closed_forms(alpha, index):
    """The peak and all of the lobe down to a thousandth of it, within 1e-3."""
    session = Session(scene({"index": index, "alpha": alpha}))
    for tilt_deg, light in ((0.0, (0.0, 0.0, 0.0)), (20.0, (8.0, 1.0, 1.0))):
        lights = ({"position_mm": list(light)},)
        session.update(scene({"index": index, "alpha": alpha}, tilt_deg=tilt_deg, lights=lights))
        rendered, expected = session.radiance().specular, plane_film(alpha, index, tilt_deg, light)
        seen = expected > 1e-3 * expected.max()
        assert seen.sum() > 100
        assert rendered.max() == pytest.approx(expected.max(), rel=1e-3)
        assert rendered.argmax() == expected.argmax()
        np.testing.assert_allclose(rendered[seen], expected[seen], rtol=1e-3)
        if tilt_deg == 0:
            # Straight on: F(0) / (4 pi alpha^2) over the squared distance.
            straight = ((index - 1) / (index + 1)) ** 2 / (4 * np.pi * alpha**2) / DISTANCE**2
            assert rendered.max() == pytest.approx(straight, rel=1e-3)


# What estimators are told ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [0.01, 0.03, 0.1])
def test_the_curvature_that_is_told_is_the_rendered_lobes(alpha):
    """-(log f)''(0) by differences of the rendered radiance along the row through the highlight, falloff taken out."""
    film = {"index": 1.36, "alpha": alpha}
    described = scene(film, diffuse=0.0)
    row = Session(described).radiance().specular[SIZE // 2].astype(float)
    angle = np.arctan((np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL)
    near = np.abs(angle) < 1.2 * alpha
    lobe = np.log(row[near] / np.cos(angle[near]) ** 2)
    # log f is even: its terms in angle^2, of which the first is -c/2.
    found = -2 * np.polynomial.polynomial.polyfit(angle[near] ** 2, lobe, 3)[1]
    told = described.calibration().priors.lobe_curvature
    assert told.mean == pytest.approx(2 / alpha**2 - 5)
    assert found == pytest.approx(told.mean, rel=5e-3)


def test_no_width_is_told_of_ggx_nor_where_the_lobe_is_unknown():
    ggx = scene({"index": 1.36, "distribution": "ggx"})
    assert ggx.calibration().priors.lobe_curvature is None
    assert ggx.reflectance.lobe_curvature is None
    untold = scene_from_dict({**scene({"index": 1.36}).model_dump(), "known": {"lobe": False}})
    assert untold.calibration().priors.lobe_curvature is None


# Film over relief -----------------------------------------------------------------------------------------------------

RELIEF = {"bands": [{"slope_deg": 5.0, "wavelength_mm": 0.5}], "seed": 3}
FILM = {"index": 1.36, "alpha": 0.04}
WIDE = 60.0


def kernel_hits(session):
    """Height of the tissue, mm, and fine and base normals at the pixels' centres, as the kernel has them."""
    tracer = session._tracer()
    lanes = session.sightlines.lanes(0, SIZE * SIZE, False, 0)
    _, _, hit = tracer.hit(*session.sightlines.centre(lanes))
    fine, base = (np.array(si.sh_frame.n, dtype=float).T for si in (hit.fine, hit.base))
    return np.array(hit.jets.height, dtype=float), fine, base


def test_pools_are_smooth_and_crests_are_rough_and_the_truth_tells_them_apart():
    """Below the film's level the rendered normals are the base's, above it the relief's."""
    bare = kernel_hits(Session(scene(FILM, RELIEF, focal=WIDE)))[1]
    for film_level, least, most in ((0.0, 0.42, 0.6), (0.5, 0.6, 0.78)):
        session = Session(scene({**FILM, "level": film_level}, RELIEF, focal=WIDE))
        height, fine, base = kernel_hits(session)
        relief, truth = session.surface.relief, session.truth()
        # There the meniscus, a tenth of a deviation wide, has ended.
        deep, high = (sign * (height - relief.level) > 1.2 * relief.deviation for sign in (-1, 1))
        assert min(deep.sum(), high.sum()) > 100
        turned = np.linalg.norm(fine - base, axis=1)
        assert turned[deep].max() < 1e-5
        assert np.linalg.norm(bare - base, axis=1)[deep].mean() > np.radians(3)
        assert np.linalg.norm(fine - bare, axis=1)[high].max() < 1e-5
        assert turned[high].mean() > np.radians(3)
        # Between them the film's surface bends by the softplus's slope. On a plane the fine normal's tangent part over
        # its normal part is the gradient.
        share = 1 / (1 + np.exp(-(height - relief.level) / relief.meniscus))
        slope, bare_slope = (np.linalg.norm(n[:, :2], axis=1) / np.abs(n[:, 2]) for n in (fine, bare))
        np.testing.assert_allclose(slope, share * bare_slope, atol=2e-5)
        clear = np.abs(height - relief.level) > 1e-4 * relief.deviation
        assert clear.mean() > 0.99
        np.testing.assert_array_equal(truth.pool.ravel()[clear], (height < relief.level)[clear])
        # About as many as a Gaussian has below the level.
        assert least < truth.pool.mean() < most
        np.testing.assert_allclose(truth.normal.reshape(-1, 3)[deep], truth.normal_base.reshape(-1, 3)[deep], atol=1e-5)
    assert not Session(scene(FILM, RELIEF, focal=WIDE)).truth().pool.any()


def test_pools_shine_as_a_smooth_film_does():
    """The specular radiance of a pool is that of the scene without relief; the base's light stays as it was."""
    session = Session(scene({**FILM, "level": 1.0}, RELIEF, focal=WIDE))
    filled, height = session.radiance(), kernel_hits(session)[0].reshape(SIZE, SIZE)
    deep = height < 0
    smooth, bare = (Session(scene(FILM, relief, focal=WIDE)).radiance() for relief in (None, RELIEF))
    bright = deep & (smooth.specular > 1e-3 * smooth.specular.max())
    assert bright.sum() > 20
    np.testing.assert_allclose(filled.specular[bright], smooth.specular[bright], rtol=2e-3)
    assert np.abs(bare.specular[bright] / smooth.specular[bright] - 1).mean() > 0.3
    np.testing.assert_array_equal(filled.diffuse, bare.diffuse)


# Patches of film ------------------------------------------------------------------------------------------------------

FLAT = {"bands": [{"slope_deg": 1e-3, "wavelength_mm": 0.5}], "seed": 3}
PATCHES = {"wavelength_mm": 1.5, "amplitude": 5.0, "dry_level": -0.3, "dry_alpha": 0.1}
"""On a relief that turns no normal the film's level changes the roughness alone."""


def test_wet_and_dry_ground_have_lobes_of_their_own_roughness():
    """At each pixel of a plane the closed form of the roughness there, between the film's and that of dry ground."""
    film = {"index": 1.36, "alpha": 0.05, "level": 0.0, "patches": PATCHES}
    session = Session(scene(film, FLAT, diffuse=0.0))
    rendered, truth = session.radiance().specular, session.truth()
    wet = session.surface.relief.wet(session.to_model(truth.position.reshape(-1, 3))).reshape(SIZE, SIZE)
    assert min((wet < 0.02).mean(), (wet > 0.98).mean()) > 0.1
    alike = [plane_film(alpha, 1.36, 0.0, (0.0, 0.0, 0.0)) for alpha in (0.05, 0.1)]
    expected = np.zeros_like(rendered)
    for row, column in np.ndindex(SIZE, SIZE):
        local = wet[row, column] * 0.05 + (1 - wet[row, column]) * 0.1
        expected[row, column] = plane_film(local, 1.36, 0.0, (0.0, 0.0, 0.0))[row, column]
    np.testing.assert_allclose(rendered, expected, rtol=2e-3)
    for one in alike:
        assert np.abs(rendered / one - 1).mean() > 0.1


@pytest.mark.parametrize("depth", [2, 3])
def test_ground_that_is_dry_everywhere_is_a_film_of_its_roughness(depth):
    """Direct light and bounces in a tube; and radii of highlights. Another roughness is no other kernel."""
    tube = {"type": "cylinder", "radius_mm": 20.0, "side": "inside"}

    def described(**film):
        tables = scene({"index": 1.36, "level": -3.0, **film}, FLAT, focal=WIDE, **tube).model_dump()
        return scene_from_dict({**tables, "render": {"samples_per_pixel": 4, "path_depth": depth}})

    session = Session(described(alpha=0.03, patches={**PATCHES, "amplitude": 1e-3, "dry_level": 3.0}))
    rebuilds, rough = session.rebuilds, []
    for alpha in (0.06, 0.1):
        patches = {**PATCHES, "amplitude": 1e-3, "dry_level": 3.0, "dry_alpha": alpha}
        session.update(described(alpha=0.03, patches=patches))
        dry, film = render_view(session, session.scene), Session(described(alpha=alpha))
        one = render_view(film, film.scene)
        for part in ("specular", "diffuse", "indirect"):
            found, expected = (getattr(view.radiance, part) for view in (dry, one))
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * expected.max(), err_msg=part)
        found, expected = (np.array([h.radius_px for h in view.highlights]) for view in (dry, one))
        np.testing.assert_allclose(found, expected, rtol=1e-3)
        np.testing.assert_allclose(session.lobe_at(dry.highlights), film.lobe_at(one.highlights), rtol=1e-3)
        rough.append(np.median(found))
    assert session.rebuilds == rebuilds
    assert rough[1] > 1.5 * rough[0]
    assert depth == 2 or dry.radiance.indirect.max() > 0


def test_patches_say_nothing_where_there_are_none():
    plain = scene({**FILM, "level": 0.5}, RELIEF)
    assert "patches" not in plain.model_dump()["reflectance"]["film"]
    assert plain.reflectance.lobe_curvature is not None
    patchy = scene({**FILM, "level": 0.5, "patches": PATCHES}, RELIEF)
    assert patchy.calibration().priors.lobe_curvature is None
    assert scene_from_dict(patchy.model_dump()) == patchy


def test_normals_that_face_away_give_no_light_and_no_nan():
    """At grazing views of a steep relief."""
    relief = {"bands": [{"slope_deg": 20.0, "wavelength_mm": 0.5}]}
    lights = ({"position_mm": [11.0, 0.0, 0.0]}, {})
    session = Session(scene(FILM, relief, tilt_deg=85.0, lights=lights))
    tracer = session._tracer()
    lanes = session.sightlines.lanes(0, SIZE * SIZE, False, 0)
    _, _, hit = tracer.hit(*session.sightlines.centre(lanes))
    away = (np.array(hit.fine.wi.z) <= 0).reshape(SIZE, SIZE) & (np.array(hit.base.t) < 1e6).reshape(SIZE, SIZE)
    assert away.sum() > 50
    radiance = session.radiance()
    for part in (radiance.specular, radiance.diffuse):
        assert np.isfinite(part).all()
        assert (part >= 0).all()
    assert (radiance.specular[away] == 0).all()


# Painted base ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("samples", "depth"), [(1, 2), (4, 2), (4, 3)])
def test_a_painted_albedo_reaches_direct_light_and_bounces(samples, depth):
    """An albedo gathered from a table, by place: 0 on one side of a tube, that of the texture on the other."""
    tube = {"type": "cylinder", "radius_mm": 20.0, "side": "inside"}
    described = scene_from_dict(
        {
            "surface": tube,
            "reflectance": {"type": "tissue", "film": {"index": 1.36, "alpha": 0.1}, "diffuse": 0.6},
            "camera": {"width": SIZE, "height": SIZE, "fx": WIDE, "fy": WIDE},
            "render": {"samples_per_pixel": samples, "path_depth": depth, "adaptive": False},
        }
    )
    session = Session(described)
    plain = session.radiance()
    mi = session.mi
    import drjit as dr  # after the backend has chosen its libLLVM

    table = mi.Float(0.0, 0.6)
    # The camera's x axis in the model frame: pixels on the left have a negative share of it.
    axis = session.to_model(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    right, origin = mi.Vector3f(*(axis[0] - axis[1]).tolist()), mi.Point3f(*axis[1].tolist())

    def albedo(si, active):
        side = dr.select(dr.dot(right, si.p - origin) > 0, mi.UInt32(1), mi.UInt32(0))
        return mi.Spectrum(dr.gather(mi.Float, table, side, active))

    session._built.scene.shapes()[0].bsdf().albedo_at = albedo
    painted = session.radiance()
    left, middle = np.s_[:, : SIZE // 2], SIZE // 2 + 1
    assert (painted.diffuse[left] == 0).all()
    np.testing.assert_allclose(painted.diffuse[:, middle:], plain.diffuse[:, middle:], rtol=1e-5)
    np.testing.assert_array_equal(painted.specular, plain.specular)
    if depth > 2:
        assert 0 < painted.indirect.sum() < 0.8 * plain.indirect.sum()
