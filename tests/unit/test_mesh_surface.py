"""A user's mesh: orientation, subdivision, normals and curvatures."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from surface_helpers import angle, hits_on

from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.mesh_surface import LUMEN_QUOTIENT, make_mesh_surface, prepare
from simtest.surfaces.triangles import isoperimetric_quotient

MESHES = Path(__file__).resolve().parents[2].parent / "shared/data/meshes"
COLON, LIVER = MESHES / "colon_edingca_00090.ply", MESHES / "liver_sksurgery.ply"
needs_meshes = pytest.mark.skipif(not COLON.is_file() or not LIVER.is_file(), reason=f"no reference meshes in {MESHES}")


def sphere(radius=10.0, level=4):
    return trimesh.creation.icosphere(level, radius=radius)


def save(mesh, path):
    mesh.export(path)
    return path


def surface(path, **settings):
    return make_mesh_surface(AnatomySurface(path=str(path), **settings))


def test_curvature_of_a_sphere_is_positive_outside_and_negative_inside(tmp_path):
    path = save(sphere(), tmp_path / "ball.ply")
    for kind, sign in (("auto", 1), ("lumen", -1)):
        model = surface(path, kind=kind, subdivisions=0)
        mesh = model.shape().mesh
        assert model.lumen == (kind == "lumen")
        origins, directions, hits, _ = hits_on(mesh, 500, 5.0, 0.2)
        hits.distance[2] = np.inf
        points = model.points(origins, directions, hits)
        # A ray that misses has no point.
        ok = np.arange(500) != 2
        np.testing.assert_array_equal(points.valid, ok)
        np.testing.assert_array_equal(np.isfinite(points.normal).all(axis=1), ok)
        position, normal = points.position[ok], points.normal[ok]
        np.testing.assert_allclose(points.k_min[ok], sign * 0.1, rtol=0.01)
        np.testing.assert_allclose(points.k_max[ok], sign * 0.1, rtol=0.01)
        np.testing.assert_allclose(points.distance[ok], hits.distance[ok])
        np.testing.assert_allclose(position, (origins + hits.distance[:, None] * directions)[ok])
        radial = sign * position / np.linalg.norm(position, axis=1, keepdims=True)
        assert np.degrees(angle(radial, normal)).max() < 0.2
        assert np.abs(np.einsum("ni,ni->n", normal, points.direction_max[ok])).max() < 1e-12
        corners = mesh.vertices[mesh.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("ni,ni->n", cross, mesh.normals[mesh.faces[:, 0]]) > 0).all()


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
