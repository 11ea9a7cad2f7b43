"""Mesh files that are cut, count from 0, or mix polygons: read as what they are, or refused with the cause."""

import re
import struct
import warnings

import numpy as np
import pytest
import trimesh

from simtest.cli.main import MANNERS
from simtest.cli.runs import validate
from simtest.errors import InputError
from simtest.spec import Experiment, Group
from simtest.surfaces.mesh_check import check_mesh
from simtest.surfaces.mesh_file import _triangles, read_mesh, read_mixed_polygons
from simtest.surfaces.mesh_surface import concentration
from simtest.validation.mesh_verdicts import MeshVerdict, mesh_verdicts
from tests.refusals import refused

CORNERS = np.array([[x, y, z] for x in (0, 10) for y in (0, 10) for z in (0, 10)], dtype=float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]
TRIANGLES = [(1, 5, 7), (1, 7, 3)]


def ball():
    return trimesh.creation.icosphere(subdivisions=2, radius=20)


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


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    "given", [{}, {"count": "int"}, {"before": "short short"}, {"before": "short", "after": "float"}]
)
def test_binary_ply_files_of_mixed_polygons_are_read(tmp_path, order, given):
    path = tmp_path / "cube.ply"
    path.write_bytes(ply([*QUADS, *TRIANGLES], order, **given))
    vertices, faces, _ = read_mesh(path)
    assert (len(vertices), len(faces)) == (8, 12)
    cube = trimesh.Trimesh(vertices, faces, process=False)
    assert cube.is_watertight
    assert cube.volume == pytest.approx(1000.0)


@pytest.mark.parametrize("faces", [QUADS, TRIANGLES, [*QUADS, (1, 5, 7, 3)]])
def test_faces_of_one_kind_are_left_to_the_usual_reader(tmp_path, faces):
    path = tmp_path / "cube.ply"
    path.write_bytes(ply(faces))
    assert read_mixed_polygons(path) is None


def test_a_cut_file_of_mixed_polygons_is_refused(tmp_path):
    path = tmp_path / "cube.ply"
    whole = ply([*QUADS, *TRIANGLES])
    for cut in (3, 30):
        path.write_bytes(whole[:-cut])
        refused(lambda: read_mesh(path), "cube.ply: ")


def test_vertex_0_of_an_obj_file_is_refused(tmp_path):
    mesh, path = ball(), tmp_path / "ball.obj"
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in mesh.vertices)
    for form, first, good in (
        ("{}", 0, False),
        ("{}//{}", 0, False),
        ("{}", 1, True),
        ("{}", -len(mesh.vertices), True),
    ):
        corners = [[form.replace("{}", str(index + first)) for index in face] for face in mesh.faces.tolist()]
        path.write_text(points + "# f 0 0 0\n" + "".join(f"f {' '.join(face)}\n" for face in corners))
        if good:
            assert len(read_mesh(path)[1]) == len(mesh.faces)
        else:
            refused(lambda: read_mesh(path), "ball.obj: f ", ": vertex 0; the first vertex of an OBJ file is 1")
    # Ten and a hundred are no zero.
    path.write_text(points + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in mesh.faces if 9 in (a, b, c)))
    read_mesh(path)


