"""Deformations in time: the map, its inverse and derivatives, and what becomes of normals and curvatures."""

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.spec import scene_from_dict
from simtest.spec.deformation import MAX_STRETCH, Breathing, Dent, Peristalsis
from simtest.surfaces import RayHits, make_surface
from simtest.surfaces.deformation import DeformationAt
from simtest.surfaces.deformed import DeformedSurface, stays_in_free_space
from simtest.surfaces.model import shape_operator

PERISTALSIS = Peristalsis(
    amplitude_mm=4.0, period_s=3.0, centre_mm=(1, 2, 3), axis=(1, 2, 0.5), radius_mm=12.0, wavelength_mm=30.0
)
BREATHING = Breathing(
    amplitude_mm=6.0, period_s=4.0, direction=(0, 1, 1), along=(1, 0, 0.3), wavelength_mm=60.0, warp=0.7,
    turn_deg=5.0, axis=(1, 1, 0),
)  # fmt: skip
DENT = Dent(amplitude_mm=-3.0, period_s=2.0, direction=(0, 0.2, 1), radius_mm=5.0, centre_mm=(3, 1, 2))
KINDS = {"peristalsis": [PERISTALSIS], "breathing": [BREATHING], "dent": [DENT]}
CASES = {**KINDS, "all": [PERISTALSIS, BREATHING, DENT]}
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
    assert np.abs(differences(at.moved, points) - jets.jacobian).max() < 1e-10
    assert np.abs(differences(lambda x: at.jets(x).jacobian, points) - jets.hessian).max() < 1e-10
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


@pytest.mark.parametrize("kind", KINDS)
def test_stretch_bounds_the_derivative_and_is_no_idle_bound(kind):
    """No point of a cloud has a displacement's derivative above the bound; some reach half of it."""
    spec = KINDS[kind][0]
    centre = np.array(spec.centre_mm)
    points = centre + np.random.default_rng(2).normal(0, 8, (10_000, 3))
    # The turn is rigid and no part of the displacement.
    rigid = {"turn_deg": 0.0} if kind == "breathing" else {}
    norms = [
        np.linalg.norm(DeformationAt([spec.model_copy(update=rigid)], t).jets(points).jacobian - np.eye(3), 2, (1, 2))
        for t in np.linspace(0, spec.period_s, 5)
    ]
    assert 0.5 * spec.stretch < np.max(norms) <= spec.stretch


def test_at_rest_nothing_moves(points):
    at = DeformationAt([BREATHING, DENT], 0.0)
    assert np.array_equal(at.moved(points), points)
    assert np.array_equal(at.jets(points).jacobian, np.broadcast_to(np.eye(3), (len(points), 3, 3)))


def quadric(parts, time_s=TIME):
    spec = {"type": "quadric", "distance_mm": 20.0, "k1_per_mm": 0.03, "k2_per_mm": -0.02}
    scene = scene_from_dict({"surface": spec})
    return make_surface(scene.surface, deformation=parts, time_s=time_s)


def parameterised(at, x, y):
    """Deformed points of the quadric by its own parameters: no ray, no derivative."""
    return at.moved(np.stack([x, y, -(0.03 * x**2 - 0.02 * y**2) / 2], axis=1))


def by_differences(at, x, y, step=2e-2):
    """Unit normal, Gaussian and mean curvature of the deformed quadric from sixth-order differences of its points."""
    weights = {1: 45 / 60, 2: -9 / 60, 3: 1 / 60}
    second = {0: -490 / 180, 1: 270 / 180, 2: -27 / 180, 3: 2 / 180}

    def shifted(i, j):
        return parameterised(at, x + i * step, y + j * step)

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


@pytest.fixture(scope="module")
def cast():
    """Points of a deformed quadric on rays of a camera at its place, with their parameters at rest."""
    surface = quadric(CASES["all"])
    x, y = np.random.default_rng(3).uniform(-5, 5, (2, 500))
    target = parameterised(surface.deformation, x, y)
    origin = np.broadcast_to(surface.model_from_camera[:3, 3], target.shape)
    distance = np.linalg.norm(target - origin, axis=1)
    directions = (target - origin) / distance[:, None]
    # The renderer's hits are off by the flatness of its triangles.
    zero = np.zeros((len(x), 2))
    hits = RayHits(distance + 1e-3, np.zeros(len(x), dtype=np.int64), zero)
    return surface, surface.points(origin, directions, hits), (x, y), distance


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
    x, y = where
    own = np.stack([0.03 * x, -0.02 * y, np.ones_like(x)], axis=1)
    wrong = np.einsum("nij,nj->ni", jets.jacobian, own)
    wrong /= np.linalg.norm(wrong, axis=1, keepdims=True)
    assert np.median(np.linalg.norm(np.cross(normal, wrong), axis=1)) > 0.05


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
    assert jets.height == pytest.approx(rest.relief.jets(X).height, abs=1e-11)
    gaps = np.abs(jets.gradient - differences(lambda y: deformed.relief.jets(y).height, Y))
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


def test_only_meshes_deform():
    with pytest.raises(InputError, match="sphere: only meshes deform; must be anatomy or quadric"):
        scene_from_dict({"surface": {"type": "sphere"}, "deformation": [DENT_TABLE]})


def test_a_scene_at_rest_is_written_as_ever():
    dumped = scene_from_dict({"surface": {"type": "plane"}}).model_dump()
    assert not {"deformation", "time_s"} & set(dumped)
    assert MAX_STRETCH < 1
