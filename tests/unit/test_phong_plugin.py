"""The Phong plugin as a BSDF: symmetry, lobes one by one, derivatives, changed parameters, variants, integrators."""

import json
import subprocess
import sys

import numpy as np
import pytest

from simtest.rendering import backend, elements

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def mi():
    mi = backend.load()
    elements.register(mi.variant())
    return mi


def material(mi, exponent=50.0, specular=0.6, albedo=0.4, normalised=False):
    base = {"type": "uniform", "value": albedo}
    description = {"exponent": exponent, "specular": specular, "normalised": normalised, "diffuse_reflectance": base}
    return mi.load_dict({"type": "simtest_phong", **description})


def directions(count, seed):
    """Unit vectors over the whole sphere."""
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def near_mirror(wi, spread, seed):
    """Directions about the mirror direction of each."""
    wo = wi * [-1, -1, 1] + spread * directions(len(wi), seed)
    return wo / np.linalg.norm(wo, axis=1, keepdims=True)


def vectors(mi, values):
    return mi.Vector3f(np.ascontiguousarray(values.T, dtype=np.float32))


def evaluate(mi, bsdf, wi, wo, method="eval", context=None):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.t = 1.0
    si.wi = vectors(mi, wi)
    value = getattr(bsdf, method)(context or mi.BSDFContext(), si, vectors(mi, wo), True)
    parts = value if isinstance(value, tuple) else (value,)
    parts = [np.array(part, dtype=float).ravel() for part in parts]
    return parts if isinstance(value, tuple) else parts[0]


def upper(count, seed):
    wi = directions(count, seed)
    wi[:, 2] = np.abs(wi[:, 2])
    return wi


@pytest.mark.parametrize("exponent", [0.5, 10.0, 500.0, 20_000.0])
@pytest.mark.parametrize("normalised", [False, True])
def test_values_are_those_of_the_formula(mi, exponent, normalised):
    """In single precision the relative error of cos^n stays below 1e-4 within the lobe, even where n eps is 2e-3."""
    wi = upper(4000, 1)
    wo = near_mirror(wi, 3 / np.sqrt(exponent), 2)
    wi, wo = wi.astype(np.float32).astype(float), wo.astype(np.float32).astype(float)
    length = np.linalg.norm(wi, axis=1) * np.linalg.norm(wo, axis=1)
    cosine = np.clip(np.sum(wi * [-1, -1, 1] * wo, axis=1) / length, 0, 1)
    scale = (exponent + 2) / (2 * np.pi) * wo[:, 2] if normalised else 1.0
    expected = 0.6 * scale * cosine**exponent + 0.4 / np.pi * wo[:, 2]
    lit = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    value = evaluate(mi, material(mi, exponent, normalised=normalised), wi, wo)
    np.testing.assert_allclose(value[lit], expected[lit], rtol=1e-4)
    assert (value[~lit] == 0).all()
    assert lit.sum() > 2000


def test_reciprocity(mi):
    """The normalised f is symmetric; as published, f cos(theta) is: the radiance with light and camera exchanged."""
    wi, other = upper(4000, 3), upper(4000, 4)
    wo = np.where(np.arange(4000)[:, None] % 2, near_mirror(wi, 0.3, 5), other)
    both = wo[:, 2] > 0.01
    wi, wo = wi[both & (wi[:, 2] > 0.01)], wo[both & (wi[:, 2] > 0.01)]
    normalised = material(mi, 20.0, normalised=True)
    forth, back = evaluate(mi, normalised, wi, wo) / wo[:, 2], evaluate(mi, normalised, wo, wi) / wi[:, 2]
    np.testing.assert_allclose(forth, back, rtol=2e-5, atol=1e-9)
    published = material(mi, 20.0, specular=1.0, albedo=0.0)
    forth, back = evaluate(mi, published, wi, wo), evaluate(mi, published, wo, wi)
    np.testing.assert_allclose(forth, back, rtol=2e-5, atol=1e-9)
    assert np.abs(forth / wo[:, 2] - back / wi[:, 2]).max() > 0.1


def test_lobes_one_by_one_add_up(mi):
    wi, wo = upper(2000, 6), upper(2000, 7)
    bsdf = material(mi, 5.0)
    whole = evaluate(mi, bsdf, wi, wo)
    parts = []
    for index, kind in enumerate((mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection)):
        by_index, by_kind = mi.BSDFContext(), mi.BSDFContext()
        by_index.component = index
        by_kind.type_mask = +kind
        parts.append(evaluate(mi, bsdf, wi, wo, context=by_index))
        np.testing.assert_array_equal(parts[-1], evaluate(mi, bsdf, wi, wo, context=by_kind))
        density = evaluate(mi, bsdf, wi, wo, "pdf", by_index)
        expected = (3 / np.pi) * np.clip(np.sum(wi * [-1, -1, 1] * wo, axis=1), 0, 1) ** 5, wo[:, 2] / np.pi
        np.testing.assert_allclose(density, expected[index], rtol=1e-4, atol=1e-8)
        assert bsdf.component_count() == 2
        assert bsdf.flags(index) == +kind | +mi.BSDFFlags.FrontSide
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-6)
    value, density = evaluate(mi, bsdf, wi, wo, "eval_pdf")
    np.testing.assert_array_equal(value, whole)
    np.testing.assert_array_equal(density, evaluate(mi, bsdf, wi, wo, "pdf"))


