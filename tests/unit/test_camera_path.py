"""Camera paths through lumens: in the middle, smooth, and the poses on them and beside them."""

from itertools import product

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces import make_surface
from simtest.surfaces.colon import build
from simtest.surfaces.model import RayHits, Shape, SurfaceModel, TriangleMesh
from simtest.surfaces.poses import MIN_CLEARANCE_MM, camera_path
from simtest.surfaces.recipe import ColonRecipe
from tests.marked import marked


class Bent(SurfaceModel):
    """A torus piece of 90 deg, open at both ends: radius 40 mm, lumen of 8 mm."""

    solid = False

    def __init__(self, sweep=np.pi / 2):
        u, v = np.meshgrid(np.linspace(0, sweep, 60), np.linspace(0, 2 * np.pi, 32, endpoint=False), indexing="ij")
        out = 40 + 8 * np.cos(v)
        vertices = np.stack([out * np.cos(u), out * np.sin(u), 8 * np.sin(v)], axis=-1).reshape(-1, 3)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(59), np.arange(32), indexing="ij"))
        a, b = i * 32 + j, i * 32 + (j + 1) % 32
        faces = np.concatenate([np.stack([a, b, a + 32], 1), np.stack([b, b + 32, a + 32], 1)])
        self._mesh = TriangleMesh(vertices, faces, np.zeros_like(vertices))
        self._key = f"bent-{sweep}"
        self.model_from_camera = np.eye(4)

    def shape(self):
        return Shape("mesh", False, np.eye(4), self._mesh, self._key)

    def clearance(self, points):
        return 8 - np.hypot(np.hypot(points[:, 0], points[:, 1]) - 40, points[:, 2])

    def points(self, origins, directions, hits: RayHits):
        raise NotImplementedError


def test_the_path_keeps_to_the_middle_of_an_open_bent_tube():
    surface = Bent()
    path = camera_path(surface)
    assert (surface.clearance(path.points) > 6.5).all()
    assert path.length == pytest.approx(40 * np.pi / 2 - 16, abs=6)
    # Its frame turns as a circle of 40 mm does, and does not roll.
    turned = np.degrees(np.arccos(np.clip(np.sum(path.tangents[:-1] * path.tangents[1:], axis=1), -1, 1)))
    assert turned.mean() == pytest.approx(np.degrees(1 / 40), rel=0.3)
    assert turned.max() < 4
    np.testing.assert_allclose(np.sum(path.tangents * path.sides, axis=1), 0, atol=1e-12)


def test_the_path_of_a_closed_tube_is_its_centreline_clear_of_both_ends():
    surface = build(ColonRecipe(closed=True))
    path, tube = camera_path(surface), surface.tube
    at, _, off = tube.slice_of(path.points)
    np.testing.assert_allclose(off, 0, atol=1e-9)
    assert (surface.clearance(path.points) > MIN_CLEARANCE_MM).all()
    # As far from either pole as it usually is from the wall.
    usual = np.median(surface.clearance(path.points))
    np.testing.assert_allclose([at[0] + tube.depth, tube.recipe.length_mm + tube.depth - at[-1]], usual, atol=3)


def test_a_place_on_the_path_is_continuous_and_goes_straight_on_beyond_its_ends():
    path = camera_path(Bent())
    places = np.linspace(0, path.length, 500)
    points = np.array([path.at(place)[0] for place in places])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.mean()
    point, tangent, _ = path.at(path.length)
    np.testing.assert_allclose(path.at(path.length + 5)[0], point + 5 * tangent)


def test_a_lumen_too_short_for_a_path_is_refused():
    with pytest.raises(InputError, match="at least 20 mm"):
        camera_path(Bent(sweep=0.4))


def poses_of(path, **keys):
    surfaces = [make_surface(AnatomySurface(path=str(path), path_share=float(s), **keys)) for s in np.linspace(0, 1, 9)]
    return surfaces[0], np.stack([surface.model_from_camera for surface in surfaces])


VIEWS, REAL_COLON = ["path", "off_axis", "wall"], "colon_edingca_00090.ply"


@pytest.mark.parametrize(
    ("view", "name"),
    # Meanwhile: the path in a bent tube, and off_axis and wall in the colon.
    marked(product(VIEWS, ["colon", REAL_COLON]), ci=[("path", "colon")], slow=product(VIEWS, [REAL_COLON])),
)
def test_poses_are_rigid_smooth_and_never_in_tissue(request, name, view):
    path = name if name == "colon" else request.getfixturevalue("shared_data") / "meshes" / name
    keys = {"view": view, "subdivisions": 0}
    surface, poses = poses_of(path, **keys)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations.transpose(0, 2, 1) @ rotations - np.eye(3), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    room = surface.clearance(poses[:, :3, 3].copy())
    # The CT colon has necks narrower than the clearance.
    assert (room > (MIN_CLEARANCE_MM if name == "colon" else 1.0)).all()
    near = AnatomySurface(path=str(path), path_share=0.5005, **keys)
    there = AnatomySurface(path=str(path), path_share=0.5, **keys)
    np.testing.assert_allclose(make_surface(near).model_from_camera, make_surface(there).model_from_camera, atol=1.2)


def test_a_camera_on_the_path_looks_along_it_and_one_that_faces_the_wall_across_it():
    surface, ahead = poses_of("colon", view="path")
    across = poses_of("colon", view="wall")[1]
    path = camera_path(surface)
    tangents = np.array([path.at(share * path.length)[1] for share in np.linspace(0, 1, 9)])
    assert (np.sum(ahead[:, :3, 2] * tangents, axis=1) > 0.5).all()
    np.testing.assert_allclose(np.sum(across[:, :3, 2] * tangents, axis=1), 0, atol=1e-12)


@pytest.mark.slow
def test_an_organ_has_no_path():
    with pytest.raises(InputError, match=r"surface\.view = wall: liver is an organ"):
        make_surface(AnatomySurface(path="liver", view="wall"))


POSES = {
    ("colon", 0, "auto"): (
        [0.1846280279399984, 0.9633884366154164, 0.19440990585536283],
        [-2.594677227332398, -7.041270607678945, 37.89825294258695],
    ),
    ("colon", 2, "auto"): (
        [-0.9229785514907074, 0.25327899415210453, -0.2897591147995414],
        [17.370206960890435, 5.033494159174883, 41.030369782436786],
    ),
    ("liver", 0, "auto"): (
        [-0.31880079764743613, 0.4472164868862102, -0.8356814376761725],
        [-25.516140925727846, -72.43875130837469, 86.61693288966805],
    ),
    ("colon", 0, "off_axis"): (
        [0.5257937454975778, -0.15952282633756482, 0.8355198412203648],
        [36.2531652072239, 3.7643791141754077, 61.72211139636033],
    ),
}


def test_viewpoints_stay_where_they_are():
    """A case is found again by the number of its viewpoint, from one release to the next."""
    for (path, viewpoint, view), (forward, site) in POSES.items():
        spec = {"path": path, "viewpoint": viewpoint, "view": view}
        if view != "auto":
            spec |= {"path_share": 0.7, "around_deg": 30.0}
        pose = make_surface(AnatomySurface(**spec)).model_from_camera
        np.testing.assert_allclose(pose[:3, 2], forward, rtol=0, atol=1e-9)
        np.testing.assert_allclose(pose[:3, 3], site, rtol=0, atol=1e-7)
