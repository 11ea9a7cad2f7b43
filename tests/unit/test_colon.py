"""The generated colon: derivatives against finite differences, its mesh, polyps and recipe.

Its points, normals and curvatures stand in test_surfaces.
"""

from pathlib import Path

import numpy as np
import pytest
from surface_helpers import SECOND_STENCIL, derivative, hits_on, interpolated_normals

from simtest.errors import InputError
from simtest.geometry.vectors import unit
from simtest.surfaces.colon import build
from simtest.surfaces.jets import Jet
from simtest.surfaces.model import RayHits
from simtest.surfaces.poses import at_viewpoint
from simtest.surfaces.recipe import ColonRecipe, LiverRecipe, Polyp, load_recipe
from simtest.surfaces.triangles import off_between
from simtest.surfaces.tube import Stalk, Tube
from tests.marked import marked

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = load_recipe(ROOT / "meshes" / "colon.toml")
LOBE = "[[lobes]]\ncentre_mm = [0, 0, 0]\nsemi_axes_mm = [50, 40, %d]"
STEP = 2e-3  # of the finite differences: truncation ~ h^4, rounding ~ eps / h^2


POLYPS = (
    Polyp(along_mm=40, around_deg=80, height_mm=5, width_mm=9),
    Polyp(along_mm=70, around_deg=-100, height_mm=3, width_mm=5),
)
STALKED = (
    Polyp(along_mm=60, around_deg=80, height_mm=8, width_mm=6, neck_mm=2.4),
    Polyp(along_mm=35, around_deg=-60, height_mm=7, width_mm=5, neck_mm=3),
)
MORE = {
    "shipped": {},
    "polyps and relief": {"polyps": POLYPS, "relief_mm": 0.01, "relief_length_mm": 5.0},
    "pedunculated": {"polyps": (*STALKED, POLYPS[1])},
}
HAUSTRA = {"fold_stagger": 0.33, "taenia_ridge_mm": 1.5, "crease_mm": 0.5, "polyp_count": 6, "polyp_stalked": 0.0}
ALL = {**MORE, "haustra": HAUSTRA}


def make_colon(recipe, viewpoint):
    return at_viewpoint(build(recipe), recipe.type, viewpoint)


@pytest.fixture(scope="module", params=list(MORE))
def recipe(request) -> ColonRecipe:
    assert isinstance(SHIPPED, ColonRecipe)
    return SHIPPED.model_copy(update=ALL[request.param])


@pytest.mark.parametrize("recipe", marked(ALL, ci=["pedunculated"]), indirect=True)
def test_partial_derivatives_match_finite_differences(recipe):
    tube = build(recipe).tube
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, recipe.length_mm, 3000), rng.uniform(-4, 8, 3000)
    jet, step_v = tube.jet(u, v), STEP / 20
    found = {
        "u": (jet.gradient[..., 0], derivative(lambda h: tube.jet(u + h, v).value, STEP), 2e-9),
        "v": (jet.gradient[..., 1], derivative(lambda h: tube.jet(u, v + h).value, step_v), 1e-7),
        "uu": (jet.hessian[..., 0, 0], derivative(lambda h: tube.jet(u + h, v).value, STEP, SECOND_STENCIL, 2), 2e-6),
        "uv": (jet.hessian[..., 0, 1], derivative(lambda h: tube.jet(u, v + h).gradient[..., 0], step_v), 1e-7),
        # rounding: 1e-14 * 100 mm / step^2
        "vv": (jet.hessian[..., 1, 1], derivative(lambda h: tube.jet(u, v + h).value, step_v, SECOND_STENCIL, 2), 3e-3),
    }
    for name, (exact, differences, atol) in found.items():
        np.testing.assert_allclose(exact, differences, atol=atol, err_msg=name)
    # The first derivatives alone are the same.
    whole, first = tube.radius(u, v), tube.radius(u, v, second=False)
    assert len(first.parts) == 2
    np.testing.assert_array_equal(whole.value, first.value)
    np.testing.assert_array_equal(whole.gradient, first.gradient)