@pytest.mark.parametrize(("component", "flag"), [(0, "GlossyReflection"), (1, "DiffuseReflection")])
def test_a_context_of_one_lobe_samples_that_lobe(mi, component, flag):
    import drjit as dr

    context = mi.BSDFContext()
    context.component = component
    si = dr.zeros(mi.SurfaceInteraction3f, 5000)
    si.t, si.wi = 1.0, mi.Vector3f(0.6, 0.0, 0.8)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 5000)
    bsdf = material(mi, 100.0)
    sample, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), True)
    assert (np.array(sample.sampled_component) == component).all()
    assert (np.array(sample.sampled_type) == int(getattr(mi.BSDFFlags, flag))).all()
    expected = [0.6 * 2 * np.pi / 101, 0.4][component]
    np.testing.assert_allclose(np.array(weight).ravel()[np.array(sample.pdf) > 0], expected, rtol=1e-4)


def test_derivatives_are_those_of_the_formula(mi):
    """Also where the lobe has ended: no NaN from log 0."""
    import drjit as dr

    wi, wo = upper(2000, 8), directions(2000, 9)
    wi[0] = wo[0] = [0.0, 0.0, 1.0]  # exactly the mirror direction
    bsdf = material(mi, 7.0)
    parameters = mi.traverse(bsdf)
    for key in ("exponent", "specular"):
        dr.enable_grad(parameters[key])
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.t, si.wi = 1.0, vectors(mi, wi)
    cosine = np.clip(np.sum(wi * [-1, -1, 1] * wo, axis=1), 0, 1) * (wo[:, 2] > 0)
    value = dr.sum(bsdf.eval(mi.BSDFContext(), si, vectors(mi, wo), True)[0])
    dr.backward(value)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(cosine > 0, 0.6 * cosine**7 * np.log(cosine), 0).sum()
    gradients = {key: float(np.array(dr.grad(parameters[key])).item()) for key in ("exponent", "specular")}
    assert gradients["exponent"] == pytest.approx(slope, rel=1e-4)
    assert gradients["specular"] == pytest.approx((cosine**7).sum(), rel=1e-4)


def test_changed_parameters_compile_no_new_kernel(mi):
    import drjit as dr

    bsdf = material(mi, 31.0)
    parameters = mi.traverse(bsdf)
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.t, si.wi = 1.0, mi.Vector3f(0.6, 0.0, 0.8)
    kernels, values = [], []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for exponent, specular in ((31.0, 0.5), (32.0, 0.25), (500.0, 0.125)):
            parameters["exponent"], parameters["specular"] = exponent, specular
            parameters.update()
            dr.kernel_history_clear()
            value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(-0.6, 0.0, 0.8), True)
            values.append(float(np.array(value).ravel()[0]))
            kernels.append([k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT])
    assert kernels[0]
    assert kernels[1] == kernels[0] == kernels[2]
    np.testing.assert_allclose(values, np.array([0.5, 0.25, 0.125]) + 0.4 / np.pi * 0.8, rtol=1e-5)


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
scene = mi.load_dict({
    "type": "scene",
    "floor": {"type": "rectangle", "bsdf": {"type": "simtest_phong", "id": "lobe", "exponent": 12.0,
              "diffuse_reflectance": colour}},
    "lamp": {"type": "point", "position": [0.3, 0.0, 1.5], "intensity": {"type": "uniform", "value": 1.0}},
    "sensor": {"type": "perspective", "fov": 40.0, "to_world": T().look_at([0.2, 0.1, 2], [0, 0, 0], [0, 1, 0]),
               "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
               "sampler": {"type": "independent", "sample_count": 64}},
})
means = {}
for name, integrator in {
    "direct": {"type": "direct"},
    "path": {"type": "path", "max_depth": 3},
    "prb": {"type": "prb", "max_depth": 3},
    "aov": {"type": "aov", "aovs": "n:sh_normal", "image": {"type": "path", "max_depth": 2}},
}.items():
    if name == "prb" and sys.argv[1].startswith("scalar"):
        continue
    image = np.array(mi.render(scene, integrator=mi.load_dict(integrator), seed=1), dtype=float)
    means[name] = image.reshape(16, 16, -1)[:, :, 0].mean()
    if name == "aov":
        means["normal"] = image[:, :, -1].mean()
if "scalar" not in sys.argv[1]:
    import drjit as dr
    parameters = mi.traverse(scene)
    key = next(k for k in parameters.keys() if k.endswith("exponent"))
    dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.mean(mi.render(scene, parameters, integrator=mi.load_dict({"type": "prb", "max_depth": 2}), seed=1)))
    means["slope"] = float(np.array(dr.grad(parameters[key])).item())
    for step in (0.05, -0.05):
        parameters[key] = 12.0 + step
        parameters.update()
        image = mi.render(scene, integrator=mi.load_dict({"type": "direct"}), seed=1)
        means["difference"] = means.get("difference", 0.0) + np.array(image, dtype=float).mean() * np.sign(step) / 0.1
print(json.dumps(means))
"""


@pytest.mark.slow
def test_all_integrators_and_variants_agree():
    """Direct, path, prb and a nested aov give one picture in colour, mono and scalar variants; prb its derivative."""
    found = {}
    for variant in VARIANTS:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", RENDERS, variant], capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        found[variant] = json.loads(done.stdout.splitlines()[-1])
    reference = found["llvm_ad_mono"]
    for variant, means in found.items():
        assert means["normal"] == pytest.approx(1.0, abs=1e-5)
        for name in {"direct", "path", "prb", "aov"} & set(means):
            assert means[name] == pytest.approx(reference["direct"], rel=5e-3), (variant, name)
        if "slope" in means:
            assert means["slope"] == pytest.approx(means["difference"], rel=1e-2)
            assert means["slope"] < 0


def test_registering_without_a_variant_is_refused():
    code = "from simtest.rendering.plugins import register; register()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "no Mitsuba variant is set" in done.stderr.splitlines()[-1]
