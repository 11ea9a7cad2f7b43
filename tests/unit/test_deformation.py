"""Deformations in time: the map, its inverse and derivatives, and what becomes of normals and curvatures."""

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.spec import scene_from_dict
from simtest.spec.surfaces import MAX_STRETCH, Breathing, Contractions, Dent, Peristalsis
from simtest.surfaces import RayHits, make_surface
from simtest.surfaces.deformation import DeformationAt, DeformedSurface, stays_in_free_space
from simtest.surfaces.model import shape_operator

PERISTALSIS = Peristalsis(
    amplitude_mm=4.0, period_s=3.0, centre_mm=(1, 2, 3), axis=(1, 2, 0.5), radius_mm=12.0, wavelength_mm=30.0
)
BREATHING = Breathing(
    amplitude_mm=6.0, period_s=4.0, direction=(0, 1, 1), along=(1, 0, 0.3), wavelength_mm=60.0, warp=0.7,
    turn_deg=5.0, axis=(1, 1, 0),
)  # fmt: skip
DENT = Dent(amplitude_mm=-3.0, period_s=2.0, direction=(0, 0.2, 1), radius_mm=5.0, centre_mm=(3, 1, 2))
RING = Contractions(
    amplitude_mm=4.0, period_s=3.0, phase=0.5, path_mm=((0, 0, -9), (1, 1, 0), (0, 0, 9)), radius_mm=12.0, width_mm=5.0,
    spacing_mm=20.0,
)  # fmt: skip
BENT = Contractions(
    amplitude_mm=3.0, period_s=2.0, path_mm=((-20, 0, 0), (0, 5, 0), (8, 20, 3), (0, 30, 10)), radius_mm=8.0,
    width_mm=4.0, spacing_mm=9.0,
)  # fmt: skip
KINDS = {"peristalsis": [PERISTALSIS], "breathing": [BREATHING], "dent": [DENT], "contractions": [RING]}
CASES = {**KINDS, "all": [PERISTALSIS, BREATHING, DENT], "bent": [BENT, BREATHING]}
TIME = 0.7


def differences(function, points, step=1e-3):
    """Fourth-order central differences along x, y, z, as the last axis."""
    sides = []
    for shift in step * np.eye(3):
        near, far = (function(points + n * shift) - function(points - n * shift) for n in (1, 2))
        sides.append((8 * near - far) / (12 * step))
    return np.stack(sides, axis=-1)


@pytest.fixture
def points():
    return np.random.default_rng(5).uniform(-20, 20, (2000, 3))


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_the_map(case, points):
    at = DeformationAt(CASES[case], TIME)
    jets = at.jets(points)
    assert np.array_equal(jets.value, at.moved(points))
    assert np.abs(differences(at.moved, points) - jets.gradient).max() < 1e-10
    assert np.abs(differences(lambda x: at.jets(x).gradient, points) - jets.hessian).max() < 1e-10
    assert np.abs(jets.hessian).max() > 1e-4


@pytest.mark.parametrize("case", CASES)
def test_inverse(case, points):
    at = DeformationAt(CASES[case], TIME)
    assert np.abs(at.at_rest(at.moved(points)) - points).max() < 1e-10
    assert np.abs(at.moved(at.at_rest(points)) - points).max() < 1e-10


def test_inverse_at_the_allowed_limit():
    """Just below the limit, where Newton's method alone may stray, every point still comes back."""
    radius = 5.0
    steep = Dent(amplitude_mm=0.899 * radius / np.exp(-0.5), period_s=1.0, direction=(1, 0, 0), radius_mm=radius)
    at = DeformationAt([steep], 0.5)
    points = np.random.default_rng(1).uniform(-15, 15, (20000, 3))
    assert np.abs(at.at_rest(at.moved(points)) - points).max() < 1e-10


def test_inverse_keeps_missing_points_missing():
    found = DeformationAt([DENT], 1.0).at_rest(np.array([[np.nan, 0, 0], [1.0, 2.0, 3.0]]))
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


