"""What every surface promises: exact points on its rays, with the normals and curvatures that differences have.

Analytic surfaces besides against one formula, written here in the camera frame.
"""

from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np
import pytest
from surface_helpers import RELIEF, STENCIL, angle, curvatures, normals, relative

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.rendering import Session, backend, truth, tube_kernel
from simtest.rendering.tube_kernel import TubeKernel
from simtest.spec import scene_from_dict
from simtest.surfaces import RayHits, SurfacePoints, make_surface
from simtest.surfaces.deformation import DeformedSurface
from simtest.surfaces.model import shape_operator
from simtest.surfaces.relief_field import make_relief
from tests.marked import marked

# Analytic surfaces ---------------------------------------------------------------------------------------------------

CAMERA = Camera(64, 48, 60.0, 55.0, 33.0, 22.5, 3.0)
D = 10.0
POSES = [(0.0, 0.0, 0.0), (0.0, 0.0, 35.0), (25.0, 0.0, 0.0), (25.0, 110.0, -50.0), (60.0, -70.0, 200.0)]
"""Tilt, azimuth, spin, deg."""

ROUND = [("outside", 3.0), ("outside", 400.0), ("inside", 10.1), ("inside", 70.0)]
ANALYTIC = [("plane", {}, (0, 0, 0))]
"""Kind, settings, and the diagonal of A: in the anchor's frame, with z along its normal, z + q A q / 2 = 0."""
for side, R in ROUND:
    k = (1 if side == "outside" else -1) / R
    ANALYTIC += [
        (kind, {"radius_mm": R, "side": side}, A) for kind, A in (("sphere", (k, k, k)), ("cylinder", (k, 0, k)))
    ]
ANALYTIC += [
    ("quadric", {"k1_per_mm": k1, "k2_per_mm": k2}, (k1, k2, 0))
    for k1, k2 in [(0.05, 0.02), (0.05, -0.05), (-0.06, -0.03), (-0.08, 0.0), (0.0, 0.0), (0.3, 0.1)]
]


def build(kind, pose=(0.0, 0.0, 0.0), **settings):
    tilt, azimuth, spin = pose
    placed = {"distance_mm": D, "tilt_deg": tilt, "azimuth_deg": azimuth, "spin_deg": spin}
    return make_surface(scene_from_dict({"surface": {"type": kind, **placed, **settings}}).surface)


def anchor_axes(pose):
    """Return the two principal directions and the normal at the anchor, camera frame, as rows: Rodrigues' formula.

    The normal is (0, 0, -1) turned by the tilt towards the azimuth; the principal directions turn along.
    """
    tilt, azimuth, spin = np.radians(pose)
    axis = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])

    def turned(v):
        return np.cos(tilt) * v + np.sin(tilt) * np.cross(axis, v) + (1 - np.cos(tilt)) * (axis @ v) * axis

    first, second = [np.cos(spin), np.sin(spin), 0.0], [-np.sin(spin), np.cos(spin), 0.0]
    axes = np.stack([turned(np.array(v)) for v in (first, second, [0.0, 0.0, -1.0])])
    normal = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    np.testing.assert_allclose(axes[2], normal, atol=1e-15)
    return axes


def cast(model, directions, near):
    """Return the exact points on rays from the camera; `near` stands in for the ray tracer's distances."""
    pose, count = model.model_from_camera, len(directions)
    hits = RayHits(np.broadcast_to(near, count).astype(float), np.zeros(count, dtype=int), np.zeros((count, 2)))
    return model.points(np.broadcast_to(pose[:3, 3], (count, 3)), directions @ pose[:3, :3].T, hits)


def roots_of(a, b, c):
    """Return the positive real roots of a t^2 + b t + c, rising, shape (N, 2); NaN where there are fewer."""
    roots = np.full((len(a), 2), np.nan)
    for i in range(len(a)):
        found = np.roots([a[i], b[i], c]) if abs(a[i]) > 1e-15 else np.array([-c / b[i]])
        real = np.sort(found[(np.abs(found.imag) < 1e-12) & (found.real > 0)].real)
        roots[i, : len(real)] = real
    return roots