def test_cut_stl_files_are_told(tmp_path):
    mesh, path = ball(), tmp_path / "ball.stl"
    whole = mesh.export(file_type="stl")
    path.write_bytes(whole[: len(whole) // 2])
    refused(lambda: read_mesh(path), "holds 159 of the 320 faces that it announces: it is cut short")
    text = trimesh.exchange.stl.export_stl_ascii(mesh)
    path.write_text(text[: len(text) // 2])
    refused(lambda: read_mesh(path), "ball.stl: has no line endsolid: it is cut short")
    for good in (whole, text.encode(), b"solid by a binary writer".ljust(80) + whole[80:]):
        path.write_bytes(good)
        assert len(read_mesh(path)[1]) == 320


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("kind", ["PolyData", "UnstructuredGrid"])
def test_cut_vtk_files_are_refused(tmp_path, kind, text, version):
    """VTK itself fills what is missing, and goes on."""
    import pyvista
    from vtkmodules.vtkIOLegacy import vtkDataSetWriter

    data = pyvista.wrap(ball())
    path, writer = tmp_path / "ball.vtk", vtkDataSetWriter()
    writer.SetInputData(data if kind == "PolyData" else data.cast_to_unstructured_grid())
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


def test_a_cut_vtk_file_is_named(tmp_path):
    import pyvista

    path = tmp_path / "ball.vtk"
    pyvista.wrap(ball()).save(path)
    path.write_bytes(path.read_bytes()[:-3000])
    refused(lambda: read_mesh(path), "ball.vtk: holds fewer points or cells than it announces: it is cut short")


# The verdict in an experiment ------------------------------------------------------------------------------------


def experiment(**values):
    return Experiment(name="x", groups=(Group(scene="anatomy", set=values), Group(scene="plane")))


@pytest.mark.parametrize(("kind", "distance"), [("lumen", 10), ("organ", 40)])
def test_a_mesh_is_judged_at_the_distance_of_its_nearest_viewpoints(tmp_path, kind, distance):
    path = tmp_path / "ball.ply"
    ball().export(path)
    (verdict,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.kind": kind}))
    at_distance = check_mesh(path, distance, concentration(200.0, None), kind)
    assert f"edges of {at_distance.needed_edge_mm:.2g} mm are needed at {distance} mm" in verdict.verdict
    assert at_distance.needed_edge_mm != pytest.approx(
        check_mesh(path, 30.0, concentration(200.0, None), kind).needed_edge_mm, rel=0.05
    )


@pytest.mark.parametrize("alpha", [0.03, 0.15])
def test_a_ggx_lobe_needs_edges_for_its_own_width(tmp_path, alpha):
    path = tmp_path / "ball.ply"
    ball().export(path)
    lobe = {"reflectance.type": "rough_plastic", "reflectance.alpha": alpha}
    (verdict,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.kind": "organ"}, **lobe))
    needed = float(re.search(r"edges of (\S+) mm are needed", verdict.verdict)[1])
    assert needed == pytest.approx(check_mesh(path, 40, concentration(None, alpha), "organ").needed_edge_mm, rel=0.1)


def test_an_experiment_judges_its_mesh_files_once(tmp_path, monkeypatch):
    path = tmp_path / "ball.ply"
    ball().export(path)
    assert mesh_verdicts(experiment()) == []
    assert mesh_verdicts(experiment(**{"surface.path": "liver"})) == []
    (coarse,) = mesh_verdicts(experiment(**{"surface.path": str(path)}))
    assert not coarse.usable
    assert str(coarse).startswith(f"mesh {path}: too coarse: edges of 0.")
    assert str(coarse).endswith(" mm are needed at 40 mm (surface.edge_mm); taken for an organ, camera outside")
    assert coarse.model_dump() == {"file": str(path), "usable": False, "verdict": coarse.verdict}
    (refined,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.edge_mm": "auto"}))
    assert refined.usable
    assert re.fullmatch(
        r"refined to edges of 0\.\d+ mm by surface.edge_mm = auto, at most 0\.\d+ mm are needed at 40 mm; "
        "taken for an organ, camera outside",
        refined.verdict,
    )
    # One that would need more faces than are allowed is not fine enough, and says so.
    monkeypatch.setattr("simtest.surfaces.mesh_surface.MAX_SUBDIVIDED_FACES", 1500)
    (limited,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.edge_mm": "auto"}))
    assert not limited.usable
    assert ": too coarse, 0." in limited.verdict
    # What is no table is told by whoever reads the scene.
    assert mesh_verdicts(experiment(surface=5)) == []
    # A wide lobe needs no fine mesh.
    trimesh.creation.icosphere(subdivisions=5, radius=20).export(path)
    (fine,) = mesh_verdicts(experiment(**{"surface.path": str(path), "reflectance.exponent": 2.0}))
    assert (fine.usable, fine.verdict) == (True, "fine enough; taken for an organ, camera outside")
    # Two lobes of one verdict are told once, and two verdicts of one file both.
    values = {"surface.path": str(path)}
    groups = [Group(scene="anatomy", set={**values, "reflectance.exponent": n}) for n in (2.0, 3.0, 9e4)]
    assert mesh_verdicts(Experiment(name="x", groups=groups[:2])) == [fine]
    both = mesh_verdicts(Experiment(name="x", groups=groups))
    assert [each.usable for each in both] == [True, False]


def test_an_open_tube_that_is_taken_for_an_organ_is_warned_of(tmp_path):
    """Seen from outside it yields fine figures, of the wrong side."""
    path = tmp_path / "tube.ply"
    # Two thirds of a ring, so that its shape is not slender.
    around, along = 40, 60
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, 4, along))
    across = 25 + 12 * np.cos(u)
    points = np.stack([across * np.cos(v), across * np.sin(v), 12 * np.sin(u)], axis=-1).reshape(-1, 3)
    k, ring = np.meshgrid(np.arange(along - 1) * around, np.arange(around), indexing="ij")
    a, b = (k + ring).ravel(), (k + (ring + 1) % around).ravel()
    quads = np.stack([a, b, b + around, a + around], axis=1)
    tube = trimesh.Trimesh(points, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]), process=False)
    tube.export(path)
    values = {"surface.path": str(path), "reflectance.exponent": 2.0}
    (guessed,) = mesh_verdicts(experiment(**values))
    assert not guessed.usable
    assert "taken for an organ, camera outside; open at 2 rims, as a tube is" in guessed.verdict
    assert "surface.kind=lumen" in guessed.verdict
    for kind, side in (("lumen", "a lumen, camera inside"), ("organ", "an organ, camera outside")):
        (stated,) = mesh_verdicts(experiment(**values, **{"surface.kind": kind}))
        assert "rims" not in stated.verdict
        assert f"taken for {side}" in stated.verdict
    # A hole of a scan is no end of a tube.
    holed = ball()
    holed.update_faces((holed.vertices[holed.faces].mean(axis=1)[:, :2] ** 2).sum(axis=1) > 4)
    holed.export(path)
    (organ,) = mesh_verdicts(experiment(**values))
    assert "rims" not in organ.verdict


@pytest.mark.parametrize("quiet", [False, True])
def test_the_command_tells_each_verdict_once(tmp_path, monkeypatch, capsys, quiet):
    monkeypatch.chdir(tmp_path)
    fit, unfit = (
        MeshVerdict(file="a.ply", usable=True, verdict="fine enough"),
        MeshVerdict(file="b.ply", usable=False, verdict="too coarse"),
    )
    monkeypatch.setattr("simtest.validation.mesh_verdicts.mesh_verdicts", lambda _: [fit, unfit])
    monkeypatch.setattr("simtest.api.validate", lambda *_, **__: None)
    monkeypatch.setattr(MANNERS, "quiet", quiet)
    if quiet:
        warnings.simplefilter("ignore")
        validate("overview", out=tmp_path)
    else:
        with pytest.warns(UserWarning, match="mesh b.ply: too coarse"):
            validate("overview", out=tmp_path)
    said = capsys.readouterr().out
    assert said.count("mesh a.ply: fine enough") == 1
    # On the error stream already, unless warnings are left out.
    assert said.count("mesh b.ply: too coarse") == (1 if quiet else 0)
