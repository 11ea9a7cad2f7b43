"""Camera poses: rigid, repeatable, never in tissue, looking at the surface."""

from pathlib import Path
from types import SimpleNamespace

import igl
import numpy as np
import pytest

from simtest.errors import InputError
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces import make_surface
from simtest.surfaces.mesh_surface import make_mesh_surface
from simtest.surfaces.poses import AXIS_RANGE_MM, MeshProbe, lumen_pose, organ_pose
from tests.marked import marked

ROOT = Path(__file__).resolve().parents[2]
MESHES = ROOT.parent / "shared/data/meshes"
SURFACES = marked(["colon", "liver", "colon_edingca_00090", "liver_sksurgery"], ci=["liver", "colon_edingca_00090"])


def make(name, viewpoint):
    if (shipped := ROOT / "meshes" / f"{name}.toml").is_file():
        return make_surface(AnatomySurface(path=str(shipped), viewpoint=viewpoint))
    path = MESHES / f"{name}.ply"
    if not path.is_file():
        pytest.skip(f"no reference mesh {path}")
    return make_mesh_surface(AnatomySurface(path=str(path), viewpoint=viewpoint, subdivisions=0))


@pytest.mark.parametrize("name", SURFACES)
def test_poses_are_rigid_repeatable_and_different(name):
    poses = [make(name, viewpoint).model_from_camera for viewpoint in range(3)]
    for viewpoint, pose in enumerate(poses):
        np.testing.assert_array_equal(pose, make(name, viewpoint).model_from_camera)
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    assert len({pose.tobytes() for pose in poses}) == 3


@pytest.mark.parametrize(
    ("values", "pinned"),
    [
        ({"path": "colon"}, 13.957490864766196),
        ({"path": "liver"}, 162.68511745695957),
        ({"path": "liver_4mm"}, -663.9348555625647),
        ({"path": "colon_40mm", "kind": "lumen"}, 40.19216974523482),
        ({"path": "colon", "view": "path"}, 113.52738710539266),
        ({"path": "colon", "view": "off_axis"}, 107.20198003121865),
        ({"path": "colon", "view": "wall"}, 109.0320600366629),
    ],
    ids=str,
)
def test_poses_are_those_of_ever(values, pinned):
    """A random sum over ten poses: a changed draw would move all viewpoints of scenes and datasets."""
    if values["path"] in ("liver_4mm", "colon_40mm"):
        values = {**values, "path": str(ROOT / "meshes" / f"{values['path']}.ply")}
    along = "view" in values
    poses = [
        make_surface(
            AnatomySurface(**values, **({"path_share": n / 9, "around_deg": 40} if along else {"viewpoint": n}))
        ).model_from_camera
        for n in range(10)
    ]
    weights = np.random.default_rng(0).uniform(-1, 1, (10, 3, 4))
    assert np.sum(weights * np.array(poses)[:, :3]) == pytest.approx(pinned, rel=0, abs=1e-9)


@pytest.mark.parametrize("name", SURFACES)
def test_camera_is_never_in_tissue_and_sees_the_surface(name):
    lumen = name.startswith("colon")
    poses = np.stack([make(name, viewpoint).model_from_camera for viewpoint in range(30)])
    model = make(name, 0)
    sites, axes = poses[:, :3, 3].copy(), poses[:, :3, 2].copy()
    room = model.clearance(sites)
    assert (room >= 4.99 if lumen else room > 0).all()
    mesh = model.shape().mesh
    distance = MeshProbe(mesh).cast(sites, axes)
    low, high = AXIS_RANGE_MM if lumen else (20, 150)
    assert ((distance >= low) & (distance <= high)).mean() > 0.9
    assert np.isfinite(distance).all()
    # Independent of the code under test: the winding number is 0 outside a closed surface and +-1 inside.
    if name != "colon":
        winding = igl.fast_winding_number(mesh.vertices, mesh.faces, sites)
        np.testing.assert_allclose(np.abs(winding), 1 if lumen else 0, atol=0.05)


@pytest.mark.parametrize("name", ["colon", "liver"])
def test_clearance_has_the_sign_of_the_side(name):
    model = make(name, 0)
    mesh = model.shape().mesh
    pick = np.random.default_rng(0).permutation(len(mesh.vertices))[:500]
    for height in (0.5, -0.5):
        points = mesh.vertices[pick] + height * mesh.normals[pick]
        room = model.clearance(points)
        u_ok = np.ones(len(pick), dtype=bool)
        if name == "colon":  # at an open end the slice decides, not the wall
            u, _, _ = model.tube.slice_of(points)
            u_ok = (u > 2) & (u < model.tube.recipe.length_mm - 2)
        assert (np.sign(room[u_ok]) == np.sign(height)).all()
        assert (np.abs(room[u_ok]) < 0.6).all()
        np.testing.assert_allclose(np.abs(room[u_ok]), 0.5, atol=0.15)


def test_mesh_probe_sign_agrees_with_the_exact_one():
    model = make("liver", 0)
    points = np.random.default_rng(1).uniform(-120, 120, size=(400, 3))
    np.testing.assert_allclose(MeshProbe(model.shape().mesh).clearance(points), model.clearance(points), atol=1e-9)


def test_no_place_is_an_input_error():
    def nowhere(points):
        return np.full(len(points), -1.0)

    def cast(origins, directions):
        return np.full(len(origins), np.inf)

    def targets(rng, count):
        return np.zeros((count, 3)), np.tile([0, 0, 1.0], (count, 1))

    probe = SimpleNamespace(cast=cast, targets=targets)
    surface = SimpleNamespace(sites=lambda rng: rng.normal(size=(4, 3)), clearance=nowhere, probe=probe)
    with pytest.raises(InputError, match="viewpoint 3"):
        lumen_pose("x", 3, surface)
    with pytest.raises(InputError, match="viewpoint 3"):
        organ_pose("x", 3, surface)
