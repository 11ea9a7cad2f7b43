"""Deformations in time: the map, its inverse and derivatives; normals and curvatures stand in test_surfaces."""

import numpy as np
import pytest
from surface_helpers import gradient

from simtest.errors import InputError
from simtest.spec import scene_from_dict
from simtest.spec.surfaces import Breathing, Contractions, Dent, Peristalsis
from simtest.surfaces import RayHits, make_surface
from simtest.surfaces.deformation import DeformationAt, DeformedSurface, stays_in_free_space

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


@pytest.fixture
def points():
    return np.random.default_rng(5).uniform(-20, 20, (2000, 3))


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_the_map(case, points):
    at = DeformationAt(CASES[case], TIME)
    jets = at.jets(points)
    assert np.array_equal(jets.value, at.moved(points))
    assert np.abs(gradient(at.moved, points, 1e-3) - jets.gradient).max() < 1e-10
    assert np.abs(gradient(lambda x: at.jets(x).gradient, points, 1e-3) - jets.hessian).max() < 1e-10
    assert np.abs(jets.hessian).max() > 1e-4


STEEP = Dent(amplitude_mm=0.899 * 5.0 / np.exp(-0.5), period_s=1.0, direction=(1, 0, 0), radius_mm=5.0)
"""Just below the limit, where Newton's method alone may stray."""


@pytest.mark.parametrize(
    ("parts", "time_s", "reach", "count"),
    [*((parts, TIME, 20, 2000) for parts in CASES.values()), ([STEEP], 0.5, 15, 20_000)],
)
def test_inverse(parts, time_s, reach, count):
    at, points = DeformationAt(parts, time_s), np.random.default_rng(1).uniform(-reach, reach, (count, 3))
    assert np.abs(at.at_rest(at.moved(points)) - points).max() < 1e-10
    assert np.abs(at.moved(at.at_rest(points)) - points).max() < 1e-10
    points[0] = np.nan
    found = at.at_rest(points[:2])
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


def test_at_rest_nothing_moves_and_a_scene_is_written_as_ever(points):
    at = DeformationAt([BREATHING, DENT], 0.0)
    assert np.array_equal(at.moved(points), points)
    assert np.array_equal(at.jets(points).gradient, np.broadcast_to(np.eye(3), (len(points), 3, 3)))
    dumped = scene_from_dict({"surface": {"type": "plane"}}).model_dump()
    assert not {"deformation", "time_s"} & set(dumped)


QUADRIC = {"type": "quadric", "k1_per_mm": 0.03, "k2_per_mm": -0.02}


def surface_of(table, parts, time_s=TIME):
    scene = scene_from_dict({"surface": {"distance_mm": 20.0, **table}, "deformation": parts})
    return make_surface(scene.surface, deformation=scene.deformation, time_s=time_s)


def quadric(parts, time_s=TIME):
    return surface_of(QUADRIC, parts, time_s)


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
    """Its height stays; normals and curvatures with it stand in test_surfaces."""
    relief = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}
    rest, deformed = (surface_of({**QUADRIC, "relief": relief}, parts) for parts in ([], CASES["all"]))
    X = np.random.default_rng(7).uniform(-5, 5, (200, 3))
    moved = deformed.deformation.moved(X)
    assert deformed.relief.jets(moved).value == pytest.approx(rest.relief.jets(X).value, abs=1e-11)


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
BENT_TABLE = {"type": "contractions", "amplitude_mm": 2.0, "period_s": 2.0, "path_mm": [[0, 0, 0], [9, 0, 0]],
              "radius_mm": 9.0, "width_mm": 5.0, "spacing_mm": 5.0}  # fmt: skip
BAD = {
    "dent folds": ({"amplitude_mm": 9.0}, r"amplitude_mm = 9: .* by up to 1\.09 of .* below 0\.9: .* radius_mm"),
    "no direction": ({"direction": [0, 0, 0]}, r"direction = \[0\.0, 0\.0, 0\.0\]: must have a length"),
    "hardly a direction": ({"direction": [1e-300, 0, 0]}, r"direction = \[1e-300, 0\.0, 0\.0\]: must have a length"),
    "type": ({"type": "cough"}, r"type = 'cough'.*breathing"),
    "twice": ({"path_mm": [[0, 0, 0], [9, 0, 0], [9, 0, 0]]}, r"points 1 and 2 are 0 mm apart; must be at least"),
    "many rings": ({"spacing_mm": 0.4}, r"spacing_mm = 0\.4: a path of 9 mm .* than 20 rings; must be at least 0\.45"),
    "rings fold": (
        {"width_mm": 1.0},
        r"amplitude_mm = 2: .* by up to 1\.27 of .*: lower amplitude_mm, or .* radius_mm",
    ),
}


def test_bad_tables():
    for case, (changes, message) in BAD.items():
        table = BENT_TABLE if case in ("twice", "many rings", "rings fold") else DENT_TABLE
        with pytest.raises(InputError, match=message) as error:
            scene_from_dict({"surface": {"type": "plane"}, "deformation": [{**table, **changes}]})
        assert "deformation.0" in str(error.value), case
        assert "\n" not in str(error.value), case


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
    kind, _, side = name.partition(", ")
    table = {"type": kind} | ({"radius_mm": radius} if kind != "plane" else {}) | ({"side": side} if side else {})
    if side and radius < 20:
        table["distance_mm"] = 0.9 * radius
    surface = surface_of(table, [DENT])
    mesh = surface.rest.shape().mesh
    assert np.abs(surface.at_rest.clearance(mesh.vertices)).max() < 1e-12 * max(radius, 1000)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert np.einsum("ni,nci->nc", across, mesh.normals[mesh.faces]).min() > 0.98
    if kind == "sphere":
        numbers = (mesh.vertices.astype(np.float32) + 0.0).view(np.int32).astype(np.int64)
        _, same = np.unique(numbers @ [1, 1_000_003, 999_999_937], return_inverse=True)
        faces, count = same[mesh.faces], len(same)
        first, last = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
        assert np.array_equal(np.sort(first * count + last), np.sort(last * count + first))
