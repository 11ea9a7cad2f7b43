"""What every reflectance promises the renderer: its formula, its parts, its width, its energy, updates, derivatives."""

import json
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest

from simtest.rendering import Session, backend, elements
from simtest.rendering.lighting import Material
from simtest.spec.reflectance import Reflectance
from simtest.spec.scene import scene_from_dict
from tests import lobe_formulas as formulas
from tests.lobe_formulas import (
    base_value,
    diffuse_share,
    drawn,
    evaluate,
    film_value,
    fresnel,
    gauss,
    incidence,
    interaction,
    lanes,
    phong_value,
    plugin,
    smith,
    unit,
)

pytestmark = pytest.mark.render


@pytest.fixture
def mi():
    mi = backend.load()
    elements.register(mi.variant())
    return mi


def upper(count, seed):
    wi = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    wi[:, 2] = np.abs(wi[:, 2])
    return wi


def about_mirror(wi, alpha, seed):
    """Directions mirrored at facets whose slopes are about alpha."""
    slopes = alpha * np.random.default_rng(seed).normal(size=(len(wi), 2))
    h = unit(np.column_stack([slopes, np.ones(len(wi))]))
    return 2 * np.sum(wi * h, axis=1, keepdims=True) * h - wi


def single(values):
    """Directions as single precision holds them, and unit."""
    return unit(values.astype(np.float32).astype(float))


# The plugins against their formulas ----------------------------------------------------------------------------------

PHONGS = [
    {"exponent": n, "specular": 0.6, "normalised": form} for n in (0.5, 10.0, 500.0, 2e4) for form in (False, True)
]
FILMS = [{"alpha": a, "index": n, "distribution": kind} for kind in ("beckmann", "ggx") for a in (0.01, 0.03, 0.1)
         for n in (1.33, 1.36, 1.4)]  # fmt: skip
GRAZING = [[0, 0, 1], *([np.sin(t), 0, np.cos(t)] for t in np.radians([60, 80, 89, 89.9]))]
BELOW = [[[0, 0, -1], [0, 0, 1]], [[1, 0, 0], [0, 0, 1]], [[1, 0, 0], [-1, 0, 0]], [[0, 0, 1], [0, 0, -1]],
         [[0, 0, 1], [1, 0, 0]]]  # fmt: skip


def values_of(wi, wo, albedo, values):
    """Return the parts' f cos(theta) of directions above the surface."""
    if "alpha" in values:
        alpha, index, kind = values["alpha"], values["index"], values["distribution"]
        return film_value(wi, wo, alpha, index, kind), base_value(wi, wo, alpha, index, albedo)
    return phong_value(wi, wo, **values), albedo / np.pi * wo[:, 2]


