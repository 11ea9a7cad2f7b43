"""The tissue plugin as a BSDF: closed form, symmetry, energy, samples, derivatives, changed parameters, integrators."""

import json
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from scipy.special import erf

from simtest.rendering import backend, elements

pytestmark = pytest.mark.render

FILMS = [
    (alpha, index, kind) for kind in ("beckmann", "ggx") for alpha in (0.01, 0.03, 0.1) for index in (1.33, 1.36, 1.4)
]


@pytest.fixture(scope="module")
def mi():
    mi = backend.load()
    elements.register(mi.variant())
    return mi


def material(mi, alpha=0.03, index=1.36, distribution="beckmann", albedo=0.5):
    base = {"type": "uniform", "value": albedo}
    film = {"alpha": alpha, "index": index, "distribution": distribution}
    return mi.load_dict({"type": "simtest_tissue", **film, "diffuse_reflectance": base})


@cache
def gauss(count):
    """Nodes and weights over [-1, 1]."""
    return np.polynomial.legendre.leggauss(count)


# The closed form, in double precision and from the textbooks' dot products -----------------------------------------


def fresnel(cosine, index):
    """Unpolarised, by Snell's angles."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return (s**2 + p**2) / 2


def facets(cosine, alpha, kind):
    """D of Walter et al. 2007, eqs 25 and 33."""
    tangent = np.sqrt(np.clip(1 - cosine**2, 0, 1)) / cosine
    if kind == "beckmann":
        return np.exp(-((tangent / alpha) ** 2)) / (np.pi * alpha**2 * cosine**4)
    return alpha**2 / (np.pi * cosine**4 * (alpha**2 + tangent**2) ** 2)


def smith(cosine, alpha, kind):
    """G1 of Walter et al. 2007, eqs 26 and 34."""
    tangent = np.maximum(np.sqrt(np.clip(1 - cosine**2, 0, 1)) / cosine, 1e-12)
    if kind == "ggx":
        return 2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2))
    a = 1 / (alpha * tangent)
    return 2 / (1 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))


def film_value(wi, wo, alpha, index, kind):
    """F D G / (4 cos_i), of directions above the surface."""
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    facing = np.clip(np.sum(wi * half, axis=-1), 0, 1)
    d = facets(np.clip(half[..., 2], 1e-9, 1), alpha, kind)
    return (
        fresnel(facing, index) * d * smith(wi[..., 2], alpha, kind) * smith(wo[..., 2], alpha, kind) / (4 * wi[..., 2])
    )


def diffuse_share(index):
    """Share of diffuse light that passes the smooth film from outside, by quadrature."""
    x, w = gauss(200)
    mu = (x + 1) / 2
    return float(np.sum(w * mu * (1 - fresnel(mu, index))))


def base_value(wi, wo, alpha, index, albedo):
    passed = diffuse_share(index) / index**2
    through = (1 - fresnel(wi[..., 2], index)) * (1 - fresnel(wo[..., 2], index)) * (1 - alpha / 40)
    return through / index**2 * albedo / np.pi / (1 - albedo * (1 - passed)) * wo[..., 2]


# Directions ----------------------------------------------------------------------------------------------------------


def unit(values):
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def upper(count, seed):
    wi = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    wi[:, 2] = np.abs(wi[:, 2])
    return wi


def about_mirror(wi, alpha, spread, seed):
    """Directions mirrored at facets whose slopes are a few alpha."""
    rng = np.random.default_rng(seed)
    slopes = alpha * spread * rng.normal(size=(len(wi), 2))
    h = unit(np.column_stack([slopes, np.ones(len(wi))]))
    return 2 * np.sum(wi * h, axis=1, keepdims=True) * h - wi


def single(values):
    """Directions as single precision holds them, and unit."""
    return unit(values.astype(np.float32).astype(float))


def interaction(mi, wi):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.t = 1.0
    si.wi = mi.Vector3f(np.ascontiguousarray(wi.T, dtype=np.float32))
    return si


def evaluate(mi, bsdf, wi, wo, method="eval", component=None):
    context = mi.BSDFContext()
    if component is not None:
        context.component = component
    wo = mi.Vector3f(np.ascontiguousarray(wo.T, dtype=np.float32))
    return np.array(getattr(bsdf, method)(context, interaction(mi, wi), wo, True), dtype=float).ravel()


@pytest.mark.parametrize(("alpha", "index", "kind"), FILMS)
def test_values_are_those_of_the_closed_form(mi, alpha, index, kind):
    """Within 1e-3 over all angles, as far out as three alpha of slope, where Beckmann's lobe is down to 1e-4."""
    wi = np.vstack([upper(4000, 1), [[0, 0, 1]], [[np.sin(t), 0, np.cos(t)] for t in np.radians([60, 80, 89, 89.9])]])
    wo = about_mirror(wi, alpha, 1.0, 2)
    wi, wo = single(wi), single(wo)
    lit = (wo[:, 2] > 0) & (wi[:, 2] > 0)
    half = unit(wi + wo)
    near = lit & (np.hypot(half[:, 0], half[:, 1]) < 3 * alpha * half[:, 2])
    assert near.sum() > 3000
    bsdf = material(mi, alpha, index, kind, 0.7)
    film, base = (evaluate(mi, bsdf, wi, wo, component=part) for part in (0, 1))
    np.testing.assert_allclose(film[near], film_value(wi, wo, alpha, index, kind)[near], rtol=1e-3)
    np.testing.assert_allclose(base[lit], base_value(wi, wo, alpha, index, 0.7)[lit], rtol=2e-5, atol=1e-9)
    np.testing.assert_allclose(evaluate(mi, bsdf, wi, wo), film + base, rtol=1e-6)
    assert (film[~lit] == 0).all()
    assert (base[~lit] == 0).all()
    # Far from the mirror direction too, where GGX still shines.
    other = single(upper(len(wi), 3))
    far = film_value(wi, other, alpha, index, kind)
    np.testing.assert_allclose(evaluate(mi, bsdf, wi, other, component=0), far, rtol=1e-3, atol=1e-6)


