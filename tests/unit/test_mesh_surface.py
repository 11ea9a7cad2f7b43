"""A user's mesh: reading, refusals, orientation, subdivision, normals and curvatures."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from simtest.errors import InputError
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.mesh_file import read_mesh
from simtest.surfaces.mesh_surface import LUMEN_QUOTIENT, make_mesh_surface, prepare
from simtest.surfaces.model import RayHits
from simtest.surfaces.triangles import isoperimetric_quotient
from tests.marked import marked

MESHES = Path(__file__).resolve().parents[2].parent / "shared/data/meshes"
COLON, LIVER = MESHES / "colon_edingca_00090.ply", MESHES / "liver_sksurgery.ply"
needs_meshes = pytest.mark.skipif(not COLON.is_file() or not LIVER.is_file(), reason=f"no reference meshes in {MESHES}")

PLY = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
CORNERS = "0 0 0\n9 0 0\n0 9 0\n0 0 9\n"
FACES = "3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
VTK = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET "


def sphere(radius=10.0, level=4):
    return trimesh.creation.icosphere(level, radius=radius)


def save(mesh, path):
    mesh.export(path)
    return path


def surface(path, **settings):
    return make_mesh_surface(AnatomySurface(path=str(path), **settings))


def hits_of(mesh, count=500, seed=0, height=5.0):
    rng = np.random.default_rng(seed)
    face, (b, c) = rng.integers(len(mesh.faces), size=count), np.sort(rng.random((2, count)), axis=0)
    b, c = b, c - b
    points = np.einsum("cn,nci->ni", np.stack([1 - b - c, b, c]), mesh.vertices[mesh.faces[face]])
    origins = points + height * mesh.normals[mesh.faces[face, 0]] + 0.2 * rng.normal(size=(count, 3))
    distance = np.linalg.norm(points - origins, axis=1)
    hits = RayHits(distance, face, np.stack([b, c], axis=1))
    return origins, (points - origins) / distance[:, None], hits


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "vtk"])
def test_every_format_reads_alike(tmp_path, suffix):
    path = tmp_path / f"ball.{suffix}"
    if suffix == "vtk":
        pyvista = pytest.importorskip("pyvista")
        pyvista.wrap(sphere(level=2)).save(path)
    else:
        save(sphere(level=2), path)
    vertices, faces, repairs = read_mesh(path)
    assert faces.shape == (320, 3)
    assert vertices.shape == (162, 3)  # STL's soup is merged
    assert not list(repairs.sentences())
    assert trimesh.Trimesh(vertices, faces, process=False).is_watertight


def test_polygons_are_cut_into_triangles(tmp_path):
    path = tmp_path / "grid.vtk"
    path.write_text(
        VTK + "UNSTRUCTURED_GRID\nPOINTS 8 float\n0 0 0 9 0 0 9 9 0 0 9 0 0 0 9 9 0 9 9 9 9 0 9 9\n"
        "CELLS 1 9\n8 0 1 2 3 4 5 6 7\nCELL_TYPES 1\n12\n"
    )
    assert read_mesh(path)[1].shape == (12, 3)


MALFORMED = {
    "empty.ply": ("", "0 bytes"),
    "empty.vtk": ("", "0 bytes"),
    "text.ply": ("this is no mesh\n", "no PLY file; it must begin with ply"),
    "text.obj": ("this is no mesh\n", "no faces"),
    "text.stl": ("this is no mesh\n", "no faces|not a readable"),
    "text.vtk": ("this is no mesh\n", "no VTK file; its first line must be"),
    "nan.ply": (PLY.format(4, 4) + CORNERS.replace("9 0 0", "nan 0 0", 1) + FACES, "vertex 1 is"),
    "infinite.obj": ("v 0 0 0\nv inf 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n", "finite|readable"),
    "cloud.ply": (PLY.format(4, 0) + CORNERS, "4 points and no faces"),
    "cloud.obj": ("v 0 0 0\nv 9 0 0\nv 0 9 0\n", "3 points and no faces"),
    "cloud.vtk": (VTK + "POLYDATA\nPOINTS 3 float\n0 0 0 9 0 0 0 9 0\n", "3 points and no faces"),
    "image.vtk": (VTK + "STRUCTURED_POINTS\nDIMENSIONS 3 3 3\nORIGIN 0 0 0\nSPACING 1 1 1\n", "PolyData"),
    "one.ply": (PLY.format(4, 1) + CORNERS + "3 0 2 1\n", "1 face; at least 4 are needed"),
    "range.ply": (PLY.format(4, 4) + CORNERS + FACES.replace("1 2 3", "1 2 9"), "names vertex 9; allowed: 0 to 3"),
    "negative.ply": (PLY.format(4, 4) + CORNERS + FACES.replace("1 2 3", "1 2 -1"), "names vertex -1"),
    "range.obj": ("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 9\n", "not a readable OBJ"),
    "range.vtk": (VTK + "POLYDATA\nPOINTS 3 float\n0 0 0 9 0 0 0 9 0\nPOLYGONS 1 4\n3 0 1 9\n", "names vertex 9"),
    "flat.ply": (PLY.format(4, 4) + "0 0 0\n9 0 0\n5 0 0\n2 0 0\n" + FACES, "0 of 4 faces have an area"),
    "huge.ply": (PLY.format(4, 6_000_000) + CORNERS, "6000000 faces; at most 5000000"),
    "metres.ply": (PLY.format(4, 4) + CORNERS.replace("9", "0.009") + FACES, "lengths are in mm"),
    "mesh.xyz": ("0 0 0\n", "unknown suffix '.xyz'; allowed: .ply, .obj, .stl, .vtk"),
}


@pytest.mark.parametrize("name", marked(MALFORMED, ci=["cloud.vtk", "range.vtk"]))
def test_malformed_files_give_one_line(tmp_path, capfd, name):
    text, message = MALFORMED[name]
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_mesh(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_binary_rubbish_truncation_and_missing_files_are_refused(tmp_path):
    whole = save(sphere(level=2), tmp_path / "ball.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[: len(whole) // 2])
    for suffix in ("ply", "obj", "stl", "vtk"):
        (tmp_path / f"rubbish.{suffix}").write_bytes(np.random.default_rng(0).bytes(2000))
    folder = tmp_path / "folder.ply"
    folder.mkdir()
    for name in ("cut.ply", "none.ply", "folder.ply", *(f"rubbish.{s}" for s in ("ply", "obj", "stl", "vtk"))):
        with pytest.raises(InputError) as error:
            read_mesh(tmp_path / name)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError):
        surface(tmp_path / "none.ply")


def test_curvature_of_a_sphere_is_positive_outside_and_negative_inside(tmp_path):
    path = save(sphere(), tmp_path / "ball.ply")
    for kind, sign in (("auto", 1), ("lumen", -1)):
        model = surface(path, kind=kind, subdivisions=0)
        mesh = model.shape().mesh
        assert model.lumen == (kind == "lumen")
        origins, directions, hits = hits_of(mesh)
        points = model.points(origins, directions, hits)
        assert points.valid.all()
        np.testing.assert_allclose(points.k_min, sign * 0.1, rtol=0.01)
        np.testing.assert_allclose(points.k_max, sign * 0.1, rtol=0.01)
        np.testing.assert_allclose(points.distance, hits.distance)
        np.testing.assert_allclose(points.position, origins + hits.distance[:, None] * directions)
        radial = sign * points.position / np.linalg.norm(points.position, axis=1, keepdims=True)
        assert np.degrees(np.arccos(np.einsum("ni,ni->n", radial, points.normal).clip(-1, 1))).max() < 0.2
        assert np.abs(np.einsum("ni,ni->n", points.normal, points.direction_max)).max() < 1e-12
        corners = mesh.vertices[mesh.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("ni,ni->n", cross, mesh.normals[mesh.faces[:, 0]]) > 0).all()


def test_curvature_of_a_torus_follows_its_formula(tmp_path):
    big, small = 20.0, 6.0
    path = save(trimesh.creation.torus(big, small, major_sections=240, minor_sections=96), tmp_path / "torus.ply")
    model = surface(path, kind="organ", subdivisions=0)
    points = model.points(*hits_of(model.shape().mesh))
    ring = np.hypot(points.position[:, 0], points.position[:, 1]) - big
    np.testing.assert_allclose(points.k_max, 1 / small, atol=2e-3)
    np.testing.assert_allclose(points.k_min, ring / small / (big + ring), atol=2e-3)


def test_rays_that_miss_have_no_point(tmp_path):
    model = surface(save(sphere(), tmp_path / "ball.ply"), subdivisions=0)
    origins, directions, hits = hits_of(model.shape().mesh, count=5)
    hits.distance[2] = np.inf
    points = model.points(origins, directions, hits)
    assert points.valid.tolist() == [True, True, False, True, True]
    assert np.isnan(points.normal[2]).all()


def test_orientation_is_mended(tmp_path):
    ball = sphere(level=3)
    flip = np.random.default_rng(0).random(len(ball.faces)) < 0.5
    faces = np.where(flip[:, None], ball.faces[:, ::-1], ball.faces)
    for name, wrong, said in (
        ("mixed", faces, "reversed"),
        ("out", ball.faces[:, ::-1], "turned 1 piece that was ins"),
    ):
        path = save(trimesh.Trimesh(ball.vertices, wrong, process=False), tmp_path / f"{name}.ply")
        with pytest.warns(UserWarning, match=said):
            mesh = prepare(path, 0).mesh
        assert (np.einsum("ni,ni->n", mesh.normals, mesh.vertices) > 0).all()


def test_subdivision_is_reduced_with_a_warning(tmp_path, monkeypatch):
    path = save(sphere(level=3), tmp_path / "ball.ply")
    assert len(prepare(path, 1).mesh.faces) == 4 * 1280
    monkeypatch.setattr("simtest.surfaces.mesh_surface.MAX_SUBDIVIDED_FACES", 10_000)
    with pytest.warns(UserWarning, match=r"3 subdivisions of 1280 faces .* 10000; using 1\. Decimated to 625 faces"):
        prepared = prepare(path, 3)
    assert prepared.subdivisions == 1
    assert len(prepared.mesh.faces) == 4 * 1280


def test_non_manifold_edges_are_not_subdivided(tmp_path):
    box = trimesh.creation.box((20, 20, 20)).subdivide()
    vertices = np.vstack([box.vertices, [[0, 0, 30.0]]])
    faces = np.vstack([box.faces, [[box.faces[0][0], box.faces[0][1], len(box.vertices)]]])
    path = save(trimesh.Trimesh(vertices, faces, process=False), tmp_path / "fin.ply")
    with pytest.warns(UserWarning, match="1 edges belong to more than two faces"):
        assert prepare(path, 1).subdivisions == 0


def test_prepared_meshes_are_kept_until_the_file_changes(tmp_path):
    path = save(sphere(level=2), tmp_path / "ball.ply")
    first = prepare(path, 0)
    assert prepare(path, 0) is first
    save(sphere(radius=12, level=3), path)
    assert prepare(path, 0).key != first.key


def test_quotient_tells_a_tube_from_a_ball():
    ball, tube = sphere(level=3), trimesh.creation.cylinder(10, 1000, sections=64)
    assert isoperimetric_quotient(ball.vertices, ball.faces) == pytest.approx(1, abs=0.03)
    assert isoperimetric_quotient(tube.vertices, tube.faces) == pytest.approx(0.045, rel=0.05)
    assert isoperimetric_quotient(tube.vertices, tube.faces) < LUMEN_QUOTIENT


@pytest.mark.ci  # meanwhile: meshes that are made here
@needs_meshes
def test_reference_meshes_are_told_apart():
    liver = surface(LIVER, subdivisions=1)
    assert not liver.lumen
    assert len(liver.shape().mesh.faces) == 80_000
    assert np.median(np.trace(liver.vertex_shape_operators(), axis1=1, axis2=2)) > 0
    colon = surface(COLON, subdivisions=0)
    assert colon.lumen
    assert np.median(np.trace(colon.vertex_shape_operators(), axis1=1, axis2=2)) < 0
    for model in (liver, colon):
        mesh = trimesh.Trimesh(model.shape().mesh.vertices, model.shape().mesh.faces, process=False)
        assert mesh.is_watertight
        assert (mesh.volume > 0) == (model is liver)  # the lumen's winding is turned inward


def test_no_file_of_the_current_folder_runs(tmp_path, monkeypatch):
    """VTK files are read in a child; a module beside the mesh must not stand in for a package there."""
    (tmp_path / "pyvista.py").write_text("from pathlib import Path; Path('ran').touch()")
    (tmp_path / "m.vtk").write_text(VTK + "POLYDATA\nPOINTS 3 float\n0 0 0 9 0 0 0 9 0\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="3 points and no faces"):
        surface(Path("m.vtk"))
    assert not (tmp_path / "ran").exists()