@pytest.mark.parametrize("kind", ["phong", "tissue"])
def test_values_are_those_of_the_closed_form_part_by_part_and_zero_below(mi, kind):
    """A film within 1e-3, out to three alpha of slope, where Beckmann's lobe is down to 1e-4, and far from its mirror.

    In single precision the relative error of cos^n stays below 1e-4 within the lobe, even where n eps is 2e-3. Fine
    normals may face away from the camera or the light: directions below the surface.
    """
    for values in PHONGS if kind == "phong" else FILMS:
        alpha = values.get("alpha") or 1.5 / np.sqrt(values["exponent"])
        wi = np.vstack([upper(2000, 1), GRAZING])
        wo = about_mirror(wi, alpha, 2)
        around = unit(np.random.default_rng(4).normal(size=(2000, 3)))
        pairs = {"near": (wi, wo), "far": (wi, upper(len(wi), 3)), "any": (around, around[::-1])}
        bsdf = plugin(mi, kind, 0.7, **values)
        for name, pair in pairs.items():
            wi, wo = map(single, pair)
            lit = (wi[:, 2] > 0) & (wo[:, 2] > 0)
            half = unit(wi + wo)
            near = np.hypot(half[:, 0], half[:, 1]) < 3 * alpha * half[:, 2]
            lobe, base = (evaluate(mi, bsdf, wi, wo, component=part) for part in (0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                expected = values_of(wi, wo, 0.7, values)
            rtol = 1e-3 if kind == "tissue" else 1e-4
            where = lit & near if name == "near" else lit
            assert where.sum() > 400, name
            np.testing.assert_allclose(lobe[where], expected[0][where], rtol=rtol, atol=0 if name == "near" else 1e-6)
            np.testing.assert_allclose(base[lit], expected[1][lit], rtol=2e-5, atol=1e-9 if name == "near" else 1e-7)
            np.testing.assert_allclose(evaluate(mi, bsdf, wi, wo), lobe + base, rtol=1e-6)
            density = evaluate(mi, bsdf, wi, wo, "pdf")
            for part in (lobe, base, density):
                assert np.isfinite(part).all()
                assert (part[~lit] == 0).all()
            assert (density[lit] > 0).all()
        wi, wo = np.array(BELOW, dtype=float).transpose(1, 0, 2)
        assert not np.any([evaluate(mi, bsdf, wi, wo, method) for method in ("eval", "pdf")])


@pytest.mark.parametrize(
    ("kind", "values", "key"),
    [
        ("phong", {"exponent": 7.0, "specular": 0.6, "normalised": False}, "exponent"),
        ("phong", {"exponent": 7.0, "specular": 0.6, "normalised": False}, "specular"),
        ("tissue", {"alpha": 0.05, "index": 1.36, "distribution": "beckmann"}, "alpha"),
        ("tissue", {"alpha": 0.05, "index": 1.36, "distribution": "beckmann"}, "index"),
    ],
)
def test_derivatives_are_those_of_the_closed_form(mi, kind, values, key):
    """Also in the mirror direction itself, and where lanes lie below the surface or the lobe has ended: no NaN."""
    import drjit as dr

    wi = upper(2000, 10)
    wo = about_mirror(wi, 0.05 if kind == "tissue" else 0.5, 11)
    wi[:5], wo[:5], wo[5:10] = [0, 0, 1], [0, 0, 1], [0, 0, -1]
    wi, wo = single(wi), single(wo)
    lit = wo[:, 2] > 0
    bsdf = plugin(mi, kind, 0.7, **values)
    parameters = mi.traverse(bsdf)
    dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), interaction(mi, wi), lanes(mi, wo), True)[0]))
    step = 1e-5 * values[key]
    ends = [sum(map(np.sum, values_of(wi[lit], wo[lit], 0.7, {**values, key: values[key] + s}))) for s in (step, -step)]
    assert float(np.array(dr.grad(parameters[key])).item()) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-3)


@pytest.mark.parametrize(("component", "flag"), [(0, "GlossyReflection"), (1, "DiffuseReflection")])
@pytest.mark.parametrize("kind", ["phong", "tissue"])
def test_a_context_of_one_part_evaluates_and_samples_that_part(mi, kind, component, flag):
    if kind == "phong":
        bsdf = plugin(mi, kind, 0.4, exponent=100.0, specular=0.6)
        expected = [0.6 * 2 * np.pi / 101, 0.4][component]
    else:
        bsdf = plugin(mi, kind, 0.5, alpha=0.03, index=1.36)
        passed = diffuse_share(1.36) / 1.36**2
        below = (1 - fresnel(0.8, 1.36)) * (1 - 0.03 / 40) * 0.5 * passed / (1 - 0.5 * (1 - passed))
        expected = [film_albedo(0.8, 0.03, 1.36, "beckmann"), below][component]
    own = +getattr(mi.BSDFFlags, flag)
    assert bsdf.component_count() == 2
    assert bsdf.flags(component) == own | +mi.BSDFFlags.FrontSide
    sample, _, pdf, weight = drawn(mi, bsdf, np.array([0.6, 0.0, 0.8]), 3, 5000, component)
    assert (np.array(sample.sampled_component) == component).all()
    assert (np.array(sample.sampled_type) == int(own)).all()
    if kind == "phong":
        # Above the surface all samples weigh the same.
        np.testing.assert_allclose(weight[pdf > 0], expected, rtol=1e-4)
    else:
        assert weight.mean() == pytest.approx(expected, rel=3e-3)
    # By its kind as by its number.
    by_kind, wi, wo = mi.BSDFContext(), upper(500, 6), upper(500, 7)
    by_kind.type_mask = own
    found = np.array(bsdf.eval(by_kind, interaction(mi, wi), lanes(mi, wo), True), dtype=float).ravel()
    np.testing.assert_array_equal(found, evaluate(mi, bsdf, wi, wo, component=component))