def test_directions_below_the_surface_give_zero(mi):
    """As fine normals have them that face away from the camera or the light."""
    around = unit(np.random.default_rng(4).normal(size=(3000, 3)))
    wi = np.vstack([around, [[0, 0, -1], [1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]]])
    wo = np.vstack([around[::-1], [[0, 0, 1], [0, 0, 1], [-1, 0, 0], [0, 0, -1], [1, 0, 0]]])
    below = (wi[:, 2] <= 0) | (wo[:, 2] <= 0)
    for kind in ("beckmann", "ggx"):
        for method in ("eval", "pdf"):
            value = evaluate(mi, material(mi, 0.05, distribution=kind), wi, wo, method)
            assert np.isfinite(value).all()
            assert (value[below] == 0).all()
            assert (value[~below] > 0).all()


@pytest.mark.parametrize("kind", ["beckmann", "ggx"])
def test_reciprocity(mi, kind):
    wi = upper(4000, 5)
    wo = np.where(np.arange(4000)[:, None] % 2, about_mirror(wi, 0.1, 1.0, 6), upper(4000, 7))
    both = (wo[:, 2] > 0.01) & (wi[:, 2] > 0.01)
    wi, wo = wi[both], wo[both]
    bsdf = material(mi, 0.1, 1.4, kind)
    forth, back = evaluate(mi, bsdf, wi, wo) / wo[:, 2], evaluate(mi, bsdf, wo, wi) / wi[:, 2]
    np.testing.assert_allclose(forth, back, rtol=1e-4)


# Energy --------------------------------------------------------------------------------------------------------------

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


def test_without_the_margin_more_would_be_reflected():
    """Why the plugin has a margin: the rough film reflects more than the smooth one at 60 deg."""
    excess = film_albedo(0.5, 0.1, 1.33, "beckmann") - fresnel(0.5, 1.33)
    assert 1e-3 < excess < 0.1 / 40 * (1 - fresnel(0.5, 1.33))