def test_a_closed_tube_goes_on_beyond_its_ends_and_has_no_way_out():
    """Also beside a pedunculated polyp and a sessile one that reaches into the end."""
    polyps = (STALKED[0], Polyp(along_mm=113, around_deg=10, height_mm=4, width_mm=6))
    recipe = SHIPPED.model_copy(update={"closed": True, "polyps": polyps, "relief_mm": 0.01})
    built, opened = build(recipe), build(recipe.model_copy(update={"closed": False}))
    tube, mesh, rng = built.tube, built.mesh, np.random.default_rng(3)
    (low, high), v = tube.ends, rng.uniform(-4, 8, 3000)
    assert low < -30
    assert high - recipe.length_mm == pytest.approx(-low)
    # derivatives, in the ends alone
    u = np.where(v > 2, rng.uniform(low + 0.1, 0, 3000), rng.uniform(recipe.length_mm, high - 0.1, 3000))
    jet, around = tube.jet(u, v), STEP / 20
    for exact, differences, atol in (
        (jet.gradient[..., 0], derivative(lambda h: tube.jet(u + h, v).value, STEP), 1e-8),
        (jet.hessian[..., 0, 0], derivative(lambda h: tube.jet(u + h, v).gradient[..., 0], STEP), 1e-6),
        (jet.hessian[..., 0, 1], derivative(lambda h: tube.jet(u, v + h).gradient[..., 0], around), 1e-6),
        (jet.hessian[..., 1, 1], derivative(lambda h: tube.jet(u, v + h).gradient[..., 1], around), 1e-5),
    ):
        np.testing.assert_allclose(exact, differences, atol=atol)
    # The same wall between the ends, and one curved alike on both sides of them; the pole has one normal.
    inner = rng.uniform(0, recipe.length_mm, 3000)
    np.testing.assert_allclose(tube.jet(inner, v).value, opened.tube.jet(inner, v).value, atol=1e-11)
    for end in (0.0, recipe.length_mm):
        before, behind = (tube.normal_and_shape_operator(np.full(3000, end + side), v) for side in (-1e-7, 1e-7))
        for one, other in zip(before, behind, strict=True):
            np.testing.assert_allclose(one, other, atol=2e-7)
    pole = tube.normal_and_shape_operator(np.full(3000, high), v)[0]
    assert (np.ptp(pole, axis=0) < 1e-6).all()
    # a mesh without an edge, whose normals are those of the surface
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    face, weights, shown = interpolated_normals(mesh)
    exact = tube.normal_and_shape_operator(*np.einsum("nc,nck->kn", weights, built.corners[face]))[0]
    assert np.quantile(np.degrees(np.arccos(np.einsum("ni,ni->n", shown, exact).clip(max=1))), 0.999) < 0.3
    # no way out, but of the open tube
    directions = unit(rng.normal(size=(20_000, 3)))
    eye = np.broadcast_to(tube.centreline(np.array([40.0])), directions.shape)
    assert np.isfinite(built.probe.cast(eye, directions)).all()
    assert not np.isfinite(opened.probe.cast(eye, directions)).all()
    axis = tube.centreline(np.array([-23.0, -21.0, 5.0, recipe.length_mm + 21, recipe.length_mm + 23]))
    assert np.sign(built.clearance(axis)).tolist() == [-1, 1, 1, 1, -1]


def test_points_at_the_seam_and_misses(recipe):
    built = build(recipe)
    seam = np.flatnonzero(built.corners[:, :, 1].max(axis=1) > 2 * np.pi - 1e-9)[:50]
    centre = built.mesh.vertices[built.mesh.faces[seam]].mean(axis=1)
    normal = built.mesh.normals[built.mesh.faces[seam, 0]]
    distance = np.full(len(seam), 3.0)
    distance[0] = np.inf
    third = np.full((len(seam), 2), 1 / 3)
    points = make_colon(recipe, 0).points(centre + 3 * normal, -normal, RayHits(distance, seam, third))
    assert not points.valid[0]
    assert np.isnan(points.position[0]).all()
    assert points.valid[1:].all()
    assert np.abs(points.distance[1:] - 3).max() < 0.02