def test_no_points_and_rays_that_all_miss_are_no_fault():
    at = DeformationAt(CASES["all"], TIME)
    none = np.empty((0, 3))
    assert at.moved(none).shape == at.at_rest(none).shape == (0, 3)
    assert at.jets(none).hessian.shape == (0, 3, 3, 3)
    rays = np.tile([[0.0, 0.0, 1.0]], (4, 1))
    hits = RayHits(np.full(4, np.inf), np.zeros(4, dtype=np.int64), np.zeros((4, 2)))
    assert not quadric(CASES["all"]).points(0 * rays, rays, hits).valid.any()


@pytest.mark.parametrize("kind", KINDS)
def test_stretch_bounds_the_derivative_and_is_no_idle_bound(kind):
    """No point of a cloud has a displacement's derivative above the bound; some reach half of it."""
    spec = KINDS[kind][0]
    centre = np.array(getattr(spec, "centre_mm", (0, 0, 0)))
    points = centre + np.random.default_rng(2).normal(0, 8, (10_000, 3))
    # The turn is rigid and no part of the displacement.
    rigid = {"turn_deg": 0.0} if kind == "breathing" else {}
    norms = [
        np.linalg.norm(DeformationAt([spec.model_copy(update=rigid)], t).jets(points).gradient - np.eye(3), 2, (1, 2))
        for t in np.linspace(0, spec.period_s, 5)
    ]
    assert 0.5 * spec.stretch < np.max(norms) <= spec.stretch


def test_at_rest_nothing_moves(points):
    at = DeformationAt([BREATHING, DENT], 0.0)
    assert np.array_equal(at.moved(points), points)
    assert np.array_equal(at.jets(points).gradient, np.broadcast_to(np.eye(3), (len(points), 3, 3)))


QUADRIC = {"type": "quadric", "k1_per_mm": 0.03, "k2_per_mm": -0.02}
ROUND = {"radius_mm": 12.0}
SURFACES = {
    # the table, and the height z over the anchor's tangent plane
    "quadric": (QUADRIC, lambda x, y: -(0.03 * x**2 - 0.02 * y**2) / 2),
    "plane": ({"type": "plane"}, lambda x, y: 0 * x),
    "sphere": ({"type": "sphere", **ROUND}, lambda x, y: np.sqrt(144 - x**2 - y**2) - 12),
    "sphere, inside": ({"type": "sphere", "side": "inside", **ROUND}, lambda x, y: 12 - np.sqrt(144 - x**2 - y**2)),
    "cylinder": ({"type": "cylinder", **ROUND}, lambda x, y: np.sqrt(144 - x**2) - 12 + 0 * y),
    "cylinder, inside": (
        {"type": "cylinder", "side": "inside", **ROUND},
        lambda x, y: 12 - np.sqrt(144 - x**2) + 0 * y,
    ),
}


def surface_of(table, parts, time_s=TIME):
    scene = scene_from_dict({"surface": {"distance_mm": 20.0, **table}, "deformation": parts})
    return make_surface(scene.surface, deformation=scene.deformation, time_s=time_s)


def quadric(parts, time_s=TIME):
    return surface_of(QUADRIC, parts, time_s)


def parameterised(at, x, y, height=SURFACES["quadric"][1]):
    """Deformed points of a surface by its own parameters: no ray, no derivative."""
    return at.moved(np.stack([x, y, height(x, y)], axis=1))


def by_differences(at, x, y, height, step=2e-2):
    """Unit normal, Gaussian and mean curvature of a deformed surface from sixth-order differences of its points."""
    weights = {1: 45 / 60, 2: -9 / 60, 3: 1 / 60}
    second = {0: -490 / 180, 1: 270 / 180, 2: -27 / 180, 3: 2 / 180}

    def shifted(i, j):
        return parameterised(at, x + i * step, y + j * step, height)

    du = sum(w * (shifted(i, 0) - shifted(-i, 0)) for i, w in weights.items()) / step
    dv = sum(w * (shifted(0, i) - shifted(0, -i)) for i, w in weights.items()) / step
    duu = sum(w * (shifted(i, 0) + shifted(-i, 0)) / (2 if i == 0 else 1) for i, w in second.items()) / step**2
    dvv = sum(w * (shifted(0, i) + shifted(0, -i)) / (2 if i == 0 else 1) for i, w in second.items()) / step**2
    duv = sum(
        a * b * (shifted(i, j) - shifted(i, -j) - shifted(-i, j) + shifted(-i, -j))
        for i, a in weights.items() for j, b in weights.items()
    ) / step**2  # fmt: skip
    normal = np.cross(du, dv)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def dot(a, b):
        return np.einsum("ni,ni->n", a, b)

    E, F, G = dot(du, du), dot(du, dv), dot(dv, dv)
    e, f, g = -dot(duu, normal), -dot(duv, normal), -dot(dvv, normal)
    area = E * G - F**2
    return normal, (e * g - f * f) / area, (e * G - 2 * f * F + g * E) / (2 * area)


