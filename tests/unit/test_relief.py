"""The relief: its told statistics, film and diffuse light; its normals on all surfaces stand in test_surfaces."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from surface_helpers import RELIEF, STENCIL, curvatures, derivative, gradient, normals, relative

from simtest.rendering import Session
from simtest.spec import scene_from_dict
from simtest.spec.reflectance import Patches
from simtest.spec.surfaces import MAX_HEIGHT_MM, Relief
from simtest.surfaces import forget_meshes
from simtest.surfaces.jets import Jet
from simtest.surfaces.relief_field import NODES, make_relief, normal_derivative
from tests.example_counts import examples
from tests.marked import marked

MESH = Path(__file__).resolve().parents[2] / "meshes" / "colon_40mm.ply"

BAND = {"slope_deg": 4.0, "wavelength_mm": 1.5}


def scene(surface, relief):
    camera = {"width": 64, "height": 48, "fx": 50, "fy": 50}
    return scene_from_dict({"surface": {**surface, "relief": relief}, "camera": camera})


def make(level=None, seed=0, **values):
    """Return the field of one band."""
    return make_relief(Relief(bands=({**BAND, **values},), seed=seed), level)


@pytest.mark.filterwarnings("ignore:.*inside out")
def test_on_a_users_mesh_the_base_is_its_interpolated_normal_and_operator():
    """Differences over the quadric of the base's normal and shape operator at each point."""
    session = Session(scene({"type": "anatomy", "path": str(MESH)}, RELIEF))
    pixels = np.random.default_rng(5).uniform([4, 4], [60, 44], (900, 2))
    origins, directions = session.sightlines.in_model(pixels)
    hits = session.exact_hits(origins, directions)
    base = session.surface.points(origins, directions, hits)
    fine = session.surface.fine_points(origins, directions, hits)
    keep = np.flatnonzero(base.valid)
    assert len(keep) >= 200
    P, N = base.position[keep], base.normal[keep]
    u, v = base.direction_max[keep], base.direction_min[keep]
    ku, kv, relief = base.k_max[keep, None], base.k_min[keep, None], session.surface.relief

    def at(a, b):
        return P + a * u + b * v - (ku * a**2 + kv * b**2) / 2 * N

    def fine_normal(a, b, step=1e-4):
        J = np.stack([u - ku * a * N, v - kv * b * N], axis=2)
        steps = [[at(a + k * step * i, b + k * step * (1 - i)) for k, _ in STENCIL] for i in (1, 0)]
        weights = [w / step for _, w in STENCIL]
        dh = np.stack([np.dot(weights, [relief.jets(x).value for x in points]) for points in steps], axis=1)
        return J, normals(J, dh, -N)[1]

    J, normal = fine_normal(0.0, 0.0)
    assert np.linalg.norm(normal - fine.normal[keep], axis=1).max() < 1e-6
    step = 2e-4
    dn = np.stack(
        [sum(w / step * fine_normal(k * step * i, k * step * (1 - i))[1] for k, w in STENCIL) for i in (1, 0)], axis=2
    )
    found = np.stack([fine.k_min, fine.k_max], axis=1)[keep]
    assert relative(curvatures(J, normal, dn), found).max() < 1e-4


# What is told ----------------------------------------------------------------------------------------------------


def plane_heights(field, normal, along, count=40_000, seed=1):
    """Return first and second differences along `along` and across it, at random points of a wide plane."""
    rng = np.random.default_rng(seed)
    normal = np.array(normal, float) / np.linalg.norm(normal)
    x = np.array(along, float) / np.linalg.norm(along)
    y = np.cross(normal, x)
    u, v = rng.uniform(-400, 400, (2, count))
    P = 3.1 * normal + u[:, None] * x + v[:, None] * y
    e, h0 = 1e-3, field.jets(P).value
    first, second = [], []
    for axis in (x, y):
        plus, minus = field.jets(P + e * axis).value, field.jets(P - e * axis).value
        first.append((plus - minus) / (2 * e))
        second.append((plus - 2 * h0 + minus) / e**2)
    return h0, first, second