@pytest.mark.parametrize("recipe", marked(MORE, ci=["shipped", "polyps and relief"]), indirect=True)
def test_mesh_has_two_open_ends_and_normals_into_the_lumen(recipe):
    shape = make_colon(recipe, 0).shape()
    mesh = shape.mesh
    assert shape.kind == "mesh"
    stalked = sum(polyp.neck_mm is not None for polyp in recipe.polyps)
    assert 190_000 < len(mesh.faces) < 210_000 + 60_000 * stalked
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    uses = np.unique(edges, axis=0, return_counts=True)[1]
    assert set(uses) == {1, 2}
    ends = np.unique(np.unique(edges, axis=0)[uses == 1])
    u, _, _ = build(recipe).tube.slice_of(mesh.vertices[ends])
    assert len(ends) == (uses == 1).sum()
    np.testing.assert_allclose(np.minimum(np.abs(u), np.abs(u - recipe.length_mm)), 0, atol=1e-9)
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ni,ni->n", cross, mesh.normals[mesh.faces[:, 0]]) > 0).all()
    tube = build(recipe).tube
    chosen = np.arange(0, len(mesh.vertices), 97)
    chosen = chosen[~tube.moved_by_stalks(mesh.vertices[chosen])]
    inward = tube.centreline(tube.slice_of(mesh.vertices[chosen])[0]) - mesh.vertices[chosen]
    # Along the flank of a fold the normal may lean, but on the whole it points to the centreline.
    assert np.median(np.einsum("ni,ni->n", inward, mesh.normals[chosen]) / np.linalg.norm(inward, axis=1)) > 0.9


def test_folds_are_convex_and_walls_concave_towards_the_camera(recipe):
    origins, directions, hits, facing = hits_on(build(recipe).mesh, 4000, 4.0, 0.8)
    points = make_colon(recipe, 0).points(origins, directions, hits)
    assert points.valid.mean() > 0.999
    assert np.nanmax(np.abs(points.distance - hits.distance)) < 0.1
    assert (np.einsum("ni,ni->n", points.normal, facing)[points.valid] > 0.9).all()
    assert np.nanmedian(points.k_min) < -1 / 40
    if not recipe.polyps:
        assert 1 / 5 < np.nanmax(points.k_max) < 1 / 2  # fold edges of 2 to 5 mm


@pytest.mark.parametrize("recipe", ALL, indirect=True)
def test_interpolated_normals_are_those_of_the_surface(recipe):
    built = build(recipe)
    face, weights, shown = interpolated_normals(built.mesh)
    exact = built.tube.normal_and_shape_operator(*np.einsum("nc,nck->kn", weights, built.corners[face]))[0]
    error = np.degrees(np.arcsin(np.linalg.norm(np.cross(shown, exact), axis=1).clip(max=1)))
    assert error.mean() < 0.05
    # Creases and domes bend within a triangle.
    assert np.quantile(error, 0.999) < (0.6 if recipe.crease_mm else 0.3)


def test_polyps_and_relief_are_where_they_are_wanted():
    bare = ColonRecipe(fold_depth_mm=0.0, taenia_mm=0.0)
    tube, plain = build(bare.model_copy(update={"polyps": POLYPS})).tube, build(bare).tube
    for polyp in POLYPS:
        u, v = np.array([polyp.along_mm]), np.radians([polyp.around_deg])
        assert plain.radius(u, v).value - tube.radius(u, v).value == pytest.approx(polyp.height_mm, abs=1e-3)
        half = polyp.width_mm / 2
        for du, dv in ((half, 0), (-half, 0), (0, half / 22), (0, -half / 22)):
            rise = plain.radius(u + du, v + dv).value - tube.radius(u + du, v + dv).value
            assert rise == pytest.approx(polyp.height_mm / 2, rel=0.01)
        assert np.linalg.eigvalsh(tube.normal_and_shape_operator(u, v)[1][0])[1:].min() > 0.1  # convex
    rough = build(bare.model_copy(update={"relief_mm": 0.02})).tube
    u, v = np.random.default_rng(0).uniform([0, 0], [115, 2 * np.pi], size=(5000, 2)).T
    assert np.std(rough.radius(u, v).value) == pytest.approx(0.02 * np.sqrt(6 / 2), rel=0.1)
    np.testing.assert_allclose(rough.radius(u, v + 2 * np.pi).value, rough.radius(u, v).value, atol=1e-12)


def test_a_pedunculated_polyp_has_the_sizes_asked_for_and_its_head_overhangs_its_neck():
    """On a flat wall: the map of a plane's points; neck and head where the width is least and largest in turn."""
    stalk = Stalk.of_size(np.zeros(3), np.array([0.0, 0, 1]), height=9.0, head=6.0, neck=2.4)
    x = np.linspace(0, 12, 20_001)
    flat = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    drawn = stalk.apply(Jet.variables(flat, 1))
    radius, _, z = drawn.value.T
    assert z[0] == pytest.approx(9.0)
    head = np.argmax(np.where(z > 4.5, radius, 0))
    neck = np.argmin(np.where((z > 0.9) & (z < z[head]), radius, np.inf))
    assert 2 * radius[head] == pytest.approx(6.0, rel=1e-4)
    assert 2 * radius[neck] == pytest.approx(2.4, rel=1e-4)
    assert z[neck] < z[head]
    # From head to neck the radius shrinks as the height falls: under the head the wall looks down.
    assert (drawn.gradient[head + 50 : neck - 50, 0, 0] < 0).all()