def test_a_painted_albedo_takes_the_place_of_the_texture(mi):
    """A function of the surface point; the film's reflection stays as it was."""
    wi, wo = upper(500, 8), upper(500, 9)
    bsdf, darker = plugin(mi, "tissue", 0.5), plugin(mi, "tissue", 0.2)
    before = evaluate(mi, bsdf, wi, wo)
    bsdf.albedo_at = lambda si, active: mi.Spectrum(0.2)
    for method in ("eval", "pdf"):
        np.testing.assert_array_equal(evaluate(mi, bsdf, wi, wo, method), evaluate(mi, darker, wi, wo, method))
    bsdf.albedo_at = None
    np.testing.assert_array_equal(evaluate(mi, bsdf, wi, wo), before)


def test_an_unknown_distribution_or_no_variant_is_refused(mi):
    with pytest.raises(Exception, match="distribution = 'phong': unknown; allowed: beckmann, ggx"):
        plugin(mi, "tissue", 0.5, distribution="phong")
    code = "from simtest.rendering.plugins import register; register()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "no Mitsuba variant is set" in done.stderr.splitlines()[-1]


# Energy of the film --------------------------------------------------------------------------------------------------

INCIDENCE_DEG = (0, 10, 20, 30, 40, 45, 50, 55, 60, 64, 68, 72, 76, 80, 83, 86, 88, 89, 89.5, 89.9)


def film_albedo(cosine, alpha, index, kind, cells=64):
    """Directional albedo of the film's reflection: the mean over the facets, by quadrature over their slopes.

    With q the share of facets below a slope, D cos dw = dq dphi/(2 pi), and dwo = 4 (wi.h) dw.
    """
    x, w = gauss(cells)
    # q = 1 - v^2 smooths the tail of both distributions.
    v, w = (x + 1) / 2, w * (x + 1) / 2
    slope = alpha * (np.sqrt(-2 * np.log(v)) if kind == "beckmann" else np.sqrt(1 / v**2 - 1))
    phi = np.pi * (np.arange(cells) + 0.5) / cells
    h = unit(np.stack(np.broadcast_arrays(slope[:, None] * np.cos(phi), slope[:, None] * np.sin(phi), 1.0), axis=-1))
    wi = np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    facing = h @ wi
    wo = 2 * facing[..., None] * h - wi
    seen = (facing > 0) & (wo[..., 2] > 0)
    height = np.where(seen, wo[..., 2], 1.0)
    value = fresnel(np.clip(facing, 0, 1), index) * smith(cosine, alpha, kind) * smith(height, alpha, kind) * facing
    return float((w[:, None] * np.where(seen, value / (cosine * h[..., 2]), 0)).sum() / cells)


def whole_albedo(cosine, alpha, index, kind):
    """Directional albedo with a base of albedo 1, by quadrature."""
    x, w = gauss(200)
    mu = (x + 1) / 2
    wi = np.broadcast_to([np.sqrt(1 - cosine**2), 0.0, cosine], (200, 3))
    wo = np.column_stack([np.sqrt(1 - mu**2), 0 * mu, mu])
    base = float(np.sum(np.pi * w * base_value(wi, wo, alpha, index, 1.0)))
    return film_albedo(cosine, alpha, index, kind) + base


def test_no_direction_reflects_more_than_arrives():
    """Of the closed form, a base of albedo 1 included; and little is lost."""
    cosines = np.cos(np.radians(INCIDENCE_DEG))
    for kind in ("beckmann", "ggx"):
        for alpha in (0.01, 0.02, 0.03, 0.05, 0.07, 0.1):
            for index in (1.33, 1.36, 1.4):
                albedo = np.array([whole_albedo(cosine, alpha, index, kind) for cosine in cosines])
                assert albedo.max() <= 1, (kind, alpha, index)
                # Up to 60 deg; at grazing directions light that facets block is lost.
                assert albedo[:9].min() > 0.995, (kind, alpha, index)
        # Dry ground is rougher.
        for alpha in (0.15, 0.2, 0.3, 0.5):
            assert max(whole_albedo(cosine, alpha, 1.33, kind) for cosine in cosines) <= 1, (kind, alpha)
    # Why the plugin has a margin: the rough film reflects more than the smooth one at 60 deg.
    excess = film_albedo(0.5, 0.1, 1.33, "beckmann") - fresnel(0.5, 1.33)
    assert 1e-3 < excess < 0.1 / 40 * (1 - fresnel(0.5, 1.33))