@pytest.mark.parametrize(("kind", "settings", "A"), ANALYTIC, ids=str)
def test_faces_of_an_analytic_mesh_join_neighbours_and_look_as_their_corners_do(kind, settings, A):
    del A
    mesh = build(kind, **settings).mesh
    corners, normals = mesh.vertices[mesh.faces], mesh.normals[mesh.faces].mean(axis=1)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    sound = area > 1e-9 * area.max()
    assert sound.mean() > 0.9
    assert (np.einsum("ni,ni->n", across, normals)[sound] > 0.8 * area[sound]).all()
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))


@pytest.mark.parametrize(("kind", "settings", "A"), ANALYTIC, ids=str)
def test_analytic_points_normals_and_shape_operators_are_those_of_the_formula(kind, settings, A):
    """F = z + q A q / 2 grows towards the camera; N = grad F / |grad F|, S = P A P / |grad F| (Goldman 2005).

    Of a sphere or cylinder the near root is met from outside and the far one from inside, of a quadric either one: that
    next to the rendered hit.
    """
    s = np.vstack([[0.0, 0, 1], CAMERA.unproject(CAMERA.pixel_centres()[::4, ::4].reshape(-1, 2))])
    A = np.diag(A)
    for pose in POSES:
        model, axes = build(kind, pose, **settings), anchor_axes(pose)
        to_axes = model.model_from_camera[:3, :3] @ axes.T
        camera, r = -D * axes[:, 2], s @ axes.T  # as the anchor's frame has them
        a, b = np.einsum("ni,ij,nj->n", r, A, r) / 2, r[:, 2] + r @ A @ camera
        roots = roots_of(a, b, camera[2] + camera @ A @ camera / 2)
        compared = 0
        for t in roots.T if kind == "quadric" else [np.fmax(*roots.T) if A[2, 2] < 0 else roots[:, 0]]:
            # Rays along an almost straight line have a far root that is all rounding.
            hit = t < 1e6
            points = cast(model, s, np.where(hit, t + 1e-3, np.inf) if kind == "quadric" else D)
            assert points.valid[hit].all()
            assert not points.valid[np.isnan(t)].any()
            well_formed(points)
            g = (camera + t[:, None] * r) @ A + [0, 0, 1]
            length = np.linalg.norm(g, axis=1, keepdims=True)
            N = g / length
            facing = np.sum(N * r, axis=1)
            # At the silhouette a formula of roots loses half of its digits.
            sure = hit & (np.abs(facing) > 0.05)
            compared += np.count_nonzero(sure)
            across = np.eye(3) - N[:, :, None] * N[:, None, :]
            S = -np.sign(facing)[:, None, None] * across @ A @ across / length[:, :, None]
            np.testing.assert_allclose(points.distance[sure], t[sure], rtol=1e-9)
            normal, found = points.normal @ to_axes, to_axes.T @ shape_operator(points) @ to_axes
            np.testing.assert_allclose(normal[sure], (-np.sign(facing)[:, None] * N)[sure], atol=1e-9)
            np.testing.assert_allclose(found[sure], S[sure], atol=1e-9 + 1e-8 * np.abs(A).max())
            if abs(t[0] - D) < 1e-9:
                # At the anchor: convex towards the camera is positive, a wall seen from inside negative.
                np.testing.assert_allclose(found[0], np.diag([A[0, 0], A[1, 1], 0.0]), atol=1e-12)
                compared += 1000
        # The anchor, and enough beside it.
        assert compared > 1020


def well_formed(points):
    """Check what holds on every surface: finite or NaN in all, an orthonormal frame, k_min <= k_max."""
    ok = points.valid
    frame = np.stack([points.normal, points.direction_min, points.direction_max], axis=1)[ok]
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1) - np.eye(3), 0, atol=1e-12)
    assert (points.k_min[ok] <= points.k_max[ok]).all()
    for field in fields(SurfacePoints):
        values = getattr(points, field.name)
        if values.dtype == float:
            assert np.isfinite(values[ok]).all(), field.name
            assert np.isnan(values[~ok]).all(), field.name