@pytest.mark.parametrize(
    ("width", "kind"),
    marked(
        product([0.05, 0.25, 0.5], ["gaussian", "ridged", "pits"]),
        ci=[(0.05, "gaussian"), (0.05, "pits"), (0.25, "gaussian"), (0.25, "ridged"), (0.5, "ridged"), (0.5, "pits")],
    ),
)
def test_slope_wavelength_and_height(kind, width):
    field = make(kind=kind, width=width)
    h, (hx, hy), (hxx, hyy) = plane_heights(field, [1, 2, 3], [3, 0, -1])
    for slope in (hx, hy):
        # One realisation holds some 4,000 independent waves, fewer pits.
        assert np.degrees(slope.std()) == pytest.approx(4.0, rel=0.05)
    wavelength = 2 * np.pi * np.sqrt(np.mean(hx**2 + hy**2) / np.mean((hxx + hyy) ** 2))
    assert wavelength == pytest.approx(1.5, rel=0.03)
    assert field.deviation == pytest.approx(h.std(), rel=0.03)
    assert abs(h.mean()) < 0.05 * h.std()


@pytest.mark.slow
def test_theory_table_of_heights():
    """theory.md section 7: 6 deg at 1.5 mm is 35 micrometres high, 6 deg at 3 mm 70, of a narrow band."""
    for slope, wavelength, micrometres in ((2, 1.5, 12), (4, 1.5, 23), (6, 1.5, 35), (6, 3.0, 70)):
        field = make(slope_deg=slope, wavelength_mm=wavelength, width=0.05)
        assert 1e3 * field.deviation == pytest.approx(micrometres, rel=0.2)


@pytest.mark.parametrize("anisotropy", [2.0, pytest.param(5.0, marks=pytest.mark.ci)])
def test_anisotropy_draws_waves_out_along_the_direction(anisotropy):
    field = make(anisotropy=anisotropy, direction=(0.0, 2.0, 1.0))
    _, (along, across), (along_2, across_2) = plane_heights(field, [1, 0, 0], [0, 2, 1])
    assert np.degrees(across.std()) == pytest.approx(4.0, rel=0.04)
    assert across.std() / along.std() == pytest.approx(anisotropy, rel=0.05)
    waves = [first.std() / second.std() for first, second in ((along, along_2), (across, across_2))]
    assert waves[0] / waves[1] == pytest.approx(anisotropy, rel=0.05)


@pytest.mark.slow
def test_gaussian_relief_is_gaussian_and_the_other_kinds_are_not():
    for kind, low, high in (("gaussian", -0.1, 0.1), ("ridged", -3, -0.5), ("pits", -8, -1)):
        h = plane_heights(make(kind=kind), [0, 0, 1], [1, 0, 0])[0]
        skewness = np.mean(((h - h.mean()) / h.std()) ** 3)
        assert low < skewness < high, kind


def test_stationary_on_a_sphere():
    field, rng = make(), np.random.default_rng(4)
    points = rng.standard_normal((60_000, 3))
    normal = points / np.linalg.norm(points, axis=1, keepdims=True)
    g = field.jets(60 * normal).gradient
    g -= normal * np.sum(g * normal, axis=1, keepdims=True)
    square = np.sum(g**2, axis=1) / 2
    # Octants of the sphere
    octant = (normal > 0) @ [1, 2, 4]
    slopes = [np.degrees(np.sqrt(square[octant == i].mean())) for i in range(8)]
    assert np.allclose(slopes, 4.0, rtol=0.06)


def test_seamless_around_a_tube_and_across_the_lattices_borders():
    field = make()
    angle = np.linspace(np.pi - 1e-3, np.pi + 1e-3, 2001)
    around = 25 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    line = np.linspace(0, 80, 400_001)[:, None] * np.array([1.0, 0.3, 0.2]) / np.linalg.norm([1.0, 0.3, 0.2])
    for path in (around, line):
        jets, step = field.jets(path), np.linalg.norm(np.diff(path, axis=0), axis=1)
        steepest = np.linalg.norm(jets.gradient, axis=1).max()
        assert (np.abs(np.diff(jets.value)) <= steepest * step * 1.01 + 1e-15).all()
        bent = np.abs(np.linalg.eigvalsh(jets.hessian)).max()
        assert (np.linalg.norm(np.diff(jets.gradient, axis=0), axis=1) <= bent * step * 1.01 + 1e-14).all()


def test_seeds_and_bands_differ_and_repeat():
    points = np.random.default_rng(0).uniform(-50, 50, (20_000, 3))
    height = make(seed=1).jets(points).value
    forget_meshes()
    assert np.array_equal(make(seed=1).jets(points).value, height)
    other = make(seed=2).jets(points).value
    assert abs(np.corrcoef(height, other)[0, 1]) < 0.05
    two = make_relief(Relief(bands=(BAND, BAND), seed=1))
    first, second = (band.jets(points).value for band in two.bands)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.05
    # Another level is the same field.
    assert np.array_equal(make(seed=1, level=0.0).tissue_jets(points).value, height)