@pytest.mark.parametrize(("alpha", "kind"), [(0.01, "beckmann"), (0.1, "beckmann"), (0.01, "ggx"), (0.1, "ggx")])
def test_samples_carry_the_albedo_and_bounded_weights(mi, alpha, kind):
    """Sampling gives the quadrature's albedo, at most 1; no sample weighs more than 2.5 times what arrives."""
    bsdf = plugin(mi, "tissue", 1.0, alpha=alpha, index=1.33, distribution=kind)
    for angle_deg in (0.0, 30.0, 60.0, 80.0, 88.0, 89.9):
        _, _, density, weight = drawn(mi, bsdf, incidence(angle_deg), 3, 20_000)
        assert np.isfinite(weight).all()
        assert (weight >= 0).all()
        assert weight.max() < 2.5
        assert (weight[density == 0] == 0).all()
        error = weight.std() / np.sqrt(len(weight))
        expected = whole_albedo(np.cos(np.radians(angle_deg)), alpha, 1.33, kind)
        assert abs(weight.mean() - expected) < 4 * error + 1e-4
        assert weight.mean() < 1 + 4 * error


# In Mitsuba's integrators --------------------------------------------------------------------------------------------

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb")

RENDERS = """
import json, sys
import numpy as np
from simtest.rendering import backend
mi = backend.load("llvm_ad_rgb")
mi.set_variant(sys.argv[1])
mi.set_log_level(mi.LogLevel.Error)
from simtest.rendering.plugins import register; register(); register()
colour = {"type": "rgb", "value": [0.4, 0.4, 0.4]}
T = mi.ScalarTransform4f
means = {}
for kind, bsdf in {
    "phong": {"type": "simtest_phong", "exponent": 12.0},
    "beckmann": {"type": "simtest_tissue", "alpha": 0.1, "index": 1.36, "distribution": "beckmann"},
    "ggx": {"type": "simtest_tissue", "alpha": 0.1, "index": 1.36, "distribution": "ggx"},
}.items():
    scene = mi.load_dict({
        "type": "scene",
        "floor": {"type": "rectangle", "bsdf": {**bsdf, "id": "lobe", "diffuse_reflectance": colour}},
        "lamp": {"type": "point", "position": [0.3, 0.0, 1.5], "intensity": {"type": "uniform", "value": 1.0}},
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": T().look_at([0.2, 0.1, 2], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
                   "sampler": {"type": "independent", "sample_count": 64}},
    })
    for name, integrator in {
        "direct": {"type": "direct"},
        "path": {"type": "path", "max_depth": 3},
        "prb": {"type": "prb", "max_depth": 3},
        "aov": {"type": "aov", "aovs": "n:sh_normal", "image": {"type": "path", "max_depth": 2}},
    }.items():
        if name == "prb" and sys.argv[1].startswith("scalar"):
            continue
        image = np.array(mi.render(scene, integrator=mi.load_dict(integrator), seed=1), dtype=float)
        means[kind + " " + name] = image.reshape(16, 16, -1)[:, :, 0].mean()
        if name == "aov":
            means["normal"] = image[:, :, -1].mean()
    if kind == "phong" and "scalar" not in sys.argv[1]:
        import drjit as dr
        parameters = mi.traverse(scene)
        key = next(k for k in parameters.keys() if k.endswith("exponent"))
        dr.enable_grad(parameters[key])
        parameters.update()
        prb = mi.load_dict({"type": "prb", "max_depth": 2})
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=prb, seed=1)))
        means["slope"] = float(np.array(dr.grad(parameters[key])).item())
        for step in (0.05, -0.05):
            parameters[key] = 12.0 + step
            parameters.update()
            image = mi.render(scene, integrator=mi.load_dict({"type": "direct"}), seed=1)
            change = np.array(image, dtype=float).mean() * np.sign(step) / 0.1
            means["difference"] = means.get("difference", 0.0) + change
print(json.dumps(means))
"""