def test_a_camera_outside_the_sphere_it_should_be_in_is_refused():
    with pytest.raises(InputError, match="puts the camera outside"):
        build("sphere", radius_mm=5.0, side="inside")
    with pytest.raises(InputError, match="puts the camera outside"):
        build("cylinder", (61.0, 0.0, 0.0), radius_mm=10.2, side="inside")


# Every surface -------------------------------------------------------------------------------------------------------

SESSILE = [{"along_mm": 40, "around_deg": 80, "height_mm": 5, "width_mm": 9},
           {"along_mm": 70, "around_deg": -100, "height_mm": 3, "width_mm": 5}]  # fmt: skip
STALKED = [{"along_mm": 60, "around_deg": 80, "height_mm": 8, "width_mm": 6, "neck_mm": 2.4},
           {"along_mm": 35, "around_deg": -60, "height_mm": 7, "width_mm": 5, "neck_mm": 3}]  # fmt: skip
COLON = {"type": "anatomy", "path": "colon"}
SURFACES = {
    "plane": {"type": "plane", "distance_mm": 20, "tilt_deg": 25},
    "sphere": {"type": "sphere", "distance_mm": 20, "radius_mm": 15},
    "sphere inside": {"type": "sphere", "distance_mm": 20, "radius_mm": 12, "side": "inside"},
    "cylinder": {"type": "cylinder", "distance_mm": 20, "radius_mm": 12},
    "cylinder inside": {"type": "cylinder", "distance_mm": 12, "radius_mm": 20, "side": "inside"},
    "quadric": {"type": "quadric", "distance_mm": 15, "k1_per_mm": 0.05, "k2_per_mm": -0.03},
    "colon": COLON,
    "colon, polyps": {**COLON, "recipe": {"polyps": SESSILE, "relief_mm": 0.01, "relief_length_mm": 5.0}},
    "colon, tight": {**COLON, "recipe": {"length_mm": 60, "radius_mm": 6, "bend_deg": 170, "sway_deg": 20,
                                         "sway_length_mm": 60, "fold_depth_mm": 2.5, "taenia_mm": 0.3}},
    "colon, closed": {**COLON, "viewpoint": 4, "recipe": {"length_mm": 50, "closed": True, "relief_mm": 0.01}},
    "colon, stalks": {**COLON, "viewpoint": 1, "recipe": {"polyps": [*STALKED, SESSILE[1]]}},
    "colon, haustra": {**COLON, "recipe": {"fold_stagger": 0.33, "taenia_ridge_mm": 1.5, "crease_mm": 0.5,
                                           "polyp_count": 8, "polyp_stalked": 0.0}},
    "liver": {"type": "anatomy", "path": "liver"},
}  # fmt: skip
ON_RELIEF = ("plane", "sphere", "cylinder inside", "quadric", "colon", "liver")
WAVE = {"type": "peristalsis", "amplitude_mm": 4.0, "period_s": 3.0, "centre_mm": [1, 2, 3], "axis": [1, 2, 0.5],
        "radius_mm": 12.0, "wavelength_mm": 30.0}  # fmt: skip
BREATH = {"type": "breathing", "amplitude_mm": 6.0, "period_s": 4.0, "direction": [0, 1, 1], "along": [1, 0, 0.3],
          "wavelength_mm": 60.0, "warp": 0.7, "turn_deg": 5.0, "axis": [1, 1, 0]}  # fmt: skip
DENT = {"type": "dent", "amplitude_mm": -3.0, "period_s": 2.0, "direction": [0, 0.2, 1], "radius_mm": 5.0,
        "centre_mm": [3, 1, 2]}  # fmt: skip
