"""Analytic surfaces against formulas written here in the camera frame, and against finite differences."""

import numpy as np
import pytest
from scipy.optimize import brentq

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.spec import scene_from_dict
from simtest.surfaces import RayHits, make_surface

CAMERA = Camera(64, 48, 60.0, 55.0, 33.0, 22.5, 3.0)
D = 10.0
POSES = [(0.0, 0.0, 0.0), (0.0, 0.0, 35.0), (25.0, 0.0, 0.0), (25.0, 110.0, -50.0), (60.0, -70.0, 200.0)]
"""Tilt, azimuth, spin, deg."""


def build(kind, pose=(0.0, 0.0, 0.0), **settings):
    tilt, azimuth, spin = pose
    placed = {"distance_mm": D, "tilt_deg": tilt, "azimuth_deg": azimuth, "spin_deg": spin}
    return make_surface(scene_from_dict({"surface": {"type": kind, **placed, **settings}}).surface)


def anchor_frame(pose):
    """Return the anchor, its normal and the two principal directions, camera frame, by Rodrigues' formula.

    The normal is (0, 0, -1) turned by the tilt towards the azimuth; the principal directions turn along.
    """
    tilt, azimuth, spin = np.radians(pose)
    normal = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])

    def turned(v):
        # About (0, 0, -1) x (cos azimuth, sin azimuth, 0).
        axis = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        return np.cos(tilt) * v + np.sin(tilt) * np.cross(axis, v) + (1 - np.cos(tilt)) * (axis @ v) * axis

    np.testing.assert_allclose(turned(np.array([0, 0, -1.0])), normal, atol=1e-15)
    first = turned(np.array([np.cos(spin), np.sin(spin), 0.0]))
    second = turned(np.array([-np.sin(spin), np.cos(spin), 0.0]))
    return np.array([0.0, 0.0, D]), normal, first, second


def cast(model, directions, near=None):
    """Return the exact points on rays from the camera, camera frame; `near` stands in for the ray tracer's distance."""
    rotation, centre = model.model_from_camera[:3, :3], model.model_from_camera[:3, 3]
    directions = np.atleast_2d(directions)
    count = len(directions)
    near = np.full(count, D) if near is None else np.broadcast_to(near, count).astype(float)
    hits = RayHits(near, np.zeros(count, dtype=np.int64), np.zeros((count, 2)))
    found = model.points(np.broadcast_to(centre, (count, 3)), directions @ rotation.T, hits)
    names = ("normal", "direction_min", "direction_max")
    return {
        "distance": found.distance, "valid": found.valid, "k_min": found.k_min, "k_max": found.k_max,
        "position": (found.position - centre) @ rotation,
        **{name: getattr(found, name) @ rotation for name in names},
    }  # fmt: skip


def rays(stride=3):
    return CAMERA.unproject(CAMERA.pixel_centres()[::stride, ::stride].reshape(-1, 2))


def agree_up_to_sign(found, expected, atol):
    np.testing.assert_allclose(np.abs(np.sum(found * expected, axis=-1)), 1, atol=atol)


def well_formed(points):
    """Check what holds on every surface: unit normals that face the camera, an orthonormal frame, k_min <= k_max."""
    ok = points["valid"]
    N, P, u, v = (points[key][ok] for key in ("normal", "position", "direction_min", "direction_max"))
    frame = np.stack([N, u, v], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (len(N), 3, 3)), atol=1e-12)
    assert (np.sum(N * P, axis=1) < 0).all()
    assert (points["k_min"][ok] <= points["k_max"][ok]).all()
    for key in ("distance", "position", "normal", "k_min", "k_max", "direction_min", "direction_max"):
        assert np.isfinite(points[key][ok]).all()
        assert np.isnan(points[key][~ok]).all()


def sphere_intersection(directions, centre, radius, far):
    """|t s - c|^2 = R^2 by the schoolbook formula."""
    along = directions @ centre
    under = along**2 - centre @ centre + radius**2
    with np.errstate(invalid="ignore"):
        return along + (1 if far else -1) * np.sqrt(under)