@pytest.fixture(scope="module", params=[*((name, "all") for name in SURFACES), ("sphere", "bent")], ids=str)
def cast(request):
    """Points of a deformed surface on rays of a camera at its place, with their parameters at rest."""
    name, case = request.param
    table, height = SURFACES[name]
    surface = surface_of(table, CASES[case])
    x, y = np.random.default_rng(3).uniform(-5, 5, (2, 500))
    target = parameterised(surface.deformation, x, y, height)
    origin = np.broadcast_to(surface.model_from_camera[:3, 3], target.shape)
    distance = np.linalg.norm(target - origin, axis=1)
    directions = (target - origin) / distance[:, None]
    # The renderer's hits are off by the flatness of its triangles.
    zero = np.zeros((len(x), 2))
    hits = RayHits(distance + 1e-3, np.zeros(len(x), dtype=np.int64), zero)
    return surface, surface.points(origin, directions, hits), (x, y, height), distance


def test_rays_meet_the_deformed_surface(cast):
    _, points, _, distance = cast
    assert points.valid.all()
    assert np.abs(points.distance - distance).max() < 1e-10


def test_normals_are_those_of_differences(cast):
    surface, points, where, _ = cast
    normal, _, _ = by_differences(surface.deformation, *where)
    assert np.linalg.norm(np.cross(normal, points.normal), axis=1).max() < 1e-8
    # Control: normals that are carried as tangents are, by J, are wrong by degrees.
    jets = surface.deformation.jets(surface.deformation.at_rest(points.position))
    wrong = np.einsum("nji,nj->ni", jets.gradient, normal)
    wrong = np.einsum("nij,nj->ni", jets.gradient, wrong)
    wrong /= np.linalg.norm(wrong, axis=1, keepdims=True)
    assert np.median(np.linalg.norm(np.cross(normal, wrong), axis=1)) > 0.03


def test_curvatures_are_those_of_differences(cast):
    surface, points, where, _ = cast
    _, gaussian, mean = by_differences(surface.deformation, *where)
    scale = np.abs(points.k_min) + np.abs(points.k_max)
    assert (np.abs(points.k_min * points.k_max - gaussian) / scale**2).max() < 1e-6
    assert (np.abs((points.k_min + points.k_max) / 2 - mean) / scale).max() < 1e-6
    # The principal directions lie in the tangent plane, and S N = 0.
    assert np.abs(np.einsum("nij,nj->ni", shape_operator(points), points.normal)).max() < 1e-12


def test_a_rigid_motion_keeps_curvatures():
    rigid = BREATHING.model_copy(update={"warp": 0.0, "turn_deg": 20.0})
    plain, moved = quadric([]), quadric([rigid])
    at = moved.deformation
    hits = RayHits(np.array([20.0]), np.zeros(1, dtype=np.int64), np.zeros((1, 2)))
    origin, direction = np.array([[0.5, 0.3, 20.0]]), np.array([[0.0, 0.0, -1.0]])
    own = plain.points(origin, direction, hits)
    turned = at.moved(origin + direction) - at.moved(origin)
    found = moved.points(at.moved(origin), turned, hits)
    assert found.position == pytest.approx(at.moved(own.position), abs=1e-10)
    curvatures = [np.concatenate([points.k_min, points.k_max]) for points in (found, own)]
    assert curvatures[0] == pytest.approx(curvatures[1], abs=1e-13)