def sampled(mi, bsdf, angle_deg, count=20_000, seed=3):
    """Directions, densities and weights of samples."""
    theta = np.radians(angle_deg)
    wi = np.tile([np.sin(theta), 0.0, np.cos(theta)], (count, 1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    sample, weight = bsdf.sample(mi.BSDFContext(), interaction(mi, wi), sampler.next_1d(), sampler.next_2d(), True)
    return tuple(np.array(part, dtype=float).squeeze() for part in (sample.wo, sample.pdf, weight))


@pytest.mark.parametrize(("alpha", "kind"), [(0.01, "beckmann"), (0.1, "beckmann"), (0.01, "ggx"), (0.1, "ggx")])
def test_samples_carry_the_albedo_and_bounded_weights(mi, alpha, kind):
    """Sampling gives the quadrature's albedo, at most 1; no sample weighs more than 2.5 times what arrives."""
    bsdf = material(mi, alpha, 1.33, kind, 1.0)
    for angle_deg in (0.0, 30.0, 60.0, 80.0, 88.0, 89.9):
        _, density, weight = sampled(mi, bsdf, angle_deg)
        assert np.isfinite(weight).all()
        assert (weight >= 0).all()
        assert weight.max() < 2.5
        assert (weight[density == 0] == 0).all()
        error = weight.std() / np.sqrt(len(weight))
        expected = whole_albedo(np.cos(np.radians(angle_deg)), alpha, 1.33, kind)
        assert abs(weight.mean() - expected) < 4 * error + 1e-4
        assert weight.mean() < 1 + 4 * error


def test_weights_are_value_over_density(mi):
    for alpha, index, kind in FILMS:
        bsdf = material(mi, alpha, index, kind, 0.6)
        for angle_deg in (0.0, 50.0, 85.0):
            wo, density, weight = sampled(mi, bsdf, angle_deg, 2000)
            theta = np.radians(angle_deg)
            wi = np.tile([np.sin(theta), 0.0, np.cos(theta)], (2000, 1))
            value, again = (evaluate(mi, bsdf, wi, wo.T, method) for method in ("eval", "pdf"))
            ok = density > 0
            assert ok.mean() > 0.3
            np.testing.assert_allclose(again, density, rtol=1e-5, atol=1e-12)
            np.testing.assert_allclose(weight[ok], value[ok] / density[ok], rtol=1e-5)


# As Mitsuba uses it --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("component", "flag"), [(0, "GlossyReflection"), (1, "DiffuseReflection")])
def test_a_context_of_one_part_samples_that_part(mi, component, flag):
    context = mi.BSDFContext()
    context.component = component
    bsdf = material(mi)
    assert bsdf.component_count() == 2
    assert bsdf.flags(component) == +getattr(mi.BSDFFlags, flag) | +mi.BSDFFlags.FrontSide
    wi = np.tile([0.6, 0.0, 0.8], (5000, 1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 5000)
    sample, weight = bsdf.sample(context, interaction(mi, wi), sampler.next_1d(), sampler.next_2d(), True)
    assert (np.array(sample.sampled_component) == component).all()
    assert (np.array(sample.sampled_type) == int(getattr(mi.BSDFFlags, flag))).all()
    expected = film_albedo(0.8, 0.03, 1.36, "beckmann") if component == 0 else None
    if expected is None:
        expected = (1 - fresnel(0.8, 1.36)) * (1 - 0.03 / 40) * 0.5 * diffuse_share(1.36) / 1.36**2
        expected /= 1 - 0.5 * (1 - diffuse_share(1.36) / 1.36**2)
    assert np.array(weight).mean() == pytest.approx(expected, rel=3e-3)


def test_a_painted_albedo_takes_the_place_of_the_texture(mi):
    """A function of the surface point; the film's reflection stays as it was."""
    wi, wo = upper(500, 8), upper(500, 9)
    bsdf, darker = material(mi, albedo=0.5), material(mi, albedo=0.2)
    bsdf.albedo_at = lambda si, active: mi.Spectrum(0.2)
    np.testing.assert_array_equal(evaluate(mi, bsdf, wi, wo), evaluate(mi, darker, wi, wo))
    np.testing.assert_array_equal(evaluate(mi, bsdf, wi, wo, "pdf"), evaluate(mi, darker, wi, wo, "pdf"))
    bsdf.albedo_at = None
    np.testing.assert_array_equal(evaluate(mi, bsdf, wi, wo), evaluate(mi, material(mi), wi, wo))


@pytest.mark.parametrize("key", ["alpha", "index"])
def test_derivatives_are_those_of_the_closed_form(mi, key):
    """Also where lanes lie below the surface: no NaN."""
    import drjit as dr

    wi = upper(2000, 10)
    wo = about_mirror(wi, 0.05, 1.0, 11)
    wi[:5], wo[5:10] = [0, 0, 1], [0, 0, -1]
    wi, wo = single(wi), single(wo)
    bsdf = material(mi, 0.05, 1.36, albedo=0.7)
    parameters = mi.traverse(bsdf)
    dr.enable_grad(parameters[key])
    parameters.update()
    out = mi.Vector3f(np.ascontiguousarray(wo.T, dtype=np.float32))
    dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), interaction(mi, wi), out, True)[0]))
    lit = wo[:, 2] > 0

    def total(alpha, index):
        return np.sum(film_value(wi, wo, alpha, index, "beckmann")[lit]) + np.sum(
            base_value(wi, wo, alpha, index, 0.7)[lit]
        )

    step = 1e-5
    at, steps = np.array([0.05, 1.36]), np.array([step, 0] if key == "alpha" else [0, step])
    slope = (total(*(at + steps)) - total(*(at - steps))) / (2 * step)
    assert float(np.array(dr.grad(parameters[key])).item()) == pytest.approx(slope, rel=1e-3)