@pytest.mark.parametrize("pose", POSES)
def test_plane(pose):
    anchor, normal, _, _ = anchor_frame(pose)
    s = rays()
    points = cast(build("plane", pose), s)
    with np.errstate(divide="ignore"):
        t = (normal @ anchor) / (s @ normal)
    hit = t > 0
    np.testing.assert_array_equal(points["valid"], hit)
    assert hit.sum() > 100
    np.testing.assert_allclose(points["distance"][hit], t[hit], rtol=1e-12)
    np.testing.assert_allclose(points["position"][hit], t[hit, None] * s[hit], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(points["normal"][hit], np.broadcast_to(normal, (hit.sum(), 3)), atol=1e-13)
    np.testing.assert_array_equal(points["k_min"][hit], 0)
    np.testing.assert_array_equal(points["k_max"][hit], 0)
    well_formed(points)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(("side", "radius"), [("outside", 3.0), ("outside", 400.0), ("inside", 10.1), ("inside", 70.0)])
def test_sphere(pose, side, radius):
    anchor, normal, _, _ = anchor_frame(pose)
    inside = side == "inside"
    centre = anchor + normal * (radius if inside else -radius)
    s = rays()
    points = cast(build("sphere", pose, radius_mm=radius, side=side), s)
    t = sphere_intersection(s, centre, radius, far=inside)
    hit = np.isfinite(t) & (t > 0)
    np.testing.assert_array_equal(points["valid"], hit)
    assert hit.sum() > 20
    well_formed(points)
    P = t[hit, None] * s[hit]
    # The schoolbook formula loses half of the digits at the silhouette.
    np.testing.assert_allclose(points["position"][hit], P, atol=1e-7)
    outward = (points["position"][hit] - centre) / radius
    np.testing.assert_allclose(points["normal"][hit], -outward if inside else outward, atol=1e-11)
    np.testing.assert_allclose(points["k_min"][hit], (-1 if inside else 1) / radius, rtol=1e-12)
    np.testing.assert_allclose(points["k_max"][hit], (-1 if inside else 1) / radius, rtol=1e-12)
    middle = cast(build("sphere", pose, radius_mm=radius, side=side), [0.0, 0, 1])
    np.testing.assert_allclose(middle["position"][0], anchor, atol=1e-11)
    np.testing.assert_allclose(middle["normal"][0], normal, atol=1e-11)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(("side", "radius"), [("outside", 3.0), ("outside", 400.0), ("inside", 10.1), ("inside", 70.0)])
def test_cylinder(pose, side, radius):
    """Curved along the first principal direction, straight along the second."""
    anchor, normal, first, straight = anchor_frame(pose)
    inside = side == "inside"
    centre = anchor + normal * (radius if inside else -radius)
    s = rays()
    points = cast(build("cylinder", pose, radius_mm=radius, side=side), s)
    # In the cross-section, across the axis: a circle and rays that are no unit vectors there.
    across = np.stack([first, normal], axis=1)
    s2, c2 = s @ across, centre @ across
    a, b, c = np.sum(s2**2, axis=1), s2 @ c2, c2 @ c2 - radius**2
    with np.errstate(invalid="ignore"):
        t = (b + (1 if inside else -1) * np.sqrt(b**2 - a * c)) / a
    hit = np.isfinite(t) & (t > 0)
    np.testing.assert_array_equal(points["valid"], hit)
    assert hit.sum() > 20
    well_formed(points)
    np.testing.assert_allclose(points["position"][hit], t[hit, None] * s[hit], rtol=1e-7, atol=1e-7)
    from_axis = points["position"][hit] - centre
    from_axis -= (from_axis @ straight)[:, None] * straight
    np.testing.assert_allclose(np.linalg.norm(from_axis, axis=1), radius, rtol=1e-11)
    outward = from_axis / radius
    np.testing.assert_allclose(points["normal"][hit], -outward if inside else outward, atol=1e-10)
    curved, flat = ("k_min", "k_max") if inside else ("k_max", "k_min")
    np.testing.assert_allclose(points[curved][hit], (-1 if inside else 1) / radius, rtol=1e-10)
    np.testing.assert_allclose(points[flat][hit], 0, atol=1e-12)
    agree_up_to_sign(points["direction_" + flat[2:]][hit], straight, 1e-10)
    around = np.cross(straight, outward)
    agree_up_to_sign(points["direction_" + curved[2:]][hit], around, 1e-10)


QUADRICS = [(0.05, 0.02), (0.05, -0.05), (-0.06, -0.03), (-0.08, 0.0), (0.0, 0.0), (0.3, 0.1)]


def quadric_level(P, pose, k1, k2):
    """F(P) = height over the tangent plane + (k1 x^2 + k2 y^2)/2, with its gradient, in the camera frame."""
    anchor, normal, first, second = anchor_frame(pose)
    q = P - anchor
    F = q @ normal + (k1 * (q @ first) ** 2 + k2 * (q @ second) ** 2) / 2
    gradient = normal + k1 * (q @ first)[..., None] * first + k2 * (q @ second)[..., None] * second
    return F, gradient


@pytest.mark.parametrize("pose", POSES[:4])
@pytest.mark.parametrize(("k1", "k2"), QUADRICS)
def test_quadric(pose, k1, k2):
    model = build("quadric", pose, k1_per_mm=k1, k2_per_mm=k2)
    _, normal, first, second = anchor_frame(pose)
    hessian = k1 * np.outer(first, first) + k2 * np.outer(second, second)
    used = 0
    for s in rays(10):
        # The root next to the anchor's depth, bracketed without the quadratic formula.
        grid = np.linspace(0.5, 25, 491)
        values = quadric_level(grid[:, None] * s, pose, k1, k2)[0]
        change = np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:]))
        if not len(change):
            continue
        i = change[0]
        t = brentq(lambda t: quadric_level(t * s, pose, k1, k2)[0], grid[i], grid[i + 1], xtol=1e-13)  # noqa: B023
        points = cast(model, s, near=t + 1e-3)
        if abs(points["normal"][0] @ s) < 0.05:
            continue
        used += 1
        well_formed(points)
        np.testing.assert_allclose(points["distance"][0], t, atol=1e-10)
        P = points["position"][0]
        _, g = quadric_level(P, pose, k1, k2)
        N = g / np.linalg.norm(g)
        sign = -np.sign(N @ s)
        np.testing.assert_allclose(points["normal"][0], sign * N, atol=1e-12)
        # Goldman 2005, curvatures of implicit surfaces; F grows towards the camera at the anchor.
        length = np.linalg.norm(g)
        adjugate = k1 * k2 * np.outer(normal, normal)  # of the Hessian, whose third eigenvector is the normal
        gaussian = g @ adjugate @ g / length**4
        mean = (length**2 * np.trace(hessian) - g @ hessian @ g) / (2 * length**3)
        np.testing.assert_allclose(points["k_min"][0] * points["k_max"][0], gaussian, atol=1e-12)
        np.testing.assert_allclose((points["k_min"][0] + points["k_max"][0]) / 2, sign * mean, atol=1e-12)
    assert used >= 10