RINGS = {"type": "contractions", "amplitude_mm": 3.0, "period_s": 2.0, "radius_mm": 8.0, "width_mm": 4.0,
         "spacing_mm": 9.0, "path_mm": [[-20, 0, 0], [0, 5, 0], [8, 20, 3], [0, 30, 10]]}  # fmt: skip
DEFORMATIONS = {"at rest": [], "breathing": [BREATH], "moved": [WAVE, BREATH, DENT], "ringed": [RINGS, BREATH]}

CASES = [(name, None, "at rest") for name in SURFACES]
CASES += [(name, film, "at rest") for name, film in product(ON_RELIEF, ("bare", -0.5))]
CASES += [(name, "patches", "at rest") for name in ("sphere", "colon")] + [("quadric", "patches", "moved")]
CASES += [(name, None, "moved") for name in list(SURFACES)[:6]]
CASES += [("sphere", None, "ringed"), ("quadric", "bare", "moved")]
BREATHING = [(name, None, "breathing") for name in ("colon", "liver")]
CASES += BREATHING
"""Surface; without relief, with a bare one, or one under a film up to a level or in patches; and its deformation."""
PATCHY = {"type": "tissue", "film": {"index": 1.34, "level": -0.5, "patches": {"wavelength_mm": 5.0}}}
DEAR = [(name, None, "at rest") for name in ("colon, polyps", "colon, tight", "colon, haustra")]
DEAR += [("colon", "bare", "at rest"), ("liver", "bare", "at rest"), ("liver", -0.5, "at rest")]
DEAR += [
    ("sphere", None, "ringed"),
    ("quadric", "bare", "moved"),
    ("quadric", "patches", "moved"),
    ("colon", "patches", "at rest"),
]
DEAR += [(name, None, "moved") for name in list(SURFACES)[:6] if name != "sphere inside"]


def scene(name, relief=None, deformation="at rest"):
    surface = SURFACES[name] | ({} if relief is None else {"relief": RELIEF})
    camera = {"width": 64, "height": 48, "fx": 50, "fy": 50}
    moment = {"deformation": DEFORMATIONS[deformation], "time_s": 0.7}
    wet = {"reflectance": PATCHY} if relief == "patches" else {}
    return scene_from_dict({"surface": surface, "camera": camera, **moment, **wet})


@pytest.fixture(scope="module")
def session():
    return Session(scene("plane"))


def placed(session, name, relief, deformation="at rest"):
    session.update(scene(name, relief, deformation))
    if isinstance(relief, float):
        session.surface.relief = make_relief(session.scene.surface.relief, relief)
    return session.surface


def height_over(surface, X):
    """Return how far points stand off a base surface by its own equation, apart from the solution under test."""
    if isinstance(surface, DeformedSurface):
        return height_over(surface.rest, surface.deformation.at_rest(X))
    if hasattr(surface, "tube"):
        u, v, radial = surface.tube.slice_of(X)
        return radial - (surface.tube.reach(u, v) if surface.tube.depth else surface.tube.radius(u, v).value)
    return surface.body.values(X) if hasattr(surface, "body") else surface.clearance(X)


@dataclass(frozen=True)
class Differences:
    """Fine normals and principal curvatures, (N, 2), by differences over the image, and the exact points."""

    points: object
    base: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray


def by_differences(session, pixels, step):
    """Difference positions, heights and fine normals along the image: each pixel position is a point of the base.

    With J = dX/dx the base's normal is across J's columns, the surface gradient is J (J^T J)^-1 dh/dx. Nothing here
    uses gradient or Hessian of the relief, or the base's normal.
    """
    relief = session.surface.relief

    def heights(points):
        return 0.0 if relief is None else relief.jets(session.to_model(np.nan_to_num(points.position))).value

    points = session.exact_points(pixels)
    J, dn, dh = np.zeros((len(pixels), 3, 2)), np.zeros((len(pixels), 3, 2)), np.zeros((len(pixels), 2))
    for axis in range(2):
        for k, weight in STENCIL:
            near = session.exact_points(pixels + k * step * np.eye(2)[axis])
            J[:, :, axis] += weight / step * near.position
            dn[:, :, axis] += weight / step * near.normal
            dh[:, axis] += weight / step * heights(near)
    usable = np.flatnonzero(np.isfinite(J).all(axis=(1, 2)) & points.valid)
    some = {name: getattr(points, name)[usable] for name in points.__dataclass_fields__}
    J, dn, dh = J[usable], dn[usable], dh[usable]
    base, normal = normals(J, dh, some["position"])
    return Differences(replace(points, **some), base, normal, curvatures(J, normal, dn))