def test_where_a_point_of_a_polyp_came_from_is_known_and_no_two_points_meet():
    stalk = Stalk.of_size(np.array([1.0, 2, 3]), np.array([0.6, 0, 0.8]), height=8.0, head=6.0, neck=2.0)
    points = stalk.foot + np.random.default_rng(2).uniform(-15, 15, (4000, 3))
    drawn = stalk.apply(Jet(points)).value
    assert np.abs(drawn - points).max() > 5
    np.testing.assert_allclose(stalk.undo(drawn), points, atol=1e-12)


def test_behind_the_head_of_a_polyp_there_is_lumen_and_in_it_tissue():
    recipe = ColonRecipe(fold_depth_mm=0.0, taenia_mm=0.0, polyps=(STALKED[0].model_copy(update={"height_mm": 12.0}),))
    tube, colon = build(recipe).tube, make_colon(recipe, 0)
    u, v = np.array([60.0]), np.radians([80.0])
    _, rho, tau = (part[0] for part in tube.frame(u, v))
    foot = tube.centreline(u)[0] + 22.0 * rho
    in_head, beside_neck, in_neck = foot - 9 * rho, foot - 4 * rho + 2.5 * tau, foot - 4 * rho
    signs = np.sign(colon.clearance(np.stack([in_head, beside_neck, in_neck])))
    assert signs.tolist() == [-1, 1, -1]


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"neck_mm": 1.0}, "neck_mm"),
        ({"neck_mm": 5.5}, "neck_mm"),
        ({"neck_mm": 3.0, "height_mm": 4.0}, "height_mm"),
        ({"along_mm": 300}, r"polyps.0.along_mm = 300"),
        ({"steepness": 2.0, "neck_mm": 3.0}, "steepness = 2"),
    ],
)
def test_polyps_that_cannot_be_drawn_out_or_lie_beyond_the_segment_are_refused(sizes, message):
    with pytest.raises(ValueError, match=message):
        ColonRecipe(polyps=(Polyp(**{"along_mm": 50, "around_deg": 0, "height_mm": 8, "width_mm": 6, **sizes}),))


def test_centreline_has_unit_speed_and_is_exact(recipe):
    tube = build(recipe).tube
    u = np.linspace(0, recipe.length_mm, 501)
    fine = np.linspace(0, recipe.length_mm, 200_001)
    psi = tube.heading(fine)[0]
    h = fine[1] - fine[0]
    simpson = h / 3 * (np.cos(psi[:-2:2]) + 4 * np.cos(psi[1:-1:2]) + np.cos(psi[2::2])).sum()
    assert tube.centreline(u)[-1, 2] == pytest.approx(simpson, abs=1e-11)
    speed = derivative(lambda s: tube.centreline(u + s), 1e-2)
    np.testing.assert_allclose(np.linalg.norm(speed, axis=1), 1, atol=1e-11)


@pytest.mark.parametrize("more", ["shipped", pytest.param("pedunculated", marks=pytest.mark.slow)])
def test_key_and_mesh_follow_the_recipe_and_its_seed_alone(more):
    recipe = SHIPPED.model_copy(update=MORE[more])
    a, b, other = (
        make_colon(recipe.model_copy(update={"seed": seed}), viewpoint).shape()
        for seed, viewpoint in ((recipe.seed, 0), (recipe.seed, 5), (7, 0))
    )
    assert a.key == b.key != other.key
    assert a.mesh is b.mesh
    assert not np.array_equal(a.mesh.vertices, other.mesh.vertices)


@pytest.mark.parametrize("update", [{"bend_deg": 180.0, "length_mm": 40.0}, {"fold_spacing_mm": 5.0}])
def test_impossible_tubes_are_refused(update):
    with pytest.raises(InputError, match="colon recipe"):
        make_colon(SHIPPED.model_copy(update=update), 0)