@pytest.mark.parametrize("pose", POSES[:4])
@pytest.mark.parametrize(("k1", "k2"), [(0.05, 0.02), (0.02, 0.05), (-0.06, -0.03), (0.05, -0.05)])
def test_quadric_at_its_anchor(pose, k1, k2):
    anchor, normal, first, second = anchor_frame(pose)
    points = cast(build("quadric", pose, k1_per_mm=k1, k2_per_mm=k2), [0.0, 0, 1])
    np.testing.assert_allclose(points["position"][0], anchor, atol=1e-12)
    np.testing.assert_allclose(points["normal"][0], normal, atol=1e-13)
    np.testing.assert_allclose(points["k_min"][0], min(k1, k2), rtol=1e-12)
    np.testing.assert_allclose(points["k_max"][0], max(k1, k2), rtol=1e-12)
    greater, lesser = (first, second) if k1 > k2 else (second, first)
    agree_up_to_sign(points["direction_max"][0], greater, 1e-12)
    agree_up_to_sign(points["direction_min"][0], lesser, 1e-12)


SURFACES = {
    "sphere outside": ("sphere", {"radius_mm": 8.0}),
    "sphere inside": ("sphere", {"radius_mm": 14.0, "side": "inside"}),
    "cylinder outside": ("cylinder", {"radius_mm": 8.0}),
    "cylinder inside": ("cylinder", {"radius_mm": 14.0, "side": "inside"}),
    "saddle": ("quadric", {"k1_per_mm": 0.06, "k2_per_mm": -0.04}),
    "dome": ("quadric", {"k1_per_mm": 0.02, "k2_per_mm": 0.09}),
    "bowl": ("quadric", {"k1_per_mm": -0.02, "k2_per_mm": -0.05}),
}