def test_changed_parameters_compile_no_new_kernel(mi):
    import drjit as dr

    bsdf = material(mi, 0.05, 1.33)
    parameters = mi.traverse(bsdf)
    si = interaction(mi, np.tile([0.6, 0.0, 0.8], (64, 1)))
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for alpha, index in ((0.05, 1.33), (0.02, 1.36), (0.1, 1.4)):
            parameters["alpha"], parameters["index"] = alpha, index
            parameters.update()
            dr.kernel_history_clear()
            value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(-0.6, 0.0, 0.8), True)
            found = float(np.array(value).ravel()[0])
            kernels.append([k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT])
            wi, wo = np.array([[0.6, 0.0, 0.8]]), np.array([[-0.6, 0.0, 0.8]])
            expected = film_value(wi, wo, alpha, index, "beckmann") + base_value(wi, wo, alpha, index, 0.5)
            assert found == pytest.approx(float(expected[0]), rel=1e-4)
    assert kernels[0]
    assert kernels[1] == kernels[0] == kernels[2]


def test_an_unknown_distribution_is_refused(mi):
    with pytest.raises(Exception, match="distribution = 'phong': unknown; allowed: beckmann, ggx"):
        material(mi, distribution="phong")


VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb")

RENDERS = """
import json, sys
import numpy as np
from simtest.rendering import backend
mi = backend.load("llvm_ad_rgb")
mi.set_variant(sys.argv[1])
mi.set_log_level(mi.LogLevel.Error)
from simtest.rendering.plugins import register; register(); register()
T = mi.ScalarTransform4f
means = {}
for kind in ("beckmann", "ggx"):
    scene = mi.load_dict({
        "type": "scene",
        "floor": {"type": "rectangle", "bsdf": {"type": "simtest_tissue", "alpha": 0.1, "index": 1.36,
                  "distribution": kind, "diffuse_reflectance": {"type": "rgb", "value": [0.4, 0.4, 0.4]}}},
        "lamp": {"type": "point", "position": [0.3, 0.0, 1.5], "intensity": {"type": "uniform", "value": 1.0}},
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": T().look_at([0.2, 0.1, 2], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
                   "sampler": {"type": "independent", "sample_count": 64}},
    })
    for name in ("direct", "path"):
        image = np.array(mi.render(scene, integrator=mi.load_dict({"type": name}), seed=1), dtype=float)
        means[kind + " " + name] = image.reshape(16, 16, -1)[:, :, 0].mean()
print(json.dumps(means))
"""


@pytest.mark.slow
def test_all_integrators_and_variants_agree():
    found = {}
    for variant in VARIANTS:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", RENDERS, variant], capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        found[variant] = json.loads(done.stdout.splitlines()[-1])
    for means in found.values():
        for kind in ("beckmann", "ggx"):
            assert means[f"{kind} direct"] == pytest.approx(found["llvm_ad_mono"][f"{kind} path"], rel=5e-3)
            assert means[f"{kind} path"] == pytest.approx(found["llvm_ad_mono"][f"{kind} path"], rel=5e-3)