def test_recipes_load_and_refuse_what_is_malformed(tmp_path):
    assert isinstance(load_recipe(ROOT / "meshes" / "liver.toml"), LiverRecipe)
    for text, message in (
        ("radius_mm = 20", "type: missing"),
        ('type = "lung"', "allowed: colon, liver"),
        ("type = [1]", "allowed: colon, liver"),
        ('type = "colon"\nfold_depth_mm = 25.0', "lumen"),
        ('type = "liver"', "lobes"),
        ('type = "liver"\nvisceral_normal = [0, 0, 0]\n' + LOBE % 30, "visceral_normal"),
        ('type = "liver"\n' + LOBE % 1, "semi_axes_mm"),
        ("type = ", "TOML"),
    ):
        path = tmp_path / "recipe.toml"
        path.write_text(text)
        with pytest.raises(InputError, match=message) as error:
            load_recipe(path)
        assert "\n" not in str(error.value)
        assert "recipe.toml" in str(error.value)
    with pytest.raises(InputError, match="no such file"):
        load_recipe(tmp_path / "none.toml")


@pytest.mark.parametrize("more", ["shipped", "pedunculated"])
def test_no_wall_is_in_the_ball_that_is_told_to_be_free(more):
    surface, rng = build(SHIPPED.model_copy(update=MORE[more])), np.random.default_rng(3)
    for site in surface.sites(rng)[:8]:
        if surface.clearance(site[None])[0] > 0:
            towards = rng.standard_normal((200, 3))
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            reach = surface.free_mm(site)
            assert reach > 0
            assert (surface.clearance(site + reach * towards) > 0).all()
            # Not much farther there is one.
            assert surface.clearance(site[None])[0] < 1.2 * reach


def test_interpolated_normals_are_judged_by_their_angle():
    ends = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]] * 5)
    angle = np.radians([0.1, 0.3, 90.0, 179.9, 180.0])
    middle = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
    np.testing.assert_array_equal(off_between(ends, middle, 0.5, 0.2), [False, True, True, True, True])


def radius_over(bare, made, u, v):
    return bare.radius(u, v, second=False).value - made.radius(u, v, second=False).value


def test_rows_of_folds_are_staggered_ridges_lie_on_taeniae_and_creases_are_as_high_as_told():
    bare = ColonRecipe(irregularity=0.0, taenia_mm=0.0, fold_depth_mm=0.0)
    tube = Tube(bare)
    u, around = np.linspace(0, 115, 4001), np.linspace(0, 2 * np.pi, 720, endpoint=False)
    # Each row of folds has its crests so far along from its neighbour's.
    folded = Tube(bare.model_copy(update={"fold_depth_mm": 7.0, "fold_stagger": 0.25, "fold_concentration": 50.0}))
    crest = [
        u[np.argmax(radius_over(tube, folded, u, np.full_like(u, folded._taenia_phase + (2 * third + 1) * np.pi / 3)))]
        % 23.0
        for third in range(3)
    ]
    np.testing.assert_allclose(np.diff(crest), 0.25 * 23.0, atol=0.1)
    # Three ridges of the told height, the same all along the tube
    ridged = Tube(bare.model_copy(update={"taenia_ridge_mm": 1.5}))
    rows = np.array([radius_over(tube, ridged, np.full_like(around, place), around) for place in (3.0, 60.0)])
    np.testing.assert_allclose(*rows, atol=1e-13)
    peaks = np.flatnonzero((rows[0] > np.roll(rows[0], 1)) & (rows[0] >= np.roll(rows[0], -1)))
    assert len(peaks) == 3
    np.testing.assert_allclose(np.cos(3 * (around[peaks] - ridged._taenia_phase)), 1, atol=1e-3)
    assert rows[0].max() == pytest.approx(1.5, abs=1e-3)
    # Half to one and a half times the mean height, more where two meet
    creased = Tube(bare.model_copy(update={"crease_mm": 0.5}))
    rise = radius_over(tube, creased, *np.random.default_rng(0).uniform([0, 0], [115, 2 * np.pi], (40_000, 2)).T)
    assert 0.6 < rise.max() < 2.0
    assert 0.1 < (rise > 0.2).mean() < 0.6