@pytest.mark.parametrize(("name", "relief", "deformation"), marked(CASES, ci=DEAR, slow=BREATHING))
def test_points_have_the_normals_and_curvatures_of_differences(session, name, relief, deformation):
    surface = placed(session, name, relief, deformation)
    pixels = np.random.default_rng(5).uniform([4, 4], [60, 44], (300, 2))
    # A relief's third derivatives jump, and the tube of the colon is solved to rounding of its length.
    smooth = relief is None and not hasattr(surface, "tube")
    turned, bent = (1e-8, 1e-6) if smooth else (1e-6, 1e-4)
    wide = by_differences(session, pixels, 5e-4 if smooth else 1e-3)
    fine = wide if smooth else by_differences(session, pixels, 1e-4)
    points = wide.points
    assert len(points.normal) >= 150
    well_formed(points)
    sightlines = points.position / points.distance[:, None]
    assert np.abs(session.camera.project(sightlines)[:, None] - pixels).sum(axis=2).min(axis=1).max() < 1e-9
    assert np.abs(height_over(surface, session.to_model(points.position))).max() < 1e-9
    assert angle(wide.normal, points.normal).max() < turned
    assert angle(wide.base, points.normal_base).max() < turned
    if relief is not None:
        # Not smooth by chance
        assert np.median(angle(points.normal, points.normal_base)) > np.radians(1)
    exact = np.stack([fine.points.k_min, fine.points.k_max], axis=1)
    assert relative(fine.curvature, exact).max() < bent


@pytest.mark.parametrize(
    ("name", "relief"),
    [
        ("sphere", None),
        ("colon", None),
        ("colon", "bare"),
        ("colon, haustra", None),
        ("colon, closed", None),
        ("colon, stalks", None),
        pytest.param("colon, polyps", None, marks=pytest.mark.ci),
        pytest.param("colon, tight", None, marks=pytest.mark.ci),
    ],
)
def test_blocks_give_what_one_piece_gives_and_a_miss_is_one_in_all(session, name, relief, monkeypatch):
    monkeypatch.setattr(truth, "BLOCK", 64)
    monkeypatch.setattr(tube_kernel, "BLOCK", 256)
    surface = placed(session, name, relief)
    pixels = np.random.default_rng(1).uniform([-9, -9], [73, 57], (1000, 2))
    origins, directions = session.sightlines.in_model(pixels)
    hits = session.exact_hits(origins, directions)
    assert name != "colon, stalks" or np.mean(surface.polyp_at(hits) > 0) > 0.05
    hits.distance[::7] = np.inf
    directions[8] = np.nan  # no ray
    backend.load()
    for count in (0, 1, 150, 1000):
        some = origins[:count], directions[:count], hits.rows(slice(count))
        kernel = None if surface.chart is None else TubeKernel(surface.chart)
        whole, blocks = truth.solve(surface, *some), truth.solve_frame(surface, kernel, *some)
        assert not whole.valid[::7].any()
        assert not whole.valid[8:9].any()
        assert count < 2 or whole.valid.mean() > 0.2
        well_formed(whole)
        for field in fields(SurfacePoints):
            one, other = getattr(whole, field.name), getattr(blocks, field.name)
            assert (one.shape, one.dtype) == (other.shape, other.dtype)
            # Products of matrices may round by their size, and the kernel adds in another order.
            np.testing.assert_allclose(other, one, rtol=0, atol=1e-11)
        np.testing.assert_array_equal(surface.distances(*some), whole.distance)