def test_reliefs_of_one_seed_differ_in_scale_alone():
    """One is made from the other's kept noise; made from nothing it has the same bytes."""
    points = np.random.default_rng(0).uniform(-20, 20, (2000, 3))

    def relief(slope, wave):
        return make_relief(Relief(bands=({"slope_deg": slope, "wavelength_mm": wave},), seed=5))

    forget_meshes()
    one, other = relief(2.0, 1.5), relief(3.0, 3.0)
    # Twice the wavelength and 1.5 times the slope are three times the height.
    assert other.jets(2 * points).value == pytest.approx(3 * one.jets(points).value, rel=1e-9, abs=1e-12)
    forget_meshes()
    assert np.array_equal(relief(3.0, 3.0).jets(points).value, other.jets(points).value)


@pytest.mark.slow
def test_heights_stay_below_the_limit():
    """The steepest relief that is allowed: hardly a point exceeds the limit, and some come near."""
    for kind, width in (("gaussian", 0.5), ("ridged", 0.25), ("pits", 0.25)):
        for slope in np.arange(12.0, 0.0, -0.1):
            try:
                field = make(kind=kind, width=width, slope_deg=slope, wavelength_mm=2.0)
            except ValueError:
                continue
            break
        h = np.abs(plane_heights(field, [0, 0, 1], [1, 0, 0])[0])
        assert np.mean(h > MAX_HEIGHT_MM) < 0.005, (kind, width)
        assert np.mean(h > 0.8 * MAX_HEIGHT_MM) > 0.001, (kind, width)


# Film and diffuse light ------------------------------------------------------------------------------------------


@given(
    height=st.floats(-0.2, 0.2),
    level=st.floats(-1.5, 1.5),
    gradient=st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
)
@settings(max_examples=examples(60), deadline=None)
def test_film_fills_valleys_smoothly(height, level, gradient):
    field = make(level=0.0)
    field = replace(field, level=level * field.deviation)
    G = np.array([gradient])
    jets = Jet(np.array([height]), G, np.zeros((1, 3, 3)))
    filled = field.fill(jets)
    surface = max(height, field.level)
    assert surface - 1e-15 <= filled.value[0] <= surface + np.log(2) * field.meniscus + 1e-15

    def near(k):
        return field.fill(Jet(jets.value + k, *jets.parts[1:]))

    # phi' from differences of phi, and phi'' from those of phi'
    share, bend = (derivative(lambda k, n=n: near(k).parts[n], 1e-6) for n in (0, 1))
    assert np.allclose(filled.gradient, share[:, None] * G, atol=1e-8)
    assert np.allclose(filled.hessian[0], np.outer(bend[0], G[0]), atol=1e-5 * (1 + np.abs(filled.hessian).max()))


PATCHES = Patches(wavelength_mm=4.0, amplitude=1.5, dry_level=-0.5)


def test_patches_are_a_smooth_level_of_the_given_deviation_and_wavelength():
    spec = Relief(bands=(BAND,), seed=2)
    field, plain = make_relief(spec, -0.2, PATCHES), make_relief(spec, -0.2)
    np.testing.assert_array_equal(field.bands[0].coefficients, plain.bands[0].coefficients)
    x = np.random.default_rng(8).uniform(-150, 150, (20_000, 3))
    gain, tissue = field.patch_jets(x), field.tissue_jets(x)
    assert gain.value.std() == pytest.approx(1.5 * field.deviation, rel=0.06)
    assert abs(gain.value.mean()) < 0.15 * field.deviation
    # Another draw than the relief's own
    assert abs(np.corrcoef(gain.value, tissue.value)[0, 1]) < 0.05
    slope, bend = gain.gradient[:, :2], gain.hessian[:, 0, 0] + gain.hessian[:, 1, 1]
    wave = 2 * np.pi * np.sqrt((slope**2).sum(axis=1).mean() / (bend**2).mean())
    assert wave == pytest.approx(4.0, rel=0.06)
    # Dry where the level is below its limit, and half dry there
    level = -0.2 * field.deviation + gain.value
    np.testing.assert_array_equal(field.wet(x) < 0.5, level < -0.5 * field.deviation)
    assert (field.wet(x) < 0.5).mean() == pytest.approx(norm.cdf(-0.3 / 1.5), abs=0.05)
    # Pools lie up to the local level: the surface is that of the tissue above it, and the level's below.
    filled = field.jets(x).value
    highest = np.maximum(tissue.value, level)
    assert (filled >= highest - 1e-15).all()
    assert (filled <= highest + np.log(2) * field.meniscus + 1e-15).all()