@pytest.mark.slow
def test_all_integrators_and_variants_agree():
    """Direct, path, prb and a nested aov give one picture in colour, mono and scalar variants; prb its derivative."""
    found = {}
    for variant in VARIANTS:
        command = [sys.executable, "-W", "ignore", "-c", RENDERS, variant]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        found[variant] = json.loads(done.stdout.splitlines()[-1])
    reference = found["llvm_ad_mono"]
    for variant, means in found.items():
        assert means.pop("normal") == pytest.approx(1.0, abs=1e-5)
        if slope := means.pop("slope", 0.0):
            assert slope == pytest.approx(means.pop("difference"), rel=1e-2)
            assert slope < 0
        assert len(means) == (12 if "ad" in variant else 9)
        for name, mean in means.items():
            assert mean == pytest.approx(reference[f"{name.split()[0]} direct"], rel=5e-3), (variant, name)


# The width that is told ----------------------------------------------------------------------------------------------

FILM = {"index": 1.33, "alpha": 0.08}
PHONG, NORMALISED = ({"type": "phong", "exponent": 40.0, "normalised": form} for form in (False, True))
BECKMANN, GGX = ({"type": "tissue", "film": {**FILM, "distribution": kind}} for kind in ("beckmann", "ggx"))


def ggx(angle, alpha):
    return (1 + np.tan(angle) ** 2 / alpha**2) ** -2.0


WIDTHS = {
    "phong": (PHONG, lambda a: np.cos(2 * a) ** 40),
    "plastic": ({"type": "rough_plastic", "alpha": 0.2}, lambda a: ggx(a, 0.2)),
    "conductor": ({"type": "rough_conductor", "alpha": 0.2}, lambda a: ggx(a, 0.2)),
    "principled": ({"type": "principled", "roughness": 0.4}, lambda a: ggx(a, 0.16)),
    "film, GGX": (GGX, lambda a: ggx(a, 0.08)),
    "film, Beckmann": (BECKMANN, lambda a: np.exp(-(np.tan(a) ** 2) / 0.08**2)),
}
CURVATURES = {
    "phong": (PHONG, lambda a: np.cos(2 * a) ** 40),
    "normalised": (NORMALISED, lambda a: np.cos(2 * a) ** 40 * np.cos(a)),
    "film": (BECKMANN, lambda a: np.exp(-(np.tan(a) ** 2) / 0.08**2) / np.cos(a) ** 5),
}


def test_the_half_width_and_the_curvature_are_those_of_the_lobe():
    """Where it is half as high, and the second difference of its logarithm."""
    for name, (table, lobe) in WIDTHS.items():
        told = scene_from_dict({"surface": {"type": "plane"}, "reflectance": table}).reflectance
        assert lobe(told.half_width) == pytest.approx(0.5 * lobe(0.0), rel=1e-9), name
    step = 1e-3
    for name, (table, lobe) in CURVATURES.items():
        told = scene_from_dict({"surface": {"type": "plane"}, "reflectance": table}).reflectance
        second = np.log(lobe(step)) + np.log(lobe(-step)) - 2 * np.log(lobe(0.0))
        assert told.lobe_curvature == pytest.approx(-second / step**2, rel=1e-4), name


@pytest.mark.parametrize("kind", ["rough_conductor", "rough_plastic"])
def test_rendered_facets_have_the_lobe_of_their_alpha(kind):
    """Light at the camera, plane across the axis: D G / (4 cos) over the squared distance, facets met straight on."""
    tables = {"surface": {"type": "plane"}, "camera": {"width": 64, "height": 64, "fx": 80.0, "fy": 80.0}}
    reflectance = {"type": kind, "alpha": 0.2, "diffuse": 0.0}
    session = Session(scene_from_dict({**tables, "reflectance": reflectance}))
    y, x = np.mgrid[:64, :64] + 0.5
    cosine = 1 / np.sqrt(1 + ((x - 32) ** 2 + (y - 32) ** 2) / 80.0**2)
    for alpha in (0.2, 0.1, 0.3):
        # As built, and after updates.
        session.update(scene_from_dict({**tables, "reflectance": {**reflectance, "alpha": alpha}}))
        seen = session.radiance().specular.astype(float)
        expected = formulas.facets(cosine, alpha, "ggx") * smith(cosine, alpha, "ggx") ** 2 * cosine
        np.testing.assert_allclose(seen / seen.max(), expected / expected.max(), rtol=2e-4, atol=1e-6)