@pytest.mark.parametrize("name", SURFACES)
def test_the_normal_turns_by_the_shape_operator(name):
    """dN = k du along the principal directions, by central differences between neighbouring rays."""
    kind, settings = SURFACES[name]
    model = build(kind, (25.0, 110.0, -50.0), **settings)
    step = 1e-4
    for pixel in ([32.0, 23.0], [25.0, 30.0], [38.0, 17.0]):
        offsets = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        points = cast(model, CAMERA.unproject(np.array(pixel) + offsets))
        assert points["valid"].all()
        P, N = points["position"], points["normal"]
        moves, turns = np.stack([P[1] - P[2], P[3] - P[4]]), np.stack([N[1] - N[2], N[3] - N[4]])
        # The tangent vectors really are tangent: the normal is that of the positions.
        assert np.abs(moves @ N[0]).max() < 1e-9 * np.abs(moves).max() / step
        u, v = points["direction_min"][0], points["direction_max"][0]
        tangent = np.stack([u, v], axis=1)
        S = np.linalg.solve(moves @ tangent, turns @ tangent)
        np.testing.assert_allclose(S, np.diag([points["k_min"][0], points["k_max"][0]]), atol=1e-7)


def test_sign_of_curvature():
    """Convex towards the camera is positive, a wall seen from inside negative (theory.md, section 0)."""
    for kind in ("sphere", "cylinder"):
        assert cast(build(kind, radius_mm=12.0), [0.0, 0, 1])["k_max"][0] == pytest.approx(1 / 12)
        assert cast(build(kind, radius_mm=12.0, side="inside"), [0.0, 0, 1])["k_min"][0] == pytest.approx(-1 / 12)
    # Points beside the anchor of a convex surface lie farther away, of a wall from inside nearer than on a plane.
    aside = CAMERA.unproject([40.0, 22.5])
    depths = {
        name: cast(build("sphere", **settings), aside)["position"][0, 2]
        for name, settings in {"convex": {"radius_mm": 12.0}, "inside": {"radius_mm": 12.0, "side": "inside"}}.items()
    }
    assert depths["inside"] < D < depths["convex"]


def test_a_miss_is_a_miss():
    s = CAMERA.unproject([[33.0, 22.5], [1.0, 1.0]])
    points = cast(build("sphere", radius_mm=3.0), s)
    assert points["valid"].tolist() == [True, False]
    unseen = cast(build("sphere", radius_mm=3.0), s, near=np.inf)
    assert not unseen["valid"].any()
    well_formed(points)


def test_a_camera_outside_the_sphere_it_should_be_in_is_refused():
    with pytest.raises(InputError, match="puts the camera outside"):
        build("sphere", radius_mm=5.0, side="inside")
    with pytest.raises(InputError, match="puts the camera outside"):
        build("cylinder", (61.0, 0.0, 0.0), radius_mm=10.2, side="inside")


def test_poses_are_rigid():
    for pose in POSES:
        rotation = build("plane", pose).model_from_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) == pytest.approx(1)