def test_the_longest_patches_are_no_higher_than_asked_for():
    field = make_relief(Relief(bands=(BAND,), seed=2), -0.2, Patches(wavelength_mm=20.0, amplitude=1.5))
    level = field.patch_jets(np.random.default_rng(8).uniform(-800, 800, (20_000, 3))).value
    assert level.std() == pytest.approx(1.5 * field.deviation, rel=0.06)


def test_the_surface_of_patches_has_the_derivatives_of_its_height():
    field = make_relief(Relief(bands=(BAND,), seed=2), -0.2, PATCHES)
    x = np.random.default_rng(9).uniform(-20, 20, (400, 3))
    jets = field.jets(x)
    assert np.abs(gradient(lambda p: field.jets(p).value, x, 1e-4) - jets.gradient).max() < 1e-7
    bent = gradient(lambda p: field.jets(p).gradient, x, 1e-4)
    assert np.abs(bent - jets.hessian).max() < 1e-4 * np.abs(jets.hessian).max()


def test_diffuse_light_sees_the_field_smoothed_in_space():
    """Against Gauss-Hermite quadrature of the convolution."""
    field = make_relief(Relief(bands=({"slope_deg": 4, "wavelength_mm": 3.0},), diffusion_mm=0.5))
    points = np.random.default_rng(3).uniform(-30, 30, (25, 3))
    x, w = np.polynomial.hermite_e.hermegauss(9)
    offsets = 0.5 * np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = (w[:, None, None] * w[:, None] * w).ravel() / (2 * np.pi) ** 1.5
    around = field.jets((points[:, None] + offsets).reshape(-1, 3))
    expected = np.einsum("nqi,q->ni", around.gradient.reshape(25, -1, 3), weights)
    found = field.tissue_jets(points, diffused=True).gradient
    assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max()
    assert np.linalg.norm(found) < 0.8 * np.linalg.norm(field.jets(points).gradient)


def test_short_waves_are_not_seen_by_diffuse_light_and_long_ones_are():
    spec = Relief(bands=({"slope_deg": 4, "wavelength_mm": 0.5}, {"slope_deg": 1, "wavelength_mm": 12.0}))
    short, long = make_relief(spec).bands
    assert not short.is_seen_diffusely
    assert long.is_seen_diffusely


# The kernel ------------------------------------------------------------------------------------------------------


def test_the_kernel_finds_the_lattices_nodes():
    """In single precision, at whole numbers of cells far from the origin too."""
    session = Session(scene({"type": "plane"}, RELIEF))
    import drjit as dr

    from simtest.rendering.tissue_kernels import _modulo

    cells = np.arange(-200_000, 200_000)
    given_cells = session.mi.Float(cells.astype(np.float32))
    dr.make_opaque(given_cells)
    assert np.array_equal(np.array(_modulo(given_cells)), np.mod(cells, NODES))


def test_rendered_shading_follows_the_fine_normal():
    """A frame of a rough plane: Phong's lobe at the exact fine normals, light at the camera."""
    rough = scene({"type": "plane", "distance_mm": 20}, {"bands": [BAND]})
    session = Session(rough)
    truth, radiance = session.truth(), session.radiance().specular.reshape(48, 64, -1)[..., 0]
    view = truth.position / truth.depth[..., None]
    # Light at the camera: the mirror direction is 2 beta off the view, published Phong cos^n of it over d^2.
    cosine = -np.sum(view * truth.normal, axis=-1)
    expected = np.maximum(2 * cosine**2 - 1, 0) ** rough.reflectance.exponent / truth.depth**2
    assert np.abs(radiance / expected.max() - expected / expected.max()).max() < 1e-3


# Formulas --------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3))
def test_fine_normals_are_unit_and_see_the_tangent_gradient_only(direction, gradient):
    N = np.array([direction])
    if np.linalg.norm(N) < 1e-3:
        N = np.array([[0.0, 0.0, 1.0]])
    N /= np.linalg.norm(N)
    G, flat = np.array([gradient]), np.zeros((1, 3, 3))
    found, other = (normal_derivative(N, flat, Jet(np.zeros(1), g, flat))[0] for g in (G, G + 0.7 * N))
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert np.allclose(found, other, atol=1e-12)
    # Its slope against the base is the gradient's length along the surface.
    along = G - N * np.sum(G * N)
    assert np.arccos(np.clip(np.sum(found * N), -1, 1)) == pytest.approx(np.arctan(np.linalg.norm(along)), abs=1e-7)