# Every reflectance of a scene ----------------------------------------------------------------------------------------

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


def scene(name, step=0):
    """Everything moves with the step: shape, lights and their profile, lens, colour, reflectance, seed."""
    colour = [COLOUR[0], COLOUR[1] + 0.1 * step, COLOUR[2]]
    profile = {"type": "cosine", "power": 1.0 + 0.5 * step}
    light = {"position_mm": [4.0, 1.0 + step, 0.0], "power": 1.0 + step, "profile": profile}
    lights = [{**light, "direction": [0.1 * step, 0.0, 1.0]}, {"power": 0.1}]
    return scene_from_dict(
        {
            "surface": {"type": "sphere", "distance_mm": 20.0, "radius_mm": 12.0 + step, "tilt_deg": 3.0 * step},
            "camera": {"width": 24, "height": 20, "fx": 24.0 + step, "fy": 24.0},
            "rig": {"lights": lights},
            "reflectance": {"type": name.split(",")[0], "colour": colour, **FORMS[name][step % 2]},
            "render": {"samples_per_pixel": 3, "seed": step},
        }
    )


@pytest.fixture(scope="module", params=FORMS)
def built(request):
    return request.param, Session(scene(request.param), "llvm_ad_rgb")


@pytest.fixture
def named(built):
    """A form and its session, as it was built: a test before may have moved it."""
    name, session = built
    session.update(scene(name))
    return name, session


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


def test_every_reflectance_of_the_scene_is_here_and_described_by_plain_data():
    assert {form.split(",")[0] for form in FORMS} == {
        spec.model_fields["type"].default for spec in get_args(get_args(Reflectance)[0])
    }
    for name in FORMS:
        reflectance = scene(name).reflectance
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
            shares = np.repeat([[c / COLOUR[0]] for c in COLOUR], lit.sum(), axis=1)
            np.testing.assert_allclose(ratio, shares, rtol=1e-4)
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


def test_samples_have_the_density_they_claim(named):
    """The mean of value / density over samples is the integral over the hemisphere."""
    name, session = named
    mi, wi = session.mi, np.array([np.sin(0.5), 0.0, np.cos(0.5)])
    bsdf = session._built.scene.shapes()[0].bsdf()
    sampled = drawn(mi, bsdf, wi, 0, 400_000)[3].mean(axis=1)
    # Midpoints over the hemisphere, fine enough for every lobe here.
    rows, columns = 800, 1600
    z, turn = np.meshgrid((np.arange(rows) + 0.5) / rows, 2 * np.pi * (np.arange(columns) + 0.5) / columns)
    side = np.sqrt(1 - z**2)
    wo = mi.Vector3f(*np.stack([side * np.cos(turn), side * np.sin(turn), z]).reshape(3, -1).astype(np.float32))
    value = bsdf.eval(mi.BSDFContext(), interaction(mi, wi, rows * columns), wo, True)
    whole = 2 * np.pi * np.array(value).mean(axis=1)
    np.testing.assert_allclose(sampled, whole, rtol=0.02)
    if name != "phong":
        assert whole.max() <= 1


def test_a_sweep_builds_once_compiles_once_and_gives_what_fresh_sessions_give(named):
    """Finite, never negative, and the lobe brightest at its highlight."""
    name, session = named
    session.frame()
    import drjit as dr  # after the backend has chosen its libLLVM

    swept = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for step in (1, 2, 3):
            session.update(scene(name, step))
            swept.append(session.frame().radiance)
        launched = dr.kernel_history((dr.KernelType.JIT,))
    assert session.rebuilds == 1
    assert len(launched) >= 6
    assert all(kernel["cache_hit"] for kernel in launched)
    fresh = Session(scene(name, 3), "llvm_ad_rgb").frame().radiance
    assert fresh.total.tobytes() != swept[0].total.tobytes()
    for part in ("specular", "diffuse", "indirect"):
        one, other = getattr(swept[-1], part), getattr(fresh, part)
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)
        assert np.isfinite(one).all()
        assert (one >= 0).all()
    lobe = fresh.specular.mean(axis=2)
    row, column = np.unravel_index(lobe.argmax(), lobe.shape)
    bp = session.highlights(swept[-1])[0].bp_px
    assert np.abs(bp - [column + 0.5, row + 0.5]).max() <= 1.0
