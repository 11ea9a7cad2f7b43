"""What every reflectance promises the renderer, whatever its form: parts, updates, energy, plain data."""

import json
from typing import get_args

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.rendering.lighting import Material
from simtest.spec.reflectance import Reflectance
from simtest.spec.scene import scene_from_dict

pytestmark = pytest.mark.render

COLOUR = [0.8, 0.4, 0.3]
FORMS = {
    "phong": [{"exponent": 40.0, "specular": 0.3, "diffuse": 0.4}, {"exponent": 90.0, "specular": 0.5, "diffuse": 0.2}],
    "phong, normalised": [
        {"normalised": True, "exponent": 40.0, "specular": 0.3, "diffuse": 0.4},
        {"normalised": True, "exponent": 90.0, "specular": 0.5, "diffuse": 0.2},
    ],
    "rough_plastic": [{"alpha": 0.15, "diffuse": 0.4}, {"alpha": 0.3, "diffuse": 0.2}],
    "principled": [{"roughness": 0.4, "diffuse": 0.4}, {"roughness": 0.5, "diffuse": 0.2}],
    "rough_conductor": [{"alpha": 0.2, "diffuse": 0.4}, {"alpha": 0.3, "diffuse": 0.2}],
    "tissue": [
        {"film": {"index": 1.36, "alpha": 0.06}, "diffuse": 0.4},
        {"film": {"index": 1.34, "alpha": 0.09}, "diffuse": 0.2},
    ],
    "tissue, ggx": [
        {"film": {"index": 1.36, "alpha": 0.06, "distribution": "ggx"}, "diffuse": 0.4},
        {"film": {"index": 1.34, "alpha": 0.09, "distribution": "ggx"}, "diffuse": 0.2},
    ],
}


def scene(name, number=0, **more):
    tables = {"type": name.split(",")[0], "colour": COLOUR, **FORMS[name][number]}
    camera = {"width": 24, "height": 20, "fx": 24.0, "fy": 24.0}
    surface = {"type": "sphere", "distance_mm": 20.0, "radius_mm": 12.0}
    rig = {"lights": [{"position_mm": [4.0, 1.0, 0.0]}]}
    return scene_from_dict({"surface": surface, "camera": camera, "rig": rig, "reflectance": tables, **more})


@pytest.fixture(scope="module", params=FORMS)
def named(request):
    return request.param, Session(scene(request.param), "llvm_ad_rgb")


def directions(mi, count, seed):
    """Unit directions above the surface, as lanes."""
    rng = np.random.default_rng(seed)
    z, turn = rng.uniform(0.05, 1.0, count), rng.uniform(0, 2 * np.pi, count)
    side = np.sqrt(1 - z**2)
    return mi.Vector3f(*np.stack([side * np.cos(turn), side * np.sin(turn), z]).astype(np.float32))


def evaluated(session, wi, wo):
    """Return lobe, base and whole, f cos(theta), (3, N)."""
    import drjit as dr

    mi, built = session.mi, session._built
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi, si.t = wi, 1.0
    bsdf = built.scene.shapes()[0].bsdf()
    lobe, base = Material(bsdf, built.base).parts(si, wo, mi.Bool(True))
    return [np.array(part) for part in (lobe, base, bsdf.eval(mi.BSDFContext(), si, wo, True))]


def test_every_reflectance_of_the_scene_is_here():
    assert {form.split(",")[0] for form in FORMS} == {
        spec.model_fields["type"].default for spec in get_args(get_args(Reflectance)[0])
    }


def test_descriptions_are_plain_data(named):
    reflectance = named[1].scene.reflectance
    for table in (reflectance.kernel, reflectance.updates, reflectance.base_kernel or {}):
        assert json.loads(json.dumps(table)) == table


def test_lobe_and_base_are_parts_of_the_whole(named):
    name, session = named
    wi, wo = directions(session.mi, 500, 1), directions(session.mi, 500, 2)
    lobe, base, whole = evaluated(session, wi, wo)
    assert min(lobe.min(), base.min()) >= 0
    np.testing.assert_allclose(lobe + base, whole, rtol=1e-5, atol=1e-6)
    # The lobe has no colour, the base has that of the scene.
    assert lobe.max() > 0
    if not name.startswith("tissue"):
        np.testing.assert_allclose(lobe[1:], lobe[:1].repeat(2, axis=0), rtol=1e-5, atol=1e-6)
    if name != "rough_plastic":
        lit = base[0] > 1e-3
        ratio = base[:, lit] / base[0, lit]
        if not name.startswith("tissue"):
            np.testing.assert_allclose(
                ratio, np.repeat([[c / COLOUR[0]] for c in COLOUR], lit.sum(), axis=1), rtol=1e-4
            )
        else:
            assert (np.diff(ratio, axis=0) < 0).all()


def test_swapped_directions_reflect_alike(named):
    name, session = named
    wi, wo = directions(session.mi, 500, 3), directions(session.mi, 500, 4)
    there, back = evaluated(session, wi, wo), evaluated(session, wo, wi)
    if name == "phong":
        # As published it has no cosine of incidence: the radiance of the lobe itself is the same.
        np.testing.assert_allclose(there[0], back[0], rtol=1e-5, atol=1e-7)
    else:
        np.testing.assert_allclose(there[2] / np.array(wo.z), back[2] / np.array(wi.z), rtol=2e-4, atol=1e-5)


def test_an_update_is_a_fresh_build_and_rebuilds_nothing(named):
    name, session = named
    session.update(scene(name, 1))
    moved = session.radiance()
    session.update(scene(name, 0))
    assert session.rebuilds == 1
    fresh = Session(scene(name, 1), "llvm_ad_rgb").radiance()
    assert moved.specular.max() > 0
    for part in ("specular", "diffuse"):
        np.testing.assert_array_equal(getattr(moved, part), getattr(fresh, part))


def test_samples_have_the_density_they_claim(named):
    """The mean of value / density over samples is the integral over the hemisphere."""
    import drjit as dr

    name, session = named
    mi, count = session.mi, 400_000
    bsdf = session._built.scene.shapes()[0].bsdf()
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi, si.t = mi.Vector3f(float(np.sin(0.5)), 0.0, float(np.cos(0.5))), 1.0
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    _, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True)
    sampled = np.array(weight).mean(axis=1)
    # Midpoints over the hemisphere, fine enough for every lobe here.
    rows, columns = 800, 1600
    z, turn = np.meshgrid((np.arange(rows) + 0.5) / rows, 2 * np.pi * (np.arange(columns) + 0.5) / columns)
    side = np.sqrt(1 - z**2)
    wo = mi.Vector3f(*np.stack([side * np.cos(turn), side * np.sin(turn), z]).reshape(3, -1).astype(np.float32))
    si = dr.zeros(mi.SurfaceInteraction3f, rows * columns)
    si.wi, si.t = mi.Vector3f(float(np.sin(0.5)), 0.0, float(np.cos(0.5))), 1.0
    whole = 2 * np.pi * np.array(bsdf.eval(mi.BSDFContext(), si, wo, True)).mean(axis=1)
    np.testing.assert_allclose(sampled, whole, rtol=0.02)
    if name != "phong":
        assert whole.max() <= 1