@pytest.mark.parametrize("count", [40, 9000], ids=["at once", "one by one"])
@pytest.mark.parametrize("closed", [False, True])
def test_folds_add_up_wherever_they_reach(closed, count):
    tube = Tube(ColonRecipe(closed=closed, **HAUSTRA))
    rng = np.random.default_rng(3)
    u, v = rng.uniform(0, tube.recipe.length_mm, count), rng.uniform(0, 2 * np.pi, count)
    whole = tube.recipe.radius_mm + tube.recipe.taenia_mm * np.cos(3 * (v - tube._taenia_phase))
    for fold in tube._folds:
        x = u - fold.along - fold.slant * np.sin(v - fold.centre)
        exponent = -(x**2) / (2 * fold.width**2) + fold.kappa * (np.cos(v - fold.centre) - 1)
        whole -= fold.depth * np.exp(exponent - fold.steep * exponent**2)
    np.testing.assert_allclose(tube.radius(u, v).value, whole, rtol=0, atol=1e-12)


def test_drawn_polyps_are_as_told_and_change_nothing_else():
    bare = ColonRecipe(seed=3, crease_mm=0.3)
    kinds, sizes = [], []
    for seed in range(12):
        recipe = bare.model_copy(update={"seed": seed, "polyp_count": 10, "polyp_smallest_mm": 4.0})
        for polyp in Tube(recipe).polyps:
            kinds.append(polyp.neck_mm is not None)
            sizes.append(polyp.width_mm)
            assert 0.1 * 115 <= polyp.along_mm <= 0.9 * 115
    assert len(sizes) == 120
    assert min(sizes) >= 4.0
    assert max(sizes) <= 15.0
    assert np.median(sizes) == pytest.approx(np.sqrt(4 * 15), rel=0.2)
    assert np.mean(kinds) == pytest.approx(0.3, abs=0.13)
    # Away from it the wall is the same to the last bit, and another number of polyps moves no crease.
    one = Tube(bare.model_copy(update={"polyp_count": 1, "polyp_stalked": 0.0}))
    (polyp,) = one.polyps
    u, v = np.random.default_rng(1).uniform([0, 0], [115, 2 * np.pi], (2000, 2)).T
    far = np.abs(u - polyp.along_mm) > 40
    assert far.sum() > 200
    np.testing.assert_array_equal(one.radius(u, v).value[far], Tube(bare).radius(u, v).value[far])
    top = np.array([polyp.along_mm]), np.radians([polyp.around_deg])
    assert radius_over(Tube(bare), one, *top) == pytest.approx(polyp.height_mm)


@pytest.mark.parametrize("steepness", [0.0, 5.0])
def test_a_dome_has_its_height_and_width_whatever_its_steepness(steepness):
    bare = ColonRecipe(fold_depth_mm=0.0, taenia_mm=0.0)
    polyp = Polyp(along_mm=50, around_deg=30, height_mm=4, width_mm=8, steepness=steepness)
    tube, u = Tube(bare.model_copy(update={"polyps": (polyp,)})), np.array([50, 54, 46, 50 + 4 * 1.3])
    rise = radius_over(Tube(bare), tube, u, np.full(4, np.radians(30)))
    np.testing.assert_allclose(rise[:3], [4, 2, 2], rtol=1e-9)
    # A steeper side falls sooner: exp(-ln 2 1.69) of a Gaussian
    assert (rise[3] / 4 < 0.28) == bool(steepness)
    np.testing.assert_array_equal(tube.polyp_at(u, np.full(4, np.radians(30))), np.ones(4))
    assert not tube.polyp_at(np.array([50.0, 62]), np.radians([120, 30])).any()


@pytest.mark.parametrize("radius", [5.0, 60.0])
def test_polyps_are_drawn_in_the_narrowest_and_the_widest_tube(radius):
    shape = {"length_mm": 200.0, "bend_deg": 0.0, "sway_deg": 0.0, "fold_depth_mm": radius / 5, "taenia_mm": 0.0}
    sizes = {"polyp_count": 20, "polyp_smallest_mm": 1.0, "polyp_largest_mm": 20.0, "polyp_stalked": 0.5}
    polyps = Tube(ColonRecipe(radius_mm=radius, **shape, **sizes)).polyps
    assert max(polyp.height_mm for polyp in polyps) <= min(radius, 20.0)
    assert {polyp.neck_mm is None for polyp in polyps} == {True, False}


def test_sizes_of_drawn_polyps_are_in_order():
    with pytest.raises(ValueError, match="polyp_smallest_mm = 9"):
        ColonRecipe(polyp_smallest_mm=9.0, polyp_largest_mm=5.0)