def test_relief_rides_on_the_tissue():
    """Its height stays, and its derivatives are those of differences of the height on the deformed tissue."""
    spec = {"type": "quadric", "distance_mm": 20.0, "k1_per_mm": 0.03, "k2_per_mm": -0.02,
            "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}}  # fmt: skip
    scene = scene_from_dict({"surface": spec})
    rest = make_surface(scene.surface)
    deformed = make_surface(scene.surface, deformation=CASES["all"], time_s=TIME)
    X = np.random.default_rng(7).uniform(-5, 5, (200, 3))
    Y = deformed.deformation.moved(X)
    jets = deformed.relief.jets(Y)
    assert jets.value == pytest.approx(rest.relief.jets(X).value, abs=1e-11)
    gaps = np.abs(jets.gradient - differences(lambda y: deformed.relief.jets(y).value, Y))
    # A cubic spline has third derivatives that jump at its nodes: there, differences are less exact.
    assert np.median(gaps) < 1e-10
    assert gaps.max() < 1e-6
    gaps = np.abs(jets.hessian - differences(lambda y: deformed.relief.jets(y).gradient, Y))
    assert np.median(gaps) < 1e-8


def test_camera_in_the_deformed_wall_is_refused():
    surface = quadric([DENT.model_copy(update={"centre_mm": (0, 0, 0), "amplitude_mm": 5.0})], 1.0)
    above, inside = np.array([[0.0, 0.0, 8.0]]), np.array([[0.0, 0.0, 3.0]])
    assert surface.clearance(above)[0] > 0
    assert surface.clearance(inside)[0] < 0
    assert isinstance(surface, DeformedSurface)
    assert surface.at_rest.clearance(inside)[0] > 0


@pytest.mark.parametrize("along", [(0, 0, 1), (1, 0, 0)])
def test_a_body_that_passes_over_the_camera_is_seen(along):
    """A small ball moves 100 mm: past the camera, or right over it to free space behind."""
    ball = make_surface(scene_from_dict({"surface": {"type": "sphere", "distance_mm": 20.0, "radius_mm": 3.0}}).surface)
    camera = ball.model_from_camera[:3, 3]
    moving = Breathing(amplitude_mm=100.0, period_s=2.0, direction=along, warp=0.0)
    for time_s in (0.0, 1.0):
        there = DeformationAt([moving], time_s).at_rest(camera[None])
        assert ball.clearance(there)[0] > 10
    assert stays_in_free_space(ball, [moving], 0.0, camera)
    assert stays_in_free_space(ball, [moving], 1.0, camera) == (along == (1, 0, 0))


DENT_TABLE = {"type": "dent", "amplitude_mm": 1.0, "period_s": 2.0, "direction": [0, 0, 1], "radius_mm": 5.0}
BAD = {
    "folds": ({"amplitude_mm": 9.0}, r"amplitude_mm = 9: .* by up to 1\.09 of .* below 0\.9: .* radius_mm"),
    "no direction": ({"direction": [0, 0, 0]}, r"direction = \[0\.0, 0\.0, 0\.0\]: must have a length"),
    "hardly a direction": ({"direction": [1e-300, 0, 0]}, r"direction = \[1e-300, 0\.0, 0\.0\]: must have a length"),
    "no period": ({"period_s": 0.0}, r"period_s = 0\.0: must be .* 0\.001"),
    "text": ({"amplitude_mm": "1"}, r"amplitude_mm = '1': must be a number"),
    "unknown": ({"speed": 1.0}, r"speed = 1\.0: unknown key; allowed: amplitude_mm"),
    "type": ({"type": "cough"}, r"type = 'cough'.*breathing"),
    "too far": ({"amplitude_mm": 1e3}, r"amplitude_mm = 1000\.0: must be .* 100"),
    "phase": ({"phase": 1.5}, r"phase = 1\.5: must be .* 1"),
    "flat": ({"direction": [0, 1]}, r"direction"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_tables(case):
    changes, message = BAD[case]
    surface = {"type": "quadric", "k1_per_mm": 0.0, "k2_per_mm": 0.0}
    with pytest.raises(InputError, match=message) as error:
        scene_from_dict({"surface": surface, "deformation": [{**DENT_TABLE, **changes}]})
    assert "deformation.0" in str(error.value)
    assert "\n" not in str(error.value)


BENT_TABLE = {"type": "contractions", "amplitude_mm": 2.0, "period_s": 2.0, "path_mm": [[0, 0, 0], [9, 0, 0]],
              "radius_mm": 9.0, "width_mm": 5.0, "spacing_mm": 5.0}  # fmt: skip
BAD_PATHS = {
    "one point": ({"path_mm": [[0, 0, 0]]}, r"path_mm.*: must have at least 2"),
    "flat": ({"path_mm": [[0, 0], [9, 0]]}, "path_mm"),
    "twice": (
        {"path_mm": [[0, 0, 0], [9, 0, 0], [9, 0, 0]]},
        r"points 1 and 2 are 0 mm apart; must be at least 0\.01 mm",
    ),
    "many rings": (
        {"spacing_mm": 0.4},
        r"spacing_mm = 0\.4: a path of 9 mm holds more than 20 rings; must be at least 0\.45",
    ),
    "folds": (
        {"width_mm": 1.0},
        r"amplitude_mm = 2: .* by up to 1\.27 of .*: lower amplitude_mm, or .* radius_mm or width_mm",
    ),
    "centre": ({"centre_mm": [0, 0, 0]}, "centre_mm.*unknown key"),
}


@pytest.mark.parametrize("case", BAD_PATHS)
def test_bad_paths(case):
    changes, message = BAD_PATHS[case]
    with pytest.raises(InputError, match=message) as error:
        scene_from_dict({"surface": {"type": "plane"}, "deformation": [{**BENT_TABLE, **changes}]})
    assert "deformation.0" in str(error.value)
    assert "\n" not in str(error.value)


def test_rings_follow_the_bends_of_their_path():
    """On a quarter of a circle of 40 mm each ring narrows a tube around the circle where it stands, and there alone."""
    angles = np.linspace(0, np.pi / 2, 20)
    path = 40 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    spec = Contractions(
        amplitude_mm=3.0, period_s=1.0, phase=0.5, path_mm=path.tolist(), radius_mm=8.0, width_mm=3.0, spacing_mm=31.4
    )
    at = DeformationAt([spec], 0.0)

    def radii(angle, around):
        """Distance from the circle of a tube's points, 8 mm at rest, across the circle at an angle."""
        out, up = np.array([np.cos(angle), np.sin(angle), 0]), np.array([0, 0, 1.0])
        centre = 40 * out
        points = centre + 8 * (np.cos(around)[:, None] * out + np.sin(around)[:, None] * up)
        return np.linalg.norm(at.moved(points) - centre, axis=1)

    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    # Half a spacing from the begin, the ring is whole: 15.7 mm along the circle.
    assert radii(15.7 / 40, around) == pytest.approx(5.0, abs=0.01)
    # Midway to the next ring.
    assert radii(31.4 / 40, around) == pytest.approx(8.0, abs=5e-3)
    # At the ends rings begin and end without a jump.
    points = np.random.default_rng(4).normal([40, 0, 0], 10, (200, 3))
    before, after = (DeformationAt([spec], t).moved(points) for t in (0.5 - 1e-6, 0.5 + 1e-6))
    assert np.abs(before - after).max() < 1e-3


@pytest.mark.parametrize(
    ("name", "radius"),
    [("plane", 1), ("sphere", 0.5), ("sphere", 400), ("sphere, inside", 12), ("cylinder, inside", 0.5)],
)
def test_meshes_of_analytic_surfaces(name, radius):
    """Vertices on the surface, triangles on the camera's side, a sphere without gaps: also in single precision."""
    table = {key: value for key, value in SURFACES[name][0].items() if key != "radius_mm"}
    if "inside" in name and radius < 20:
        table["distance_mm"] = 0.9 * radius
    if table["type"] in ("sphere", "cylinder"):
        table["radius_mm"] = radius
    surface = surface_of(table, [DENT])
    mesh = surface.rest.shape().mesh
    assert np.abs(surface.at_rest.clearance(mesh.vertices)).max() < 1e-12 * max(radius, 1000)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert np.einsum("ni,nci->nc", across, mesh.normals[mesh.faces]).min() > 0.98
    if table["type"] == "sphere":
        numbers = (mesh.vertices.astype(np.float32) + 0.0).view(np.int32).astype(np.int64)
        _, same = np.unique(numbers @ [1, 1_000_003, 999_999_937], return_inverse=True)
        faces, count = same[mesh.faces], len(same)
        first, last = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
        assert np.array_equal(np.sort(first * count + last), np.sort(last * count + first))


def test_a_scene_at_rest_is_written_as_ever():
    dumped = scene_from_dict({"surface": {"type": "plane"}}).model_dump()
    assert not {"deformation", "time_s"} & set(dumped)
    assert MAX_STRETCH < 1
