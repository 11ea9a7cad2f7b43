"""Mesh files of all formats: read as what they are, or refused with the cause on one line."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from simtest.errors import InputError
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.mesh_file import _triangles, read_mesh, read_mixed_polygons
from simtest.surfaces.mesh_surface import make_mesh_surface

BALL = trimesh.creation.icosphere(subdivisions=2, radius=20)
SUFFIXES = ["ply", "obj", "stl", "vtk"]

# Files that are read -------------------------------------------------------------------------------------------------

CORNERS = np.array([[x, y, z] for x in (0, 10) for y in (0, 10) for z in (0, 10)], dtype=float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]
TRIANGLES = [(1, 5, 7), (1, 7, 3)]
MIXED = [*QUADS, *TRIANGLES]


def ply(faces, order="<", count="uchar", before="", after=""):
    """Return a binary PLY file of the cube; `before` and `after` are types of further properties of a face."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = [f"ply\nformat {name} 1.0\nelement vertex 8\nproperty float x\nproperty double y\nproperty float z"]
    lines += [f"element face {len(faces)}", *(f"property {kind} a{i}" for i, kind in enumerate(before.split()))]
    lines += [f"property list {count} int vertex_indices", *(f"property {kind} b" for kind in after.split())]
    data = ("\n".join(lines) + "\nend_header\n").encode()
    data += b"".join(struct.pack(f"{order}fdf", *corner) for corner in CORNERS)
    letter = {"uchar": "B", "int": "i"}[count]
    for face in faces:
        data += struct.pack(f"{order}{'h' * len(before.split())}", *([7] * len(before.split())))
        data += struct.pack(f"{order}{letter}{len(face)}i", len(face), *face)
        data += struct.pack(f"{order}{'f' * len(after.split())}", *([0.5] * len(after.split())))
    return data


def obj(form, first):
    """Return the ball as an OBJ file whose corners count from `first`."""
    lines = [f"v {x} {y} {z}" for x, y, z in BALL.vertices] + ["# f 0 0 0"]
    lines += ["f " + " ".join(form.replace("{}", str(i + first)) for i in face) for face in BALL.faces.tolist()]
    return ("\n".join(lines) + "\n").encode()


STL, STL_TEXT = BALL.export(file_type="stl"), trimesh.exchange.stl.export_stl_ascii(BALL).encode()
GOOD = {
    "ply": [BALL.export(file_type="ply")],
    "obj": [obj("{}", 1), obj("{}", -len(BALL.vertices))],
    "stl": [STL, STL_TEXT, b"solid by a binary writer".ljust(80) + STL[80:]],
    "vtk": [],
}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_reads_alike(tmp_path, suffix):
    path = tmp_path / f"ball.{suffix}"
    if suffix == "vtk":
        pytest.importorskip("pyvista").wrap(BALL).save(path)
    for data in GOOD[suffix] or [path.read_bytes()]:
        path.write_bytes(data)
        vertices, faces, repairs = read_mesh(path)
        assert (vertices.shape, faces.shape) == ((162, 3), (320, 3))  # STL's soup is merged
        assert not list(repairs.sentences())
        assert trimesh.Trimesh(vertices, faces, process=False).is_watertight


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_files_of_mixed_polygons_are_read(tmp_path, order):
    path = tmp_path / "cube.ply"
    for given in ({}, {"count": "int"}, {"before": "short short"}, {"before": "short", "after": "float"}):
        path.write_bytes(ply(MIXED, order, **given))
        vertices, faces, _ = read_mesh(path)
        cube = trimesh.Trimesh(vertices, faces, process=False)
        assert (len(vertices), len(faces), cube.is_watertight) == (8, 12, True)
        # As the file winds them, before any repair
        raw = trimesh.Trimesh(*read_mixed_polygons(path), process=False)
        assert raw.volume == pytest.approx(1000.0)
        assert cube.volume == pytest.approx(1000.0)
    # Faces of one kind are left to the usual reader.
    for faces in (QUADS, TRIANGLES, [*QUADS, (1, 5, 7, 3)]):
        path.write_bytes(ply(faces, order))
        assert read_mixed_polygons(path) is None


VTK = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET "


def test_polygons_are_cut_into_triangles(tmp_path):
    path = tmp_path / "grid.vtk"
    path.write_text(
        VTK + "UNSTRUCTURED_GRID\nPOINTS 8 float\n0 0 0 9 0 0 9 9 0 0 9 0 0 0 9 9 0 9 9 9 9 0 9 9\n"
        "CELLS 1 9\n8 0 1 2 3 4 5 6 7\nCELL_TYPES 1\n12\n"
    )
    assert read_mesh(path)[1].shape == (12, 3)


# Files that are refused ----------------------------------------------------------------------------------------------

PLY = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
POINTS = "0 0 0\n9 0 0\n0 9 0\n0 0 9\n"
FACES = "3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
TRIANGLE = VTK + "POLYDATA\nPOINTS 3 float\n0 0 0 9 0 0 0 9 0\n"
RUBBISH = np.random.default_rng(0).bytes(2000)
FROM_0 = ": vertex 0; the first vertex of an OBJ file is 1"

