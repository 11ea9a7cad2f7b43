"""What is computed twice, in NumPy and in a kernel, is the same: relief, colour, light.

A colon's points are compared in test_surfaces, the misfit in test_highlight_search, instruments in test_instruments.
"""

import numpy as np
import pytest

from simtest.rendering import backend
from simtest.rendering.elements.lights import LightPose, factor, kind_of, parameters
from simtest.rendering.tissue_kernels import AlbedoKernel, ReliefKernel
from simtest.spec import load_scene
from simtest.spec.lights import LightSpec
from simtest.spec.reflectance import Patches, TissueColour
from simtest.spec.scene import scene_from_dict
from simtest.spec.surfaces import Relief
from simtest.surfaces import make_surface
from simtest.surfaces.relief_field import make_relief
from simtest.surfaces.tissue_pattern import make_pattern
from simtest.surfaces.vessels import surface_patch

pytestmark = pytest.mark.render

COUNT = 3000
TISSUES = ("tissue_colon", "tissue_stomach", "tissue_liver", "tissue_gallbladder")
KINDS = Relief.model_validate({
    "bands": [
        {"slope_deg": 4, "wavelength_mm": 1.5},
        {"slope_deg": 2, "wavelength_mm": 0.9, "kind": "ridged", "anisotropy": 2, "direction": [1, 2, 0]},
        {"slope_deg": 1.5, "wavelength_mm": 2.2, "kind": "pits"},
    ],
    "seed": 3,
})  # fmt: skip


@pytest.fixture(scope="module", params=["llvm_ad_mono", pytest.param("llvm_ad_rgb", marks=pytest.mark.ci)])
def mi(request):
    return backend.load(request.param)


def in_kernel(kind, values):
    """Points or vectors as lanes, and the single-precision numbers that they are there."""
    rounded = np.asarray(values, dtype=np.float32)
    return kind(np.ascontiguousarray(rounded.T)), rounded.astype(float)


@pytest.mark.parametrize("name", ["all kinds", *TISSUES])
def test_relief(mi, name):
    import drjit as dr

    spec = KINDS if name == "all kinds" else load_scene(name).surface.relief
    lanes, points = in_kernel(mi.Point3f, np.random.default_rng(9).uniform(-40, 40, (COUNT, 3)))
    for level, patches in ((None, None), (0.2, None), (-0.2, Patches(wavelength_mm=4.0, dry_level=-1.0))):
        field = make_relief(spec, level, patches)
        kernel = ReliefKernel(field)
        jets = kernel.jets(lanes, True, bent=True)
        dr.eval(jets.height, jets.gradient, jets.diffused, jets.hessian)
        if patches is not None:
            wet, pool = np.array(kernel.wet(jets.gain)), np.array(kernel.pool(jets))
            assert np.abs(wet - field.wet(points)).max() < 1e-4
            assert 0.1 < wet.mean() < 0.9
            above = field.tissue_jets(points).value - field.level - field.patch_jets(points).value
            clear = np.abs(above) > 1e-3 * field.deviation
            np.testing.assert_array_equal(pool[clear], (above < 0)[clear])
        exact, diffused, tissue = (
            field.jets(points),
            field.tissue_jets(points, diffused=True),
            field.tissue_jets(points),
        )
        # A place up to 70 mm from the origin is rounded by 5e-6 mm in the lattice.
        atol = 1e-5 if name == "all kinds" else 5e-6 * np.abs(exact.hessian).max()
        assert np.abs(np.array(jets.gradient).T - exact.gradient).max() < atol
        assert np.abs(np.array(jets.diffused).T - diffused.gradient).max() < atol
        assert np.abs(np.array(jets.height) - tissue.value).max() < 1e-4 * field.deviation
        six = exact.hessian[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T
        assert np.abs(np.array(jets.hessian) - six).max() < 1e-4 * np.abs(six).max()


COLOURED = {
    "plane": {"type": "plane", "distance_mm": 20.0},
    "sphere": {"type": "sphere", "radius_mm": 10.0, "side": "inside"},
    "colon": {"type": "anatomy", "path": "colon"},
}


@pytest.mark.parametrize(
    ("name", "preset"),
    [("plane", "colon_mucosa"), ("sphere", "stomach"), ("plane", "gallbladder"),
     pytest.param("sphere", "liver_capsule", marks=pytest.mark.ci),
     pytest.param("colon", "colon_mucosa", marks=pytest.mark.ci)],
)  # fmt: skip
def test_albedo(mi, name, preset):
    tables = {"surface": COLOURED[name], "camera": {"width": 8, "height": 8, "fx": 8.0, "fy": 8.0}}
    surface = make_surface(scene_from_dict(tables).surface)
    pattern = make_pattern(surface, TissueColour(preset=preset))
    drawn, _ = surface_patch(surface).draw(np.random.default_rng(2), COUNT)
    # Beyond the borders, too.
    drawn[::2] *= 3.0 if name == "plane" else 1.0
    lanes, points = in_kernel(mi.Point3f, drawn)
    found, expected = np.array(AlbedoKernel(pattern).at(lanes, mi.Bool(True))).T, pattern.albedo(points)
    if mi.variant().endswith("mono"):
        # Rec. 709 luminance
        expected = expected @ [[0.212671], [0.715160], [0.072169]]
    np.testing.assert_allclose(found, expected, atol=1e-5)


TABLE = {"type": "table", "angle_deg": [0.0, 10.0, 35.0, 70.0], "value": [1.0, 0.9, 0.3, 0.1]}
LIGHTS = {
    "isotropic": {},
    "cosine": {"profile": {"type": "cosine", "power": 1.0}, "direction": [0.2, -0.1, 1.0]},
    "narrow": {"profile": {"type": "cosine", "power": 300.0}, "direction": [-0.2, 0.3, 1.0]},
    "table": {"profile": TABLE},
    "spot": {"spot_deg": 70.0},
    "soft spot": {"spot_deg": 90.0, "soft_edge_deg": 20.0, "profile": TABLE, "direction": [0.0, 0.4, 1.0]},
}


def test_emission(mi):
    directions = np.random.default_rng(4).normal(size=(COUNT, 3))
    directions[::2, 2] = 2 * np.abs(directions[::2, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lanes, away = in_kernel(mi.Vector3f, directions)
    for name, table in LIGHTS.items():
        light = LightSpec(**table)
        values = parameters(light, LightPose(np.zeros(3), light.axis, light.across))
        found = np.broadcast_to(np.array(factor(kind_of(light), values, lanes)), COUNT)
        # Next to the rim of a spot single precision may decide otherwise.
        angle = np.degrees(np.arccos(np.clip(away @ light.axis, -1, 1)))
        apart = np.abs(angle - (light.spot_deg or 720.0) / 2) > 1e-4
        np.testing.assert_allclose(found[apart], light.factor(away)[apart], atol=1e-5, err_msg=name)
        assert apart.mean() > 0.99