MALFORMED = {
    "ply": [
        ("", "0 bytes"),
        ("this is no mesh\n", "no PLY file; it must begin with ply"),
        (PLY.format(4, 4) + POINTS.replace("9 0 0", "nan 0 0", 1) + FACES, "vertex 1 is"),
        (PLY.format(4, 0) + POINTS, "4 points and no faces"),
        (PLY.format(4, 1) + POINTS + "3 0 2 1\n", "1 face; at least 4 are needed"),
        (PLY.format(4, 4) + POINTS + FACES.replace("1 2 3", "1 2 9"), "names vertex 9; allowed: 0 to 3"),
        (PLY.format(4, 4) + POINTS + FACES.replace("1 2 3", "1 2 -1"), "names vertex -1"),
        (PLY.format(4, 4) + "0 0 0\n9 0 0\n5 0 0\n2 0 0\n" + FACES, "0 of 4 faces have an area"),
        (PLY.format(4, 6_000_000) + POINTS, "6000000 faces; at most 5000000"),
        (PLY.format(4, 4) + POINTS.replace("9", "0.009") + FACES, "lengths are in mm"),
        (RUBBISH, None),
        (GOOD["ply"][0][: len(GOOD["ply"][0]) // 2], None),
        (ply(MIXED)[:-3], None),
        (ply(MIXED)[:-30], None),
    ],
    "obj": [
        ("this is no mesh\n", "no faces"),
        ("v 0 0 0\nv inf 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n", "finite|readable"),
        ("v 0 0 0\nv 9 0 0\nv 0 9 0\n", "3 points and no faces"),
        ("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 9\n", "not a readable OBJ"),
        (obj("{}", 0), FROM_0),
        (obj("{}//{}", 0), FROM_0),
        (RUBBISH, None),
    ],
    "stl": [
        ("this is no mesh\n", "no faces|not a readable"),
        (RUBBISH, None),
        (STL[: len(STL) // 2], "holds 159 of the 320 faces that it announces: it is cut short"),
        (STL_TEXT[: len(STL_TEXT) // 2], "has no line endsolid: it is cut short"),
    ],
    "vtk": [
        ("", "0 bytes"),
        ("this is no mesh\n", "no VTK file; its first line must be"),
        (TRIANGLE, "3 points and no faces"),
        (VTK + "STRUCTURED_POINTS\nDIMENSIONS 3 3 3\nORIGIN 0 0 0\nSPACING 1 1 1\n", "PolyData"),
        (TRIANGLE + "POLYGONS 1 4\n3 0 1 9\n", "names vertex 9"),
        (RUBBISH, None),
    ],
    "xyz": [("0 0 0\n", "unknown suffix '.xyz'; allowed: .ply, .obj, .stl, .vtk")],
}


def refused(path, message=None):
    with pytest.raises(InputError, match=message) as error:
        read_mesh(path)
    assert str(error.value).startswith(str(path))
    assert str(error.value).isprintable()


@pytest.mark.parametrize("suffix", MALFORMED)
def test_malformed_and_cut_files_give_one_line(tmp_path, capfd, suffix):
    path = tmp_path / f"mesh.{suffix}"
    refused(path)
    for content, message in MALFORMED[suffix]:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        refused(path, message)
    path.unlink()
    path.mkdir()
    refused(path)
    assert capfd.readouterr() == ("", "")


def test_huge_files_are_refused_by_their_size_alone(tmp_path, monkeypatch):
    path = tmp_path / "ball.obj"
    path.write_bytes(obj("{}", 1))
    monkeypatch.setenv("SIMTEST_LIMITS", "mesh_bytes=1000")
    refused(path, "bytes; at most 1000 are allowed: decimate")


def test_cut_vtk_files_are_refused(tmp_path):
    """VTK itself fills what is missing, and goes on."""
    pyvista = pytest.importorskip("pyvista")
    from vtkmodules.vtkIOLegacy import vtkDataSetWriter

    path, data = tmp_path / "ball.vtk", pyvista.wrap(BALL)
    for kind, text, version in [
        (k, t, v) for k in (data, data.cast_to_unstructured_grid()) for t in (0, 1) for v in (42, 51)
    ]:
        writer = vtkDataSetWriter()
        writer.SetInputData(kind)
        writer.SetFileName(str(path))
        writer.SetFileVersion(version)
        writer.SetFileTypeToASCII() if text else writer.SetFileTypeToBinary()
        writer.Write()
        whole = path.read_bytes()
        assert len(_triangles(str(path))[1]) == 320
        # A file of text that ends before its cells has no faces, which is refused as well.
        for share in (0.8, 0.85, 0.9, 0.95, 0.99):
            path.write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(InputError, match="it is cut short or damaged"):
                _triangles(str(path))
    refused(path, "holds fewer points or cells than it announces: it is cut short")


def test_no_file_of_the_current_folder_runs(tmp_path, monkeypatch):
    """VTK files are read in a child; a module beside the mesh must not stand in for a package there."""
    (tmp_path / "pyvista.py").write_text("from pathlib import Path; Path('ran').touch()")
    (tmp_path / "m.vtk").write_text(TRIANGLE)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="3 points and no faces"):
        make_mesh_surface(AnatomySurface(path=str(Path("m.vtk"))))
    assert not (tmp_path / "ran").exists()
